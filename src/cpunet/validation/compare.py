"""Compare the scores of several validations: a table and a page."""

from __future__ import annotations

import os
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple
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
from cpunet.validation.metrics import MAIN, QUANTITIES, SURVIVAL, Metrics, PeakScores, signed
from cpunet.validation.report import METRICS, PAGE, Report, read_metrics

if TYPE_CHECKING:
    from pandas import DataFrame

Cell = tuple[float, float | None, str, float]  # score, error, text, and distance from the best
FEW = 8  # runs whose scores are printed side by side; of more, the page has them


class Row(NamedTuple):
    """One score of every run, in the order of the runs.

    Attributes
    ----------
    peak, score
        Name of the peak and of the score.
    values, texts
        Numbers, and scores as displayed: the best are marked, if two or more runs have one.
    far
        Which runs are far from the median of all, beyond the scatter and the own error.
    over
        Median and standard deviation over the runs.
    """

    peak: str
    score: str
    values: list[float | None]
    texts: list[str]
    far: list[bool]
    over: str


@dataclass(frozen=True, eq=False, repr=False)
class Comparison:
    """Scores of several runs, as returned by `cpunet.compare`.

    The best is the highest IoU, the AUC closest to that of shuffled labels, the lowest RMSE of
    the edge, and the smallest difference of A/E survival.

    Parameters
    ----------
    method
        Method that is scored.
    reports
        Report of each run, by the name of its folder, made unique, such as
        ``DETECTOR/PERIOD``.
    missing
        Names of the reports that are not there.
    path
        The page; None if none was written.

    Examples
    --------
    >>> iou = lambda value: {"iou": {"ren": value, "ceiling": 90.0}}
    >>> scores = lambda v: {"peaks": {"SEP": {"parameters": {"drift_time": iou(v)}}}}
    >>> reports = {name: Report(Metrics(**scores(v))) for name, v in (("old", 80), ("new", 85))}
    >>> Comparison("ren", reports).rows[0].texts
    ['80 (90.0)', '85 (90.0)*']
    """

    method: str
    reports: Mapping[str, Report]
    missing: tuple[str, ...] = ()
    path: Path | None = None

    @cached_property
    def rows(self) -> list[Row]:
        """Scores that any run has, ordered by peak."""
        rows, metrics = [], [report.metrics for report in self.reports.values()]
        for peak in _union(of_run.peaks for of_run in metrics):
            collected = [_scores(of_run, peak, self.method) for of_run in metrics]
            for title in _union(collected):
                cells = [scores.get(title) for scores in collected]
                present = [cell for cell in cells if cell is not None]
                least = min(off for *_, off in present) if len(present) > 1 else -1.0
                values, numbers = [cell and cell[0] for cell in cells], [v for v, *_ in present]
                over = NO_VALUE
                if len(present) > 1:
                    over = with_std(np.median(numbers), np.std(numbers, ddof=1))
                texts = [f"{c[2]}{'*' * (c[3] == least)}" if c else NO_VALUE for c in cells]
                far = outliers(values, [cell and cell[1] for cell in cells])
                rows.append(Row(peak, title, values, texts, far, over))
        return rows

    @property
    def scores(self) -> DataFrame:
        """Numbers of the scores: a row per peak and score, a column per run."""
        from pandas import DataFrame, MultiIndex

        index = MultiIndex.from_tuples([row[:2] for row in self.rows], names=["peak", "score"])
        values = [row.values for row in self.rows]
        return DataFrame(values, index, list(self.reports), dtype=float)

    @property
    def note(self) -> str:
        """Signs that runs were not scored on the same pulses; empty if there are none."""
        pulses = {
            name: {
                "detectors": of.compared.get("detector"),
                "peaks": of.peaks.keys(),
                "numbers of measured pulses": {peak: s.n_data for peak, s in of.peaks.items()},
                "rejections of measured pulses": of.rejections.get("data"),
                "numbers of simulated pulses": {peak: s.n_sim for peak, s in of.peaks.items()},
                "rejections of simulated pulses": of.rejections.get("sim"),
            }
            for name, of in ((n, report.metrics) for n, report in self.reports.items())
        }
        first, *others = pulses
        differing = {
            name: [k for k, value in pulses[name].items() if value != pulses[first][k]]
            for name in others
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
        refuse_existing(path, *(of.folder for of in self.reports.values()), force=force)
        links = {
            name: quote(os.path.relpath(of.folder / PAGE, path.parent))
            for name, of in self.reports.items()
            if of.folder is not None and (of.folder / PAGE).is_file()
        }
        peaks = {row.peak: [r for r in self.rows if r.peak == row.peak] for row in self.rows}
        title = f"{label(self.method)}: {len(self.reports)} runs compared"
        values = {"title": title, "comparison": self, "links": links, "peaks": peaks}
        html = rendered("compare.html", **values, far=f"{FAR:g}")
        with written_aside(path) as aside:
            aside.write_text(html, encoding="utf-8")

    def __str__(self) -> str:
        lines = []
        if self.path is None or len(self.reports) <= FEW:
            peaks = [row.peak for row in self.rows]
            rows = [
                ["" if last == row.peak else row.peak, row.score, *row.texts]
                for last, row in zip(["", *peaks], self.rows, strict=False)
            ]
            title = f"Scores of {self.method}, the best with *"
            lines = [text_table(["peak", "score", *self.reports], rows, words=2, title=title)]
            lines += [f"note: {self.note}"] if self.note else []
        lines += [f"no report: {name}" for name in self.missing]
        return "\n".join(lines if self.path is None else [*lines, str(self.path)])

    def __repr__(self) -> str:
        return f"<Comparison of {', '.join(self.reports)}: {self.method}>"


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
    reports: Sequence[str | Path | Report], *, method: str = "ren", failed: Sequence[Path] = ()
) -> Comparison:
    """Compare the scores of several validations, see `compare`.

    Parameters
    ----------
    reports, method
        As of `compare`.
    failed
        Reports to list as missing: what is in their folders is of an earlier validation.
    """
    opened: list[tuple[Path, Report | None]] = []
    for report in reports:
        if isinstance(report, Report):  # of one in memory the run has a name
            opened.append((report.folder or Path(report.metrics.compared["run"]), report))
            continue
        path = Path(report)
        files = (path, path / METRICS, path / "report" / METRICS)  # the last one of a demo
        file = next((f for f in files if f.is_file() and path not in failed), None)
        stored = Report(read_metrics(file), folder=file.parent) if file else None
        opened.append((path, stored))
    # by its folder, with as many parent folders as make it unique, without those at the end
    # that all reports share, such as ``report``
    places = [place.resolve() for place, _ in opened]
    parts = [(path.parent if path.is_file() else path).parts for path in places]
    while len(set(parts)) == len(parts) > 1 and len({part[-1] for part in parts}) == 1:
        parts = [part[:-1] for part in parts]
    for depth in range(1, max(map(len, parts), default=1) + 1):
        names = [str(Path(*part[-depth:])) for part in parts]
        if len(set(names)) == len(names):
            break
    else:  # names that are still equal refer to the same report
        names = [f"{part[-1]} ({i})" for i, part in enumerate(parts, start=1)]
    named = {name: of for name, (_, of) in zip(names, opened, strict=True)}
    runs = {name: report for name, report in named.items() if report is not None}
    if not runs:
        remedy = "give folders of cpunet validate or cpunet demo"
        raise CpunetError(f"none of the {len(reports)} reports is there", remedy)
    made = Comparison(method, runs, tuple(name for name in named if name not in runs))
    if not made.rows:
        methods = _union(s.methods for of in runs.values() for s in of.metrics.peaks.values())
        others = f"there are {', '.join(methods)}" if methods else "nothing is scored there"
        raise CpunetError(f"{', '.join(runs)}: no score of the method {method}; {others}")
    return made


