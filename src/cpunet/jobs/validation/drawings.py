"""The figures of a validation: their numbers, and the functions that draw them.

A `Drawing` contains only numbers and text, so figures can be stored and redrawn without
scoring again, see `cpunet.jobs.validation.figure_store`.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from cpunet.analysis.ae_energy_figure import FIGURE as AE_ENERGY
from cpunet.analysis.ae_energy_figure import ae_energy_figure
from cpunet.analysis.ae_figures import ae_figure, roc_figure, two_dimensional_figure
from cpunet.analysis.baseline_spectra import spectrum_of_noise
from cpunet.analysis.comparisons import data_axis
from cpunet.analysis.drift_slices import Slices, Superpulse
from cpunet.analysis.mean_pulse import MeanPulse
from cpunet.analysis.paired import align_half_maximum
from cpunet.analysis.pulse_figures import DataPulse, single_pulse_figure, spectrum_figure
from cpunet.analysis.remains_figure import sizes_figure
from cpunet.analysis.run_figures import (
    cycle_figure,
    loss_curves,
    mean_pulses,
    parameter_histograms,
)
from cpunet.analysis.slice_figure import slice_figure
from cpunet.jobs.validation.evaluation import Evaluation
from cpunet.jobs.validation.peak_details import PeakDetails
from cpunet.jobs.validation.peak_sets import PeakSets
from cpunet.pulses.parameters import PARAMETERS
from cpunet.training.loop import Record
from cpunet.translation.translator import IREN, REN

# methods in the figures; more lines could not be distinguished
DRAWN = ("data", "raw", "gauss_exp", "superpulse", "ren", "truth")
SINGLE = ("raw", "rc", "ren", "truth")  # methods in the figure of a single pulse
SHOWN = 10  # pulses in a figure of cycles, as in the paper
REMAINS = "remains of earlier pulses"
SPECTRUM, LOSSES, ROC, DEP = "spectrum", "losses", "A over E survival", "DEP"
CYCLES = ("forward cycle", "backward cycle")
OF_PEAKS = (
    *PARAMETERS,
    "mean pulse",
    "single pulse",
    "superpulses",
    "A over E",
    "A over E and drift time",
    "noise",
)


@dataclass(frozen=True, eq=False)
class Drawing:
    """A figure to be drawn.

    Parameters
    ----------
    kind
        Kind of figure, one of `KINDS`.
    values
        Arguments of its function: numbers, text, arrays, and lists and mappings of them.
    """

    kind: str
    values: Mapping[str, Any]

    def draw(self) -> Figure:
        """Draw the figure."""
        return _DRAW[self.kind](**self.values)


def figure_names(peaks: Iterable[str]) -> list[str]:
    """Names of all figures that a validation of these peaks can have."""
    names = [f"{peak} {figure}" for peak in peaks for figure in (*CYCLES, *OF_PEAKS)]
    return [SPECTRUM, REMAINS, AE_ENERGY, *names, ROC, LOSSES]


def drawings(found: Evaluation) -> dict[str, Drawing]:
    """All figures of a validation by name."""
    peaks = {name: peak.energy_kev for name, peak in found.ren.recipe.peaks.items()}
    energies = {"data": found.data.energies_kev, "raw": found.sim.energies_kev}
    made = {SPECTRUM: Drawing(SPECTRUM, {"energy_kev": energies, "peaks": peaks})}
    made |= _remains(found.metrics["remains"] or {})
    if methods := found.metrics["ae_energy"].get("methods"):
        made[AE_ENERGY] = Drawing(AE_ENERGY, {"methods": methods})
    scored = [peak for peak in found.sets if found.values[peak.name]]
    fullest = max(scored, key=lambda s: min(len(s.sim_rows), len(s.data_rows)))
    forward, backward = CYCLES
    made[f"{fullest.name} {forward}"] = _forward(fullest, found.ren, found.iren)
    made[f"{fullest.name} {backward}"] = _backward(fullest, found.ren, found.iren)
    for peak in scored:
        made |= {f"{peak.name} {what}": one for what, one in _of_peak(peak, found).items()}
    if DEP in {peak.name for peak in scored} and len(scored) > 1:
        made[ROC] = _roc(found, [peak.name for peak in scored])
    if found.losses:
        made[LOSSES] = of_losses(found.losses)
    return made


def _remains(told: Mapping[str, Any]) -> dict[str, Drawing]:
    """Sizes of remains with their law, if a training found any and kept them."""
    if not (told.get("rate_khz") and "sizes" in told):
        return {}
    wanted = ("rate_khz", "rate_error_khz", "decay_us", "error_kev", "traces")
    values = {
        "told": {name: told[name] for name in wanted},
        "sizes": told["sizes"],
        "energies_kev": told["drawn"]["energies_kev"],
    }
    return {REMAINS: Drawing(REMAINS, values)}


def of_losses(records: list[Record]) -> Drawing:
    """The losses of a training."""
    return Drawing(LOSSES, {"records": records})


def _of_peak(peak: PeakSets, found: Evaluation) -> dict[str, Drawing]:
    name, details = peak.name, found.details[peak.name]
    scores = found.metrics["peaks"][name]
    made = {
        parameter: _histograms(name, parameter, found, scores["parameters"][parameter])
        for parameter in scores["parameters"]
        if np.isfinite(found.values[name]["data"][parameter]).any()
    }
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
        made["noise"] = Drawing("noise", {"noise": noise, "peak": name})
    return made


def _histograms(
    peak: str, parameter: str, found: Evaluation, comparison: Mapping[str, Any]
) -> Drawing:
    values = found.values[peak]
    return Drawing(
        "histograms",
        {
            "values": {m: v[parameter] for m, v in values.items() if m in DRAWN},
            "max_bins": found.ren.recipe.scores.max_bins,
            "parameter": parameter,
            "peak": peak,
            "comparison": comparison,
        },
    )


def _mean_pulse(details: PeakDetails, peak: PeakSets) -> Drawing:
    means = {m: mean._asdict() for m, mean in details.means.items() if m in DRAWN}
    return Drawing("mean pulse", {"sets": means, "dt_ns": peak.dt_ns, "peak": peak.name})


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
    return Drawing(
        "single pulse",
        {
            "pulses": pulses,
            "data": beside._asdict(),
            "dt_ns": peak.dt_ns,
            "samples_before": before,
            "title": f"{peak.name}, simulated pulse {row}",
        },
    )


def _superpulses(details: PeakDetails, peak: PeakSets) -> Drawing:
    shown = ("data", "superpulse", "ren")
    sets = {m: asdict(s) for m, s in details.slices.items() if m in shown}
    return Drawing("superpulses", {"sets": sets, "dt_ns": peak.dt_ns, "peak": peak.name})


def _ae(details: PeakDetails, name: str) -> Drawing:
    table = dict(details.ae_against_time)
    table["methods"] = {m: rows for m, rows in table["methods"].items() if m in DRAWN}
    return Drawing("A over E", {"table": table, "peak": name})


def _roc(found: Evaluation, peaks: list[str]) -> Drawing:
    ae = {
        peak: {
            method: values["current_amplitude"]
            for method, values in found.values[peak].items()
            if method in DRAWN
        }
        for peak in peaks
    }
    return Drawing(ROC, {"ae": ae, "dep": DEP})


def _plane(details: PeakDetails, name: str) -> Drawing:
    table = dict(details.plane)
    shown = ("data", "raw", "ren", "truth")
    table["counts"] = {m: c for m, c in table["counts"].items() if m in shown}
    return Drawing("A over E and drift time", {"table": table, "peak": name})


def _forward(peak: PeakSets, ren: REN, iren: IREN) -> Drawing:
    """Simulated pulses translated by REN and back by IREN."""
    sim = peak.raw.waveforms[:SHOWN]
    like_data = ren.apply(sim, noise=False)
    titles = ("Simulation", "REN (simulation)", "IREN (REN (simulation))")
    return _cycle(sim, like_data, iren.apply(like_data, noise=False), titles, ren.dt_ns)


def _backward(peak: PeakSets, ren: REN, iren: IREN) -> Drawing:
    """Measured pulses translated by IREN and back by REN."""
    data = peak.data.waveforms[:SHOWN]
    like_sim = iren.apply(data, noise=False)
    titles = ("Data", "IREN (data)", "REN (IREN (data))")
    return _cycle(data, like_sim, ren.apply(like_sim, noise=False), titles, ren.dt_ns)


def _cycle(start: Any, middle: Any, end: Any, titles: tuple[str, ...], dt_ns: float) -> Drawing:
    windows = {"start": start, "middle": middle, "end": end}
    return Drawing("cycle", windows | {"titles": list(titles), "dt_ns": dt_ns})


def _draw_histograms(values: Mapping[str, Any], max_bins: int, **more: Any) -> Figure:
    return parameter_histograms(values, data_axis(values["data"], max_bins), **more)


def _draw_mean_pulse(sets: Mapping[str, Any], **more: Any) -> Figure:
    return mean_pulses({method: MeanPulse(**one) for method, one in sets.items()}, **more)


def _draw_single_pulse(data: Mapping[str, Any], **more: Any) -> Figure:
    return single_pulse_figure(data=DataPulse(**data), **more)


def _draw_superpulses(sets: Mapping[str, Any], **more: Any) -> Figure:
    def slices(one: Mapping[str, Any]) -> Slices:
        pulses = tuple(Superpulse(**pulse) for pulse in one["pulses"])
        return Slices(**{**one, "pulses": pulses})

    return slice_figure({method: slices(one) for method, one in sets.items()}, **more)


def _draw_noise(noise: Mapping[str, Any], peak: str) -> Figure:
    return spectrum_of_noise(noise, peak)


_DRAW: Mapping[str, Callable[..., Figure]] = {
    SPECTRUM: spectrum_figure,
    REMAINS: sizes_figure,
    "cycle": cycle_figure,
    "histograms": _draw_histograms,
    "mean pulse": _draw_mean_pulse,
    "single pulse": _draw_single_pulse,
    "superpulses": _draw_superpulses,
    AE_ENERGY: ae_energy_figure,
    "A over E": ae_figure,
    "A over E and drift time": two_dimensional_figure,
    ROC: roc_figure,
    "noise": _draw_noise,
    LOSSES: loss_curves,
}
KINDS = frozenset(_DRAW)
