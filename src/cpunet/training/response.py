"""`cpunet.response`: what readout was learned, with the true response if given."""

from __future__ import annotations

import json
import logging
import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from scipy.stats import median_abs_deviation

import cpunet
from cpunet.electronics.chain import Electronics, read_electronics
from cpunet.electronics.stand import Stand
from cpunet.errors import CpunetError
from cpunet.outputs import FolderKind, folder_written_aside, refuse_existing
from cpunet.settings import plain, yaml_text
from cpunet.tables import text_table, with_std
from cpunet.training.chain_description import (
    DescribedChain,
    chain_numbers,
    describe_chain,
    true_chain_of,
    true_parameters,
)
from cpunet.training.run import RunLike, as_run

if TYPE_CHECKING:
    from matplotlib.figure import Figure
    from pandas import DataFrame

log = logging.getLogger(__name__)

RESPONSE = FolderKind(
    name="response", command="cpunet response", own=r"response\.(json|png|yaml|csv|html)"
)
_DPI = 150
# What ``response.json`` has of a `Run` and of a `DescribedChain`
_OF_RUN = ("peak", "seed", "dt_ns")
_OF_CHAIN = ("values", "errors", "parameters", "parameter_errors", "doubts")

# What a name of `describe_chain` stands for, and its unit; shares are given in percent.
ROWS = {
    r"pole_(\d)_ns": (r"bandwidth pole \1", "ns"),
    r"slow_share": ("late charge", "%"),
    r"slow_time_ns": ("its mean time", "ns"),
    r"ringing": ("ringing", "%"),
    r"ringing_mhz": ("ringing frequency", "MHz"),
    r"ringing_damping_ns": ("ringing damping", "ns"),
    r"deviation": ("largest deviation from a chain", "%"),
    r"drift_stretch": ("drift-time scale, change", "%"),
    r"drift_stretch_per_us": ("drift-time scale, change per µs", "%"),
    r"rise_(.*)_(.*)_ns": (r"rise \1–\2 %", "ns"),
    r"missing_(.*)_ns": (r"not yet collected after \1 ns", "%"),
    r"overshoot": ("overshoot", "%"),
    r"decay_us": ("main decay", "µs"),
    r"sharpness": ("samples: 0 means, 1 points", ""),
    r"fast_decay_(\d)_us": (r"fast decay \1", "µs"),
    r"fast_decay_(\d)_share": (r"share of fast decay \1", "%"),
    r"effective_decay_us": ("effective decay, tail", "µs"),
    r"decay_(.*)_us": (r"share decaying with \1 µs", "%"),
    r"slew_kev_per_ns": ("slew rate", "keV/ns"),
    r"nonlinearity": ("largest non-linearity", "‰"),
    r"noise_rms_kev": ("noise RMS", "keV"),
    r"noise_corner_mhz": ("noise corner", "MHz"),
    r"chi_square_per_moment": ("chi-square per moment", ""),
}
# What a page of channels shows, and where a channel stands out: so many robust standard
# deviations from the median, of at least so many channels.
SHOWN = (
    *("rise_10_90_ns", "slow_share", "missing_500_ns", "effective_decay_us", "noise_rms_kev"),
    "chi_square_per_moment",
)
FAR, FEW = 4.0, 5


def row_of(name: str) -> tuple[int, str, float]:
    """Place of a quantity in `ROWS`, its title, and what its values are multiplied by.

    Examples
    --------
    >>> row_of("rise_10_90_ns")[1:], row_of("slow_share")[1:]
    (('rise 10–90 % [ns]', 1.0), ('late charge [%]', 100.0))
    """
    for place, (pattern, (text, unit)) in enumerate(ROWS.items()):
        if re.fullmatch(pattern, name):
            title = re.sub(pattern, text, name) + (f" [{unit}]" if unit else "")
            return place, title, {"%": 100.0, "‰": 1000.0}.get(unit, 1.0)
    raise KeyError(name)


