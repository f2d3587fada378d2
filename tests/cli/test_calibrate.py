"""``cpunet calibrate``: a detector that is 3 K warmer than it was simulated."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import cpunet
from cpunet.simulation.geometry_readers import read_detector

# Pulses of the peak, on each side: as few as a fit takes, and enough for a small error.
FEW, ENOUGH = 240, 420
# A readout of few numbers, and a chain that can describe it.
READOUT = {
    "slow": {"fraction": 0.065, "tau_ns": 400.0},
    "decays": [{"fraction": 1.0, "tau_us": 80.0}],
}
PLAIN = (
    "generator.slow_ns=[400]",
    "generator.fast_decays_us=[]",
    "training.ringing_mhz=[]",
    "training.start_factors=[1]",
    "training.steps=5",
)


def make_stand(out: Path, full_energy: int, **readout: object) -> Path:
    """A small stand; made by the package's own job, in this process."""
    cpunet.make_stand(
        out,
        detector="ppc",
        events={"FEP": full_energy, "DEP": 60},
        shift={"temperature_K": 3},
        settings=readout,
        seed=3,
    )
    return out


def calibrate(stand: Path, run: Path, *overrides: str) -> Path:
    from cpunet.jobs.calibration.calibrate import Calibration
    from cpunet.jobs.calibration.calibration_inputs import Freedom, Start
    from cpunet.pulses.reading.files import PulseFile
    from cpunet.recipes import load_recipe

    Calibration(
        Start(sim=PulseFile(stand / "sim.lh5")),
        PulseFile(stand / "data.lh5"),
        load_recipe("fast", overrides),
        Freedom.of("temperature", "", []),
    ).run(run)
    return run


@pytest.fixture(scope="module")
def stand(tmp_path_factory) -> Path:
    return make_stand(tmp_path_factory.mktemp("calibrate") / "stand", FEW, **READOUT)


@pytest.fixture(scope="module")
def calibrated(stand, tmp_path_factory) -> Path:
    """A search of one short round, for a chain of few parameters."""
    with pytest.MonkeyPatch.context() as patch:
        for name, few in {"ROUNDS": 1, "STEPS": 6, "FIRST_STEPS": 8}.items():
            patch.setattr(f"cpunet.calibration.search.{name}", few)
        return calibrate(stand, tmp_path_factory.mktemp("calibrated") / "run", *PLAIN)


def require_temperature(run: Path) -> dict[str, Any]:
    """What is told of the temperature, which must be near the true one."""
    told = json.loads((run / "calibration.json").read_text())
    temperature = told["parameters"]["temperature_K"]
    simulated = read_detector("ppc").temperature_K
    assert temperature["simulated"] == simulated
    assert temperature["error"] > 0
    assert abs(temperature["value"] - simulated - 3) < 3.5 * temperature["error"]
    chi = told["chi_square"]
    assert chi["after"] < chi["before"]
    assert len(told["pulls"]["after"]) == chi["moments"]
    assert told["directions"][0]["components"] == {"temperature_K": 1.0}
    names = told["covariance"]["names"]
    assert np.shape(told["covariance"]["matrix"]) == (len(names), len(names))
    assert len(told["profiles"]["temperature_K"]["chi_square"]) == 5
    for name in ("profiles", "pulls", "directions"):
        assert (run / f"{name}.png").stat().st_size > 1000
    return told


def test_the_temperature_is_found(calibrated):
    require_temperature(calibrated)


@pytest.mark.slow
def test_the_temperature_is_found_with_a_small_error(tmp_path):
    told = require_temperature(
        calibrate(make_stand(tmp_path / "stand", ENOUGH), tmp_path / "run")
    )
    assert told["parameters"]["temperature_K"]["error"] < 0.5
    chi = told["chi_square"]
    assert chi["after"] < 1.6 * chi["moments"] < chi["before"]
    profile = told["profiles"]["temperature_K"]["chi_square"]
    assert np.argmin(profile) == 2  # of five, the middle one


def test_it_is_a_run_like_any_other(calibrated, stand, command, tmp_path):
    detector = read_detector(calibrated / "detector.yaml")
    told = json.loads((calibrated / "calibration.json").read_text())
    assert detector.temperature_K == told["parameters"]["temperature_K"]["value"]
    out = tmp_path / "translated.lh5"
    done = command("translate", calibrated, calibrated / "sim.lh5", "--out", out)
    assert done.code == 0, done.err
    done = command("info", calibrated)
    assert done.code == 0, done.err
    words = ("--detector", calibrated / "detector.yaml", "--hits", calibrated / "sim.lh5")
    again = tmp_path / "again.lh5"
    settings = ("--settings", calibrated / "settings.yaml", "--cluster-mm", "0")
    done = command("simulate", *words, *settings, "--out", again)
    assert done.code == 0, done.err


