"""The figures of a validation, as functions that draw them."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import partial
from typing import Any

import numpy as np
import torch
from matplotlib.figure import Figure

from cpunet.networks.learned_response import DriftUNet
from cpunet.pulses.binning import data_axis
from cpunet.pulses.half_maximum import align_half_maximum
from cpunet.pulses.parameters import PARAMETERS
from cpunet.translation.translator import IREN, REN
from cpunet.validation.ae_energy_figure import FIGURE as AE_ENERGY
from cpunet.validation.ae_energy_figure import ae_energy_figure
from cpunet.validation.ae_figures import ae_figure, roc_figure, two_dimensional_figure
from cpunet.validation.baseline_spectra import spectrum_of_noise
from cpunet.validation.comparisons import Comparison
from cpunet.validation.evaluation import Evaluation
from cpunet.validation.peak_details import PeakDetails
from cpunet.validation.peak_sets import PeakSets
from cpunet.validation.pulse_figures import DataPulse, single_pulse_figure, spectrum_figure
from cpunet.validation.remains_figure import sizes_figure
from cpunet.validation.run_figures import (
    cycle_figure,
    drift_figure,
    further_histograms,
    loss_curves,
    mean_pulses,
    parameter_histograms,
)
from cpunet.validation.slice_figure import slice_figure

# methods in the figures; more lines could not be distinguished
DRAWN = ("data", "raw", "gauss_exp", "superpulse", "ren", "truth")
SINGLE = ("raw", "rc", "ren", "truth")  # methods in the figure of a single pulse
SHOWN = 10  # pulses in a figure of cycles, as in the paper
TAILS = "pile-up tails"
DRIFT, IN_DRIFT = "clock and blur of the U-Net", 2048  # pulses in it
SPECTRUM, LOSSES, ROC, DEP = "spectrum", "losses", "A over E survival", "DEP"
CYCLES = ("forward cycle", "backward cycle")

Drawing = Callable[[], Figure]


def drawings(found: Evaluation) -> dict[str, Drawing]:
    """Functions that draw the figures of a validation, by name; they hold what they draw."""
    peaks = {name: peak.energy_kev for name, peak in found.ren.recipe.peaks.items()}
    energies = {"data": found.data.energies_kev, "raw": found.sim.energies_kev}
    made: dict[str, Drawing] = {SPECTRUM: partial(spectrum_figure, energies, peaks)}
    made |= _tails(found.metrics["tails"] or {})
    if methods := found.metrics["ae_energy"].get("methods"):
        made[AE_ENERGY] = partial(ae_energy_figure, methods)
    scored = [peak for peak in found.sets if found.values[peak.name]]
    fullest = max(scored, key=lambda s: min(len(s.sim_rows), len(s.data_rows)))
    forward, backward = CYCLES
    made[f"{fullest.name} {forward}"] = _forward(fullest, found.ren, found.iren)
    made[f"{fullest.name} {backward}"] = _backward(fullest, found.ren, found.iren)
    made |= _drift(fullest, found.ren)
    for peak in scored:
        made |= {f"{peak.name} {what}": one for what, one in _of_peak(peak, found).items()}
    if DEP in {peak.name for peak in scored} and len(scored) > 1:
        made[ROC] = _roc(found, [peak.name for peak in scored])
    if found.run.records:
        made[LOSSES] = partial(loss_curves, found.run.records)
    return made


def _tails(told: Mapping[str, Any]) -> dict[str, Drawing]:
    """Sizes of tails with their law, if a training found any and kept them."""
    if not (told.get("rate_khz") and "sizes" in told):
        return {}
    wanted = ("rate_khz", "rate_error_khz", "decay_us", "error_kev", "traces")
    known = {name: told[name] for name in wanted}
    return {TAILS: partial(sizes_figure, known, told["sizes"], told["drawn"]["energies_kev"])}


def _drift(peak: PeakSets, ren: REN) -> dict[str, Drawing]:
    """What a U-Net before the readout does, if there is one."""
    response = getattr(ren.backend.network, "response", None)
    drift = getattr(response, "drift", None)
    if not isinstance(drift, DriftUNet):
        return {}
    effect = drift.effect(torch.from_numpy(peak.raw.waveforms[:IN_DRIFT]))
    return {DRIFT: partial(drift_figure, *(values.numpy() for values in effect))}


def _of_peak(peak: PeakSets, found: Evaluation) -> dict[str, Drawing]:
    name, details = peak.name, found.details[peak.name]
    scores = found.metrics["peaks"][name]
    made: dict[str, Drawing] = {
        parameter: _histograms(name, parameter, found, scores["parameters"][parameter])
        for parameter in scores["parameters"]
        if np.isfinite(found.values[name]["data"][parameter]).any()
    }
    made |= _further(name, found)
    made["mean pulse"] = _mean_pulse(details, peak)
    row = _drawable(peak)
    if row is not None:
        made["single pulse"] = _single_pulse(peak, row, found)
    if details.slices:
        made["superpulses"] = _superpulses(details, peak)
    if "missing" not in details.ae_against_time:
        made["A over E"] = _ae(details, name)
    if "missing" not in details.plane:
        made["A over E and drift time"] = _plane(details, name)
    if "missing" not in scores["noise"]["data"]:
        shown = ("frequency_mhz", "data", "ren")
        noise = {method: n for method, n in scores["noise"].items() if method in shown}
        made["noise"] = partial(spectrum_of_noise, noise, name)
    return made


def _histograms(
    peak: str, parameter: str, found: Evaluation, comparison: Comparison
) -> Drawing:
    values = {m: v[parameter] for m, v in found.values[peak].items() if m in DRAWN}
    axis = data_axis(values["data"], found.ren.recipe.scores.max_bins)
    return partial(parameter_histograms, values, axis, parameter, peak, comparison)


def _further(peak: str, found: Evaluation) -> dict[str, Drawing]:
    by_method = {m: v for m, v in found.values[peak].items() if m in DRAWN}
    values = {
        name: {method: of_method[name] for method, of_method in by_method.items()}
        for name, data in by_method["data"].items()
        if name not in PARAMETERS and np.isfinite(data).any()
    }
    bins = found.ren.recipe.scores.max_bins
    drawing = partial(further_histograms, values, bins, peak)
    return {"further parameters": drawing} if values else {}


def _mean_pulse(details: PeakDetails, peak: PeakSets) -> Drawing:
    means = {m: mean for m, mean in details.means.items() if m in DRAWN}
    return partial(mean_pulses, means, peak.dt_ns, peak.name)


def _drawable(peak: PeakSets) -> int | None:
    """The first simulated event with an edge in every method."""
    for row in peak.known_to_all():
        windows = peak.without_noise(np.array([row])).values()
        edges = (align_half_maximum(w, 100, 150) for w in windows)
        if all(np.isfinite(edge).any() for edge in edges):
            return int(row)
    return None


def _single_pulse(peak: PeakSets, row: int, found: Evaluation) -> Drawing:
    sets = peak.without_noise(np.array([row]))
    pulses = {method: sets[method][0] for method in SINGLE if method in sets}
    before = found.ren.recipe.preparation.samples_before
    beside = DataPulse.beside(pulses, peak.data.waveforms, peak.dt_ns, before)
    title = f"{peak.name}, simulated pulse {row}"
    return partial(single_pulse_figure, pulses, beside, peak.dt_ns, before, title)


def _superpulses(details: PeakDetails, peak: PeakSets) -> Drawing:
    shown = ("data", "superpulse", "ren")
    sets = {m: slices for m, slices in details.slices.items() if m in shown}
    return partial(slice_figure, sets, peak.dt_ns, peak.name)


def _ae(details: PeakDetails, name: str) -> Drawing:
    table = dict(details.ae_against_time)
    table["methods"] = {m: rows for m, rows in table["methods"].items() if m in DRAWN}
    return partial(ae_figure, table, name)


def _roc(found: Evaluation, peaks: list[str]) -> Drawing:
    ae = {
        peak: {
            method: values["current_amplitude"]
            for method, values in found.values[peak].items()
            if method in DRAWN
        }
        for peak in peaks
    }
    return partial(roc_figure, ae, DEP)


def _plane(details: PeakDetails, name: str) -> Drawing:
    table = dict(details.plane)
    shown = ("data", "raw", "ren", "truth")
    table["counts"] = {m: c for m, c in table["counts"].items() if m in shown}
    return partial(two_dimensional_figure, table, name)


def _forward(peak: PeakSets, ren: REN, iren: IREN) -> Drawing:
    """Simulated pulses translated by REN and back by IREN."""
    sim = peak.raw.waveforms[:SHOWN]
    like_data = ren.apply(sim, noise=False)
    back = iren.apply(like_data, noise=False)
    titles = ("Simulation", "REN (simulation)", "IREN (REN (simulation))")
    return partial(cycle_figure, sim, like_data, back, titles, ren.dt_ns)


def _backward(peak: PeakSets, ren: REN, iren: IREN) -> Drawing:
    """Measured pulses translated by IREN and back by REN."""
    data = peak.data.waveforms[:SHOWN]
    like_sim = iren.apply(data, noise=False)
    back = ren.apply(like_sim, noise=False)
    titles = ("Data", "IREN (data)", "REN (IREN (data))")
    return partial(cycle_figure, data, like_sim, back, titles, ren.dt_ns)