def _scores(metrics: Metrics, peak: str, method: str) -> dict[str, Cell]:
    """Scores that a method has at a peak, by name, and how far each is from the best."""
    scores, cells = metrics.peaks.get(peak, PeakScores()), dict[str, Cell]()
    for name, compared in scores.parameters.items():
        if (iou := compared.iou.get(method)) is not None:
            error, ceiling = compared.iou_std.get(method), compared.iou.get("ceiling")
            text = with_std(iou, error) + ("" if ceiling is None else f" ({ceiling:.1f})")
            title = f"{name.replace('_', ' ')}: IoU [%] (data vs data)"
            cells[title] = iou, error, text, 100 - iou
    if isinstance(tested := scores.two_sample.get(method), TwoSample):
        text, off = with_std(tested.auc, tested.auc_std), abs(tested.auc - tested.null_mean)
        cells["classifier: AUC"] = tested.auc, tested.auc_std, text, off
    if method in scores.paired and (edge := scores.paired[method].edge_rmse) is not None:
        cells["edge RMSE [10⁻³]"] = 1e3 * edge, None, f"{1e3 * edge:#.3g}", edge
    verdicts = metrics.judge(peak, method) if peak in metrics.peaks else {}
    for name in (*MAIN, SURVIVAL):
        difference, std = verdicts[name].difference if name in verdicts else (None, None)
        if difference is not None:
            unit = "points" if name == SURVIVAL else LABELLED[name].unit
            title = f"{QUANTITIES[name]} minus data" + (f" [{unit}]" if unit else "")
            cells[title] = difference, std, signed(difference, std), abs(difference)
    return cells


def _union(names: Iterable[Iterable[str]]) -> list[str]:
    """All names in the order of their first occurrence."""
    return list(dict.fromkeys(name for some in names for name in some))
