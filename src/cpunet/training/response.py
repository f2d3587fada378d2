"""`cpunet.response`: what readout was learned, beside the truth if it is known."""

from __future__ import annotations

import json
import logging
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

import cpunet
from cpunet.electronics.chain import Electronics, read_electronics
from cpunet.errors import CpunetError
from cpunet.outputs import FolderKind, folder_written_aside, refuse_existing
from cpunet.settings import checked, read_json
from cpunet.tables import text_table
from cpunet.training.chain_description import DescribedChain, describe_chain
from cpunet.training.closed_forms import (
    Chain,
    Numbers,
    chain_numbers,
    true_chain_of,
    true_parameters,
)
from cpunet.training.run import Run, RunLike, as_run

if TYPE_CHECKING:
    from matplotlib.figure import Figure
    from pandas import DataFrame

log = logging.getLogger(__name__)

MARKER = "response.json"
RESPONSE = FolderKind(
    name="response",
    command="cpunet response",
    own=r"response\.json|response\.png",
)
_DPI = 150

# What a name of `describe_chain` stands for, and its unit; shares are given in percent.
ROWS = {
    r"pole_(\d)_ns": (r"bandwidth pole \1", "ns"),
    r"slow_share": ("slow share of the charge", "%"),
    r"slow_time_ns": ("its mean time", "ns"),
    r"ringing": ("ringing", "%"),
    r"ringing_(sine|cosine)": (r"its \1", "%"),
    r"ringing_mhz": ("ringing frequency", "MHz"),
    r"ringing_damping_ns": ("ringing damping", "ns"),
    r"drift_stretch": ("drift stretched by", "%"),
    r"drift_stretch_per_us": ("and per µs by", "%"),
    r"rise_(.*)_(.*)_ns": (r"rise \1–\2 %", "ns"),
    r"missing_(.*)_ns": (r"still missing at \1 ns", "%"),
    r"overshoot": ("overshoot", "%"),
    r"decay_us": ("main decay", "µs"),
    r"fast_decay_(\d)_us": (r"fast decay \1", "µs"),
    r"fast_decay_(\d)_share": (r"share of fast decay \1", "%"),
    r"effective_decay_us": ("effective decay, tail", "µs"),
    r"decay_(.*)_us": (r"share decaying with \1 µs", "%"),
    r"droop_(.*)_us": (r"decayed at \1 µs", "%"),
    r"noise_rms_kev": ("noise RMS", "keV"),
    r"noise_corner_mhz": ("noise corner", "MHz"),
    r"chi_square_per_moment": ("chi-square per moment", ""),
}
# The division of a chain into parts is degenerate, and times of slow parts and decays are
# fixed: a true part between two of them is split, which the errors do not contain.
PARTS = re.compile(r"slow_|missing_|overshoot|decay_|fast_decay_|droop_")