class Response:
    """Readout chains of runs in terms of physics.

    Parameters
    ----------
    runs
        The chains of the runs.
    truth
        True readout, if given.

    Attributes
    ----------
    true_values
        The same quantities of the true readout; empty if it is not given.
    difference, sigma
        Difference of the first run from the truth, and the same in units of its error; without
        those that have none.
    """

    def __init__(
        self, runs: Sequence[DescribedChain], truth: Electronics | None = None
    ) -> None:
        self.runs, self.truth, self.true_values = runs, truth, dict[str, float]()
        self._named = dict[str, DescribedChain]()
        for chain in runs:  # several runs in memory have the same name
            same = sum(of.run.name == chain.run.name for of in self._named.values())
            self._named[chain.run.name + f" ({same + 1})" * (same > 0)] = chain
        first = runs[0]
        if truth is not None:
            of_truth, preparation = true_chain_of(truth), first.run.recipe.preparation
            self.true_values = true_parameters(truth)
            self.true_values |= chain_numbers(of_truth, preparation, first.run.dt_ns)
        own, errors, true = first.values, first.errors, self.true_values
        self.difference = {n: own[n] - true[n] for n in true if n in own}
        self.sigma = {n: off / errors[n] for n, off in self.difference.items() if errors.get(n)}
        names = [name for source in (*(of.values for of in runs), true) for name in source]
        self.rows = sorted(dict.fromkeys(names), key=lambda name: row_of(name)[0])

    @property
    def values(self) -> DataFrame:
        """A row per quantity, a column per run, and ``truth``."""
        from pandas import DataFrame

        columns = {name: chain.values for name, chain in self._named.items()}
        if self.truth is not None:
            columns["truth"] = self.true_values
        return DataFrame(columns).reindex(self.rows)

    def plot(self) -> Figure:
        """Step and impulse response, tail and noise."""
        from cpunet.training.figures import response_figure

        tail_ns = self.runs[0].run.recipe.preparation.after_ns
        truth = None if self.truth is None else true_chain_of(self.truth)
        return response_figure([chain.chain for chain in self.runs], truth, tail_ns=tail_ns)

    def save(self, path: str | Path, force: bool = False) -> None:
        """Make a folder of ``response.json``, ``.yaml``, ``.csv`` and ``.png``.

        The YAML has correlations.  Of several runs, ``response.html`` is a page with outliers
        marked.

        Raises
        ------
        CpunetError
            If the folder exists and `force` is off, or is of something else.
        """
        runs = [
            {"path": name, "recipe": chain.run.recipe.name}
            | {of: getattr(chain.run, of) for of in _OF_RUN}
            | {of: getattr(chain, of) for of in _OF_CHAIN}
            for name, chain in self._named.items()
        ]
        content: dict[str, Any] = {"cpunet": cpunet.__version__, "runs": runs}
        if self.truth is not None:
            content["truth"] = {"name": self.truth.name, "values": self.true_values}
            content["truth"] |= {"difference": self.difference, "sigma": self.sigma}
        folders = [chain.run.folder for chain in self.runs]
        with folder_written_aside(Path(path), RESPONSE, *folders, force=force) as folder:
            text = json.dumps(content, indent=1, ensure_ascii=False)
            (folder / "response.json").write_text(text + "\n", encoding="utf-8")
            (folder / "response.yaml").write_text(as_yaml(self._named), encoding="utf-8")
            (folder / "response.csv").write_text(as_csv(self._named), encoding="utf-8")
            if len(self.runs) > 1:
                page = array_page(self._named)
                (folder / "response.html").write_text(page, encoding="utf-8")
            self.plot().savefig(folder / "response.png", dpi=_DPI)

    def __str__(self) -> str:
        alone = len(self.runs) == 1  # with several runs errors have no room
        head = ["", *(Path(name).name for name in self._named)]
        sources = [(chain.values, chain.errors if alone else {}) for chain in self.runs]
        if self.truth is not None:
            head += [self.truth.name, *(["difference", "σ"] if alone else [])]
            sources.append((self.true_values, {}))
        rows = []
        for name in self.rows:
            _, title, scale = row_of(name)
            cells = [title]
            for pair in sources:
                scaled = (scale * of[name] if name in of else None for of in pair)
                cells.append(with_std(*scaled))
            if self.truth is not None and alone:
                difference, true = self.difference.get(name), self.true_values.get(name)
                text = ""
                if difference is not None and scale == 100:  # of shares in percentage points
                    text = f"{100 * difference:+.2f} pp"
                elif difference is not None and true:
                    text = f"{100 * difference / true:+.1f} %"
                cells += [text, f"{self.sigma[name]:+.1f}" if name in self.sigma else ""]
            rows.append(cells)
        return text_table(head, rows, title="Readout response")

    __repr__ = __str__


