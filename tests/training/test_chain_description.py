"""Learned responses in numbers: chains whose numbers are known by hand, and by the stand."""

from __future__ import annotations

import csv
import json
import re
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import scipy.fft
import yaml

from cpunet.electronics.baseline_noise import BaselineNoise
from cpunet.electronics.chain import Electronics, read_electronics
from cpunet.errors import CpunetError
from cpunet.networks.generators import ResponseGenerator
from cpunet.networks.response_layer import ElectronicsResponse
from cpunet.training.chain_description import (
    FEW_AXES,
    error_ends,
    learned_chain,
    moved_along_axes,
    true_chain_of,
)
from cpunet.training.chain_fit import by_name, vector_of
from cpunet.training.response import Response, response
from cpunet.training.run import Run
from cpunet.training.verdict import PARTS
from synthetic import (
    FACTS,
    NOISE_BINS,
    NOISE_SAMPLES,
    load_recipe,
    one_line,
    write_chain,
    write_run,
)

DT_NS = 16.0
# of the run's parameters: log_poles_ns are in the order of the recipe
ERRORS = {"log_poles_ns.1": 0.02, "log_poles_ns.2": 0.05, "log_decay_us.1": 0.01}
ERRORS |= {"slow_weights.3": 0.004, "decay_weights.1": 0.002}
FIT = {"chi_square": 120.0, "moments": 80, "steps": 9, "errors": ERRORS, "pulls": {}}
FEW = load_recipe("fast", ["generator.slow_ns=[400]", "generator.fast_decays_us=[]"])
RESPONSE = ElectronicsResponse(FEW.matching[0], DT_NS)


def write_response(
    folder: Path,
    *overrides: str,
    slow: dict[int, float] | None = None,
    fast: dict[int, float] | None = None,
    noise_density: np.ndarray | None = None,
    dt_ns: float = DT_NS,
    **info: Any,
) -> Path:
    """A run folder; weights by index into the recipe's times (100 … 1600 ns; 4, 16 µs)."""

    def change(chain: ResponseGenerator) -> None:
        chain.response.dt_ns.fill(dt_ns)
        for index, value in (slow or {}).items():
            chain.response.slow_weights[index] = value
        for index, value in (fast or {}).items():
            chain.response.decay_weights[index] = value
        if noise_density is not None:
            samples = 2 * (len(noise_density) - 1)
            chain.set_noise(BaselineNoise(noise_density, samples, dt_ns, 1000))

    return write_chain(folder, *overrides, change=change, dt_ns=dt_ns, **info)


def electronics(**fields: Any) -> Electronics:
    changed = {
        "name": "known",
        "bandwidth_poles_ns": [55, 35],
        "slow": {"fraction": 0.065, "tau_ns": 400},
        "decays": [{"fraction": 0.96, "tau_us": 80}, {"fraction": 0.04, "tau_us": 4}],
    }
    whole = read_electronics("legend200").model_dump() | changed | fields
    return Electronics.model_validate(whole)


@pytest.fixture
def run(tmp_path: Path) -> Path:
    """A run that has learned `electronics()` exactly."""
    start = "generator.poles_ns=[35, 55]", "generator.decay_us=80"
    return write_response(tmp_path / "run", *start, slow={2: 0.065}, fast={0: 0.04}, fit=FIT)


def values(*runs: Path) -> dict[str, float]:
    return response(*runs).runs[0].values


def test_few_axes_have_the_errors_of_edges_and_of_tails():
    """Those of tails are a hundred times smaller, but alike at all samples."""
    response = ElectronicsResponse(
        FEW.matching[0].model_copy(update={"deviations": True}), DT_NS
    )
    draws, rng = response.deviation_draws, np.random.default_rng(0)
    n, lags = draws.shape
    edges = (
        1e-3
        * np.exp(-np.arange(lags) / 30)
        * np.cos(np.outer(np.arange(1, 9), np.arange(lags)))
    )
    tail = 1e-5 * np.linspace(0, 1, lags)
    draws[:] = (rng.normal(size=(n, 8)) @ edges + np.outer(rng.normal(size=n), tail)) / n**0.5

    def variances(**how: bool) -> np.ndarray:
        ends = error_ends(response, [], **how)
        moves = np.array([0.5 * (a.deviation - b.deviation) for a, b in ends])
        assert len(moves) == (2 * FEW_AXES if how else n)
        return np.array([np.sum((moves @ edges[0]) ** 2), np.sum(moves[:, -1] ** 2)])

    assert variances(few=True) == pytest.approx(variances(), rel=0.05)


