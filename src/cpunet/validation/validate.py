"""Validate a run: scores per peak, figures and a report."""

from __future__ import annotations

import logging
import re
from concurrent.futures import ThreadPoolExecutor
from contextlib import nullcontext
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import cpunet
from cpunet.errors import CpunetError
from cpunet.outputs import folder_written_aside
from cpunet.processes import one_thread_for_matrices, usable_cores
from cpunet.progress import stage
from cpunet.pulses.channels import Outcome, Pair, each_channel, own_folder, paired
from cpunet.pulses.loading import InputSet, load_pulses, require_same_sampling
from cpunet.pulses.parameters import tail_slope
from cpunet.pulses.peaks import parse_selection
from cpunet.pulses.reading.files import ALL, PulseFile, ReadOptions, Source
from cpunet.pulses.shape_parameters import median_decay_ns
from cpunet.recipes.schema import Recipe
from cpunet.settings import require_seed
from cpunet.training.run import INFO, Run, RunLike, resolve_device, used_run
from cpunet.translation.translator import REN
from cpunet.validation.a_over_e import DEP, Range, dep_scales, survivals
from cpunet.validation.ae_energy import against_energy
from cpunet.validation.compare import compared
from cpunet.validation.methods import fit_baseline_methods, translate_all, true_responses
from cpunet.validation.metrics import Metrics
from cpunet.validation.peaks import PeakSets, fit_ends, score_peak
from cpunet.validation.report import REPORT, Report

log = logging.getLogger(__name__)

INDEX = "index.html"
MAX_PULSES = 50_000  # per side, for an error of the scores of about 0.3 percentage points


def validate(
    run: RunLike,
    sim: Source,
    data: Source,
    out: str | Path | None = None,
    *,
    truth: str | Path | None = None,
    baselines: bool = True,
    peak: str = "",
    max_pulses: int = MAX_PULSES,
    seed: int = 0,
    read: ReadOptions = ReadOptions(),
    force: bool = False,
) -> Report | Outcome[Report]:
    """Score a run per peak and write a report: figures, metrics.json, report.html.

    Every peak of the recipe is scored, and the energies of the training if they are not a
    peak.  SEP and DEP take no part in a training on the FEP: they are the test.

    Parameters
    ----------
    run
        Folder of a training run, or of runs by channel.
    sim
        Simulated pulses.
    data
        Measured pulses.
    out
        Report folder to make; without one, nothing is written.
    truth
        Noise-free responses of the simulated pulses (.npz), if given.
    baselines
        Fit the baseline methods too, which takes most of the time.
    peak
        Further energies to score in keV, as ``200-400`` or ``200-400,400-1000``.
    max_pulses
        Pulses of a side that are compared: of more, a random sample. Some 30 kB each.
    seed
        Seed of noise and bootstraps.
    read
        How the files are read.
    force
        Replace existing output.

    Returns
    -------
    Report or Outcome
        Scores, values, histograms and figures; with ``data_table="all"`` those of each
        channel, whose reports are folders in `out`, with a page of all.

    Raises
    ------
    CpunetError
        If an argument cannot be used, or no peak can be scored.

    Examples
    --------
    cpunet validate run --sim sim.lh5 --data raw.lh5 --out report

    cpunet validate runs --sim sim.lh5 --data raw.lh5 --data-table all --out reports
    """
    if max_pulses < 100:
        raise CpunetError(f"`max_pulses`: {max_pulses} are too few to compare", "give 100")
    sim, data = read.files(sim, data)
    folder = None if out is None else Path(out)
    how: dict[str, Any] = {
        "truth": None if truth is None else Path(truth),
        "baselines": baselines,
        "further": peak,
        "max_pulses": max_pulses,
        "seed": require_seed(seed),
        "force": force,
    }
    if data.table != ALL:
        return _validated(used_run(run), (sim, data), folder, **how)
    if folder is None:
        raise CpunetError(f"`data_table` {ALL}: give `out`, the folder of the reports")
    channels = paired(sim, data)
    outcome = each_channel(channels, folder, partial(_of_channel, run, how))
    if outcome.done:
        folders = [folder / name for name in channels]
        # without force, a channel with a report fails and keeps it
        failed = [folder / name for name in outcome.failed if force]
        compared(folders, failed=failed).save(folder / INDEX, force=True)
        log.info(f"all channels: {folder / INDEX}")
    return Outcome({n: Report.load(place) for n, place in outcome.done.items()}, outcome.failed)


