"""The result of a validation: scores, values, figures, and the folder that holds them.

The page is self-contained: figures and script are embedded, and its content security policy
blocks all requests.
"""

from __future__ import annotations

import json
import re
from collections import UserDict
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

import hist
import numpy as np
from pydantic import ValidationError

from cpunet.errors import CpunetError, named
from cpunet.outputs import FolderKind, folder_written_aside
from cpunet.plotting import COLOURS, label, own_axes
from cpunet.progress import stage
from cpunet.pulses.parameters import Values
from cpunet.pulses.reading.other_formats import read_arrays
from cpunet.pulses.shape_parameters import LABELLED, Histogram, labelled
from cpunet.settings import flat, read_json
from cpunet.tables import number, text_table, with_std
from cpunet.validation.metrics import Metrics, called

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure
    from pandas import DataFrame

METRICS, VALUES, PAGE = "metrics.json", "parameters.npz", "report.html"
REPORT = FolderKind(
    name="report", command="cpunet validate", own=r"metrics\.json|report\.html|parameters\.npz"
)
# methods of the printed table, in the order of the page; those without noise are in the metrics
_METHODS = ("raw", "rc", "rc_late", "gauss_exp", "superpulse", "ren", "truth", "ceiling")
_NAMES = {
    "raw": "simulation",
    "truth": "true resp.",
    "rc": "RC",
    "gauss_exp": "Gauss ⊗ exp",
    "ren": "REN",
    "current_amplitude": "I_max",
    "drift_time": "T_drift",
    "rc_late": "RC + late",
    "ceiling": "data vs data",
}
_SHOWN = ("raw", "ren", "truth", "ceiling")  # methods in a notebook's table


FIRST = 3  # figures of overlap and mean pulses at the top of the page, and of noise
# Section, end of the name of a figure, and what it shows, for readers of its text alone.
SECTIONS = (
    ("first", "overlap with data", "overlap with data by method; band: data with data"),
    ("first", "mean pulse", "mean pulses by method; differences in standard errors"),
    ("slices", "superpulses", "mean pulses in four ranges of rise time; differences"),
    ("noise", "noise", "noise power before the pulse by frequency, data and REN; ratio"),
    ("pulses", "single pulse", "a simulated pulse by each method, and the nearest measured"),
    ("further", "further parameters", "distributions of further parameters by method"),
    ("ae", "A over E survival", "survival of other peaks against that of the DEP"),
    ("ae_energy", "A over E and energy", "position and width of the A/E peak against energy"),
    ("others", "losses", "losses of the training by iteration"),
    ("others", "cycle of simulation", "simulated pulses, their translations, and those back"),
    ("others", "cycle of data", "measured pulses, their translations, and those back"),
    ("distributions", "", "distributions by method, and differences in standard errors"),
)


