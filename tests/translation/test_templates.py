"""Pulse-shape libraries behind a readout chain: place, height and schema, and in reboost."""

from __future__ import annotations

from pathlib import Path

import h5py
import lh5
import numpy as np
import pytest
from lgdo import Array, Scalar, Struct
from torch import nn

from cpunet.errors import CpunetError
from cpunet.legend.make_library import make_library
from cpunet.legend.templates import TemplateTranslator
from cpunet.legend.translate_library import translate_library
from cpunet.networks.response_generator import ResponseGenerator
from cpunet.recipes import load_recipe
from cpunet.simulation.geometry_readers import read_detector
from cpunet.simulation.settings import SimulationSettings
from cpunet.translation.translator import REN
from synthetic import after_pole_and_decay, sampled, write_run

TAU_NS, DECAY_NS = 50.0, 60_000.0
R, Z = np.arange(3.0), np.arange(4.0)
FINE = 8  # samples of the charge to one of a template


def written(folder: Path, *overrides: str, stretch: float = 0.0) -> Path:
    """A run, sampled every 16 ns, that knows a pole of 50 ns and a decay of 60 µs."""
    known = ["generator.poles_ns=[50]", "generator.decay_us=60", *overrides]
    recipe = load_recipe("fast", known)
    generator = ResponseGenerator(recipe.matching.generator, 16.0)
    if generator.response.drift is not None:
        generator.response.drift.stretch.data.fill_(stretch)
    info = {"recipe": "fast", "peak": "FEP", "seed": 0, "dt_ns": 16.0}
    model = nn.ModuleDict({"ren": generator})
    write_run(folder, model, recipe, info | {"seconds": 1.0, "device": "cpu"})
    return folder