def test_a_single_pole_and_a_single_decay(tmp_path):
    one = "generator.poles_ns=[50]", "generator.decay_us=1e6"
    numbers = values(write_response(tmp_path / "a", *one))
    assert numbers["pole_1_ns"] == pytest.approx(50)
    assert numbers["rise_10_90_ns"] == pytest.approx(50 * np.log(9), rel=1e-3)
    assert numbers["rise_1_99_ns"] == pytest.approx(50 * np.log(99), rel=1e-3)
    assert numbers["missing_500_ns"] == pytest.approx(0.5 * np.exp(-10), abs=1e-7)
    assert numbers["overshoot"] == pytest.approx(0, abs=1e-9)
    assert numbers["slow_share"] == 0
    assert "slow_time_ns" not in numbers
    assert "noise_rms_kev" not in numbers
    decaying = values(write_response(tmp_path / "b", "generator.decay_us=54.6"))
    assert decaying["effective_decay_us"] == pytest.approx(54.6, rel=1e-4)


def test_noise_is_told_in_kev(tmp_path):
    """A full charge is 0.8 e^(t/tau) high in prepared pulses; power falls by half at 8 MHz."""
    frequency_mhz = np.linspace(0, 500 / DT_NS, NOISE_BINS)
    shape = 1 / (1 + (frequency_mhz / 8) ** 4)
    mean = (2 * shape.sum() - shape[0] - shape[-1]) / (NOISE_SAMPLES)
    # aligned at the half rise of poles of 60 and 40 ns, some 80 ns after the step
    height = 0.8 * np.exp((397.5 * DT_NS + 80) / 54_600)
    density = (1.7 * height) ** 2 * shape / mean
    decay = "generator.decay_us=54.6"
    numbers = values(write_response(tmp_path / "a", decay, noise_density=density))
    assert numbers["noise_rms_kev"] == pytest.approx(1.7, rel=5e-3)
    assert numbers["noise_corner_mhz"] == pytest.approx(8, rel=0.01)


def test_a_chain_learned_exactly_differs_in_nothing_from_the_truth_and_has_its_errors(run):
    told = response(run, truth=electronics())
    true = told.true_values
    assert true.keys() - told.difference.keys() == {"noise_rms_kev", "noise_corner_mhz"}
    for name, difference in told.difference.items():
        assert difference == pytest.approx(0, abs=1e-6 * abs(true[name]) + 1e-7), name
    assert true["rise_10_90_ns"] == pytest.approx(165, abs=10)
    assert true["noise_rms_kev"] == pytest.approx(1.95, rel=1e-3)
    assert true["noise_corner_mhz"] == pytest.approx(8.5, rel=0.02)
    (told,) = told.runs  # errors go with the poles that they belong to
    assert told.values["pole_1_ns"] == pytest.approx(55)
    assert told.errors == pytest.approx({"pole_1_ns": 0.05 * 55, "pole_2_ns": 0.02 * 35})
    assert told.parameter_errors["decay_us"] == pytest.approx(0.8)
    assert told.parameter_errors["slow_400_ns"] == 0.004
    assert told.parameters["slow_400_ns"] == pytest.approx(0.065)
    assert told.values["chi_square_per_moment"] == 1.5


def test_differences_are_told_in_their_errors(tmp_path):
    """Noise of 1.98 against 1.95 keV."""
    density = np.full(NOISE_BINS, (1.98 * 0.8) ** 2)
    noise = {"baselines": 1500, "rms": 1.98 * 0.8, "rms_error": 0.02 * 1.98 * 0.8}
    run = write_response(
        tmp_path / "run",
        "generator.poles_ns=[50]",
        "generator.decay_us=500",
        noise_density=density * np.exp(2 * 397.5 * DT_NS / 500e3),
        fit=FIT | {"noise": noise, "errors": {"log_poles_ns.1": 0.02}},
    )
    told = response(run, truth=electronics(bandwidth_poles_ns=[49]))
    (own,), sigma = told.runs, told.sigma
    assert own.values["noise_rms_kev"] == pytest.approx(1.98, rel=2e-3)
    # 2 % of the baselines, and 1 µs of the decay
    error = 1.98 * np.hypot(0.02, 1 / 500)
    assert own.errors["noise_rms_kev"] == pytest.approx(error, rel=0.01)
    assert sigma["noise_rms_kev"] == pytest.approx(0.03 / (1.98 * 0.0201), rel=0.1)
    assert sigma["pole_1_ns"] == pytest.approx(1.0, abs=0.02)
    assert set(sigma) == {"noise_rms_kev", "pole_1_ns"}  # parts are degenerate


