"""``cpunet response``."""

from __future__ import annotations

import logging
import re
from pathlib import Path
from typing import Annotated, Any

import typer
from rich.box import SIMPLE_HEAD
from rich.markup import escape
from rich.table import Table

from cpunet.cli import options
from cpunet.cli.messages import tell
from cpunet.errors import CpunetError
from cpunet.outputs import refuse_inputs

log = logging.getLogger(__name__)

Stand = Annotated[
    Path | None, typer.Option("--stand", help="Test stand of the data: compare with its truth.")
]
Truth = Annotated[
    str | None,
    typer.Option("--electronics", help="True readout: ornl, legend200, ringing, or YAML."),
]
Out = Annotated[Path | None, typer.Option("--out", help="Folder for response.json and .png.")]

# What a name of `describe_responses` stands for, and its unit; shares are given in percent.
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


def response(
    runs: options.Runs,
    stand: Stand = None,
    electronics: Truth = None,
    out_folder: Out = None,
    force: options.Force = False,
) -> None:
    """Say in terms of physics what readout was learned, beside the truth if it is known.

    Example: cpunet response run1 run2 --stand stand --out response
    """
    from cpunet.electronics.chain import read_electronics
    from cpunet.training.chain_description import describe_responses, stand_electronics

    if stand is not None and electronics is not None:
        raise CpunetError("--stand and --electronics both name the truth; give one of them")
    if out_folder is not None:
        refuse_inputs(out_folder, stand, electronics)
    truth = None
    if stand is not None:
        truth = stand_electronics(stand)
    elif electronics is not None:
        truth = read_electronics(electronics)
    told = describe_responses(runs, truth=truth, out=out_folder, force=force)
    if out_folder is None:
        tell(response_table(told))
    else:
        tell(response_table(told))
        tell(f"{out_folder / 'response.png'}")
    for run in told["runs"]:
        for doubt in run["doubts"]:
            log.warning(f"{Path(run['path']).name}: {doubt}")


def response_table(told: dict[str, Any]) -> Table:
    """Draw runs, their mean and the truth side by side.

    Parameters
    ----------
    told
        The content of ``response.json``.
    """
    runs, truth = told["runs"], told.get("truth")
    table = Table(title="Readout response", box=SIMPLE_HEAD, padding=(0, 1, 0, 0))
    table.add_column("")
    heads = [Path(run["path"]).name for run in runs]
    if "mean" in told:
        heads.append("mean ± spread")
    if truth is not None:
        heads += [truth["name"], "difference", "σ"]
    for head in heads:
        table.add_column(escape(head), justify="right")
    for name in _names(told):
        label, unit = _label(name)
        table.add_row(
            escape(f"{label} [{unit}]" if unit else label),
            *_cells(told, name, unit),
        )
    return table


def _names(told: dict[str, Any]) -> list[str]:
    """Quantities that any run or the truth has, in the order of `ROWS`."""
    sources = [run["values"] for run in told["runs"]]
    if "truth" in told:
        sources.append(told["truth"]["values"])
    names = {name: None for source in sources for name in source}
    patterns = list(ROWS)
    return sorted(names, key=lambda name: patterns.index(_pattern(name)))


def _pattern(name: str) -> str:
    return next(pattern for pattern in ROWS if re.fullmatch(pattern, name))


def _label(name: str) -> tuple[str, str]:
    pattern = _pattern(name)
    text, unit = ROWS[pattern]
    return re.sub(pattern, text, name), unit


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
