"""The page of a crystal's pulses holds what simulator, preparation and run give directly."""

from __future__ import annotations

import base64
import json
import re
import sys
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest
import torch
from torch import nn

from cpunet.analysis.explorer import EDGE, TAIL_STEP
from cpunet.analysis.nearest import nearest_pulses
from cpunet.analysis.paired import align_half_maximum
from cpunet.cli.main import main
from cpunet.errors import CpunetError
from cpunet.jobs.common.inputs import InputFile, load_measured
from cpunet.jobs.common.monitor import Monitor
from cpunet.jobs.inspection.explore import explore_runs
from cpunet.jobs.inspection.places import IN_CONTACT, NOT_COLLECTED
from cpunet.networks.positional_unet import PositionalUNet
from cpunet.networks.response_generator import ResponseGenerator
from cpunet.pulses.container import Pulses
from cpunet.pulses.parameters import current_amplitude
from cpunet.pulses.peaks import parse_selection
from cpunet.pulses.preparation import Rejection, prepare
from cpunet.pulses.shape_parameters import all_parameters
from cpunet.pulses.writing import PulseWriter
from cpunet.recipes import load_recipe
from cpunet.simulation.fields import compute_fields
from cpunet.simulation.geometry_readers import read_detector
from cpunet.simulation.settings import SimulationSettings
from cpunet.simulation.signals import hit_signals
from cpunet.training.run_folder import write_run
from cpunet.translation.translator import REN

SMALL = [
    "name=small",
    "crystal_length=14",
    "crystal_radius=10",
    "bottom_taper_length=2",
    "bias_V=600",
    "grid_mm=0.25",
]
DETECTOR = read_detector("ppc", SMALL)
POINTS = 60
INFO = {"peak": "FEP", "seed": 1, "seconds": 1.0, "device": "cpu", "dt_ns": 16.0}


@pytest.fixture(scope="module", autouse=True)
def own_cache(tmp_path_factory: pytest.TempPathFactory) -> Iterator[None]:
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("CPUNET_CACHE", str(tmp_path_factory.mktemp("cache")))
        yield


def write_response(folder: Path, *overrides: str, **info: Any) -> Path:
    """A run of the recipe fast, with the chain that the overrides name."""
    recipe = load_recipe("fast", overrides)
    info = INFO | {"recipe": "fast"} | info
    folder.mkdir(parents=True)
    generator = ResponseGenerator(recipe.generator, float(info["dt_ns"]))
    write_run(folder, nn.ModuleDict({"ren": generator}), recipe, info)
    return folder


@pytest.fixture(scope="module")
def runs(tmp_path_factory: pytest.TempPathFactory) -> list[Path]:
    folder = tmp_path_factory.mktemp("runs")
    return [
        write_response(
            folder / f"run{n}", f"generator.poles_ns=[{pole}, 30]", "generator.decay_us=80"
        )
        for n, pole in enumerate((45, 50, 58))
    ]