def test_the_closed_form_is_the_chain_of_the_stand():
    chosen = load_recipe("fast", ["generator.poles_ns=[55, 35]", "generator.decay_us=80"])
    response = ElectronicsResponse(chosen.matching.generator, DT_NS)
    response.slow_weights[2], response.decay_weights[0] = 0.065, 0.04
    chain, truth = learned_chain(response, "run"), electronics()
    time_ns = np.arange(-20.0, 20_000.0, 8.0)
    np.testing.assert_allclose(chain.step(time_ns), truth.transfer.step(time_ns), atol=1e-12)
    undecayed = true_chain_of(truth).undecayed(time_ns)
    np.testing.assert_allclose(chain.undecayed(time_ns), undecayed, atol=1e-6)
    # beyond the first samples, where the layer's spline cannot follow a step
    layer = scipy.fft.irfft(response.transfer(2400), 2400)[:600]
    middle_ns = (np.arange(600) + 0.5) * DT_NS
    np.testing.assert_allclose(layer[20:], chain.step(middle_ns)[20:], atol=1e-3)


def test_a_folder_with_numbers_and_figure(run, tmp_path):
    out = tmp_path / "out"
    told = response(run, truth=electronics(), out=out)
    files = {f"response.{kind}" for kind in ("csv", "json", "png", "yaml")}
    assert {file.name for file in out.iterdir()} == {".cpunet.json", *files}
    stored = json.loads((out / "response.json").read_text())
    assert stored["runs"][0]["recipe"] == "fast"
    assert stored["runs"][0]["values"] == told.runs[0].values
    assert stored["truth"]["name"] == "known"
    assert stored["truth"]["sigma"] == told.sigma
    assert (out / "response.png").read_bytes().startswith(b"\x89PNG")
    with pytest.raises(CpunetError, match="exists already"):
        response(run, out=out)
    response(run, out=out, force=True)
    assert sorted(file.name for file in tmp_path.iterdir()) == ["out", "run"]


def test_the_truth_of_a_stand(run, tmp_path):
    stand = tmp_path / "stand"
    stand.mkdir()
    counts = {"n_sim": 1, "n_data": 1, "sim_lines": {}, "data_lines": {}, "flags": {}}
    content = {"electronics": electronics().model_dump(mode="json"), "counts": counts}
    (stand / "stand.json").write_text(json.dumps(content))
    known = response(run, truth=electronics()).true_values
    assert response(run, truth=stand).true_values == known
    chain = tmp_path / "chain.yaml"
    chain.write_text(yaml.safe_dump(content["electronics"]))
    of_two = response(run, write_response(tmp_path / "run [2]", fit=FIT), truth=chain)
    assert of_two.true_values == known
    head, line, *_ = str(of_two).splitlines()[1:]
    assert head.split()[-4:] == ["run", "run", "[2]", "known"]
    assert line.split() == ["bandwidth", "pole", "1", "[ns]", "55", "60", "55"]
    assert response(Run.load(run), truth="legend200").truth.name == "legend200"
    (stand / "stand.json").unlink()
    one_line(lambda: response(run, truth=stand), "stand.json: cannot be read")


def test_every_parameter_has_a_row():
    values = ElectronicsResponse(load_recipe("fast").matching[0], 16.0).describe()
    values = {k: v for k, v in values.items() if not k.startswith("slow_")}  # told as a sum
    run = SimpleNamespace(run=SimpleNamespace(name="run"), values=values, errors={})
    shown = str(Response([run]))
    assert len(shown.splitlines()) == 2 + len(values)


def test_runs_that_cannot_be_described(run, tmp_path):
    out, network = tmp_path / "out", tmp_path / "network"
    coarse, truth = write_response(tmp_path / "coarse", dt_ns=10.0), electronics()
    network.mkdir()
    write_run(network, {}, load_recipe("published"), FACTS)
    for runs, parts in (
        ((run, tmp_path / "none"), ("none: no finished run", "cpunet train")),
        ((), ("no run was given",)),
        ((coarse,), (f"{coarse}: ", "electronics known samples")),
        ((network,), (f"{network}: recipe published trains a network", "cpunet validate")),
    ):
        one_line(lambda runs=runs: response(*runs, truth=truth, out=out), *parts)
        assert not out.exists()