def _of_channel(runs: RunLike, how: dict[str, Any], name: str, pair: Pair, out: Path) -> Path:
    """The folder of the report of a channel, made in a process of its own."""
    run = runs if isinstance(runs, Run) else own_folder(Path(runs), name, INFO)
    _validated(used_run(run), pair, out, **how)
    return out


def _validated(
    run: Run, pair: Pair, out: Path | None, *, truth: Path | None, force: bool, **how: Any
) -> Report:
    """Scores, and functions that draw; translated pulses are forgotten."""
    pair = run.sim.reading(pair[0]), run.data.reading(pair[1])
    read = (run.folder, *pair[0].files, *pair[1].files, truth)
    written = folder_written_aside(out, REPORT, *read, force=force) if out else nullcontext()
    with written as aside:
        evaluation = evaluate(run, *pair, truth=truth, **how)
        # matplotlib is not needed while the pulses take most memory
        from cpunet.validation.drawings import drawings

        drawn = drawings(evaluation)
        values = {peak.name: peak.values for peak in evaluation.sets if peak.values}
        report = Report(evaluation.metrics, values, out, drawn)
        del evaluation  # all pulses
        if aside is not None:
            report.write(aside)
    return report


@dataclass(frozen=True, eq=False)
class Evaluation:
    """Results of a validation, from which figures and report are translations.

    Parameters
    ----------
    run
        The run.
    sets
        Pulses of each peak and, if it is scored, their parameters.
    metrics
        All numbers.
    """

    run: Run
    sets: list[PeakSets]
    metrics: Metrics


