"""Compare the scores of several validations: a table and a page."""

from __future__ import annotations

import os
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple
from urllib.parse import quote

import numpy as np

from cpunet.errors import CpunetError
from cpunet.outputs import refuse_existing, refuse_inputs, written_aside
from cpunet.plotting import label
from cpunet.pulses.shape_parameters import LABELLED
from cpunet.pulses.two_sample import TwoSample
from cpunet.tables import NO_VALUE, text_table, with_std
from cpunet.training.response import FAR, Response, outliers, response
from cpunet.training.run import Run, RunLike
from cpunet.validation.metrics import MAIN, QUANTITIES, Metrics, PeakScores, signed
from cpunet.validation.report import METRICS, PAGE, Report, read_metrics

if TYPE_CHECKING:
    from pandas import DataFrame

FEW = 8  # runs whose scores are printed side by side; of more, the page has them


class Cell(NamedTuple):
    """A score with its error, its text, and its distance from the best possible."""

    value: float
    error: float | None
    text: str
    off: float


class Row(NamedTuple):
    """One score of every run.

    Attributes
    ----------
    peak, score
        Name of the peak and of the score.
    cells
        Scores in the order of the runs; None of a run without.
    """

    peak: str
    score: str
    cells: list[Cell | None]

    @property
    def best(self) -> set[int]:
        """Indices of the runs with the best score; empty if fewer than two have one."""
        off = {i: cell.off for i, cell in enumerate(self.cells) if cell is not None}
        return {i for i in off if len(off) > 1 and off[i] == min(off.values())}

    @property
    def texts(self) -> list[str]:
        """Scores as displayed; the best are marked."""
        shown = [NO_VALUE if cell is None else cell.text for cell in self.cells]
        return [f"{text}{'*' * (i in self.best)}" for i, text in enumerate(shown)]

    @property
    def far(self) -> list[bool]:
        """Which runs are far from the median of all, beyond the scatter and the own error."""
        return outliers(
            [c and c.value for c in self.cells], [c and c.error for c in self.cells]
        )

    @property
    def over(self) -> str:
        """Median and standard deviation over the runs."""
        values = [cell.value for cell in self.cells if cell is not None]
        return with_std(np.median(values), np.std(values, ddof=1)) if values[1:] else NO_VALUE


