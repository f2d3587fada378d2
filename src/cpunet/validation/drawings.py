"""What is drawn of a validation, peak by peak.

It is unknown which simulated and which measured pulses come from the same position.  A
simulated pulse is therefore shown with the measured pulse nearest to its translation.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from functools import partial
from itertools import pairwise
from typing import TYPE_CHECKING

import numpy as np
from matplotlib.figure import Figure

from cpunet.pulses.container import FloatArray
from cpunet.pulses.parameters import Values
from cpunet.pulses.shape_parameters import data_axis
from cpunet.training.figures import loss_curves
from cpunet.translation.translator import IREN
from cpunet.validation import figures
from cpunet.validation.a_over_e import DEP
from cpunet.validation.metrics import PeakScores
from cpunet.validation.peaks import MeanPulse, PeakSets, around_half, sliced

if TYPE_CHECKING:
    from cpunet.validation.validate import Evaluation

SINGLE = ("raw", "rc", "rc_late", "ren", "truth")  # methods in the figure of a single pulse
SLICED = ("data", "rc", "rc_late", "ren")  # and in slices
SHOWN = 10  # pulses in a figure of cycles, as in the paper

Drawing = Callable[[], Figure]


def drawings(evaluated: Evaluation) -> dict[str, Drawing]:
    """Functions that draw the figures of a validation, by name; they hold what they draw."""
    drawn: dict[str, Drawing] = {}
    metrics, run = evaluated.metrics, evaluated.run
    if metrics.held_out:
        drawn["overlap with data"] = partial(figures.overlap_figure, metrics)
    if courses := metrics.ae_energy.methods:
        drawn["A over E and energy"] = partial(figures.ae_energy_figure, courses)
    scored = [peak for peak in evaluated.sets if peak.values]
    for peak in scored:
        of_peak = _of_peak(peak, metrics.peaks[peak.name])
        drawn |= {f"{peak.name} {what}": draw for what, draw in of_peak}
    ae = {p.name: {m: v["current_amplitude"] for m, v in p.values.items()} for p in scored}
    if DEP in ae and len(ae) > 1:
        drawn["A over E survival"] = partial(figures.roc_figure, ae)
    if any(name.startswith(f"{IREN.part}.") for name in run.weights):
        # pulses of both sides of the fullest peak through both networks and back
        fullest = max(evaluated.sets, key=lambda peak: min(map(len, peak.rows.values())))
        iren, ren = run.iren, fullest.translations.ren
        for forward, back, side, names in (
            (ren, iren, "raw", ("Simulation", "REN", "IREN of REN")),
            (iren, ren, "data", ("Data", "IREN", "REN of IREN")),
        ):
            start, rows = fullest.windows(side)[:SHOWN], fullest.rows[side][:SHOWN]
            kev = fullest.translations.energy_kev[side][rows]
            middle = forward.apply(start, energy_kev=kev, noise=False)
            end = back.apply(middle, energy_kev=kev, noise=False)
            stages = dict(zip(names, (start, middle, end), strict=True))
            name = f"{fullest.name} cycle of {names[0].lower()}"
            drawn[name] = partial(figures.cycle_figure, stages, ren.dt_ns)
    if run.records:
        drawn["losses"] = partial(loss_curves, run.records)
    return drawn


def _of_peak(peak: PeakSets, scores: PeakScores) -> Iterator[tuple[str, Drawing]]:
    """Distributions, mean pulses, a single pulse and the noise of a peak."""
    ren, name, values = peak.translations.ren, peak.name, peak.values
    dt_ns, bins = ren.dt_ns, ren.recipe.scores.max_bins
    further: dict[str, dict[str, Values]] = {}
    for parameter, data in values["data"].items():
        by_method = {m: v[parameter] for m, v in values.items()}
        if not np.isfinite(data).any():
            continue
        if parameter in scores.judged:
            how = (by_method, data_axis(data, bins), parameter, name, scores.judged[parameter])
            yield parameter.replace("_", " "), partial(figures.parameter_histograms, *how)
        else:
            further[parameter] = by_method
    yield "further parameters", partial(figures.further_histograms, further, bins, name)

    # mean pulses, of all and in slices
    rise_time = {method: v["rise_01_90"] for method, v in values.items()}
    edges, means = sliced(peak.windows, rise_time, dt_ns)
    whole = {"": {method: of_method[0] for method, of_method in means.items()}}
    draw = partial(figures.shape_figure, dt_ns=dt_ns)
    yield "mean pulse", partial(draw, whole, title=f"{name}: mean pulse")
    columns = {
        f"{low:.0f} … {high:.0f} ns": {m: means[m][i] for m in SLICED if m in means}
        for i, (low, high) in enumerate(pairwise(edges), start=1)
    }
    title = f"{name}: superpulses in slices of rise time 1–90 %"
    yield "superpulses", partial(draw, columns, title=title)

    # the first simulated pulse that all methods can align
    for row in peak.known_to_all():
        windows = peak.translations.without_noise(row)
        shapes = {m: around_half(windows[m], dt_ns)[0] for m in SINGLE if m in windows}
        if all(np.isfinite(shape).any() for shape in shapes.values()):
            measured = around_half(peak.windows("data"), dt_ns)
            place, rms = nearest(measured, shapes["ren"])
            shapes = {"data": measured[place]} | shapes
            pulses = {m: MeanPulse(s, np.full(len(s), np.nan), 1) for m, s in shapes.items()}
            title = f"{name}: a simulated pulse without noise, and the measured pulse\n"
            title += f"nearest to its REN translation (RMS difference {rms:.4f})"
            yield "single pulse", partial(draw, {"": pulses}, title=title)
            break
    if not scores.noise["data"].missing:
        noise = {m: scores.noise[m] for m in ("data", "ren")}
        yield "noise", partial(figures.spectrum_of_noise, noise, name)


def nearest(aligned: FloatArray, target: FloatArray) -> tuple[int, float]:
    """The pulse with the smallest RMS difference from another, both aligned at half maximum.

    Noise contributes to the difference.  Pulses with less than half of the compared samples
    in their record are left out.

    Parameters
    ----------
    aligned
        Pulses to choose from, see `around_half`, shape ``(n, samples)``.
    target
        Aligned pulse to compare with, shape ``(samples,)``.

    Returns
    -------
    tuple
        Row of the pulse, and its RMS difference in pulse heights.

    Examples
    --------
    >>> time = np.arange(400.0)
    >>> pulses = np.array([1 / (1 + np.exp((200 - time) / width)) for width in (2, 5, 9)])
    >>> aligned = around_half(pulses, dt_ns=16)
    >>> nearest(aligned, aligned[1])[0]
    1
    """
    offset = np.square(aligned - target.astype(float))
    is_finite = np.isfinite(offset)
    mean = np.where(is_finite, offset, 0).sum(axis=1) / np.maximum(is_finite.sum(axis=1), 1)
    enough = np.isfinite(aligned).sum(axis=1) >= 0.5 * np.isfinite(target).sum()
    squares = np.where(enough & is_finite.any(axis=1), mean, np.inf)
    row = int(squares.argmin())
    return row, float(np.sqrt(squares[row]))
