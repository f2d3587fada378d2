"""`cpunet.calibrate`: a detector that is 3 K warmer than it was simulated."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

import cpunet
from cpunet.electronics.chain import Electronics, read_electronics
from cpunet.simulation.geometry_readers import read_detector
from synthetic import load_recipe, of_parts, status_of

# A readout of few numbers, and a chain that can describe it.
READOUT = {
    "slow": {"fraction": 0.065, "tau_ns": 400.0},
    "decays": [{"fraction": 1.0, "tau_us": 80.0}],
}
PLAIN = of_parts("""
generator slow_ns=[400] fast_decays_us=[]
training start_factors=[1] steps=5
""")


@pytest.fixture(scope="module")
def stand(tmp_path_factory) -> Path:
    """A small stand, of as few pulses as a fit takes, whose data are warmer than simulated."""
    out = tmp_path_factory.mktemp("calibrate") / "stand"
    chain = Electronics.model_validate(read_electronics("legend200").model_dump() | READOUT)
    how = {"electronics": chain, "detector": "ppc", "events": {"FEP": 240, "DEP": 60}}
    cpunet.make_stand(out, **how, shift={"temperature_K": 3}, seed=3)
    return out


@pytest.fixture(scope="module")
def calibrated(stand, tmp_path_factory, reads) -> cpunet.Calibration:
    """A search of two short rounds for few parameters."""
    reads.clear()
    sides, out = (stand / "sim.lh5", stand / "data.lh5"), tmp_path_factory.mktemp("calibrated")
    how = {"free": ["temperature"], "recipe": load_recipe("fast", PLAIN)}
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("cpunet.calibration.search.ROUNDS", 2)
        run = cpunet.calibrate(*sides, out / "run", **how)
    assert [reads[side] for side in sides] == [1, 1]
    return run


def test_the_temperature_is_found(calibrated):
    run = calibrated.folder
    told = json.loads((run / "calibration.json").read_text())
    temperature = told["parameters"]["temperature_K"]
    simulated = read_detector("ppc").temperature_K
    assert temperature["simulated"] == simulated
    assert temperature["error"] > 0
    assert abs(temperature["value"] - simulated - 3) < 3.5 * temperature["error"]
    chi = told["chi_square"]
    assert chi["after"] < chi["before"]
    assert len(told["pulls_after"]) == sum(told["groups"].values()) == chi["moments"]
    assert told["directions"][0]["components"] == {"temperature_K": 1.0}
    assert [*told["parameters"]] == ["temperature_K"]
    assert np.shape(told["covariance"]) == (1, 1)
    for name in ("pulls", "directions"):
        assert (run / f"{name}.png").stat().st_size > 1000


@pytest.mark.slow  # two to three minutes
def test_physics_of_data_by_others_are_found(reference_data, tmp_path):
    """Siggen's pulses at 92 K, with charge that repels, behind an unknown readout."""
    sim, run = tmp_path / "sim.lh5", tmp_path / "run"
    data = reference_data / "closure-shifted" / "data.lh5"
    cpunet.simulate(
        sim,
        detector=reference_data / "siggen" / "geometry_A.yaml",
        hits=reference_data / "geant4" / "g4_h20mm.npz",
        settings={"diffusion_constant": "siggen"},
    )
    found = cpunet.calibrate(sim, data, run).physics
    for name, true in (("temperature_K", 92), ("impurity_factor", 1), ("self_repulsion", 1)):
        value, error = found.loc[name, ["value", "error"]]
        assert abs(value - true) < 3 * error, name
    assert found.loc["temperature_K", "error"] < 0.2
    scores = cpunet.validate(run, run / "sim.lh5", data, baselines=False).scores
    of_ren = scores.xs("ren", level="method")
    assert (of_ren["iou"] > 0.9 * of_ren["ceiling"]).all(), of_ren


def test_it_is_a_run_like_any_other(calibrated, stand):
    run = cpunet.Calibration.load(calibrated.folder)
    physics = run.physics.loc["temperature_K"]
    assert run.detector.temperature_K == physics["value"]
    assert physics["prior_error"] > 0
    assert run.settings.dt_ns == run.dt_ns
    assert run.translate(run.simulation).valid.any()
    assert {"pulls", "directions"} == set(run.figures)
    html = run._repr_html_()
    assert "temperature [K]" in html
    assert "cpunet run" in html
    lines = str(run).splitlines()
    assert lines[0].startswith("temperature [K] ")
    assert lines[-1] == str(run.folder)


@pytest.mark.thorough
def test_a_plan_is_told_before_any_fit(stand, tmp_path, capsys):
    out = tmp_path / "plan"
    words = ["--sim", stand / "sim.lh5", "--data", stand / "data.lh5", "--plan", "--out", out]
    words += ["--free", "temperature,hole_velocity_low", "--prior"]
    assert status_of("calibrate", *words, "hole_velocity_low=1.2±0.06") == 0
    printed = capsys.readouterr().out
    assert "temperature [K]" in printed
    assert "in units of the prior" in printed
    told = json.loads((out / "plan.json").read_text())
    # as given, not in units of the simulated value
    assert told["errors_by_name"]["hole_velocity_low_factor"]["prior"] == pytest.approx(0.06)
    of_temperature = told["errors_by_name"]["temperature_K"]
    assert of_temperature["alone"]["40000"] < of_temperature["alone"]["1000"]
    assert of_temperature["alone"]["1000"] < of_temperature["all_free"]["1000"]
    assert (out / "plan.png").stat().st_size > 1000
    errors = cpunet.Plan.model_validate(told).errors
    assert errors.loc[("temperature_K", "alone"), "1000"] == of_temperature["alone"]["1000"]


@pytest.mark.parametrize(
    ("given", "told"),
    [
        ({"out": None}, "give `out`, the run folder to make, or `plan`"),
        ({"free": ["colour"]}, "'colour': no such parameter of the physics; these are temp"),
        ({"prior": ["temperature=90"]}, "expected NAME=VALUE±ERROR"),
        ({"prior": {"temperature": (90, 0)}}, "an error above 0"),
        ({"prior": {"mood": (1, 2)}}, "'mood': no such parameter of the physics"),
        ({"recipe": "paper"}, "fits no readout chain"),
        ({"read": cpunet.ReadOptions(data_table="all")}, "a detector with physics of its own"),
        ({"sim": "data.lh5"}, "give an output of cpunet simulate or"),
        ({"peak": "DEP"}, r"determine neither the physics.*; give more files"),
    ],
)
def test_what_is_wrong_is_told(stand, given, told, tmp_path):
    values = {"sim": "sim.lh5", "out": tmp_path / "run"} | given
    sim = stand / values.pop("sim")
    with pytest.raises(cpunet.CpunetError, match=told):
        cpunet.calibrate(sim, stand / "data.lh5", **values)
    assert not (tmp_path / "run").exists()
