"""Templates behind a chain, and libraries of currents: layout, and A/E by reboost."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import h5py
import lh5
import numpy as np
import pytest
from lgdo import Array, Scalar, Struct

from cpunet.errors import CpunetError
from cpunet.legend.currents import PEAK, add_rings, currents_about_peak
from cpunet.legend.library_files import make_library
from cpunet.legend.translate_library import (
    TemplateTranslator,
    chosen_libraries,
    known_detector,
    translate_library,
)
from cpunet.pulses.container import Pulses
from cpunet.pulses.loading import load_pulses
from cpunet.pulses.peaks import parse_selection
from cpunet.pulses.reading.files import PulseFile
from cpunet.recipes import load_recipe
from cpunet.simulation import simulator
from cpunet.simulation.geometry_readers import read_detector
from cpunet.simulation.hits import Hits
from cpunet.simulation.settings import SimulationSettings
from cpunet.simulation.simulator import Simulator
from cpunet.training.run import Run
from cpunet.translation.translator import REN
from synthetic import after_pole_and_decay, one_line, sampled, write_chain, write_pulses

R, Z, MM = np.arange(6.0), np.arange(8.0), {"units": "mm"}
WAVEFORMS = ("waveform_000_deg", "waveform_045_deg")
SETTINGS = SimulationSettings(dt_ns=1.0, length_ns=5000.0)
FINE = 8  # samples of the charge to one of a template
POLE = ("generator.poles_ns=[50]", "generator.decay_us=60")


def charge(n_samples: int = 2400) -> np.ndarray:
    """Edges (r, z, samples) that come later outwards; none outside a quarter circle."""
    r, z = np.meshgrid(R, Z, indexing="ij")
    time = np.arange(n_samples)
    middle, width = 500 + 60 * np.hypot(r, z), 12 + r + 0.5 * z
    made = 1 / (1 + np.exp(-(time - middle[..., None]) / width[..., None]))
    made[np.hypot(r, z) > 7.2] = np.nan
    return made


def write(path: Path, waveforms: np.ndarray, name: str = "V01", **more: object) -> Path:
    library = {
        "r": Array(R / 1000, attrs={"units": "m"}),
        "z": Array(Z / 1000, attrs={"units": "m"}),
        "dt": Scalar(1.0, attrs={"units": "ns"}),
        "t0": Scalar(0.0, attrs={"units": "ns"}),
        "waveform_000_deg": Array(waveforms, attrs={"units": ""}),
        "waveform_045_deg": Array(waveforms, attrs={"units": ""}),
    } | more
    library = {key: value for key, value in library.items() if value is not None}
    lh5.write(Struct(library), name, str(path), wo_mode="of")
    return path


@pytest.fixture(scope="module")
def ideal(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write(tmp_path_factory.mktemp("ideal") / "ideal.lh5", charge())


@pytest.fixture(scope="module")
def current(chain: Path, ideal: Path) -> Path:
    """The same behind the chain."""
    translate_library(chain, ideal, ideal.with_name("current.lh5"))
    return ideal.with_name("current.lh5")


@pytest.mark.thorough
def test_currents_about_their_maximum() -> None:
    templates = charge()[0, :3].astype(np.float32)
    found, times = currents_about_peak(templates)
    for template, current, time in zip(templates, found, times, strict=True):
        expected = np.diff(template.astype(float), prepend=0)
        for _ in range(3):
            expected = np.convolve(expected, np.ones(48) / 48)
        assert abs(time - expected.argmax()) <= 0.5
        at = time + np.arange(-300, 301)
        near = np.interp(at, np.arange(len(expected)), expected)
        np.testing.assert_allclose(
            current[PEAK - 300 : PEAK + 301], near, atol=2e-3 * near.max()
        )
        assert current.argmax() == PEAK
    # moved by a fraction of a sample, the current is the same
    later = np.pad(templates, ((0, 0), (1, 0)))[:, :-1]
    shifted = currents_about_peak(0.25 * templates + 0.75 * later)
    assert shifted[1][0] - times[0] == pytest.approx(0.75, abs=0.02)
    np.testing.assert_allclose(shifted[0][0], found[0], atol=3e-4 * found[0].max())
    templates[1, -50] = np.nan  # long after the maximum
    constant = np.full((2, 300), [[0], [np.nan]], np.float32)
    for nothing, wanted in ((constant, [True, True]), (templates, [False, True, False])):
        found, times = currents_about_peak(nothing)
        assert np.isnan(found).all(axis=1).tolist() == wanted
        assert np.isnan(times).tolist() == wanted


def test_rings_go_on_from_the_crystal() -> None:
    r, z = np.meshgrid(np.arange(9.0), np.arange(10.0), indexing="ij")
    plane = 100 + 7 * r - 3 * z
    there = np.hypot(r, z - 5) < 5
    times = np.where(there, plane, np.nan)
    templates = times[..., None].astype(np.float32)
    add_rings(templates, times, 3)
    reached = np.isfinite(times)
    # three rings beyond, on the slope, and all within as it was
    np.testing.assert_allclose(times[reached], plane[reached])
    assert reached.sum() > there.sum()
    np.testing.assert_array_equal(templates[there, 0], plane[there])
    np.testing.assert_array_equal(np.isfinite(templates[..., 0]), reached)


def test_the_layout_is_that_of_production(current: Path) -> None:
    library = lh5.read("V01", str(current))
    arrays = {f"{what}_{a}_deg" for what in ("waveform", "drift_time") for a in ("000", "045")}
    assert set(library) == {"r", "z", "dt", "t0"} | arrays
    assert library["r"].attrs["units"] == "mm"
    np.testing.assert_allclose(library["r"].nda, np.arange(len(R) + 3), atol=1e-9)
    np.testing.assert_allclose(library["z"].nda, np.arange(-3, len(Z) + 3), atol=1e-9)
    assert (library["dt"].value, library["t0"].value) == (1.0, -1000.0)
    currents, times = library["waveform_000_deg"].nda, library["drift_time_000_deg"].nda
    assert currents.shape == (9, 14, 4001)
    assert currents.dtype == np.float32
    there = np.isfinite(times)
    np.testing.assert_array_equal(there, np.isfinite(currents).all(axis=2))
    assert (currents[there].argmax(axis=1) == 1000).all()
    # no cell that reaches into the crystal lacks a corner
    inner = np.isfinite(charge()[..., 0])
    i, j = np.nonzero(inner)
    for di in (0, 1):
        for dj in (2, 3, 4):
            assert there[i + di, j + dj].all()
    # the delay of the electronics, some 100 ns, is taken off; what it is depends on the edge
    assert times[0, 3] == pytest.approx(500, abs=10)
    amplitudes = currents[:6, 3:11][inner][..., PEAK].astype(float)
    assert amplitudes.min() < 1 < amplitudes.max()
    numbers = json.loads(library.attrs["cpunet"])
    assert (numbers["templates"], numbers["translated"]) == (96, 2 * int(inner.sum()))
    assert numbers["rings"] == 3


def test_axes_and_periods_as_others_write_them(chain: Path, tmp_path: Path) -> None:
    # SolidStateDetectors.jl: two nodes about the axis, and a step beyond the end
    nodes = np.array([-1e-8, 1e-8, 1e-3, 2e-3, 3e-3, 3.00000001e-3])
    changes = {"r": Array(nodes, attrs={"units": "m"}), "dt": Array(np.array([1e-3]))}
    source = write(tmp_path / "ideal.lh5", charge(), **changes)
    with h5py.File(source, "a") as file:
        file["V01/dt"].attrs["units"] = np.bytes_(b"us")
    translate_library(chain, source, tmp_path / "psl.lh5")
    library = lh5.read("V01", str(tmp_path / "psl.lh5"))
    assert library["dt"].value == 1
    # the nodes stay within the rings
    np.testing.assert_allclose(library["r"].nda[:-3], 1000 * nodes)
    there = np.isfinite(library["drift_time_000_deg"].nda[:-3, 3:-3])
    assert there[np.isfinite(charge()[..., 0])].all()


def without(waveforms: np.ndarray, which: Any) -> np.ndarray:
    waveforms[which] = np.nan
    return waveforms


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"dt": Scalar(2.0, attrs={"units": "ns"})}, "sampled every 2 ns (dt in 'ns')"),
        ({"dt": Scalar(1.0, attrs={"units": "furlong"})}, "dt in 'furlong'"),
        ({"dt": None}, "no dt with the waveforms"),
        ({"z": Array(np.empty((0, 2)), attrs=MM)}, "z does not ascend"),
        (dict.fromkeys(WAVEFORMS), "no pulse-shape library"),
        (dict.fromkeys(WAVEFORMS, Array(-charge())), "84 of 84 templates end below half"),
        ({"r": Array(R[::-1].copy(), attrs=MM)}, "r does not ascend"),
        ({"z": Array(Z, attrs={"units": "m"})}, "z reaches 7000 mm"),
        ({"r": Array(R, attrs={"units": "inch"})}, "r is in 'inch'"),
        ({"r": Array(np.arange(4.0), attrs=MM)}, "expected numbers of shape (r, z, samples)"),
        ({"waveform_000_deg": Array(without(charge(), 2))}, "1 rows of 000_deg are NaN"),
        ({"waveform_045_deg": Array(without(charge(), np.s_[:]))}, "no template of 045_deg"),
        (
            {"waveform_045_deg": Array(without(charge(), np.s_[2, 1, 2000:]))},
            "1 templates hold NaN among their samples, the first at r 2, z 1 mm",
        ),
        (
            dict.fromkeys(WAVEFORMS, Array(np.diff(charge(), axis=2, prepend=0))),
            "these are currents",
        ),
    ],
)
def test_other_libraries_are_refused_in_one_line(
    chain: Path, tmp_path: Path, change: dict[str, Any], words: str
) -> None:
    source = write(tmp_path / "ideal.lh5", charge(), **change)
    out = tmp_path / "psl.lh5"
    one_line(lambda: translate_library(chain, source, out), words, str(source))
    assert sorted(p.name for p in tmp_path.iterdir()) == ["ideal.lh5"]


def test_a_library_of_another_detector(ideal: Path) -> None:
    with h5py.File(ideal) as file:
        assert chosen_libraries(file, ideal, (), None) == ["V01"]
        assert chosen_libraries(file, ideal, ("V01",), "B02") == ["V01"]
        with pytest.raises(CpunetError, match="trained with a simulation of B02; give the"):
            chosen_libraries(file, ideal, (), "B02")
        with pytest.raises(CpunetError, match="no library of V03; the file has V01"):
            chosen_libraries(file, ideal, ("V03",), None)


def test_what_a_run_tells_of_its_detector(chain: Path, tmp_path: Path) -> None:
    sim, known = tmp_path / "sim.lh5", Run.load(chain)
    assert known_detector(known) is None
    edges = np.repeat([[0.0, 1.0]], [300, 300], axis=1) + np.linspace(0, 1e-6, 60)[:, None]
    pulses = Pulses.of(edges, dt_ns=16, energy_kev=np.full(60, 2614.5))
    recipe = load_recipe("fast")
    fep = parse_selection("FEP", recipe.peaks)
    for told, name in (("no JSON", None), (json.dumps({"detector": {"name": "V01"}}), "V01")):
        write_pulses(sim, pulses, attrs={"simulation": told}, force=True)
        side = load_pulses(PulseFile(sim), "simulated", recipe, fep).provenance()
        sim.unlink()  # what was trained is stored with the run, wherever its file is now
        run = known.model_copy(update={"sim": side, "folder": tmp_path})
        assert known_detector(run) == name
    (tmp_path / "detector.yaml").write_text("name: V02\n")  # of a calibrated run
    assert known_detector(run) == "V02"


def test_single_places_within_are_filled(chain: Path, current: Path, tmp_path: Path) -> None:
    source = write(tmp_path / "ideal.lh5", without(charge(), np.s_[2, 3]))
    told = translate_library(chain, source, tmp_path / "psl.lh5").numbers
    assert told["V01"].healed == 2
    files = tmp_path / "psl.lh5", current
    times, known = (lh5.read("V01/drift_time_000_deg", str(path)).nda for path in files)
    assert times[2, 6] == pytest.approx(known[2, 6], abs=20)  # of 60 from node to node


def test_a_library_is_made(tmp_path: Path) -> None:
    short = {"grid_mm": 12, "settings": {"length_ns": 2400}}
    made_maps = []

    def counted(*given: Any) -> Any:
        made_maps.append(maps(*given))
        return made_maps[-1]

    maps, path = simulator.drift_maps, str(tmp_path / "psl.lh5")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(simulator, "drift_maps", counted)
        done = make_library("ppc", path, **short)
    assert len(made_maps) == 1  # whatever the number of places
    assert "places have a template" in str(done)
    (name,) = lh5.ls(path)
    made = lh5.read(name, path)
    assert {"waveform_000_deg", "drift_time_045_deg"} <= set(made)
    assert made["dt"].value == 1
    assert made["waveform_000_deg"].nda.shape[2] == 2400
    for change, words in (
        ({"grid_mm": 0}, "`grid_mm` is 0"),
        ({"settings": {"dt_ns": 2}}, "dt_ns = 2: templates are sampled every nanosecond"),
        ({"grid_mm": 100}, "0 of 2 places .* 2 give no signal"),
        ({"settings": {"length_ns": 50}}, "[1-9][0-9]* are not collected in time"),
    ):
        with pytest.raises(CpunetError, match=rf"^[^\n]*{words}[^\n]+$"):
            make_library("ppc", tmp_path / "other.lh5", **(short | change))
    assert not (tmp_path / "other.lh5").exists()


@pytest.mark.thorough  # compiles the loops of reboost
def test_reboost_gives_the_a_over_e_of_charges_drifted_one_by_one(
    chain: Path, tmp_path: Path
) -> None:
    """Events of one or two sites at nodes of the grid, where templates need no neighbours."""
    psd, utils = (pytest.importorskip(f"reboost.hpge.{name}") for name in ("psd", "utils"))
    ak, units = (pytest.importorskip(name) for name in ("awkward", "reboost.units"))
    detector, path = read_detector("ppc", ["grid_mm=0.5"]), str(tmp_path / "psl.lh5")
    make_library(detector, tmp_path / "ideal.lh5", grid_mm=2)
    ((name, numbers),) = translate_library(chain, tmp_path / "ideal.lh5", path).numbers.items()
    rng = np.random.default_rng(5)
    counts = np.repeat([1, 2], 60)
    r, z = 2.0 * rng.integers(1, 15, counts.sum()), 2.0 * rng.integers(4, 20, counts.sum())
    offsets = np.concatenate([[0], np.cumsum(counts)])
    hits = Hits.of(np.stack([r, 0 * r, z], axis=1), rng.uniform(300, 900, len(r)), offsets)
    drifted = Simulator(detector, SETTINGS).events(hits).waveforms
    currents, _ = currents_about_peak(TemplateTranslator(REN.load(chain), 1.0)(drifted))
    full = currents[:, PEAK] / numbers.mode_per_ns

    def column(values: Any, unit: str) -> Any:
        return units.attach_units(ak.unflatten(values, counts), unit)

    places = column(r, "mm"), column(0 * r, "mm"), column(z, "mm")
    maps = utils.load_hpge_drift_time_maps(path, name, (0, 45))
    load = getattr(utils, "load_hpge_pulse_shape_library", None)
    load = load or utils.get_hpge_pulse_shape_library
    found = psd.maximum_current(
        column(hits.edep_kev, "keV"),
        psd.drift_time_crystal_axes(*places, maps),
        r=places[0],
        z=places[2],
        template=load(path, name, "waveform_000_deg", out_of_bounds_val=0),
        times=None,
    )
    apart = np.abs(np.asarray(found) / hits.energy_kev / full - 1)
    np.testing.assert_allclose(apart[:60], 0, atol=1e-3)
    # reboost looks every 20 ns first, and may take the lower one of two maxima
    assert (apart[60:] < 2e-3).mean() > 0.9


@pytest.fixture(scope="module")
def plain_chain(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run, sampled every 16 ns, that knows a pole of 50 ns and a decay of 60 µs."""
    return write_chain(tmp_path_factory.mktemp("chain"), *POLE)