@pytest.mark.thorough
@pytest.mark.parametrize(
    "free",
    [
        "temperature,hole_velocity_low",
        pytest.param("temperature,hole_velocity_low,impurity", marks=pytest.mark.slow),
    ],
)
def test_a_plan_is_told_before_any_fit(stand, command, free, tmp_path):
    out = tmp_path / "plan"
    words = ("--sim", stand / "sim.lh5", "--data", stand / "data.lh5", "--plan", "--out", out)
    prior = ("--prior", "hole_velocity_low=1.2±0.06")
    done = command("calibrate", *words, "--free", free, *prior)
    assert done.code == 0, done.err
    assert "temperature [K]" in done.out
    assert "in units of the prior" in done.out
    told = json.loads((out / "plan.json").read_text())
    # as given, not in units of the simulated value
    assert told["errors"]["hole_velocity_low_factor"]["prior"] == pytest.approx(0.06)
    of_temperature = told["errors"]["temperature_K"]
    assert of_temperature["alone"]["40000"] < of_temperature["alone"]["1000"]
    assert of_temperature["alone"]["1000"] < of_temperature["all_free"]["1000"]
    assert (out / "plan.png").stat().st_size > 1000


@pytest.mark.parametrize(
    ("words", "told"),
    [
        ((), "give --out, the run folder to make, or --plan"),
        (("--out", "run", "--free", "colour"), "'colour': no such parameter of the physics"),
        (("--out", "run", "--prior", "temperature=90"), "expected NAME=VALUE±ERROR"),
        (("--out", "run", "--prior", "temperature=90±0"), "expected NAME=VALUE±ERROR"),
        (("--out", "run", "--free", "bias", "--fix", "bias"), "all of it is fixed"),
        (("--out", "run", "--recipe", "paper"), "fits no readout chain"),
        (("--out", "run", "--hits", "x.lh5"), "give either --sim FILE, with its hits, or"),
    ],
)
def test_a_wrong_call_is_one_line(stand, command, words, told, monkeypatch, tmp_path):
    monkeypatch.chdir(tmp_path)
    both = ("--sim", stand / "sim.lh5", "--data", stand / "data.lh5")
    done = command("calibrate", *both, *words)
    assert done.code == 2
    assert told in done.err
    assert len(done.err.strip().splitlines()) == 1
    assert not (tmp_path / "run").exists()


def test_pulses_without_hits_are_refused(stand, command, tmp_path):
    words = ("--sim", stand / "data.lh5", "--data", stand / "data.lh5")
    done = command("calibrate", *words, "--out", tmp_path / "run")
    assert done.code == 2
    assert "give an output of cpunet simulate or cpunet stand" in done.err


def test_settings_keep_the_period_of_the_pulses(stand, command, tmp_path):
    words = ("--sim", stand / "sim.lh5", "--data", stand / "data.lh5", "--set", "dt_ns=8")
    done = command("calibrate", *words, "--out", tmp_path / "run")
    assert done.code == 2
    assert "dt_ns = 8, but the pulses of" in done.err
    assert not (tmp_path / "run").exists()


def test_hits_need_a_detector(stand, command, tmp_path):
    words = ("--hits", stand / "sim.lh5", "--data", stand / "data.lh5")
    done = command("calibrate", *words, "--out", tmp_path / "run")
    assert done.code == 2
    assert "give the --detector that they lie in" in done.err


def test_an_input_is_not_overwritten(stand, command):
    words = ("--sim", stand / "sim.lh5", "--data", stand / "data.lh5")
    done = command("calibrate", *words, "--out", stand, "--force")
    assert done.code == 2
    assert (stand / "sim.lh5").is_file()


def test_it_can_be_looked_at_in_python(calibrated):
    import cpunet

    run = cpunet.CalibratedRun.load(calibrated)
    assert run.physics["temperature_K"]["value"] == run.detector.temperature_K
    assert run.settings.dt_ns == run.dt_ns
    assert run.simulation.is_file()
    assert {"pulls", "profiles", "directions"} == set(run.figures)
    html = run._repr_html_()
    assert "temperature [K]" in html
    assert "cpunet run" in html