@dataclass(frozen=True, eq=False, repr=False)
class Response:
    """Readout chains of runs in terms of physics.

    Parameters
    ----------
    content
        ``runs``: for each run the content of a
        `cpunet.training.chain_description.DescribedChain`.  ``mean`` and ``spread`` (standard
        deviation) of several runs.  ``truth``: the same ``values`` of the true chain, the
        ``difference`` of the run or of the mean of the runs from it, and ``sigma``, the
        difference divided by the error or the spread, whichever is larger.  A quantity
        without an error has no sigma: the runs share their data, so their spread shows how
        well they agree, not how accurate they are.  Nor has one of `PARTS` of the chain.
    runs
        The chains of the runs.
    truth
        True chain, if known.
    """

    content: dict[str, Any]
    runs: list[DescribedChain]
    truth: Chain | None = None

    @property
    def values(self) -> DataFrame:
        """A row per quantity, a column per run, and ``mean``, ``spread``, ``truth``."""
        from pandas import DataFrame

        columns = {run["path"]: run["values"] for run in self.content["runs"]}
        columns |= {n: self.content[n] for n in ("mean", "spread") if n in self.content}
        if "truth" in self.content:
            columns["truth"] = self.content["truth"]["values"]
        return DataFrame(columns).reindex(_names(self.content))

    def plot(self) -> Figure:
        """Step and impulse response, tail and noise."""
        from cpunet.training.figures import response_figure

        first = self.runs[0].run
        tail_ns = first.recipe.preparation.samples_after * first.dt_ns
        return response_figure([one.chain for one in self.runs], self.truth, tail_ns=tail_ns)

    def save(self, path: str | Path, force: bool = False) -> None:
        """Make a folder of ``response.json`` and ``response.png``.

        Raises
        ------
        CpunetError
            If the folder exists and `force` is off, or is of something else.
        """
        folders = [one.run.folder for one in self.runs]
        with folder_written_aside(Path(path), RESPONSE, *folders, force=force) as folder:
            text = json.dumps(self.content, indent=1, ensure_ascii=False)
            (folder / MARKER).write_text(text + "\n", encoding="utf-8")
            self.plot().savefig(folder / "response.png", dpi=_DPI)

    def __str__(self) -> str:
        head = ["", *(Path(run["path"]).name for run in self.content["runs"])]
        if "mean" in self.content:
            head.append("mean ± spread")
        if "truth" in self.content:
            head += [self.content["truth"]["name"], "difference", "σ"]
        rows = []
        for name in _names(self.content):
            _, label, unit = _row(name)
            text = f"{label} [{unit}]" if unit else label
            rows.append([text, *_cells(self.content, name, unit)])
        return text_table(head, rows, title="Readout response")

    def __repr__(self) -> str:
        truth = "" if self.truth is None else f", beside {self.content['truth']['name']}"
        names = ", ".join(Path(one.run.name).name for one in self.runs)
        return f"<{type(self).__name__} of {names}{truth}>"


def response(
    *runs: RunLike,
    truth: str | Path | Electronics | None = None,
    out: str | Path | None = None,
    force: bool = False,
) -> Response:
    """Say in terms of physics what readout was learned, beside the truth if it is known.

    Parameters
    ----------
    runs
        Runs of a readout chain, as of several seeds, with the same sampling and preparation.
    truth
        True readout: folder of a test stand, ornl, legend200, ringing, or a YAML file.
    out
        Folder for response.json and response.png.
    force
        Replace existing output.

    Returns
    -------
    Response
        Numbers of each run, which prints them side by side.

    Raises
    ------
    CpunetError
        If a run has no readout chain, or runs or truth are incompatible.

    Examples
    --------
    ``cpunet response run1 run2 --truth stand --out response``
    """
    known = [as_run(run) for run in runs]
    if not known:
        raise CpunetError("no run was given", "give the folder of one")
    if out is not None:
        place = str(truth) if isinstance(truth, str | Path) else None
        refuse_existing(Path(out), place, *(run.folder for run in known), force=force)
    electronics = _electronics(truth)
    first, preparation = known[0], known[0].recipe.preparation
    chains = [describe_chain(run) for run in known]
    _require_alike(known, electronics)
    content: dict[str, Any] = {"cpunet": cpunet.__version__, "dt_ns": first.dt_ns}
    content |= {"runs": [one.content for one in chains]} | _summary(chains)
    true_chain = None
    if electronics is not None:
        true_chain = true_chain_of(electronics)
        values = true_parameters(electronics)
        values |= chain_numbers(true_chain, preparation, first.dt_ns)
        content["truth"] = {"name": electronics.name} | _compared(content, values)
    result = Response(content, chains, true_chain)
    for one in chains:
        for doubt in one.doubts:
            log.warning(f"{Path(one.run.name).name}: {doubt}")
    if out is not None:
        result.save(out, force)
    return result


def _electronics(truth: str | Path | Electronics | None) -> Electronics | None:
    """The true readout, if given, of a stand from its ``stand.json``."""
    if truth is None or isinstance(truth, Electronics):
        return truth
    if not Path(truth).is_dir():
        return read_electronics(truth)
    path = Path(truth) / "stand.json"
    content = read_json(path, "give the folder of a test stand, as of `cpunet stand`")
    return checked(Electronics, content.get("electronics"), f"{path}: electronics")


