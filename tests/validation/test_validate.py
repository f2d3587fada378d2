"""Validation with parts missing, and on the reference data: what is there is scored."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

import cpunet
from cpunet.errors import CpunetError
from cpunet.pulses.container import Pulses
from cpunet.pulses.preparation import prepare
from cpunet.pulses.reading.files import PulseFile
from cpunet.training.published import UNKNOWN
from cpunet.training.run import Run
from cpunet.training.train import train
from cpunet.validation.drawings import drawings
from cpunet.validation.methods import pair_squares, passing_cuts, scores_of_squares
from cpunet.validation.metrics import ALARM
from cpunet.validation.peaks import classifier_excess, fit_ends
from cpunet.validation.validate import Evaluation, _compared, evaluate, validate
from synthetic import after_pole, decay, leave_undrawn, load_recipe, phased_edges, write_pulses

# more poles than these pulses have take long to be looked for
RECIPE = load_recipe("fast", ["scores.bootstraps=10", "generator.poles_ns=[60]"])
KEV = {"FEP": 2614.511, "SEP": 2103.511, "DEP": 1592.511}


def measured_shape(simulated: np.ndarray) -> np.ndarray:
    return after_pole(simulated, 4.0, 60) * decay(450, 4000.0, 1100)


def write(path: Path, counts: dict[float, int], seed: int, *, measured: bool) -> PulseFile:
    """Edges of various widths, behind a pole and a decay if measured."""
    rng = np.random.default_rng(seed)
    kev = np.repeat(list(counts), list(counts.values())).astype(float)
    waveforms = phased_edges(len(kev), rng, 450, 1100)
    if measured:
        waveforms = measured_shape(waveforms)
        noise = rng.normal(0, 2.0, waveforms.shape)
        waveforms = np.round(1000 + 10 * kev[:, None] * waveforms + 10 * noise)
    write_pulses(path, Pulses.of(waveforms, dt_ns=16, energy_kev=kev), table="geds/raw")
    return PulseFile(path)


@pytest.fixture(scope="module")
def files(tmp_path_factory) -> dict[str, PulseFile]:
    folder = tmp_path_factory.mktemp("evaluation")
    full = {KEV["FEP"]: 260, KEV["SEP"]: 60, 2030.0: 25, KEV["SEP"] + 15: 5}
    return {
        "sim": write(folder / "sim.lh5", full | {KEV["DEP"]: 30}, 1, measured=False),
        "data": write(folder / "data.lh5", full | {KEV["DEP"]: 30}, 2, measured=True),
        "no DEP": write(folder / "no_dep.lh5", full, 3, measured=True),
    }


@pytest.fixture(scope="module")
def run(files, tmp_path_factory) -> Run:
    out = tmp_path_factory.mktemp("run") / "run"
    return train(files["sim"], files["data"], out, recipe=RECIPE, seed=0, device="cpu")


@pytest.fixture(scope="module")
def found(run, files, tmp_path_factory) -> Evaluation:
    path = tmp_path_factory.mktemp("truth") / "truth.npz"
    n, rng = files["sim"].open().n_pulses, np.random.default_rng(1)
    np.savez(path, response=measured_shape(phased_edges(n, rng, 450, 1100)).astype(np.float32))
    return evaluate(run, files["sim"], files["data"], truth=path)


@pytest.mark.thorough
def test_a_sample_of_both_sides_is_compared(run, files) -> None:
    how = {"baselines": False, "max_pulses": 250}
    few = evaluate(run, files["sim"], files["data"], **how)
    assert len(few.sets[0].translations.windows["raw"]) == 250
    assert few.metrics.rejections["sim"]["not_drawn"] == 130


def test_what_is_compared(found) -> None:
    metrics = found.metrics
    assert "ranges of energy" in (metrics.ae_energy.missing or "ranges of energy")
    ranges = metrics.ae_details["survival by energy range"]
    assert ranges["Qbb"]["ren"].peak == 25
    assert ranges["SEP"]["data"].sideband == 5
    assert ranges["FEP"]["data"].sideband == 0
    assert {"noise", "noise_spectrum"} <= set(metrics.judge("SEP", "ren"))
    assert metrics.peaks["SEP"].noise["ren"].rms_ratio == pytest.approx(1, abs=0.1)
    assert metrics.scored == ["FEP", "SEP", "DEP"]


@pytest.mark.thorough
def test_every_figure_can_be_drawn(found) -> None:
    made = drawings(found)
    assert {"FEP mean pulse", "SEP superpulses", "SEP single pulse", "losses"} <= set(made)
    assert {"FEP cycle of simulation", "FEP cycle of data"} <= set(made)
    assert all(draw().axes for draw in made.values())
    weights = {n: w for n, w in found.run.weights.items() if not n.startswith("iren.")}
    alone = found.run.model_copy(update={"weights": weights})
    made = drawings(dataclasses.replace(found, run=alone))
    assert "losses" in made
    assert not any("cycle" in name for name in made)


def test_a_run_whose_training_was_not_published_says_no_more_than_is_known(run) -> None:
    sides = [SimpleNamespace(path=Path(f), detector=None, read_as={}) for f in ("sim", "data")]
    unknown = {"seed": None, "sim": UNKNOWN, "data": UNKNOWN, "started": ""}
    told = _compared(run.model_copy(update=unknown), *sides)
    assert told["trained"] == (
        "recipe fast on FEP, an unknown number of simulated and an unknown number of measured "
        "pulses"
    )


def test_a_missing_peak_is_told_and_the_rest_stands(run, files, tmp_path, monkeypatch) -> None:
    monkeypatch.setattr("cpunet.validation.drawings.drawings", lambda found: {})  # above
    sides = files["sim"], files["no DEP"]
    report = validate(run, *sides, tmp_path / "report", baselines=False, max_pulses=200)
    metrics = report.metrics
    assert f"DEP: not scored, {metrics.peaks['DEP'].missing}" in str(report)
    assert metrics.peaks["DEP"].missing.startswith("no measured pulses")
    assert "DEP" in metrics.ae_survival.missing
    assert "no A/E cut" in metrics.ae_details["survival by energy range"].missing
    assert metrics.peaks["SEP"].parameters["drift_time"].iou["ren"] > 0
    page = (tmp_path / "report" / "report.html").read_text()
    assert "no measured pulses" in page
    assert "REN, SEP" in page


def test_nothing_to_score_is_an_error(run, files, tmp_path) -> None:
    other = write(tmp_path / "other.lh5", {2030.0: 40}, 4, measured=True)
    with pytest.raises(CpunetError, match="no peak has pulses on both sides"):
        evaluate(run, files["sim"], other, baselines=False)


@pytest.mark.thorough
def test_scores_of_pairs_are_those_of_the_windows_without_noise(found):
    peak = max(found.sets, key=lambda peak: len(peak.rows["raw"]))
    rows, translations = peak.known_to_all(), peak.translations
    assert rows.tolist() == peak.rows["raw"].tolist()
    each = [translations.without_noise(row) for row in rows]
    windows = {method: np.concatenate([one[method] for one in each]) for method in each[0]}
    assert set(windows) == {"raw", "rc", "rc_late", "gauss_exp", "superpulse", "ren", "truth"}
    scores, edges = found.metrics.peaks[peak.name].paired, found.run.recipe.scores
    squares = pair_squares(windows, windows["truth"], edges.samples(edges.edge_ns))
    for method, score in scores.items():
        direct = scores_of_squares(squares[method])
        assert vars(score) == pytest.approx(vars(direct), rel=1e-4)
    assert scores["ren"].edge_rmse < scores["raw"].edge_rmse


def test_pulses_are_there_by_method_and_with_the_noise_of_the_seed(found):
    peak = found.sets[0]
    pulses = {method: peak.windows(method) for method in peak.rows}
    names = ("data", "raw", "rc", "rc_late", "gauss_exp", "superpulse", "ren", "truth")
    assert tuple(pulses) == names
    raw, of = peak.rows["raw"], peak.translations
    assert all(len(p) == len(raw) for m, p in pulses.items() if m != "data")
    how = {"energy_kev": of.energy_kev["raw"], "generator": np.random.default_rng(0)}
    again = of.ren.apply(of.windows["raw"], **how)
    np.testing.assert_array_equal(pulses["ren"], again[raw])


def test_translated_pulses_pass_the_cuts_of_the_data(files):
    raw, pulses = files["data"].open().read(), RECIPE.at(16).preparation
    late = raw.waveforms.copy()
    late[:5, 700:] += 300 * (1 - np.exp(-np.arange(late.shape[1] - 700) / 100))
    ready = prepare(raw.with_waveforms(late), pulses, "measured").pulses
    passed = passing_cuts(ready, RECIPE.at(16))
    assert not passed[:5].any()
    assert passed[5:].mean() > 0.98
    ready.waveforms[-1] = np.nan  # cannot be prepared
    assert not passing_cuts(ready, RECIPE.at(16))[-1]


def test_errors_of_the_fit_are_in_the_p_of_the_classifier(run, found):
    peak, excess = found.sets[1], {}  # of few pulses
    for factor in (0, 1, 900):
        covariance = (factor * np.array(run.fit.covariance)).tolist()
        fit = run.fit.model_copy(update={"covariance": covariance})
        ends = fit_ends(run.model_copy(update={"fit": fit}), peak.translations.ren)
        excess[factor] = classifier_excess(peak, ends, seed=0)
    assert excess[0] == 0
    assert excess[1] < 0.05 < excess[900]
    scored = found.metrics.peaks["SEP"].two_sample["ren"]
    assert scored.of_fit == excess[1]
    metrics, p = found.metrics.model_copy(deep=True), []
    for of_fit in (0.0, 0.05, 0.6):
        for auc in (scored.null_mean + 0.1, 0.95):
            tested = dataclasses.replace(scored, auc=auc, null_std=0.02, of_fit=of_fit)
            metrics.peaks["SEP"].two_sample["ren"] = tested
            p.append(metrics.judge("SEP", "ren")["auc"].p)
    assert p[0] < ALARM < p[2]
    assert max(p[1], p[3]) < ALARM < min(p[4:])  # where any AUC is expected, none is off


@pytest.fixture(scope="module")
def report(run, files, tmp_path_factory) -> cpunet.Report:
    """Nothing is written before it is saved."""
    folder = tmp_path_factory.mktemp("report")
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        leave_undrawn(patch)
        made = validate(run, str(files["sim"].path), files["data"], baselines=False)
        assert made.folder is None
        assert not list(folder.iterdir())
        made.save("report")
        with pytest.raises(CpunetError, match="report: exists already"):
            made.save("report")
    return dataclasses.replace(made, folder=folder / "report")


def test_a_report(report):
    assert sorted(report.values) == ["DEP", "FEP", "SEP"]
    data = report.values["FEP"]["data"]["current_amplitude"]
    histogram = report.hist("FEP")
    scored = report.metrics.peaks["FEP"].parameters["current_amplitude"].axis
    assert histogram.axes[1].size == scored.bins
    assert histogram.axes[1].edges[[0, -1]].tolist() == [scored.low, scored.high]
    assert histogram[{"method": "data"}].sum(flow=True) == np.isfinite(data).sum()
    compared = report.metrics.peaks["SEP"].parameters["drift_time"]
    row = report["SEP"].loc["drift_time", "ren"]
    assert row["iou"] == compared.iou["ren"]
    assert row["ceiling"] == compared.iou["ceiling"]
    assert report.scores.loc["SEP", "drift_time", "ren"].equals(row)
    assert "current amplitude" in report._repr_html_()
    assert repr(report).startswith(f"<Report {report.folder}: ")
    assert report.figures["FEP mean pulse"].axes
    with pytest.raises(CpunetError, match="no scored peak '1500'; there are FEP, SEP, DEP"):
        report["1500"]
    lines = str(report).splitlines()
    assert lines[0].startswith(("REN agrees with the data in all", "REN is off in"))
    assert "REN − data" in lines[1]
    head = next(line for line in lines if line.startswith("peak"))
    assert head.split() == ["peak", "parameter", "simulation", "REN", "data", "vs", "data"]
    ren = f"{compared.iou['ren']:.1f}"
    assert any(line.startswith("SEP") and "T_drift" in line and ren in line for line in lines)
    assert lines[-1] == str(report.folder / "report.html")


def test_a_report_again(report, tmp_path):
    again = cpunet.Report.load(report.folder)
    assert again.metrics == report.metrics
    for method in ("data", "raw", "ren"):
        one, other = (r.hist("FEP", "drift_time")[{"method": method}] for r in (report, again))
        assert np.array_equal(one.values(), other.values())
    assert again.plot("SEP", "drift_time").get_title() == "SEP"
    assert again.figures["FEP mean pulse"].name == "FEP_mean_pulse.svg"
    assert again.scores.sort_index().equals(report.scores.sort_index())
    with pytest.raises(CpunetError, match="is a report already; copy the folder"):
        again.save(tmp_path / "copy")


@pytest.mark.timeout(1800)
@pytest.mark.slow
def test_the_default_recipe_beats_the_raw_simulation(reference_data: Path, tmp_path: Path):
    """Trained on FEP, judged on SEP and DEP, which it has not seen."""
    folder = reference_data / "closure"
    sim, data = PulseFile(folder / "sim.lh5"), PulseFile(folder / "data.lh5")
    train(sim, data, tmp_path / "run", recipe=load_recipe("fast"), device="cpu")
    truth = folder / "truth.npz"
    metrics = validate(tmp_path / "run", sim, data, tmp_path / "report", truth=truth).metrics
    for peak, shares in (("SEP", (0.9, 0.9, 0.9)), ("DEP", (0.6, 0.9, 0.9))):
        scores = metrics.peaks[peak]
        for (name, compared), share in zip(scores.parameters.items(), shares, strict=True):
            iou, distance = compared.iou, compared.wasserstein
            assert iou["ren"] > iou["raw"], (peak, name)
            assert distance["ren"] < distance["raw"], (peak, name)
            assert iou["ren"] >= share * iou["ceiling"], (peak, name)
        ren, raw = scores.paired["ren"], scores.paired["raw"]
        assert ren.rmse < raw.rmse
        assert ren.edge_rmse < min(raw.edge_rmse, 0.002)
    assert metrics.peaks["SEP"].two_sample["ren"].auc < 0.65


@pytest.mark.slow
def test_the_chain_runs_on_measured_flashcam_traces(reference_data: Path, tmp_path: Path):
    """Traces of a real detector, whose few events are taken from 300 keV on."""
    sim = PulseFile(reference_data / "closure" / "sim.lh5")
    data = PulseFile(reference_data / "real" / "th228.fcio", kev_per_adc=0.06493)
    # the simulation is of another detector, which no start of a fit would cure
    recipe = load_recipe("fast", ["training.start_factors=[1]"])
    made = train(sim, data, tmp_path / "run", recipe=recipe, peak="300-", device="cpu")
    assert 200 < made.data.used < 1000
    metrics = validate(tmp_path / "run", sim, data, tmp_path / "report").metrics
    scores = metrics.peaks["300-"]
    assert scores.n_data == made.data.used
    assert set(scores.parameters) == {"current_amplitude", "drift_time", "tail_slope"}
    for name in ("metrics.json", "report.html", "losses.svg"):
        assert (tmp_path / "report" / name).is_file()