@pytest.fixture(scope="module")
def chain(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return written(tmp_path_factory.mktemp("chain"))


@pytest.fixture(scope="module")
def stretched(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The same, and charges drift for a tenth longer than simulated."""
    folder = tmp_path_factory.mktemp("stretched")
    return written(folder, "generator.drift_terms=1", stretch=0.1)


def fine_charge(n_samples: int, dt_ns: float, seed: int = 0) -> np.ndarray:
    """Charge (r, z, samples * FINE) of logistic edges at different times; two are outside."""
    rng = np.random.default_rng(seed)
    shape = (len(R), len(Z), 1)
    time = (np.arange(n_samples * FINE) + 0.5) * dt_ns / FINE
    rise, width = rng.uniform(400, 1000, shape), rng.uniform(30, 60, shape)
    charge = 1 / (1 + np.exp(-(time - rise) / width))
    charge[2, 3] = charge[0, 0] = np.nan
    return charge


def templates(n_samples: int, dt_ns: float) -> np.ndarray:
    return sampled(fine_charge(n_samples, dt_ns), FINE)


def responded(n_samples: int, dt_ns: float) -> np.ndarray:
    """The same behind the pole and the decay, by recursion in fine steps."""
    charge = fine_charge(n_samples, dt_ns)
    fine = after_pole_and_decay(charge, dt_ns / FINE, TAU_NS, DECAY_NS, middle=True)
    return sampled(fine, FINE)


def write(path: Path, waveforms: np.ndarray, dt_ns: float, **more: object) -> Path:
    """A library as simulation workflows write it, with something else beside it."""
    library = {
        "r": Array(R / 1000, attrs={"units": "m"}),
        "z": Array(Z / 1000, attrs={"units": "m"}),  # reboost counts hits in mm
        "dt": Scalar(dt_ns, attrs={"units": "ns"}),
        "t0": Scalar(-3.0, attrs={"units": "ns"}),
        "waveform_000_deg": Array(waveforms, attrs={"units": ""}),
        "waveform_045_deg": Array(waveforms.astype(np.float32), attrs={"units": ""}),
        "drift_time_000_deg": Array(np.ones((3, 4)), attrs={"units": "ns"}),
    } | more
    library = {name: value for name, value in library.items() if value is not None}
    lh5.write(Struct(library, attrs={"made_by": "test"}), "V01", str(path), wo_mode="of")
    return path


@pytest.mark.parametrize("dt_ns", [1.0, 16.0])
def test_a_template_is_responded_to_in_its_place(chain, dt_ns):
    n_samples = int(3000 / dt_ns)
    charge = templates(n_samples, dt_ns)[1].astype(np.float32)
    translate = TemplateTranslator(REN.load(chain), dt_ns)
    result, codes = translate(charge)
    assert not codes.any()
    # the pole was learned at 16 ns, and holds at 1 ns
    assert np.abs(result - responded(n_samples, dt_ns)[1]).max() < 1e-3
    # no alignment, no normalisation: half the charge is half the record
    half, _ = translate(0.5 * charge)
    np.testing.assert_allclose(half, 0.5 * result, atol=1e-6)
    nothing, codes = translate(np.zeros_like(charge))
    assert not nothing.any()
    assert not codes.any()


@pytest.mark.parametrize("dt_ns", [1.0, 16.0])
def test_stretched_templates_keep_their_begin(chain, stretched, dt_ns):
    """They are summed by time, which counts from the begin of the drift."""
    time = dt_ns * np.arange(int(3000 / dt_ns))

    def drifting(long_ns: np.ndarray) -> np.ndarray:
        along = np.clip(time / long_ns[:, np.newaxis], 0, 1)
        return (along**3 * (10 - 15 * along + 6 * along**2)).astype(np.float32)

    long_ns = np.array([400.0, 900.0, 1700.0])
    found, _ = TemplateTranslator(REN.load(stretched), dt_ns)(drifting(long_ns))
    expected, _ = TemplateTranslator(REN.load(chain), dt_ns)(drifting(1.1 * long_ns))
    # the begin is known to a sample, of which a tenth is what it may be off
    steepest = np.abs(np.diff(expected, axis=1)).max()
    assert np.abs(found - expected).max() < 0.2 * steepest + 1e-3
    assert (
        np.abs(TemplateTranslator(REN.load(chain), dt_ns)(drifting(long_ns))[0] - found).max()
        > 0.05
    )


def test_schema_and_all_else_stay(chain, tmp_path):
    charge = templates(1500, 2.0)
    source = write(tmp_path / "psl.lh5", charge, 2.0)
    told = translate_library(chain, source, tmp_path / "ren.lh5").numbers
    assert told["libraries"] == ["V01"]
    assert (told["templates"], told["translated"], told["outside"]) == (24, 20, 4)
    assert told["rejections"] == {}
    # a chain is linear: a library of it is exact for events of many hits
    assert told["linearity"]["events"] == 200
    assert told["linearity"]["largest"] < 1e-5
    before, after = lh5.read("V01", str(source)), lh5.read("V01", str(tmp_path / "ren.lh5"))
    assert before.attrs == after.attrs
    assert set(before) == set(after)
    for name in before:
        assert before[name].attrs == after[name].attrs
        if not name.startswith("waveform"):
            assert np.array_equal(np.asarray(before[name]), np.asarray(after[name]))
    old, new = (x["waveform_000_deg"].nda for x in (before, after))
    assert (new.dtype, new.shape) == (old.dtype, old.shape)
    assert after["waveform_045_deg"].nda.dtype == np.float32
    assert np.array_equal(np.isnan(old), np.isnan(new))
    inside = ~np.isnan(old[..., 0])
    assert np.abs(new - responded(1500, 2.0))[inside].max() < 1e-3
    assert not list(tmp_path.glob(".*"))


def test_libraries_at_any_depth_and_without_t0(chain, tmp_path):
    charge = templates(600, 4.0)
    source = write(tmp_path / "psl.lh5", charge, 4.0, t0=None)
    with h5py.File(source, "a") as file:
        file.copy("V01", "scan/slope_1/dep_1")
    told = translate_library(chain, source, tmp_path / "ren.lh5").numbers
    assert told["libraries"] == ["V01", "scan/slope_1/dep_1"]
    for path in told["libraries"]:
        made = lh5.read(path, str(tmp_path / "ren.lh5"))
        assert made["t0"].value == 0
        assert made["t0"].attrs["units"] == "ns"


@pytest.mark.thorough
def test_reboost_reads_the_translated_library(chain, tmp_path):
    utils = pytest.importorskip("reboost.hpge.utils")
    source = write(tmp_path / "psl.lh5", templates(1500, 2.0), 2.0)
    translate_library(chain, source, tmp_path / "ren.lh5")
    before, after = (
        utils.load_hpge_pulse_shape_libraries(str(tmp_path / name), "V01", (0, 45))
        for name in ("psl.lh5", "ren.lh5")
    )
    for angle in (0, 45):
        np.testing.assert_array_equal(before[angle].t, after[angle].t)
        np.testing.assert_array_equal(before[angle].r, after[angle].r)
        assert before[angle].t_units == after[angle].t_units
        assert before[angle].waveforms.shape == after[angle].waveforms.shape
    assert after[0].t[0] == -3
    # at the same times, the half maximum comes later by about the pole
    halves = [
        x[0].t[np.argmax(x[0].waveforms[1, 1] > 0.5 * x[0].waveforms[1, 1].max())]
        for x in (before, after)
    ]
    assert 30 < halves[1] - halves[0] < 60


@pytest.mark.slow  # ten seconds, in which reboost compiles its own loops
def test_reboost_finds_the_current_amplitude(chain, tmp_path):
    psd, utils = (pytest.importorskip(f"reboost.hpge.{name}") for name in ("psd", "utils"))
    ak = pytest.importorskip("awkward")
    source = write(tmp_path / "psl.lh5", templates(1500, 2.0), 2.0)
    translate_library(chain, source, tmp_path / "ren.lh5", format="currents")
    translate_library(chain, source, tmp_path / "charge.lh5")
    library = utils.load_hpge_pulse_shape_library(
        str(tmp_path / "ren.lh5"), "V01", "waveform_000_deg"
    )
    times = utils.load_hpge_drift_time_maps(str(tmp_path / "ren.lh5"), "V01", (0, 45))[0]
    assert library.t[np.nanargmax(library.waveforms[1, 1])] == 0
    assert np.isnan(library.waveforms[0, 0]).all()
    sites, kev = [(0, 1), (1, 2)], np.array([1500.0, 800.0])
    event = {"edep": [kev.tolist()], "drift_time": [[times.values[s] for s in sites]]}
    amplitude = psd.maximum_current(
        **{name: ak.Array(values) for name, values in event.items()},
        r=ak.Array([[R[i] for i, _ in sites]]),
        z=ak.Array([[Z[j] for _, j in sites]]),
        template=library,
        times=None,
    )
    # the same from the sum of the charges, each left in its place
    charge = lh5.read("V01/waveform_000_deg", str(tmp_path / "charge.lh5")).nda
    whole = sum(e * charge[s] for e, s in zip(kev, sites, strict=True))
    current = np.diff(whole) / 2.0
    for _ in range(3):
        current = np.convolve(current, np.ones(24) / 24, mode="same")
    assert float(amplitude[0]) == pytest.approx(current.max(), rel=2e-3)


@pytest.mark.thorough
def test_a_library_of_our_own(chain, tmp_path):
    utils = pytest.importorskip("reboost.hpge.utils")
    settings = SimulationSettings(dt_ns=4, length_ns=3200, step_ns=2)
    counts = make_library(
        read_detector("ppc", ["grid_mm=0.2"]),
        tmp_path / "psl.lh5",
        settings_file=settings,
        grid_mm=8,
    )
    told = translate_library(chain, tmp_path / "psl.lh5", tmp_path / "ren.lh5").numbers
    assert counts.templates == told["templates"]
    assert counts.written == told["translated"] > 0
    assert counts.outside + counts.late == told["outside"]
    (name,) = told["libraries"]
    for file in ("psl.lh5", "ren.lh5"):
        library = utils.load_hpge_pulse_shape_library(
            str(tmp_path / file), name, "waveform_045_deg"
        )
        inside = library.waveforms[~np.isnan(library.waveforms[..., 0])]
        assert len(inside) > 0
        if file == "psl.lh5":
            np.testing.assert_allclose(inside[:, -1], 1, atol=1e-4)
            assert (np.diff(library.t) == 4).all()
    maps = utils.load_hpge_drift_time_maps(str(tmp_path / "ren.lh5"), name, (0, 45))
    slow, fast = maps[45].values, maps[0].values
    assert np.nanmean(slow - fast) > 0  # charge drifts fastest along <100>


def test_a_network_keeps_the_place_and_height(run, tmp_path):
    charge = templates(700, 16.0)[1].astype(np.float32)
    ren = REN.load(run)
    results, codes = TemplateTranslator(ren, 16.0)(charge)
    assert not codes.any()
    windows = ren.translate(charge, noise=False)
    for template, window, result in zip(charge, windows, results, strict=True):
        at = np.flatnonzero(template < 0.999 * template.max())[-1] + 1
        first = max(0, at - 400)
        np.testing.assert_allclose(
            result[first : at + 400], window[400 - at + first :][: at + 400 - first], atol=1e-5
        )
        assert result[-1] == pytest.approx(window[-1], abs=1e-5)
    half, _ = TemplateTranslator(ren, 16.0)(0.5 * charge)
    np.testing.assert_allclose(half, 0.5 * results, atol=1e-5)


def test_a_network_is_not_linear_and_that_is_told(run, tmp_path):
    source = write(tmp_path / "psl.lh5", templates(700, 16.0), 16.0)
    told = translate_library(run, source, tmp_path / "ren.lh5").numbers
    assert told["linearity"]["largest"] > 1e-4


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"dt": None}, "no dt"),
        ({"dt": Scalar(1.0, attrs={"units": "furlong"})}, "furlong"),
        ({"r": Array(np.arange(5.0), attrs={"units": "mm"})}, "expected (r, z, samples)"),
        ({"waveform_000_deg": None, "waveform_045_deg": None}, "no pulse-shape library"),
    ],
)
def test_other_files_are_refused_in_one_line(chain, tmp_path, change, words):
    source = write(tmp_path / "psl.lh5", templates(300, 8.0), 8.0, **change)
    with pytest.raises(CpunetError) as error:
        translate_library(chain, source, tmp_path / "ren.lh5")
    assert words in str(error.value)
    assert "\n" not in str(error.value)
    assert sorted(p.name for p in tmp_path.iterdir()) == ["psl.lh5"]


def test_currents_are_refused(chain, tmp_path):
    currents = np.diff(templates(300, 8.0), axis=2, prepend=0)
    source = write(tmp_path / "psl.lh5", currents, 8.0)
    with pytest.raises(CpunetError, match="these are currents"):
        translate_library(chain, source, tmp_path / "ren.lh5")


def test_a_network_refuses_another_sampling(run, tmp_path):
    source = write(tmp_path / "psl.lh5", templates(300, 8.0), 8.0)
    with pytest.raises(CpunetError, match="for 16 ns alone"):
        translate_library(run, source, tmp_path / "ren.lh5")