@pytest.fixture(scope="module")
def data(runs: list[Path], tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Translated pulses of random places, noisy, as traces of a digitiser."""
    rng = np.random.default_rng(4)
    r, z = rng.uniform(1.5, 8, 150), rng.uniform(3, 12, 150)
    windows = direct_pulses(r, z)
    translated = REN.load(runs[1]).apply(windows, noise=False)
    tail = translated[:, -1:] * np.exp(-np.arange(1, 201) * 16 / 80_000)
    whole = np.hstack([np.zeros((len(r), 200)), translated, tail])
    noisy = 8000 + 4e4 * (whole + rng.normal(0, 1e-3, whole.shape))
    path = tmp_path_factory.mktemp("data") / "raw.lh5"
    kev = np.where(np.arange(len(r)) % 3 == 2, 1000.0, 2614.5)
    with PulseWriter(path, table="geds/raw", waveform_units="ADC") as writer:
        writer.append(
            Pulses.of(noisy, dt_ns=16, energy_kev=kev, event_number=7 * np.arange(len(r)))
        )
    return path


def direct_pulses(r: npt.ArrayLike, z: npt.ArrayLike) -> npt.NDArray[np.float32]:
    """Prepared pulses of deposits at these places, straight from the simulator."""
    signals = hit_signals(
        compute_fields(DETECTOR), r, np.zeros(np.shape(r)), z, 1.0, SimulationSettings()
    )
    assert signals.collected.all()
    pulses = Pulses.of(signals.waveforms, dt_ns=16)
    return prepare(pulses, load_recipe("fast").preparation, "simulated").pulses.waveforms


def content(page: Path) -> dict[str, Any]:
    text = page.read_text(encoding="utf-8")
    (found,) = re.findall(
        r'<script type="application/json" id="view-data">(.*?)</script>', text
    )
    return json.loads(found)


def unpacked(packed: dict[str, Any]) -> npt.NDArray[np.float64]:
    numbers = np.frombuffer(base64.b64decode(packed["data"]), "<i2").reshape(packed["shape"])
    return np.where(numbers == -32768, np.nan, numbers * packed["scale"])


def places_with_pulse(told: dict[str, Any]) -> tuple[npt.NDArray[Any], npt.NDArray[Any]]:
    kept = np.array(told["row"]) >= 0
    assert [row for row in told["row"] if row >= 0] == list(range(kept.sum()))
    return np.array(told["r_mm"])[kept], np.array(told["z_mm"])[kept]


def drawn(windows: npt.NDArray[np.float32]) -> npt.NDArray[np.float64]:
    aligned = align_half_maximum(windows, EDGE, 400)
    return np.hstack([aligned[:, : 2 * EDGE], aligned[:, 2 * EDGE :: TAIL_STEP]])


def test_pulses_are_those_of_the_simulator_and_the_run(runs, tmp_path):
    summary = explore_runs(runs[:1], DETECTOR, tmp_path / "page.html", points=POINTS)
    told = content(tmp_path / "page.html")
    r, z = places_with_pulse(told)
    assert summary["shown"] == len(r) > 40
    ideal = direct_pulses(r, z)
    translated = REN.load(runs[0]).apply(ideal, noise=False)
    recipe = load_recipe("fast")
    for side, windows in (("ideal", ideal), ("ren", translated)):
        np.testing.assert_allclose(unpacked(told[side]["wave"]), drawn(windows), atol=3e-5)
        truth = all_parameters(Pulses.of(windows, dt_ns=16), recipe.preparation, recipe.scores)
        for name, values in told[side]["numbers"].items():
            np.testing.assert_allclose(values, truth[name], atol=0.051)
        np.testing.assert_allclose(
            told[side]["numbers"]["current_amplitude"], truth["current_amplitude"], atol=6e-6
        )
    assert "band" not in told["ren"]
    assert told["measured"] is None
    assert "spread" not in told["ren"]


def test_places_without_a_pulse_are_there_and_counted_by_reason(runs, tmp_path):
    summary = explore_runs(runs[:1], DETECTOR, tmp_path / "page.html", points=POINTS)
    told = content(tmp_path / "page.html")
    r, z, row = (np.array(told[name]) for name in ("r_mm", "z_mm", "row"))
    assert summary["places"] == len(r)
    assert abs(len(r) - POINTS) < 0.25 * POINTS
    assert DETECTOR.inside(r, z).all()
    fields, nowhere = compute_fields(DETECTOR), np.zeros(len(r))
    signals = hit_signals(fields, r, nowhere, z, 1.0, SimulationSettings())
    np.testing.assert_array_equal(row >= 0, signals.valid)
    assert not DETECTOR.active(r, z)[row < 0].any()
    counts = Counter(told["reasons"][i] for i in told["reason"] if i >= 0)
    assert counts == summary["left_out"] == {IN_CONTACT: int((row < 0).sum())}
    assert f"{counts[IN_CONTACT]} {IN_CONTACT}" in told["notes"][0]


def test_charge_that_does_not_arrive_in_the_record_is_a_reason(runs, tmp_path):
    summary = explore_runs(
        runs[:1],
        DETECTOR,
        tmp_path / "page.html",
        points=POINTS,
        settings=SimulationSettings(length_ns=160),
    )
    assert 0 < summary["left_out"][NOT_COLLECTED] < summary["places"]
    assert summary["shown"] + sum(summary["left_out"].values()) == summary["places"]


def test_what_a_run_cannot_translate_is_a_reason(runs, tmp_path, monkeypatch):
    whole = explore_runs(runs[:1], DETECTOR, tmp_path / "whole.html", points=POINTS)
    translate = REN.apply_with_codes

    def fails(self: REN, windows: Any, *more: Any) -> Any:
        result, codes = translate(self, windows, *more)
        result[[3, 8]], codes[[3, 8]] = np.nan, Rejection.NAN
        return result, codes

    monkeypatch.setattr(REN, "apply_with_codes", fails)
    summary = explore_runs(runs[:2], DETECTOR, tmp_path / "page.html", points=POINTS)
    assert summary["left_out"]["not translated by run0: nan"] == 2
    assert summary["shown"] == whole["shown"] - 2
    told, before = (content(tmp_path / name) for name in ("page.html", "whole.html"))
    kept = np.delete(np.arange(whole["shown"]), [3, 8])
    np.testing.assert_array_equal(
        unpacked(told["ideal"]["wave"]), unpacked(before["ideal"]["wave"])[kept]
    )
    assert np.isfinite(unpacked(told["ren"]["wave"])).all()


def test_several_runs_have_a_mean_and_a_band(runs, tmp_path):
    explore_runs(runs, DETECTOR, tmp_path / "page.html", points=POINTS)
    told = content(tmp_path / "page.html")
    ideal = direct_pulses(*places_with_pulse(told))
    windows = [REN.load(run).apply(ideal, noise=False) for run in runs]
    by_run = np.stack([drawn(w) for w in windows])
    np.testing.assert_allclose(unpacked(told["ren"]["wave"]), by_run.mean(axis=0), atol=3e-5)
    low, high = (unpacked(packed) for packed in told["ren"]["band"])
    np.testing.assert_allclose(low, by_run.min(axis=0), atol=3e-5)
    np.testing.assert_allclose(high, by_run.max(axis=0), atol=3e-5)
    amplitudes = np.array([current_amplitude(w) for w in windows])
    np.testing.assert_allclose(
        told["ren"]["spread"]["current_amplitude"], amplitudes.std(axis=0, ddof=1), atol=1e-6
    )
    # the current's band is of the smoothed current, whose maximum is the amplitude: at most,
    # since it is drawn sample by sample
    low, high = (unpacked(packed).max(axis=1) for packed in told["ren"]["current_band"])
    for band, amplitude in ((low, amplitudes.min(axis=0)), (high, amplitudes.max(axis=0))):
        assert np.all(band < 1.001 * amplitude)
        assert np.all(band > 0.95 * amplitude)


def test_measured_neighbours_are_the_nearest_of_the_training_energies(runs, data, tmp_path):
    summary = explore_runs(
        runs, DETECTOR, tmp_path / "page.html", data=InputFile(data), points=POINTS
    )
    told = content(tmp_path / "page.html")
    recipe = load_recipe("fast")
    selection = parse_selection("FEP", recipe.peaks)
    measured = load_measured(InputFile(data), recipe, selection, Monitor()).prepared.pulses
    assert summary["measured"] == len(measured) <= 100
    ideal = direct_pulses(*places_with_pulse(told))
    edges = np.mean(
        [align_half_maximum(REN.load(run).apply(ideal, noise=False), 100, 100) for run in runs],
        axis=0,
    )
    others = align_half_maximum(measured.waveforms, 100, 100)
    rms = np.sqrt(((edges[:, None] - others) ** 2).mean(axis=2))
    best = np.argsort(rms, axis=1)[:, :3]
    page = told["measured"]
    events = np.array(page["event_number"])
    np.testing.assert_array_equal(events[page["nearest"]], measured.event_number[best])
    np.testing.assert_allclose(page["rms"], np.take_along_axis(rms, best, 1), atol=1e-5)
    assert len(events) == len(set(events)) == summary["drawn"] == len(np.unique(best))
    first = np.searchsorted(measured.event_number, events)
    np.testing.assert_allclose(
        unpacked(page["wave"]), drawn(measured.waveforms[first]), atol=4e-5
    )


def test_a_pulse_finds_itself_and_those_without_an_edge_are_counted():
    time = np.arange(300.0)
    pulses = np.array([1 / (1 + np.exp((150.3 - time) / w)) for w in np.linspace(2, 9, 700)])
    measured = np.vstack([np.ones((1, 300)), pulses])
    found = nearest_pulses(align_half_maximum(pulses, 50, 50), measured, 1)
    np.testing.assert_array_equal(found.index[:, 0], np.arange(1, 701))
    assert found.unaligned == 1
    assert found.rms.max() < 1e-3


def test_a_network_can_be_explored(tmp_path):
    recipe = load_recipe("paper", ["generator.width=2"])
    torch.manual_seed(0)
    network = PositionalUNet(recipe.generator, recipe.preparation.length)
    folder = tmp_path / "network"
    folder.mkdir()
    write_run(folder, nn.ModuleDict({"ren": network}), recipe, INFO | {"recipe": "paper"})
    summary = explore_runs([folder], DETECTOR, tmp_path / "page.html", points=20)
    assert summary["shown"] > 10


def test_the_largest_page_is_below_5_mb(runs, data, tmp_path):
    out = tmp_path / "page.html"
    summary = explore_runs(runs, DETECTOR, out, data=InputFile(data), points=600)
    assert summary["shown"] > 450
    assert out.stat().st_size == summary["bytes"] < 5e6


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"runs": []}, "no run"),
        ({"runs": ["nowhere"]}, "nowhere: no finished run"),
        ({"runs": ["run0", "at10"]}, "at10: .*every 10 ns, .*run0 every 16 ns"),
        ({"runs": ["run0", "short"]}, "short: .*another preparation"),
        ({"runs": ["run0", "dep"], "data": True}, "dep: trained on DEP"),
        ({"runs": ["at10"], "data": True}, "raw.lh5: sampled every 16 ns"),
        ({"settings": SimulationSettings(dt_ns=8)}, "settings: dt_ns = 8"),
        ({"settings": SimulationSettings(step_ns=1, length_ns=16)}, "none of .* places"),
        ({"points": 7}, "--points 7"),
        ({"detector": DETECTOR.model_copy(update={"bias_V": 1.0})}, "does not deplete"),
    ],
)
def test_what_does_not_go_together_is_told_in_a_line(
    runs, data, tmp_path, change: dict[str, Any], words: str
):
    write_response(tmp_path / "at10", dt_ns=10.0)
    write_response(tmp_path / "short", "preparation.samples_after=390")
    write_response(tmp_path / "dep", peak="DEP")
    (tmp_path / "run0").symlink_to(runs[0])
    chosen = [tmp_path / name for name in change.pop("runs", ["run0"])]
    detector = change.pop("detector", DETECTOR)
    if change.pop("data", False):
        change["data"] = InputFile(data)
    before = sorted(tmp_path.iterdir())
    with pytest.raises(CpunetError, match=words) as told:
        explore_runs(chosen, detector, tmp_path / "page.html", **{"points": POINTS} | change)
    assert "\n" not in str(told.value)
    assert sorted(tmp_path.iterdir()) == before


def test_the_simulation_follows_the_sampling_of_the_run(tmp_path):
    run = write_response(tmp_path / "run", dt_ns=12.5)
    settings = SimulationSettings(diffusion=False)
    explore_runs([run], DETECTOR, tmp_path / "page.html", points=20, settings=settings)
    assert content(tmp_path / "page.html")["dt_ns"] == 12.5


def test_an_existing_page_is_kept_and_a_failure_leaves_nothing(runs, tmp_path, monkeypatch):
    out = tmp_path / "page.html"
    out.write_text("mine")
    with pytest.raises(CpunetError, match="exists already"):
        explore_runs(runs[:1], DETECTOR, out, points=20)

    def fails(*_: Any) -> str:
        raise CpunetError("stopped")

    with monkeypatch.context() as patch:
        patch.setattr("cpunet.jobs.inspection.explore.explorer_page", fails)
        with pytest.raises(CpunetError, match="stopped"):
            explore_runs(runs[:1], DETECTOR, out, points=20, force=True)
    assert [path.name for path in tmp_path.iterdir()] == ["page.html"]
    assert out.read_text() == "mine"
    explore_runs(runs[:1], DETECTOR, out, points=20, force=True)
    assert out.read_text(encoding="utf-8").startswith("<!doctype html>")


def test_text_in_the_data_cannot_end_its_element(runs, tmp_path):
    named = DETECTOR.model_copy(update={"name": "</script><b>x"})
    explore_runs(runs[:1], named, tmp_path / "page.html", points=20)
    text = (tmp_path / "page.html").read_text(encoding="utf-8")
    assert "<b>x" not in text
    assert content(tmp_path / "page.html")["detector"] == "</script><b>x"


def command(monkeypatch: pytest.MonkeyPatch, *words: object) -> Any:
    monkeypatch.setattr(sys, "argv", ["cpunet", *map(str, words)])
    with pytest.raises(SystemExit) as stop:
        main()
    return stop.value.code


def test_the_command(runs, data, tmp_path, monkeypatch, capsys):
    values = [word for value in SMALL for word in ("--set", value)]
    out = tmp_path / "page.html"
    words = ["explore", *runs, "--detector", "ppc", *values, "--points", 20, "--out", out]
    assert command(monkeypatch, *words, "--data", data) == 0
    assert "measured ones beside them" in " ".join(capsys.readouterr().out.split())
    assert content(out)["runs"] == ["run0", "run1", "run2"]
    assert command(monkeypatch, "explore", runs[0], "--detector", "none", "--out", out) == 2
    assert "detector none: neither a file nor one of bege" in capsys.readouterr().err