@dataclass(frozen=True, eq=False, repr=False)
class Report:
    """Scores of a run, as returned by `cpunet.validate`.

    ``report["SEP"]`` are the scores of a peak, a row for each parameter and method.

    Parameters
    ----------
    metrics
        The content of ``metrics.json``; `to_dict` gives it as plain values.
    values
        Pulse-shape parameters by peak, method and name: arrays with a value for each pulse.
    folder
        Folder of the report; None if none was written.
    drawn
        Functions that draw the figures, by name; none for a report that was opened.
    notes
        Further paragraphs for the top of the page.
    """

    metrics: Metrics
    values: Mapping[str, Mapping[str, Mapping[str, Values]]] = field(default_factory=dict)
    folder: Path | None = None
    drawn: Mapping[str, Callable[[], Any]] | None = None
    notes: Sequence[str] = ()

    @classmethod
    def load(cls, folder: str | Path) -> Report:
        """Open the folder of a report; its figures are the SVG files in it.

        Raises
        ------
        CpunetError
            If the folder is not a report, or cannot be read.
        """
        remedy = "give the folder of a report, or make one with cpunet.validate"
        metrics = read_metrics(Path(folder) / METRICS, remedy)
        values: dict[str, dict[str, dict[str, Values]]] = {}
        for key, stored in read_arrays(Path(folder) / VALUES).items():
            peak, method, name = key.rsplit("/", 2)
            values.setdefault(peak, {}).setdefault(method, {})[name] = stored
        return cls(metrics, values, Path(folder))

    @cached_property
    def scores(self) -> DataFrame:
        """A row per peak, parameter and method.

        ``iou`` is the overlap with data in percent, ``ceiling`` that of data with data.
        """
        from pandas import DataFrame

        index = ["peak", "parameter", "method"]
        columns = [*index, "iou", "iou_std", "ceiling", "wasserstein"]
        rows = [
            [peak, parameter, method]
            + [by.get(method) for by in (of.iou, of.iou_std)]
            + [of.iou.get("ceiling"), of.wasserstein.get(method)]
            for peak, scores in self.metrics.peaks.items()
            for parameter, of in scores.parameters.items()
            for method in of.iou
            if method != "ceiling"
        ]
        return DataFrame(rows, columns=columns).set_index(index)

    def __getitem__(self, peak: str) -> DataFrame:
        peaks = {name: name for name in self.metrics.scored}
        selected: DataFrame = self.scores.loc[named(peaks, peak, "scored peak")]
        return selected

    def to_dict(self) -> dict[str, Any]:
        """The content of ``metrics.json``."""
        return self.metrics.to_dict()

    @property
    def verdicts(self) -> list[str]:
        """Verdicts on the translation in words, peak by peak."""
        return [self.metrics.summary(peak) for peak in self.metrics.scored]

    @property
    def figures(self) -> Mapping[str, Figure | Path]:
        """Figures by name, drawn on every access; of an opened report its SVG files."""
        if self.drawn is None:
            files = [] if self.folder is None else sorted(self.folder.glob("*.svg"))
            return {file.stem.replace("_", " "): file for file in files}
        return _Figures(self.drawn)

    def hist(
        self, peak: str, parameter: str = "current_amplitude", bins: int | None = None
    ) -> Histogram:
        """Distributions of a parameter by method, in the range in which it is scored.

        Parameters
        ----------
        peak, parameter
            Names of both.
        bins
            Number of bins; that of the score by default.

        Returns
        -------
        Histogram
            A `hist.Hist` with the axes ``method`` (categories) and the parameter.

        Raises
        ------
        CpunetError
            If there is no such peak or parameter.
        """
        of_peak = named(self.values, peak, "scored peak")
        named(of_peak["data"], parameter, "parameter")
        scores = self.metrics.peaks[peak]
        binning = (scores.parameters | scores.further)[parameter].axis
        axis = hist.axis.Regular(binning.bins or 1, binning.low or 0.0, binning.high or 1.0)
        axis = labelled(axis, parameter, bins)
        made = Histogram(hist.axis.StrCategory(list(of_peak), name="method"), axis)
        for method, values in of_peak.items():
            made.fill(method, values[parameter][np.isfinite(values[parameter])])
        return made

    def plot(
        self,
        peak: str | None = None,
        parameter: str = "current_amplitude",
        ax: Axes | None = None,
    ) -> Axes:
        """Draw the distributions of a parameter by method, with its scores; return the axes.

        Parameters
        ----------
        peak
            Name of a scored peak; None for the first.
        parameter
            Name of a scored parameter.
        ax
            Where to draw; a new figure of pyplot by default.

        Raises
        ------
        CpunetError
            If there is no such peak, or no such parameter is scored there.
        """
        from cpunet.validation.figures import draw_parameter

        peak = next(iter(self.values)) if peak is None else peak
        of_peak = named(self.values, peak, "scored peak")
        compared = named(self.metrics.peaks[peak].parameters, parameter, "scored parameter")
        values = {method: of_method[parameter] for method, of_method in of_peak.items()}
        axis = self.hist(peak, parameter).axes[1]
        ax = own_axes(ax)
        draw_parameter(ax, values, axis, parameter, compared)
        ax.set_title(peak)
        ax.legend()
        return ax

    def save(self, folder: str | Path, force: bool = False) -> None:
        """Write the report to a folder: page, metrics, values and figures.

        Raises
        ------
        CpunetError
            If the folder exists and `force` is off, or is not a report; or if this report was
            opened from one.
        """
        with folder_written_aside(Path(folder), REPORT, force=force) as aside:
            self.write(aside)

    def write(self, folder: Path) -> None:
        """Write the report into an existing folder, see `save`.

        Names of figures become file names and captions.
        """
        from markupsafe import Markup

        from cpunet.html_pages import asset, figure_html, rendered

        if self.drawn is None:
            raise CpunetError(f"{self.folder}: is a report already", "copy the folder")
        metrics = self.metrics
        text = json.dumps(self.to_dict(), indent=2, allow_nan=False, ensure_ascii=False)
        (folder / METRICS).write_text(text + "\n", encoding="utf-8")
        arrays: dict[str, Any] = dict(flat(self.values, "/"))
        np.savez_compressed(folder / VALUES, allow_pickle=False, **arrays)

        placed: dict[str, dict[str, Markup]] = {place: {} for place, _, _ in SECTIONS}
        with stage("Drawing", len(self.drawn)) as bar:
            for name, draw in self.drawn.items():
                stem = re.sub(r"[^\w.-]+", "_", name)  # file systems refuse some characters
                caption = name.replace("_", " ")
                place, _, shows = next(of for of in SECTIONS if caption.endswith(of[1]))
                svg = folder / f"{stem}.svg"
                placed[place][name] = figure_html(caption, draw(), svg, shows)
                bar.update(1)
        # of each method that is drawn, for the page's legend
        drawn = "".join(html for of_place in placed.values() for html in of_place.values())
        methods = dict.fromkeys(re.findall('data-method="([^"]*)"', drawn))
        # of mean pulses and noise a few, preferably of peaks that took no part in the training
        peak = str(metrics.training.get("peak"))
        trained = tuple(f"{name} " for name in (peak, *peak.split(",")))
        for place in ("first", "noise"):
            shown = placed[place]
            few = [n for n in shown if not n.startswith(trained)][:FIRST] or [*shown][:FIRST]
            placed["others"] |= {name: html for name, html in shown.items() if name not in few}
            placed[place] = {name: shown[name] for name in few}
        html = rendered(
            "report.html",
            title="CPU-Net validation",
            metrics=metrics,
            placed={place: [*of_place.values()] for place, of_place in placed.items()},
            notes=self.notes,
            colours={method: COLOURS[method] for method in methods},
            script=Markup(asset("report.js")),
            **{f.__name__: f for f in (called, flat, label, number, with_std)},
            unit=lambda name: LABELLED[name].unit,
        )
        (folder / PAGE).write_text(html, encoding="utf-8")

    def __str__(self) -> str:
        table = self._table(_METHODS)
        lines = [text_table(*table, words=2, title="Overlap with data (IoU, %)")]
        if peaks := self.metrics.held_out:
            main = text_table(*self.metrics.main_table(peaks), words=2)
            lines = [self.metrics.headline()[1], main, "", *lines]
        for peak, scores in self.metrics.peaks.items():
            if scores.missing:
                lines.append(f"{peak}: not scored, {scores.missing}")
        return "\n".join(lines if self.folder is None else [*lines, str(self.folder / PAGE)])

    def __repr__(self) -> str:
        where = "" if self.folder is None else f" {self.folder}"
        off, judged = self.metrics.off("ren")
        return f"<Report{where}: {f'{off} of {judged} scores off' if judged else 'not judged'}>"

    def _repr_html_(self) -> str:
        from cpunet.html_pages import part

        (_, _, *methods), rows = self._table(_SHOWN)
        head = ["peak", "overlap with data (%)", *methods]
        where = {"page": None if self.folder is None else self.folder / PAGE}
        return part("object", "cpunet report", where, head, rows, self.verdicts)

    def _table(self, methods: Iterable[str]) -> tuple[list[str], list[list[str]]]:
        """IoU by peak and parameter, of the methods that have any."""
        of_all = {
            (peak, _NAMES.get(parameter, parameter.replace("_", " "))): compared.iou
            for peak, scores in self.metrics.peaks.items()
            for parameter, compared in scores.parameters.items()
        }
        shown = [m for m in methods if any(m in iou for iou in of_all.values())]
        rows = [[*k, *(number(iou.get(m), ".1f") for m in shown)] for k, iou in of_all.items()]
        return ["peak", "parameter", *(_NAMES.get(m, m) for m in shown)], rows


def read_metrics(file: Path, remedy: str = "validate the run again") -> Metrics:
    """Read a ``metrics.json``; `remedy` says what to do if that fails.

    Raises
    ------
    CpunetError
        If the file cannot be read or does not contain the scores of a validation.
    """
    content = read_json(file, remedy)
    try:
        return Metrics.model_validate(content)
    except ValidationError as error:
        raise CpunetError(
            f"{file}: holds no scores by peak", "give a report of cpunet validate"
        ) from error


class _Figures(UserDict[str, Any]):
    """Figures that exist only while they are used: drawn on every access."""

    def __getitem__(self, name: str) -> Any:
        return self.data[name]()
