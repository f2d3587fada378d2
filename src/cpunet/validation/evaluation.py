"""Apply a run to simulated pulses and compare them with measured ones."""

from __future__ import annotations

import re
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import cpunet
from cpunet.errors import CpunetError
from cpunet.processes import one_thread_for_matrices, usable_cores
from cpunet.progress import stage
from cpunet.pulses.loading import InputSet, load_pulses, require_same_sampling
from cpunet.pulses.parameters import tail_slope
from cpunet.pulses.peaks import parse_selection
from cpunet.pulses.reading.files import PulseFile
from cpunet.pulses.shape_parameters import median_decay_ns
from cpunet.recipes.schema import Recipe
from cpunet.training.run import Run, resolve_device
from cpunet.translation.translator import REN
from cpunet.validation.a_over_e import DEP, Range, dep_scales, survivals
from cpunet.validation.ae_energy import against_energy
from cpunet.validation.methods import fit_baseline_methods, translate_all, true_responses
from cpunet.validation.metrics import Metrics
from cpunet.validation.peaks import PeakSets, fit_ends, score_peak

MAX_PULSES = 50_000  # per side, for an error of the scores of about 0.3 percentage points


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
    """Translate, compare and score; see `cpunet.validation.validate.validate`.

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
    selection = parse_selection(",".join(names), recipe.peaks)
    lines = _lines(recipe)
    more = [band for _, sidebands in lines.values() for band in sidebands]
    more += recipe.scores.continuum_kev.values()
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
        raise CpunetError(
            f"{data_set.path}: no peak has pulses on both sides",
            "check the calibration (`kev_per_adc`, `data_energy`)",
        )
    continua: dict[str, tuple[Range, list[Range]]] = {
        n: (span, []) for n, span in recipe.scores.continuum_kev.items()
    }
    survival, ranges = survivals(
        ae,
        amplitudes,
        energy_kev,
        lines | continua,
        {peak.name: peak.moved[name] for peak in sets if peak.moved},
        seed,
    )
    tails = None if run.fit is None else run.fit.tails
    metrics = Metrics(
        compared=_compared(run, sim_set, data_set),
        peaks=peaks,
        ae_survival=survival,
        ae_details={"survival by energy range": ranges},
        ae_energy=against_energy(
            {method: amplitudes[method] for method in ("data", "ren")},
            energy_kev,
            {name: span for name, (span, _) in lines.items()},
        ),
        a_over_e_scale=scales,
        baseline_methods={
            "fits": {name: of.describe() for name, of in fits.methods.items()},
            "missing": fits.missing,
        },
        training={"recipe": recipe.name}
        | {name: getattr(run, name) for name in ("seconds", "device", "seed", "peak", "ok")},
        tails=None if tails is None else tails.model_dump(exclude_unset=True),
        rejections={"sim": sim_set.prepared.rejections, "data": data_set.prepared.rejections},
    )
    return Evaluation(run, sets, metrics)


def _lines(recipe: Recipe) -> dict[str, tuple[Range, list[Range]]]:
    """Range and sidebands of each peak."""
    near, far = recipe.scores.sideband_kev
    widest = max(peak.half_width_kev for peak in recipe.peaks.values())
    if widest > near:
        raise CpunetError(
            f"recipe {recipe.name}: sidebands from {near:g} keV off a line overlap its "
            f"range of {widest:g} keV; give a larger scores.sideband_kev"
        )
    return {
        name: (
            (peak.energy_kev - peak.half_width_kev, peak.energy_kev + peak.half_width_kev),
            [
                (peak.energy_kev - far, peak.energy_kev - near),
                (peak.energy_kev + near, peak.energy_kev + far),
            ],
        )
        for name, peak in recipe.peaks.items()
    }


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
