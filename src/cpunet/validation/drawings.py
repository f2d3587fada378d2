"""The figures of a validation, as functions that draw them."""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping
from dataclasses import replace
from functools import partial
from typing import TypeVar

import numpy as np
import torch
from matplotlib.figure import Figure

from cpunet.networks.learned_response import DriftUNet
from cpunet.pulses.parameters import PARAMETERS, Values, align_half_maximum
from cpunet.pulses.shape_parameters import data_axis
from cpunet.validation.a_over_e import DEP, ae_figure
from cpunet.validation.ae_energy import ae_energy_figure
from cpunet.validation.evaluation import Evaluation
from cpunet.validation.noise import spectrum_of_noise
from cpunet.validation.page import AE_ENERGY
from cpunet.validation.peaks import PeakSets
from cpunet.validation.pulse_figures import (
    DataPulse,
    single_pulse_figure,
    spectrum_figure,
    tails_figure,
)
from cpunet.validation.run_figures import (
    cycle_figure,
    drift_figure,
    further_histograms,
    loss_curves,
    mean_pulses,
    parameter_histograms,
    roc_figure,
)
from cpunet.validation.slices import slice_figure

# methods in the figures; more lines could not be distinguished
DRAWN = ("data", "raw", "gauss_exp", "superpulse", "ren", "truth")
SINGLE = ("raw", "rc", "ren", "truth")  # methods in the figure of a single pulse
SHOWN = 10  # pulses in a figure of cycles, as in the paper
TAILS = "pile-up tails"
DRIFT, IN_DRIFT = "clock and blur of the U-Net", 2048  # pulses in it
SPECTRUM, LOSSES, ROC = "spectrum", "losses", "A over E survival"
FORWARD = ("Simulation", "REN (simulation)", "IREN (REN (simulation))")
BACKWARD = ("Data", "IREN (data)", "REN (IREN (data))")

Drawing = Callable[[], Figure]
T = TypeVar("T")


def drawings(found: Evaluation) -> dict[str, Drawing]:
    """Functions that draw the figures of a validation, by name; they hold what they draw."""
    ren, iren, metrics = found.ren, found.iren, found.metrics
    peaks = {name: peak.energy_kev for name, peak in ren.recipe.peaks.items()}
    energies = {"data": found.data.energies_kev, "raw": found.sim.energies_kev}
    drawn: dict[str, Drawing] = {SPECTRUM: partial(spectrum_figure, energies, peaks)}
    tails = metrics["tails"] or {}
    if tails.get("rate_khz") and "sizes" in tails:  # if any are known and were kept
        drawn[TAILS] = partial(tails_figure, tails)
    if found.ae_energy.methods:
        drawn[AE_ENERGY] = partial(ae_energy_figure, found.ae_energy.methods)
    scored = [peak for peak in found.sets if found.values[peak.name]]
    fullest = max(scored, key=lambda s: min(len(s.sim_rows), len(s.data_rows)))
    for name, side, there, back, titles in (
        ("forward cycle", fullest.raw, ren, iren, FORWARD),
        ("backward cycle", fullest.data, iren, ren, BACKWARD),
    ):
        start = side.waveforms[:SHOWN]
        middle = there.apply(start, noise=False)
        end = back.apply(middle, noise=False)
        drawn[f"{fullest.name} {name}"] = partial(
            cycle_figure, start, middle, end, titles, ren.dt_ns
        )
    drift = getattr(getattr(ren.backend.network, "response", None), "drift", None)
    if isinstance(drift, DriftUNet):
        effect = drift.effect(torch.from_numpy(fullest.raw.waveforms[:IN_DRIFT]))
        drawn[DRIFT] = partial(drift_figure, *(values.numpy() for values in effect))
    for peak in scored:
        drawn |= {f"{peak.name} {what}": one for what, one in _of_peak(peak, found).items()}
    if DEP in {peak.name for peak in scored} and len(scored) > 1:
        ae = {
            peak.name: {
                method: values["current_amplitude"]
                for method, values in _shown(found.values[peak.name]).items()
            }
            for peak in scored
        }
        drawn[ROC] = partial(roc_figure, ae, DEP)
    if found.run.records:
        drawn[LOSSES] = partial(loss_curves, found.run.records)
    return drawn


def _shown(by_method: Mapping[str, T], methods: Collection[str] = DRAWN) -> dict[str, T]:
    return {method: one for method, one in by_method.items() if method in methods}


def _of_peak(peak: PeakSets, found: Evaluation) -> dict[str, Drawing]:
    name, details, dt_ns = peak.name, found.details[peak.name], peak.dt_ns
    scores, values = found.metrics["peaks"][name], _shown(found.values[name])
    before, bins = found.run.recipe.preparation.samples_before, found.run.recipe.scores.max_bins
    drawn: dict[str, Drawing] = {}
    further: dict[str, dict[str, Values]] = {}
    for parameter, data in values["data"].items():
        by_method = {m: v[parameter] for m, v in values.items() if parameter in v}
        if not np.isfinite(data).any():
            continue
        if parameter in PARAMETERS:
            axis, compared = data_axis(data, bins), scores["parameters"][parameter]
            how = (by_method, axis, parameter, name, compared)
            drawn[parameter] = partial(parameter_histograms, *how)
        else:
            further[parameter] = by_method
    drawn["further parameters"] = partial(further_histograms, further, bins, name)
    drawn["mean pulse"] = partial(mean_pulses, _shown(details.means), dt_ns, name)
    row = _drawable(peak)
    if row is not None:
        sets = _shown(peak.without_noise(np.array([row])), SINGLE)
        pulses = {method: windows[0] for method, windows in sets.items()}
        beside = DataPulse.beside(pulses, peak.data.waveforms, dt_ns, before)
        title = f"{name}, simulated pulse {row}"
        drawn["single pulse"] = partial(
            single_pulse_figure, pulses, beside, dt_ns, before, title
        )
    slices = _shown(details.slices, ("data", "superpulse", "ren"))
    drawn["superpulses"] = partial(slice_figure, slices, dt_ns, name)
    ae = details.ae_against_time
    drawn["A over E"] = partial(ae_figure, replace(ae, methods=_shown(ae.methods)), name)
    if "missing" not in scores["noise"]["data"]:
        noise = _shown(scores["noise"], ("frequency_mhz", "data", "ren"))
        drawn["noise"] = partial(spectrum_of_noise, noise, name)
    return drawn


def _drawable(peak: PeakSets) -> int | None:
    """The first simulated event with an edge in every method."""
    for row in peak.known_to_all():
        windows = peak.without_noise(np.array([row])).values()
        edges = (align_half_maximum(w, 100, 150) for w in windows)
        if all(np.isfinite(edge).any() for edge in edges):
            return int(row)
    return None
