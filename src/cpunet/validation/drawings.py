"""The figures of a validation, as functions that draw them."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from itertools import pairwise

import numpy as np
from matplotlib.figure import Figure

from cpunet.pulses.parameters import Values
from cpunet.pulses.shape_parameters import data_axis
from cpunet.translation.translator import IREN
from cpunet.validation import run_figures
from cpunet.validation.a_over_e import DEP
from cpunet.validation.evaluation import Evaluation
from cpunet.validation.peaks import MeanPulse, PeakSets, around_half, sliced

SINGLE = ("raw", "rc", "rc_late", "ren", "truth")  # methods in the figure of a single pulse
SLICED = ("data", "rc", "rc_late", "ren")  # and in slices
SHOWN = 10  # pulses in a figure of cycles, as in the paper

Drawing = Callable[[], Figure]


def drawings(evaluated: Evaluation) -> dict[str, Drawing]:
    """Functions that draw the figures of a validation, by name; they hold what they draw."""
    drawn: dict[str, Drawing] = {}
    metrics = evaluated.metrics
    if metrics.held_out:
        drawn["overlap with data"] = partial(run_figures.overlap_figure, metrics)
    if courses := metrics.ae_energy.methods:
        drawn["A over E and energy"] = partial(run_figures.ae_energy_figure, courses)
    scored = [peak for peak in evaluated.sets if peak.values]
    for peak in scored:
        of_peak = _of_peak(peak, evaluated)
        drawn |= {f"{peak.name} {what}": draw for what, draw in of_peak.items()}
    ae = {p.name: {m: v["current_amplitude"] for m, v in p.values.items()} for p in scored}
    if DEP in ae and len(ae) > 1:
        drawn["A over E survival"] = partial(run_figures.roc_figure, ae)
    if any(name.startswith(f"{IREN.part}.") for name in evaluated.run.weights):
        # pulses of both sides of the fullest peak through both networks and back
        fullest = max(evaluated.sets, key=lambda peak: min(map(len, peak.rows.values())))
        iren, ren = evaluated.run.iren, fullest.translations.ren
        for forward, back, side, names in (
            (ren, iren, "raw", ("Simulation", "REN", "IREN of REN")),
            (iren, ren, "data", ("Data", "IREN", "REN of IREN")),
        ):
            start, rows = fullest.windows(side)[:SHOWN], fullest.rows[side][:SHOWN]
            kev = fullest.translations.energy_kev[side][rows]
            middle = forward.apply(start, energy_kev=kev, noise=False)
            end = back.apply(middle, energy_kev=kev, noise=False)
            stages = dict(zip(names, (start, middle, end), strict=True))
            draw = partial(run_figures.cycle_figure, stages, ren.dt_ns)
            drawn[f"{fullest.name} cycle of {names[0].lower()}"] = draw
    if evaluated.run.records:
        drawn["losses"] = partial(run_figures.loss_curves, evaluated.run.records)
    return drawn


def _of_peak(peak: PeakSets, evaluated: Evaluation) -> dict[str, Drawing]:
    name, dt_ns, bins = peak.name, evaluated.run.dt_ns, evaluated.run.recipe.scores.max_bins
    scores, values = evaluated.metrics.peaks[name], peak.values
    drawn: dict[str, Drawing] = {}
    further: dict[str, dict[str, Values]] = {}
    for parameter, data in values["data"].items():
        by_method = {m: v[parameter] for m, v in values.items()}
        if not np.isfinite(data).any():
            continue
        if parameter in scores.judged:
            how = (by_method, data_axis(data, bins), parameter, name, scores.judged[parameter])
            drawn[parameter.replace("_", " ")] = partial(run_figures.parameter_histograms, *how)
        else:
            further[parameter] = by_method
    drawn["further parameters"] = partial(run_figures.further_histograms, further, bins, name)
    rise_time = {method: v["rise_01_90"] for method, v in values.items()}
    edges, means = sliced(peak.windows, rise_time, dt_ns)
    whole = {"": {method: of_method[0] for method, of_method in means.items()}}
    title = f"{name}: mean pulse"
    drawn["mean pulse"] = partial(run_figures.shape_figure, whole, dt_ns, title)
    columns = {
        f"{low:.0f} … {high:.0f} ns": {m: means[m][i] for m in SLICED if m in means}
        for i, (low, high) in enumerate(pairwise(edges), start=1)
    }
    title = f"{name}: superpulses in slices of rise time 1–90 %"
    drawn["superpulses"] = partial(run_figures.shape_figure, columns, dt_ns, title)
    if (single := _single_pulse(peak)) is not None:
        drawn["single pulse"] = single
    if not scores.noise["data"].missing:
        noise = {m: scores.noise[m] for m in ("data", "ren")}
        drawn["noise"] = partial(run_figures.spectrum_of_noise, noise, name)
    return drawn


def _single_pulse(peak: PeakSets) -> Drawing | None:
    """The first simulated event with an edge in every method, with a measured pulse."""
    dt_ns = peak.translations.ren.dt_ns
    for row in peak.known_to_all():
        windows = peak.translations.without_noise(row)
        shapes = {m: around_half(windows[m], dt_ns)[0] for m in SINGLE if m in windows}
        if all(np.isfinite(shape).any() for shape in shapes.values()):
            data = peak.windows("data")
            place, rms = run_figures.nearest(around_half(data, dt_ns), shapes["ren"])
            shapes = {"data": around_half(data[[place]], dt_ns)[0]} | shapes
            pulses = {m: MeanPulse(s, np.full(len(s), np.nan), 1) for m, s in shapes.items()}
            title = f"{peak.name}: a simulated pulse without noise, and the measured pulse\n"
            title += f"nearest to its REN translation (RMS difference {rms:.4f})"
            return partial(run_figures.shape_figure, {"": pulses}, dt_ns, title)
    return None