def response(
    *runs: RunLike,
    truth: str | Path | Electronics | None = None,
    out: str | Path | None = None,
    force: bool = False,
) -> Response:
    """Say in terms of physics what readout was learned, with the true response if given.

    Parameters
    ----------
    runs
        Runs of a readout chain, as of several detectors.
    truth
        True readout: folder of a test stand, ornl, legend200, ringing, mjd, or a YAML file.
    out
        Folder for response.json and .png, tables in YAML (with correlations) and CSV, and, of
        several runs, a page with outliers marked.
    force
        Replace existing output.

    Returns
    -------
    Response
        Numbers of each run, which prints them side by side.

    Raises
    ------
    CpunetError
        If a run has no readout chain, or the truth is not that of the first.

    Examples
    --------
    ``cpunet response run1 run2 --truth stand --out response``
    """
    opened = [as_run(run) for run in runs]
    if not opened:
        raise CpunetError("no run was given", "give its folder")
    if out is not None:
        place = str(truth) if isinstance(truth, str | Path) else None
        refuse_existing(Path(out), place, *(run.folder for run in opened), force=force)
    electronics = truth
    if isinstance(truth, str | Path):
        folder = Path(truth).is_dir()
        electronics = Stand.load(truth).electronics if folder else read_electronics(truth)
    assert electronics is None or isinstance(electronics, Electronics)
    result = Response([describe_chain(run) for run in opened], electronics)
    if electronics is not None and not np.isclose(electronics.dt_ns, opened[0].dt_ns):
        raise CpunetError(
            f"{opened[0].name}: trained on pulses sampled every {opened[0].dt_ns:g} ns, "
            f"electronics {electronics.name} samples every {electronics.dt_ns:g} ns; give the "
            "truth of its data"
        )
    for chain in result.runs:
        for doubt in chain.doubts:
            log.warning(f"{Path(chain.run.name).name}: {doubt}")
    if out is not None:
        result.save(out, force)
    return result


def as_yaml(chains: Mapping[str, DescribedChain]) -> str:
    """Value and error of each number, and correlations, by channel."""
    content = {}
    for name, chain in chains.items():
        names = [name for name in chain.moved if chain.errors.get(name)]
        moved = np.array([chain.moved[name] for name in names])  # (numbers, axes)
        covariance = moved @ moved.T if names else np.zeros((0, 0))
        sizes = np.sqrt(covariance.diagonal())
        content[name] = {
            "run": chain.run.name,
            "good": chain.run.ok,
            "numbers": {
                n: {"value": v, "error": chain.errors.get(n)} for n, v in chain.values.items()
            },
            "correlations": {
                "names": names,
                "matrix": (covariance / np.outer(sizes, sizes)).round(4).tolist(),
            },
        }
    return yaml_text(plain(content))


def as_csv(chains: Mapping[str, DescribedChain]) -> str:
    """A line for each channel: each number with its error."""
    from pandas import DataFrame

    rows = {
        channel: {"good": int(chain.run.ok)}
        | {
            f"{name}{end}": of.get(name)
            for name in chain.values
            for end, of in (("", chain.values), ("_error", chain.errors))
        }
        for channel, chain in chains.items()
    }
    return str(DataFrame.from_dict(rows, orient="index").to_csv(index_label="channel"))


def outliers(values: Sequence[float | None], errors: Sequence[float | None]) -> list[bool]:
    """Which values are far from the median, in robust standard deviations and in errors.

    Examples
    --------
    >>> outliers([1.0, 1.1, 0.9, 1.0, 1.05, 3.0], [0.01] * 6)
    [False, False, False, False, False, True]
    """
    numbers = np.array([np.nan if value is None else value for value in values], float)
    own = np.array([error or 0.0 for error in errors])
    finite = numbers[np.isfinite(numbers)]
    if finite.size < FEW:
        return [False] * len(numbers)
    spread = np.hypot(median_abs_deviation(finite, scale="normal"), own)
    distances = np.abs(numbers - np.median(finite))
    return [bool(a > FAR * s) for a, s in zip(distances, spread, strict=True)]


def array_page(chains: Mapping[str, DescribedChain]) -> str:
    """A page of all channels, on which outliers and bad fits are marked."""
    from cpunet.html_pages import rendered

    columns: dict[str, list[tuple[str, bool]]] = {}
    for name in SHOWN:
        _, title, scale = row_of(name)
        both = [(chain.values.get(name), chain.errors.get(name)) for chain in chains.values()]
        if any(value is not None for value, _ in both):
            texts = [with_std(*(of and scale * of for of in pair)) for pair in both]
            columns[title] = list(zip(texts, outliers(*zip(*both, strict=True)), strict=True))
    rows = list[dict[str, Any]]()
    for i, (channel, chain) in enumerate(chains.items()):
        cells = [column[i] for column in columns.values()]
        marked = sum(far for _, far in cells) + (not chain.run.ok)
        rows.append({"name": channel, "good": chain.run.ok, "cells": cells, "marked": marked})
    rows.sort(key=lambda row: -row["marked"])
    marked = sum(bool(row["marked"]) for row in rows)
    title = f"Readouts of {len(rows)} channels: {marked} to look at"
    return rendered("array.html", title=title, head=list(columns), rows=rows, far=f"{FAR:g}")