@dataclass(frozen=True, eq=False, repr=False)
class Comparison:
    """Scores of several runs, as returned by `cpunet.compare`.

    The best is the highest IoU, the AUC closest to that of shuffled labels, the lowest RMSE of
    the edge, and the smallest difference of A/E survival.

    Parameters
    ----------
    method
        Method that is scored.
    metrics
        Scores by run.  Runs have the names of their folders, made unique,
        such as ``DETECTOR/PERIOD``.
    folders
        Folder of each report; None for those in memory.
    missing
        Names of the reports that are not there.
    path
        The page; None if none was written.

    Examples
    --------
    >>> iou = lambda value: {"iou": {"ren": value, "ceiling": 90.0}}
    >>> scores = lambda v: {"peaks": {"SEP": {"parameters": {"drift_time": iou(v)}}}}
    >>> metrics = {name: Metrics(**scores(v)) for name, v in (("old", 80.0), ("new", 85.0))}
    >>> made = Comparison("ren", metrics)
    >>> made.rows[0].texts
    ['80 (90.0)', '85 (90.0)*']
    """

    method: str
    metrics: Mapping[str, Metrics]
    folders: Mapping[str, Path | None] = field(default_factory=dict)
    missing: tuple[str, ...] = ()
    path: Path | None = None

    @cached_property
    def rows(self) -> list[Row]:
        """Scores that any run has, ordered by peak."""
        rows = []
        for peak in _union(metrics.peaks for metrics in self.metrics.values()):
            collected = [_scores(of_run, peak, self.method) for of_run in self.metrics.values()]
            rows += [
                Row(peak, score, [cells.get(score) for cells in collected])
                for score in _union(collected)
            ]
        return rows

    @property
    def scores(self) -> DataFrame:
        """Numbers of the scores: a row per peak and score, a column per run."""
        from pandas import DataFrame, MultiIndex

        index = MultiIndex.from_tuples([row[:2] for row in self.rows], names=["peak", "score"])
        values = [[cell and cell.value for cell in row.cells] for row in self.rows]
        return DataFrame(values, index, list(self.metrics), dtype=float)

    @property
    def note(self) -> str:
        """Signs that runs were not scored on the same pulses; empty if there are none."""
        (first, first_pulses), *others = (
            (n, _pulses(metrics)) for n, metrics in self.metrics.items()
        )
        differing = {
            name: [k for k in first_pulses if of[k] != first_pulses[k]] for name, of in others
        }
        names = ", ".join(name for name, differences in differing.items() if differences)
        words = ", ".join(_union(differing.values()))
        text = f"other pulses than those of {first} ({words}), so scores differ for that, too"
        return f"{names}: {text}" if names else ""

    def save(self, path: str | Path, force: bool = False) -> None:
        """Write the comparison as an HTML page, with links to the reports.

        Raises
        ------
        CpunetError
            If the page exists and `force` is off, or cannot be written.
        """
        from cpunet.html_pages import rendered

        path = Path(path)
        if path.is_dir():
            raise CpunetError(
                f"{path}: is a folder", "give the name of a page, as compare.html"
            )
        refuse_existing(path, *self.folders.values(), force=force)
        links = {
            name: quote(os.path.relpath(folder / PAGE, path.parent))
            for name, folder in self.folders.items()
            if folder is not None and (folder / PAGE).is_file()
        }
        peaks = {row.peak: [r for r in self.rows if r.peak == row.peak] for row in self.rows}
        title = f"{label(self.method)}: {len(self.metrics)} runs compared"
        values = {"title": title, "comparison": self, "links": links, "peaks": peaks}
        with written_aside(path) as aside:
            aside.write_text(
                rendered("compare.html", **values, far=f"{FAR:g}"), encoding="utf-8"
            )

    def __str__(self) -> str:
        lines = []
        if self.path is None or len(self.metrics) <= FEW:
            peaks = [row.peak for row in self.rows]
            rows = [
                ["" if last == row.peak else row.peak, row.score, *row.texts]
                for last, row in zip(["", *peaks], self.rows, strict=False)
            ]
            title = f"Scores of {self.method}, the best with *"
            lines = [text_table(["peak", "score", *self.metrics], rows, words=2, title=title)]
            lines += [f"note: {self.note}"] if self.note else []
        lines += [f"no report: {name}" for name in self.missing]
        return "\n".join(lines if self.path is None else [*lines, str(self.path)])

    def __repr__(self) -> str:
        return f"<Comparison of {', '.join(self.metrics)}: {self.method}>"


def compare(
    *reports: RunLike | Report,
    method: str = "ren",
    out: str | Path | None = None,
    force: bool = False,
) -> Comparison | Response:
    """Compare the scores of several validations, of one detector or of many.

    The page also has links to the reports, room for many detectors and periods, and of three
    or more the median and the standard deviation. Reports that are missing are listed.

    Parameters
    ----------
    reports
        Folders of cpunet validate or demo, or their metrics.json. From Python also reports, or
        runs, whose readouts are compared as by ``cpunet.response``.
    method
        Whose scores: ren, raw, rc, gauss_exp, superpulse, truth.
    out
        Page to write, such as compare.html.
    force
        Replace existing output.

    Returns
    -------
    Comparison or Response
        Scores of the runs side by side; of runs, their readouts.

    Raises
    ------
    CpunetError
        If a report cannot be read, all are missing, none has a score of `method`, or `out`
        exists or is not writable.

    Examples
    --------
    cpunet compare report1 report2 --out compare.html

    cpunet compare results/*/*/report --out results/index.html
    """
    if runs := [report for report in reports if isinstance(report, Run)]:
        if len(runs) < len(reports):
            raise CpunetError("runs and reports are not compared", "validate the runs")
        return response(*runs, out=out, force=force)
    scored = [report for report in reports if not isinstance(report, Run)]
    if out is not None:
        refuse_inputs(Path(out), *(of for of in scored if not isinstance(of, Report)))
    comparison = compared(scored, method=method)
    if out is None:
        return comparison
    comparison.save(out, force=force)
    return replace(comparison, path=Path(out))