def test_a_poor_fit_is_doubted(run, tmp_path):
    assert response(run).runs[0].doubts == []
    checks = {"chi_square": 9.0, "amplitude": 1.0, "z": 30.0, "z_ns": 40.0}
    checks |= {"beyond_ns": [40.0, 48.0], "off": {"onset": 30.0}, "pulses": [1000, 900]}
    fit = FIT | {"verdict": "bad: chi-square is 9", "checks": checks}
    (said,) = response(write_response(tmp_path / "bad", fit=fit)).runs[0].doubts
    assert said.startswith("the fit is bad: chi-square is 9; ")
    assert said.endswith(PARTS["onset"][1])
    assert response(write_response(tmp_path / "none")).runs[0].doubts == []
    early = write_response(tmp_path / "early", slow={0: -0.4, 2: -0.2})
    (said,) = response(early).runs[0].doubts
    assert said.startswith("60 % of the charge would arrive too early")


def numbers(response: ElectronicsResponse) -> dict[str, float]:
    first, second = response.log_poles_ns.tolist()
    return {"sum": first + second, "difference": first - second}


def test_what_is_known_together_has_a_small_error() -> None:
    covariance = np.diag([0.04, 0.04, 1.0, 1.0, 1.0])
    covariance[0, 1] = covariance[1, 0] = -0.0399
    found = moved_along_axes(RESPONSE, covariance.tolist(), numbers)
    assert np.linalg.norm(found["sum"]) == pytest.approx(np.sqrt(2e-4))
    assert np.linalg.norm(found["difference"]) == pytest.approx(np.sqrt(0.08 + 2 * 0.0399))

    def partly(response: ElectronicsResponse) -> dict[str, float]:
        found = numbers(response)
        return found if response.slow_weights.item() > -0.1 else {"sum": found["sum"]}

    # a number that is not always defined has no error: along the other axes it is too small
    covariance = np.diag([0.04, 0.04, 1.0, 1.0, 1.0])
    assert [*moved_along_axes(RESPONSE, covariance.tolist(), partly)] == ["sum"]
    # without a covariance there are no errors
    for none in ([], [[1.0]], np.full((5, 5), np.nan).tolist()):
        assert moved_along_axes(RESPONSE, none, numbers) == {}


def test_a_page_and_tables_of_channels_of_which_one_differs(tmp_path):
    """Channels with small errors of all parameters, one with a pole of its own."""
    folder, runs = tmp_path / "array", []
    chain = ElectronicsResponse(load_recipe("fast").matching[0], DT_NS)
    errors = np.full(len(vector_of(chain)), 1e-4)
    fit = {"errors": by_name(chain, errors), "covariance": np.diag(errors**2).tolist()}
    for pole in (30.0, 30.5, 29.5, 30.2, 29.8, 60.0):
        setting = f"generator.poles_ns=[45, {pole}]"
        runs.append(write_response(tmp_path / f"V{len(runs):02d}", setting, fit=fit))
    response(*runs, out=folder)
    html = (folder / "response.html").read_text()
    assert "Readouts of 6 channels: 1 to look at" in html
    assert "late charge [%]" in html
    rows = re.findall(r'<tr><th scope="row">(.*?)</th>(.*?)</tr>', html)
    assert rows[0][0] == str(runs[5])  # comes first, and is marked
    assert ['class="off"' in cells for _, cells in rows] == [True] + 5 * [False]
    # both tables have the numbers of the command
    known = json.loads((folder / "response.json").read_text())["runs"]
    whole = yaml.safe_load((folder / "response.yaml").read_text())
    with (folder / "response.csv").open() as stream:
        lines = {line["channel"]: line for line in csv.DictReader(stream)}
    for run, numbers in zip(runs, known, strict=True):
        for name, value in numbers["values"].items():
            assert whole[str(run)]["numbers"][name]["value"] == pytest.approx(value)
            assert float(lines[str(run)][name]) == pytest.approx(value)
    # correlations are those of the errors
    names = whole[str(runs[0])]["correlations"]["names"]
    matrix = np.array(whole[str(runs[0])]["correlations"]["matrix"])
    assert {"rise_10_90_ns", "missing_500_ns", "effective_decay_us"} <= set(names)
    np.testing.assert_allclose(np.diag(matrix), 1, atol=1e-3)
    np.testing.assert_allclose(matrix, matrix.T)
    assert np.abs(matrix).max() <= 1.001
    assert all(whole[str(runs[0])]["numbers"][name]["error"] > 0 for name in names)
    # what comes late is not there early
    late, later = (names.index(f"missing_{ns}_ns") for ns in (500, 1000))
    assert matrix[late, later] > 0.5