def _summary(chains: Sequence[DescribedChain]) -> dict[str, Numbers]:
    """Mean and spread of several chains."""
    if len(chains) < 2:
        return {}
    names = [n for n in chains[0].values if all(n in one.values for one in chains)]
    columns = {name: [one.values[name] for one in chains] for name in names}
    return {
        "mean": {name: float(np.mean(column)) for name, column in columns.items()},
        "spread": {name: float(np.std(column, ddof=1)) for name, column in columns.items()},
    }


def _compared(told: Mapping[str, Any], values: Numbers) -> dict[str, Numbers]:
    """Truth, and the difference of the run or of the mean of the runs from it."""
    runs = told["runs"]
    found: Numbers = told.get("mean", runs[0]["values"])
    spread: Numbers = told.get("spread", {})
    difference = {n: found[n] - true for n, true in values.items() if n in found}
    sigma = {}
    for name, apart in difference.items():
        errors = [run["errors"][name] for run in runs if name in run["errors"]]
        if len(errors) == len(runs) and any(errors) and not PARTS.match(name):
            sigma[name] = apart / max(spread.get(name, 0.0), float(np.mean(errors)))
    return {"values": values, "difference": difference, "sigma": sigma}


def _require_alike(runs: Sequence[Run], truth: Electronics | None) -> None:
    """Raise a `CpunetError` unless all runs have the first's sampling and preparation."""
    first, *others = runs
    for run in others:
        if not np.isclose(run.dt_ns, first.dt_ns):
            raise CpunetError(
                f"{run.name}: trained on pulses sampled every {run.dt_ns:g} ns, {first.name} "
                f"every {first.dt_ns:g} ns; describe them one by one"
            )
        if run.recipe.preparation != first.recipe.preparation:
            raise CpunetError(
                f"{run.name}: trained with another preparation than {first.name}; describe "
                "them one by one"
            )
    if truth is not None and not np.isclose(truth.dt_ns, first.dt_ns):
        raise CpunetError(
            f"{first.name}: trained on pulses sampled every {first.dt_ns:g} ns, electronics "
            f"{truth.name} samples every {truth.dt_ns:g} ns; give the truth of its data"
        )


def _names(told: dict[str, Any]) -> list[str]:
    """Quantities that any run or the truth has, in the order of `ROWS`."""
    sources = [run["values"] for run in told["runs"]]
    if "truth" in told:
        sources.append(told["truth"]["values"])
    names = {name: None for source in sources for name in source}
    return sorted(names, key=lambda name: _row(name)[0])


def _row(name: str) -> tuple[int, str, str]:
    """Place, label and unit of a quantity in `ROWS`."""
    return next(
        (place, re.sub(pattern, text, name), unit)
        for place, (pattern, (text, unit)) in enumerate(ROWS.items())
        if re.fullmatch(pattern, name)
    )


def _cells(told: dict[str, Any], name: str, unit: str) -> list[str]:
    """A row of the table."""
    runs, truth = told["runs"], told.get("truth")
    scale = 100.0 if unit == "%" else 1.0
    # beside several runs there is no room for errors, and the spread says more
    errors = runs[0]["errors"] if len(runs) == 1 else {}
    cells = [_number(run["values"].get(name), scale, errors.get(name)) for run in runs]
    if "mean" in told:
        cells.append(_number(told["mean"].get(name), scale, told["spread"].get(name)))
    if truth is not None:
        true, apart = truth["values"].get(name), truth["difference"].get(name)
        cells += [_number(true, scale), _difference(apart, true, unit)]
        sigma = truth["sigma"].get(name)
        cells.append("" if sigma is None else f"{sigma:+.1f}")
    return cells


def _number(value: float | None, scale: float, error: float | None = None) -> str:
    if value is None:
        return "–"
    text = f"{scale * value:.4g}" if abs(scale * value) >= 0.005 else f"{scale * value:.2f}"
    if error is None:
        return text
    return f"{text} ± {scale * error:{'.2g' if scale * error < 99 else '.0f'}}"


def _difference(apart: float | None, true: float | None, unit: str) -> str:
    """Relative, but of shares in percentage points."""
    if apart is None or (not true and unit != "%"):
        return ""
    if unit == "%":
        return f"{100 * apart:+.2f} pp"
    return f"{100 * apart / true:+.1f} %" if true else ""