@one_thread_for_matrices()
def evaluate(
    run: Run,
    sim: PulseFile,
    data: PulseFile,
    *,
    truth: Path | None = None,
    baselines: bool = True,
    further: str = "",
    max_pulses: int = MAX_PULSES,
    seed: int = 0,
) -> Evaluation:
    """Translate, compare and score; see `validate`.

    Raises
    ------
    CpunetError
        If the input cannot be used, or no peak can be scored.
    """
    recipe, trained_on = run.recipe, run.peak
    ren = REN.of(run, resolve_device("auto", run.recipe))
    others = further.replace(" ", "").split(",") if further else []
    names = list(dict.fromkeys([*recipe.peaks, trained_on, *others]))
    # energies of the peaks, with all sidebands and continua
    selection, bands = parse_selection(",".join(names), recipe.peaks), _bands(recipe)
    more = [band for span, sidebands in bands.values() for band in sidebands or [span]]
    selection = replace(selection, ranges_kev=(*selection.ranges_kev, *more))
    sim_set = load_pulses(sim, "simulated", recipe, selection, max_pulses=max_pulses)
    data_set = load_pulses(data, "measured", recipe, selection, max_pulses=max_pulses)
    require_same_sampling(sim_set, data_set)
    ren.require_sampling(f"{sim_set.path}:", sim_set.dt_ns)
    responses = None if truth is None else true_responses(truth, sim_set)
    fit_on = parse_selection(trained_on, recipe.peaks)
    fits = fit_baseline_methods(ren, sim_set, data_set, fit_on, fitted=baselines)
    translations = translate_all(ren, fits, sim_set, data_set, responses, seed)
    sets = [PeakSets.of(name, translations) for name in names]
    dep = next((peak.rows for peak in sets if peak.name == DEP), {})
    amplitudes, energy_kev = translations.amplitudes, translations.energy_kev
    scales = dep_scales({m: amplitudes[m][rows] for m, rows in dep.items()}, seed)
    samples = recipe.preparation.at(ren.dt_ns).decay_fit_samples
    decays = {  # as an analysis has one for a channel
        method: median_decay_ns(tail_slope(windows, ren.dt_ns, samples))
        for method, windows in translations.windows.items()
    }
    ends = fit_ends(run, ren)
    score = partial(score_peak, ends=ends, seed=seed, scales=scales, decays_ns=decays)
    peaks = {}
    with stage("Scoring", len(sets)) as bar, ThreadPoolExecutor(usable_cores()) as pool:
        for peak, scores in zip(sets, pool.map(score, sets), strict=True):
            peaks[peak.name] = scores
            bar.update(1)
    name = "current_amplitude"
    ae = {p.name: {m: v[name] for m, v in p.values.items()} for p in sets if p.values}
    if not ae:
        remedy = "check the calibration (`kev_per_adc`, `data_energy`)"
        raise CpunetError(f"{data_set.path}: no peak has pulses on both sides", remedy)
    moved = {peak.name: peak.moved[name] for peak in sets if peak.moved}
    survival, ranges = survivals(ae, amplitudes, energy_kev, bands, moved, seed)
    both = {method: amplitudes[method] for method in ("data", "ren")}
    lines = {peak: bands[peak][0] for peak in recipe.peaks}
    fitted = {name: of.values for name, of in fits.methods.items()}
    tails = None if run.fit is None else run.fit.tails
    metrics = Metrics(
        compared=_compared(run, sim_set, data_set),
        peaks=peaks,
        ae_survival=survival,
        ae_details={"survival by energy range": ranges},
        ae_energy=against_energy(both, energy_kev, lines),
        a_over_e_scale=scales,
        baseline_methods={"fits": fitted, "missing": fits.missing},
        training={"recipe": recipe.name}
        | {name: getattr(run, name) for name in ("seconds", "device", "seed", "peak", "ok")},
        tails=None if tails is None else tails.model_dump(exclude_unset=True),
        rejections={"sim": sim_set.prepared.rejections, "data": data_set.prepared.rejections},
    )
    return Evaluation(run, sets, metrics)


def _bands(recipe: Recipe) -> dict[str, tuple[Range, list[Range]]]:
    """Range and sidebands of each peak, and range of each continuum."""
    near, far = recipe.scores.sideband_kev
    bands: dict[str, tuple[Range, list[Range]]] = {}
    for name, peak in recipe.peaks.items():
        kev, half = peak.energy_kev, peak.half_width_kev
        if half > near:
            raise CpunetError(
                f"recipe {recipe.name}: sidebands from {near:g} keV off a line overlap its "
                f"range of {half:g} keV; give a larger scores.sideband_kev"
            )
        sidebands = [(kev - far, kev - near), (kev + near, kev + far)]
        bands[name] = (kev - half, kev + half), sidebands
    return bands | {name: (span, []) for name, span in recipe.scores.continuum_kev.items()}


def _compared(run: Run, sim: InputSet, data: InputSet) -> dict[str, str]:
    """Description of the compared inputs, shown before the scores."""
    training = (
        f"recipe {run.recipe.name} on {run.peak}",
        "" if run.seed is None else f"seed {run.seed}",
        f"{run.sim.used} simulated and {run.data.used} measured pulses",
        run.started[:10],
    )
    legend = re.match(r"l\d+-(p\d\d)-(r\d{3})-", data.path.name)
    # places of files do not depend on where a study is stored
    facts = {
        "detector": sim.detector,
        "channel": data.read_as.get("table"),
        "period": legend and f"{legend[1]} {legend[2]}",
        "simulation": "/".join(sim.path.absolute().parts[-2:]),
        "data": "/".join(data.path.absolute().parts[-2:]),
        "run": Path(run.name).absolute().name,
        "trained": ", ".join(filter(None, training)),
        "fit": run.fit and run.fit.verdict,
        "scored with": f"cpunet {cpunet.__version__}",
    }
    return {name: str(value) for name, value in facts.items() if value}
