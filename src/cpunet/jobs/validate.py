"""How well a run translates: scores per peak, figures and a page to read."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from cpunet.analysis.comparisons import compare
from cpunet.analysis.paired import paired_scores
from cpunet.analysis.report import METRICS, write_report
from cpunet.errors import CpunetError
from cpunet.files import folder_written_aside
from cpunet.jobs.figures import validation_figures
from cpunet.jobs.inputs import (
    InputFile,
    InputSet,
    load_measured,
    load_simulated,
    require_same_sampling,
)
from cpunet.jobs.monitor import Monitor
from cpunet.jobs.pulse_tests import survivals, told_apart
from cpunet.jobs.rivals import RivalWindows, rival_windows
from cpunet.jobs.train import resolve_device
from cpunet.jobs.truth import read_response
from cpunet.pulses.container import FloatArray, Pulses
from cpunet.pulses.parameters import Values, pulse_parameters
from cpunet.pulses.peaks import parse_selection
from cpunet.recipes.schema import Recipe
from cpunet.training.run_folder import read_info, read_losses
from cpunet.translation.translator import IREN, REN

QUIET = Monitor()
FEWEST = 10  # pulses, below which a distribution says nothing


@dataclass(frozen=True, eq=False)
class PeakSets:
    """The pulses of one peak: raw simulation, its translation, measured.

    ``clean`` holds noise-free windows by method, for the comparison with ``truth``;
    ``others`` the windows of the rivals and of the truth, with noise and without.
    """

    name: str
    raw: Pulses
    ren: Pulses
    data: Pulses
    clean: Mapping[str, FloatArray]
    truth: FloatArray | None
    others: Mapping[str, FloatArray]

    def not_prepared(self) -> dict[str, int]:
        """How many translated pulses cannot be prepared as data are, by method."""
        left = {"ren": self.ren.waveforms, **self.others}
        counts = {method: len(self.raw) - len(windows) for method, windows in left.items()}
        return {method: count for method, count in counts.items() if count}

    def missing(self) -> str | None:
        """Say what keeps the peak from being scored, if anything does."""
        sides = (("simulated", self.raw), ("measured", self.data))
        few = [
            f"{len(pulses) or 'no'} {side}" for side, pulses in sides if len(pulses) < FEWEST
        ]
        return f"{' and '.join(few)} pulses (at least {FEWEST} are needed)" if few else None


def validate_run(
    run: Path,
    sim: InputFile,
    data: InputFile,
    out: Path,
    *,
    truth: Path | None = None,
    rivals: bool = True,
    seed: int = 0,
    device: str = "auto",
    force: bool = False,
    monitor: Monitor = QUIET,
) -> dict[str, Any]:
    """Score a run on simulated and measured pulses and write the report folder.

    Every peak of the recipe is scored, and the energies of the training if they are
    none of them. SEP and DEP are no part of the training: they are the test.

    Parameters
    ----------
    run
        Folder of the training run.
    sim, data
        Simulated and measured pulses.
    out
        Report folder: ``metrics.json``, figures, ``report.html``.
    truth
        ``.npz`` with ``response``: the noise-free trace of each simulated pulse.
    rivals
        Fit the rival methods too, which takes most of the time.
    seed
        Of noise and bootstraps.
    device, force, monitor
        As for `cpunet.jobs.train.train_run`.

    Returns
    -------
    dict
        The content of ``metrics.json``.

    Raises
    ------
    CpunetError
        If the input cannot be used, or no peak can be scored.
    """
    info = read_info(run)
    ren = REN.load(run, resolve_device(device))
    iren = IREN.load(run, resolve_device(device))
    recipe = ren.recipe
    names = list(dict.fromkeys([*recipe.peaks, str(info["peak"])]))
    selection = parse_selection(",".join(names), recipe.peaks)
    with folder_written_aside(out, marker=METRICS, force=force) as folder:
        sim_set = load_simulated(sim, recipe, selection, monitor)
        data_set = load_measured(data, recipe, selection, monitor)
        require_same_sampling(sim_set, data_set)
        if not np.isclose(sim_set.dt_ns, ren.dt_ns):
            raise CpunetError(
                f"{sim_set.path}: sampled every {sim_set.dt_ns:g} ns, the run was trained on "
                f"{ren.dt_ns:g} ns; resample the pulses"
            )
        response = None if truth is None else read_response(truth, sim_set)
        others = rival_windows(
            sim_set,
            data_set,
            data,
            parse_selection(str(info["peak"]), recipe.peaks),
            recipe,
            fitted=rivals,
            response=response,
            seed=seed,
            monitor=monitor,
        )
        windows = sim_set.prepared.pulses.waveforms
        with monitor.stage("Translating", 2 * len(windows)) as advance:
            noisy = ren.apply(
                windows,
                energy_kev=sim_set.prepared.pulses.energy_kev,
                generator=ren.seeded(seed),
                progress=advance,
            )
            clean = ren.apply(windows, noise=False, progress=advance)
        sets = [
            _peak_sets(name, recipe, sim_set, data_set, noisy, clean, others) for name in names
        ]
        values: dict[str, dict[str, dict[str, Values]]] = {}
        peaks: dict[str, Any] = {}
        with monitor.stage("Scoring", len(sets)) as advance:
            for peak in sets:
                values[peak.name], peaks[peak.name] = _score(peak, recipe, seed)
                advance(1)
        if all("missing" in scores for scores in peaks.values()):
            raise CpunetError(
                f"{data_set.path}: no peak has pulses on both sides; "
                "check the calibration (--kev-per-adc, --data-energy)"
            )
        metrics = {
            "peaks": peaks,
            "ae_survival": survivals(values, seed),
            "rivals": {"fits": others.fits, "missing": others.missing},
            "training": {key: info[key] for key in ("recipe", "seconds", "device", "seed")}
            | {"peak": info["peak"]},
            "rejections": {
                "sim": sim_set.prepared.rejections,
                "data": data_set.prepared.rejections,
            },
        }
        with monitor.stage("Drawing") as advance:
            figures = validation_figures(sets, values, peaks, read_losses(run), ren, iren)
            write_report(folder, metrics, figures, _notes(info, truth))
    return metrics


def _peak_sets(
    name: str,
    recipe: Recipe,
    sim_set: InputSet,
    data_set: InputSet,
    noisy: FloatArray,
    clean: FloatArray,
    rivals: RivalWindows,
) -> PeakSets:
    selection = parse_selection(name, recipe.peaks)
    sim, data = sim_set.prepared.pulses, data_set.prepared.pulses
    chosen = selection.select(sim.energy_kev)
    raw = sim[chosen]
    return PeakSets(
        name=name,
        raw=raw,
        ren=Pulses.of(_prepared(noisy[chosen]), dt_ns=raw.dt_ns),
        data=data[selection.select(data.energy_kev)],
        clean={"raw": raw.waveforms}
        | {name: windows[chosen] for name, windows in rivals.clean.items() if name != "truth"}
        | {"ren": clean[chosen]},
        truth=rivals.clean["truth"][chosen] if "truth" in rivals.clean else None,
        others={name: _prepared(w[chosen]) for name, w in rivals.methods().items()},
    )


def _prepared(windows: FloatArray) -> FloatArray:
    """Leave out the rows that could not be prepared."""
    return windows[np.isfinite(windows).all(axis=1)]


def _score(
    peak: PeakSets, recipe: Recipe, seed: int
) -> tuple[dict[str, dict[str, Values]], dict[str, Any]]:
    """Return parameter values by method and the scores of one peak."""
    scores: dict[str, Any] = {
        "n_sim": len(peak.raw),
        "n_data": len(peak.data),
        "not_prepared": peak.not_prepared(),
    }
    missing = peak.missing()
    if missing is not None:
        return {}, scores | {"parameters": {}, "missing": missing}
    values = {
        method: pulse_parameters(pulses, recipe.preparation, recipe.scores)
        for method, pulses in _by_method(peak)
    }
    methods: Mapping[str, Mapping[str, Values]] = {
        method: of_method for method, of_method in values.items() if method != "data"
    }
    windows = {method: pulses.waveforms for method, pulses in _by_method(peak)}
    scores["two_sample"] = told_apart(windows, values, seed)
    scores["parameters"] = compare(values["data"], methods, recipe.scores, seed)
    if peak.truth is not None:
        scores["paired"] = _paired(peak, recipe.scores.edge_samples)
    return values, scores


def _by_method(peak: PeakSets) -> list[tuple[str, Pulses]]:
    """Pulses by method, from the simplest to the known answer."""
    others = {
        name: Pulses.of(windows, dt_ns=peak.raw.dt_ns)
        for name, windows in peak.others.items()
        if len(windows) >= FEWEST
    }
    rivals = {name: p for name, p in others.items() if not name.startswith("truth")}
    truth = {name: p for name, p in others.items() if name.startswith("truth")}
    scored = {"data": peak.data, "raw": peak.raw} | rivals | {"ren": peak.ren} | truth
    return list(scored.items())


def _paired(peak: PeakSets, edge_samples: int) -> dict[str, Any]:
    assert peak.truth is not None
    known = np.isfinite(peak.truth).all(axis=1)
    for windows in peak.clean.values():
        known &= np.isfinite(windows).all(axis=1)
    return {
        method: paired_scores(waveforms[known], peak.truth[known], edge_samples)
        for method, waveforms in peak.clean.items()
    }


def _notes(info: Mapping[str, Any], truth: Path | None) -> list[str]:
    notes = [
        f"Trained with recipe “{info['recipe']}” on {info['sim']['used']} simulated and "
        f"{info['data']['used']} measured pulses of {info['peak']}, unpaired; peaks other "
        "than that took no part in the training.",
        "IoU is the overlap of two distributions in percent. Two samples of the same "
        "distribution do not reach 100 at finite size: the ceiling is what data score "
        "against data at these sizes.",
    ]
    if truth is None:
        notes.append("No truth was given, so single pulses are not scored.")
    return notes
