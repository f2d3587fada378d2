"""A run as parameters of LEGEND's chain, two numbers in place of it, and the lithium layer."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import lh5
import numpy as np
import pytest
import yaml

from cpunet.electronics.exponentials import Exponentials
from cpunet.errors import CpunetError
from cpunet.legend.export import (
    current_delay_ns,
    equivalent_kernel,
    export_legend,
    kernel_step,
)
from cpunet.legend.lithium import LithiumLayer, arrived, lithium_table
from cpunet.networks.generators import ResponseGenerator
from synthetic import write_chain

MEAN = {"a": -1.5e-6, "b": 1.0024, "per_mev_percent": -0.15, "per_mev_error_percent": 0.02}
LAW = {"a": 2e-5, "b": 6.0, "c": 2.0}
METHOD = {"mean": MEAN, "resolution": LAW, "points": [], "scale": 0.08}


@pytest.fixture(scope="module")
def chain(tmp_path_factory: pytest.TempPathFactory) -> Path:
    def slow(chain: ResponseGenerator) -> None:
        chain.response.slow_weights[2] = 0.03

    settings = ("generator.poles_ns=[45,30]", "generator.decay_us=60")
    return write_chain(tmp_path_factory.mktemp("chain"), *settings, change=slow)


def test_a_stretched_drift_is_not_in_the_parameters(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    stretch = lambda chain: chain.response.drift.stretch.fill(0.08)  # noqa: E731
    run = write_chain(tmp_path / "run", "generator.drift_terms=1", change=stretch)
    told = export_legend(run, tmp_path / "pars")
    assert any("charges drift for 8.0 % longer than simulated" in n for n in caplog.messages)
    assert told.content["electronics"]["chain"]["drift_stretch"] == pytest.approx(0.08)


def report(folder: Path, **changes: Any) -> Path:
    folder.mkdir()
    metrics = {
        "training": {"recipe": "fast", "peak": "FEP", "seed": 0},
        "ae_energy": {"multi_site": False, "methods": {"data": METHOD, "ren": METHOD}},
    }
    (folder / "metrics.json").write_text(json.dumps(metrics | changes))
    return folder


def read(path: Path) -> Any:
    return yaml.safe_load(path.read_text())


def test_files_of_production(chain: Path, tmp_path: Path) -> None:
    out = tmp_path / "pars"
    told = export_legend(chain, out, detector="V01", report=report(tmp_path / "report"))
    assert {p.name for p in out.glob("*.yaml")} == {
        "elecmod.yaml",
        "aoemeanmod.yaml",
        "aoeresmod.yaml",
        "cpunet.yaml",
        "response.yaml",
    }
    electronics = read(out / "elecmod.yaml")["V01"]
    assert set(electronics) == {"sigma", "tau"}
    assert 10 < electronics["sigma"] < 40 < electronics["tau"] < 90
    # the expressions are evaluated by production with x in keV
    mean = read(out / "aoemeanmod.yaml")["V01"]["psl"]
    assert eval(mean["expression"], {}, {"x": 1592.5} | mean["pars"]) == pytest.approx(
        1, abs=1e-4
    )
    width = read(out / "aoeresmod.yaml")["V01"]
    assert width == {"expression": "SigmaFit", "parameters": LAW}
    whole = read(out / "cpunet.yaml")
    assert whole == json.loads(json.dumps({told.detector: told.content}))
    assert whole["V01"]["electronics"]["chain"]["pole_1_ns"] == pytest.approx(45)
    assert whole["V01"]["electronics"]["equivalent"]["late_charge_percent"] > 0.5
    assert 40 < whole["V01"]["drift_time"]["current_maximum_delay_ns"] < 80
    with pytest.raises(CpunetError, match="exists already"):
        export_legend(chain, out)
    # without a report, what is known of A/E is nothing; old files of the kind go
    told = export_legend(chain, out, force=True)
    assert told.detector == "default"
    assert sorted(p.name for p in out.glob("*.yaml")) == [
        "cpunet.yaml",
        "elecmod.yaml",
        "response.yaml",
    ]
    numbers = read(out / "response.yaml")["default"]["numbers"]
    head, line = (out / "response.csv").read_text().splitlines()
    row = dict(zip(head.split(","), line.split(","), strict=True))
    assert float(row["rise_10_90_ns"]) == numbers["rise_10_90_ns"]["value"]


def test_a_width_without_noise_is_not_exported(chain, tmp_path, caplog) -> None:
    silent = METHOD | {"resolution": LAW | {"b": 0.0}}
    found = {"multi_site": True, "methods": {"data": silent, "ren": METHOD}}
    given = report(tmp_path / "report", ae_energy=found)
    export_legend(chain, tmp_path / "pars", report=given)
    assert not (tmp_path / "pars" / "aoeresmod.yaml").exists()
    assert (tmp_path / "pars" / "aoemeanmod.yaml").exists()
    assert any("b = 0" in note for note in caplog.messages)


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"training": {"recipe": "fast", "peak": "SEP", "seed": 0}}, "of a run with peak SEP"),
        ({"ae_energy": {"missing": "two few events"}}, "no A/E against energy: two few"),
        ({"ae_energy": 3, "training": None}, "give the folder that `cpunet validate` made"),
        ({"ae_energy": None}, "give the folder that `cpunet validate` made"),
        (
            {"ae_energy": {"methods": {"data": METHOD}}},
            "give the folder that `cpunet validate`",
        ),
    ],
)
def test_other_reports_are_refused(
    chain: Path, tmp_path: Path, changes: dict[str, Any], words: str
) -> None:
    with pytest.raises(CpunetError) as error:
        export_legend(chain, tmp_path / "pars", report=report(tmp_path / "report", **changes))
    assert words in str(error.value)
    assert "\n" not in str(error.value)
    assert not (tmp_path / "pars").exists()


class KernelStep:
    """What is known of a chain, of Gaussian ⊗ exponential."""

    def step(self, time_ns: np.ndarray) -> np.ndarray:
        return kernel_step(time_ns, 30.0, 90.0)


def test_a_step_of_both() -> None:
    time = np.arange(-2000.0, 4000.0)
    gauss = np.exp(-0.5 * (np.arange(-600, 601) / 30.0) ** 2)
    step = np.convolve(1 - np.exp(-np.maximum(time, 0) / 90), gauss / gauss.sum(), "same")
    inner = slice(700, -700)
    np.testing.assert_allclose(kernel_step(time, 30.0, 90.0)[inner], step[inner], atol=2e-5)


def test_a_chain_that_is_one_is_found() -> None:
    found = equivalent_kernel(KernelStep())  # type: ignore[arg-type]
    assert found.sigma_ns == pytest.approx(30, abs=0.05)
    assert found.tau_ns == pytest.approx(90, abs=0.1)
    assert found.prompt_share == pytest.approx(1, abs=1e-3)
    assert found.current_error_percent < 0.05
    assert abs(found.late_charge_percent) < 1e-3
    assert found.ae_error_percent < 0.05


def test_what_two_numbers_cannot_follow_is_told() -> None:
    fast = Exponentials.low_pass(45.0) * Exponentials.low_pass(30.0)
    slow = fast * Exponentials.mixed(0.06, 800.0)
    without, found = equivalent_kernel(fast), equivalent_kernel(slow)
    # half of the slow charge is still to come when the peak is over by 500 ns
    assert found.late_charge_percent == pytest.approx(6 * np.exp(-500 / 800), abs=0.8)
    assert abs(without.late_charge_percent) < 0.1
    assert found.prompt_share < without.prompt_share
    assert 40 < current_delay_ns(fast) < 75


def test_what_arrives_in_the_end() -> None:
    # without recombination the chance is the share of the way; with it everywhere, sinh
    depth = np.array([0.1, 0.33, 0.75])
    late = [1e7]
    free = arrived(LithiumLayer(1.0, recombination_depth_mm=0.0), depth, late)[:, 0]
    np.testing.assert_allclose(free, depth, atol=1e-6)
    layer = LithiumLayer(1.0, recombination_depth_mm=1.0, lifetime_ns=2000.0)
    length = np.sqrt(290e-7 * 2000)
    expected = np.sinh(depth / length) / np.sinh(1 / length)
    np.testing.assert_allclose(arrived(layer, depth, late)[:, 0], expected, rtol=1e-3)


def test_when_it_arrives() -> None:
    layer, time = LithiumLayer(1.0, recombination_depth_mm=0.0), np.arange(40_000.0)
    share = arrived(layer, [0.6, 0.98, 1.0, 3.0], time)
    assert (np.diff(share, axis=1) >= -1e-12).all()
    np.testing.assert_allclose(share[2:], 1)
    # mean time of those that arrive, from 0.6 of the way: (1 - 0.36) L²/6D
    coming = np.diff(share[0])
    mean = (coming * (time[1:] - 0.5)).sum() / coming.sum()
    assert mean == pytest.approx(0.64 / 6 / 290e-7, rel=0.01)
    # near the boundary, as from a wall in an endless layer
    from scipy.special import erfc

    early = np.array([100.0, 400.0])
    near = arrived(layer, [0.98], early)[0]
    np.testing.assert_allclose(near, erfc(0.02 / np.sqrt(4 * 290e-7 * early)), atol=3e-3)


@pytest.mark.slow  # compiles reboost's model
def test_reboosts_model() -> None:
    surface = pytest.importorskip("reboost.hpge.surface")
    layer, time = LithiumLayer(1.0), np.arange(10_001.0)
    depth = np.array([0.5, 0.7, 0.9])
    found = arrived(layer, depth, time)
    for share, mm in zip(found, depth, strict=True):
        # in cells of 10 µm and steps of 1 ns
        theirs = surface.get_surface_response(1000, init=1000 * mm)
        np.testing.assert_allclose(share[1:], theirs[: len(share) - 1], atol=0.01)


@pytest.mark.parametrize(
    ("numbers", "words"),
    [
        ((0.0,), "thickness_mm is 0.0"),
        ((1.0, 2.0), "down to 2.0 mm of 1.0"),
        ((1, 0.5, -3), "-3"),
    ],
)
def test_numbers_without_a_meaning(numbers: tuple[float, ...], words: str) -> None:
    with pytest.raises(CpunetError, match=words):
        LithiumLayer(*numbers)


@pytest.mark.slow
def test_the_file_serves_reboosts_surface_model(tmp_path: Path) -> None:
    psd = pytest.importorskip("reboost.hpge.psd")
    told = lithium_table(LithiumLayer(1.0), tmp_path / "lithium.lh5")
    assert 0.5 < told.dead_mm < 0.8
    made = lh5.read("lithium", str(tmp_path / "lithium.lh5"))
    assert made["arrived"].nda.shape == (10_000, 100)
    np.testing.assert_array_equal(made["activeness"].nda, made["arrived"].nda[-1])
    template = np.exp(-0.5 * ((np.arange(4001.0) - 1000) / 40) ** 2)
    columns = psd.make_convolved_surface_library(template, made["arrived"].nda)
    highest = columns.max(axis=0)
    # the deeper, the nearer to the bulk's current; near the surface nothing
    assert highest[-1] == pytest.approx(1)
    assert highest[2] < 0.01
    assert (np.diff(highest[20:]) > 0).all()
    with pytest.raises(CpunetError, match="exists already"):
        lithium_table(LithiumLayer(1.0), tmp_path / "lithium.lh5")
    with pytest.raises(CpunetError, match="give a thicker one"):
        lithium_table(LithiumLayer(0.005, 0.001), tmp_path / "x.lh5")