@pytest.mark.parametrize("dt_ns", [1.0, 16.0])
def test_a_template_is_responded_to_in_its_place(plain_chain, dt_ns):
    time = (np.arange(int(3000 / dt_ns) * FINE) + 0.5) * dt_ns / FINE
    rise, width = np.array([[450.0], [700.0], [950.0]]), np.array([[60.0], [30.0], [45.0]])
    fine = 1 / (1 + np.exp(-(time - rise) / width))
    charge = sampled(fine, FINE).astype(np.float32)
    translate = TemplateTranslator(REN.load(plain_chain), dt_ns)
    result = translate(charge)
    # the pole was learned at 16 ns, and holds at 1 ns; here by recursion in fine steps
    responded = after_pole_and_decay(fine, dt_ns / FINE, 50.0, 60_000.0, middle=True)
    assert np.abs(result - sampled(responded, FINE)).max() < 1e-3
    # no alignment, no normalisation: half the charge is half the record
    half = translate(0.5 * charge)
    np.testing.assert_allclose(half, 0.5 * result, atol=1e-6)
    assert not translate(np.zeros_like(charge)).any()


@pytest.mark.parametrize("dt_ns", [1.0, 16.0])
def test_stretched_templates_keep_their_begin(plain_chain, tmp_path, dt_ns):
    """They are summed by time, which counts from the begin of the drift."""
    # charges drift for a tenth longer than simulated
    stretch = lambda chain: chain.response.drift.stretch.fill(0.1)  # noqa: E731
    stretched = write_chain(tmp_path / "run", *POLE, "generator.drift_terms=1", change=stretch)
    time = dt_ns * np.arange(int(3000 / dt_ns))

    def drifting(run: Path, long_ns: np.ndarray) -> np.ndarray:
        along = np.clip(time / long_ns[:, np.newaxis], 0, 1)
        charge = (along**3 * (10 - 15 * along + 6 * along**2)).astype(np.float32)
        return TemplateTranslator(REN.load(run), dt_ns)(charge)

    long_ns = np.array([400.0, 900.0, 1700.0])
    found, expected = drifting(stretched, long_ns), drifting(plain_chain, 1.1 * long_ns)
    # the begin is known to a sample, of which a tenth is what it may be off
    steepest = np.abs(np.diff(expected, axis=1)).max()
    assert np.abs(found - expected).max() < 0.2 * steepest + 1e-3
    assert np.abs(drifting(plain_chain, long_ns) - found).max() > 0.05
