"""`cpunet.validate`, and the report that it returns."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from zipfile import BadZipFile

import hist
import numpy as np
from matplotlib.figure import Figure

from cpunet.errors import CpunetError
from cpunet.html_pages import part
from cpunet.jobs.validation.compare import read_metrics
from cpunet.jobs.validation.drawings import Drawing
from cpunet.jobs.validation.evaluation import ValidateOptions
from cpunet.jobs.validation.scoring import ByMethod
from cpunet.jobs.validation.validate import validated
from cpunet.jobs.validation.when_asked import WhenAsked
from cpunet.pulses.binning import MAX_BINS, data_axis, labelled
from cpunet.pulses.reading.files import Source, pulse_file
from cpunet.training.run import RunLike
from cpunet.translation.translation import named
from cpunet.validation.report_folder import METRICS, VALUES

_SHOWN = ("raw", "ren", "truth")  # methods in a notebook's table


@dataclass(frozen=True, eq=False, repr=False)
class Report:
    """Scores of a run, as returned by `cpunet.validate`.

    Parameters
    ----------
    metrics
        The content of ``metrics.json``.
    values
        Pulse-shape parameters by peak, method and name: arrays with a value for each pulse.
    folder
        Folder of the report; None if none was written.
    drawn
        Functions that draw the figures, by name; none for a report that was opened.
    """

    metrics: Mapping[str, Any]
    values: Mapping[str, ByMethod]
    folder: Path | None
    drawn: Mapping[str, Drawing]

    @classmethod
    def load(cls, folder: str | Path) -> Report:
        """Open the folder of a report; its figures are the PNG files beside it.

        Raises
        ------
        CpunetError
            If the folder is not a report, or cannot be read.
        """
        remedy = "give the folder of a report, or make one with cpunet.validate"
        metrics = read_metrics(Path(folder) / METRICS, remedy)
        values: dict[str, ByMethod] = {}
        try:
            with np.load(Path(folder) / VALUES, allow_pickle=False) as stored:
                for key in stored:
                    peak, method, name = key.rsplit("/", 2)
                    values.setdefault(peak, {}).setdefault(method, {})[name] = stored[key]
        except (OSError, ValueError, BadZipFile) as error:
            raise CpunetError(
                f"{Path(folder) / VALUES}: cannot be read ({error}); validate again"
            ) from error
        return cls(metrics, values, Path(folder), {})

    @property
    def scores(self) -> list[dict[str, Any]]:
        """One row per peak, parameter and method, ready for `pandas.DataFrame`.

        ``iou`` is the overlap with data in percent, ``ceiling`` that of data with data.
        """
        rows = []
        for peak, of_peak in self.metrics["peaks"].items():
            for parameter, compared in of_peak["parameters"].items():
                ceiling = compared["iou"].get("ceiling")
                for method, iou in compared["iou"].items():
                    if method == "ceiling":
                        continue
                    row = {"peak": peak, "parameter": parameter, "method": method}
                    row |= {"iou": iou, "iou_std": compared["iou_std"].get(method)}
                    row |= {"ceiling": ceiling, "ks": compared["ks"].get(method)}
                    rows.append(row | {"wasserstein": compared["wasserstein"].get(method)})
        return rows

    @property
    def verdicts(self) -> list[str]:
        """Verdicts on the translation in words, peak by peak."""
        return list(self.metrics["verdicts"]["summary"])

    @property
    def figures(self) -> Mapping[str, Figure]:
        """Figures by name, drawn on every access."""
        return WhenAsked(self.drawn)

    def hist(
        self,
        peak: str,
        parameter: str = "current_amplitude",
        max_bins: int | None = None,
    ) -> hist.Hist[Any]:
        """Distributions of a parameter by method.

        Parameters
        ----------
        peak, parameter
            Names of both.
        max_bins
            Maximum number of bins; None for the bins in which the parameter is scored.

        Returns
        -------
        hist.Hist
            Axes ``method`` (categories) and the parameter.

        Raises
        ------
        CpunetError
            If there is no such peak or parameter.
        """
        of_peak = named(self.values, peak, "scored peak")
        data = named(of_peak["data"], parameter, "parameter")
        there = {m: v[parameter] for m, v in of_peak.items() if parameter in v}
        methods = hist.axis.StrCategory(list(there), name="method")
        compared = self.metrics["peaks"][peak]["parameters"].get(parameter, {})
        told = compared.get("axis", {})
        axis = (
            hist.axis.Regular(int(told["bins"]), told["low"], told["high"])
            if max_bins is None and told.get("bins")
            else data_axis(data, max_bins or MAX_BINS)
        )
        axis = labelled(axis, parameter)
        made: hist.Hist[Any] = hist.Hist(methods, axis)
        for method, values in there.items():
            made.fill(method, values[np.isfinite(values)])
        return made

    def __repr__(self) -> str:
        peaks = ", ".join(self.metrics["peaks"])
        where = "" if self.folder is None else f" {self.folder}"
        return f"<Report{where}: {peaks}>"

    def _repr_html_(self) -> str:
        methods = [m for m in _SHOWN if any(row["method"] == m for row in self.scores)]
        by_place: dict[tuple[str, str], dict[str, Any]] = {}
        for row in self.scores:
            place = by_place.setdefault((row["peak"], row["parameter"]), {})
            place |= {row["method"]: row["iou"], "ceiling": row["ceiling"]}
        head = ["peak", "overlap with data (%)", *methods, "ceiling"]
        rows = [
            [peak, parameter.replace("_", " "), *(_number(iou.get(m)) for m in head[2:])]
            for (peak, parameter), iou in by_place.items()
        ]
        where = {"page": None if self.folder is None else self.folder / "report.html"}
        return part("object", "cpunet report", where, head, rows, self.verdicts)


def validate(
    run: RunLike,
    sim: Source,
    data: Source,
    out: str | Path | None = None,
    *,
    truth: str | Path | None = None,
    rivals: bool = True,
    seed: int = 0,
    ae_range_kev: tuple[float, float] | None = None,
    device: str = "auto",
    force: bool = False,
) -> Report:
    """Score a run on simulated and measured pulses, peak by peak.

    Parameters
    ----------
    run
        A trained run or its folder.
    sim, data
        Simulated and measured pulses: a path, or `cpunet.PulseFile` with reading options.
    out
        Folder for ``report.html`` and figures; None to write nothing.
    truth
        Noise-free responses of the simulated pulses, if they are known (``truth.npz``).
    rivals
        Whether to fit the baseline methods, too.
    seed
        Seed of noise and bootstraps.
    ae_range_kev
        Further energies to read on both sides for A/E against energy, such as (900, 2350).
    device
        ``"cpu"``, ``"cuda"`` or ``"auto"``.
    force
        Whether to replace an output that this program wrote earlier.

    Returns
    -------
    Report
        Scores, values, histograms and figures.

    Raises
    ------
    CpunetError
        If an argument cannot be used, or no peak can be scored.
    """
    found, drawn = validated(
        run,
        pulse_file(sim),
        pulse_file(data),
        None if out is None else Path(out),
        ValidateOptions(
            None if truth is None else Path(truth), rivals, seed, ae_range_kev, device=device
        ),
        force=force,
    )
    values = {peak: of_peak for peak, of_peak in found.values.items() if of_peak}
    where = None if out is None else Path(out)
    return Report(found.metrics, values, where, drawn)


def _number(value: float | None) -> str:
    return "–" if value is None else f"{value:.1f}"