def compared(
    reports: Sequence[str | Path | Report],
    *,
    method: str = "ren",
    failed: Collection[Path] = (),
) -> Comparison:
    """Compare the scores of several validations, see `compare`.

    Parameters
    ----------
    reports, method
        As of `compare`.
    failed
        Reports to list as missing: what is in their folders is of an earlier validation.
    """
    collected: list[tuple[Path, Metrics | None, Path | None]] = []
    for report in reports:
        if isinstance(report, Report):
            # one in memory is named by its run
            place = report.folder or Path(report.metrics.compared["run"])
            collected.append((place, report.metrics, report.folder))
            continue
        path = Path(report)
        files = (path, path / METRICS, path / "report" / METRICS)  # the last one of a demo
        file = next((f for f in files if f.is_file() and path not in failed), None)
        collected.append((path, read_metrics(file) if file else None, file and file.parent))
    names = _names([place for place, _, _ in collected])
    folders = {name: folder for name, (_, _, folder) in zip(names, collected, strict=True)}
    each = zip(names, collected, strict=True)
    runs = {name: metrics for name, (_, metrics, _) in each if metrics is not None}
    if not runs:
        raise CpunetError(
            f"none of the {len(reports)} reports is there",
            "give folders of cpunet validate or cpunet demo",
        )
    missing = tuple(name for name in names if name not in runs)
    made = Comparison(method, runs, folders, missing)
    if not made.rows:
        methods = _union(s.methods for metrics in runs.values() for s in metrics.peaks.values())
        raise CpunetError(
            f"{', '.join(runs)}: no score of the method {method}; "
            + (f"there are {', '.join(methods)}" if methods else "nothing is scored there")
        )
    return made


def _scores(metrics: Metrics, peak: str, method: str) -> dict[str, Cell]:
    """Scores that a method has at a peak, by name."""
    scores, cells = metrics.peaks.get(peak, PeakScores()), {}
    for name, compared in scores.parameters.items():
        if (iou := compared.iou.get(method)) is not None:
            error, ceiling = compared.iou_std.get(method), compared.iou.get("ceiling")
            text = with_std(iou, error) + ("" if ceiling is None else f" ({ceiling:.1f})")
            title = f"{name.replace('_', ' ')}: IoU [%] (data vs data)"
            cells[title] = Cell(iou, error, text, 100 - iou)
    if isinstance(tested := scores.two_sample.get(method), TwoSample):
        text, off = with_std(tested.auc, tested.auc_std), abs(tested.auc - tested.null_mean)
        cells["classifier: AUC"] = Cell(tested.auc, tested.auc_std, text, off)
    if method in scores.paired and (edge := scores.paired[method].edge_rmse) is not None:
        cells["edge RMSE [10⁻³]"] = Cell(1e3 * edge, None, f"{1e3 * edge:#.3g}", edge)
    differences = {
        f"{QUANTITIES[name]} minus data [{LABELLED[name].unit}]".removesuffix(" []"): (
            scores.judged[name].shift.get(method),
            scores.judged[name].shift_std.get(method),
        )
        for name in MAIN
        if name in scores.judged
    }
    if (row := metrics.survival.get(peak)) is not None:
        title = "A/E survival minus data [points]"
        differences[title] = row.difference.get(method), row.difference_std.get(method)
    for title, (difference, std) in differences.items():
        if difference is not None:
            cells[title] = Cell(difference, std, signed(difference, std), abs(difference))
    return cells


def _pulses(metrics: Metrics) -> dict[str, Any]:
    """What distinguishes the pulses of a validation from those of another."""
    peaks, rejections = metrics.peaks, metrics.rejections
    return {
        "detectors": metrics.compared.get("detector"),
        "peaks": peaks.keys(),
        "numbers of measured pulses": {peak: of.n_data for peak, of in peaks.items()},
        "rejections of measured pulses": rejections.get("data"),
        "numbers of simulated pulses": {peak: of.n_sim for peak, of in peaks.items()},
        "rejections of simulated pulses": rejections.get("sim"),
    }


def _union(names: Iterable[Iterable[str]]) -> list[str]:
    """All names in the order of their first occurrence."""
    return list(dict.fromkeys(name for some in names for name in some))


def _names(reports: Sequence[Path]) -> list[str]:
    """Name each report by its folder, with as many parent folders as make it unique.

    Folders at the end that all reports share, such as ``report``, are left out.
    """
    given = [report.resolve() for report in reports]
    parts = [(path.parent if path.is_file() else path).parts for path in given]
    while len(set(parts)) == len(parts) > 1 and len({part[-1] for part in parts}) == 1:
        parts = [part[:-1] for part in parts]
    for depth in range(1, max(map(len, parts), default=1) + 1):
        names = [str(Path(*part[-depth:])) for part in parts]
        if len(set(names)) == len(names):
            return names
    # names that are still equal refer to the same report
    return [f"{part[-1]} ({i})" for i, part in enumerate(parts, start=1)]
