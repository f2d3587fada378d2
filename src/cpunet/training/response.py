"""`cpunet.response`: what readout was learned, with the true response if given."""

from __future__ import annotations

import json
import logging
import re
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

import cpunet
from cpunet.electronics.chain import Electronics, read_electronics
from cpunet.electronics.stand import Stand
from cpunet.errors import CpunetError
from cpunet.outputs import FolderKind, folder_written_aside, refuse_existing
from cpunet.tables import text_table, with_std
from cpunet.training.chain_description import DescribedChain, describe_chain
from cpunet.training.closed_forms import Numbers, chain_numbers, true_chain_of, true_parameters
from cpunet.training.response_tables import array_page, as_csv, as_yaml
from cpunet.training.run import RunLike, as_run

if TYPE_CHECKING:
    from matplotlib.figure import Figure
    from pandas import DataFrame

log = logging.getLogger(__name__)

MARKER = "response.json"
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


@dataclass(frozen=True, eq=False, repr=False)
class Response:
    """Readout chains of runs in terms of physics.

    Parameters
    ----------
    runs
        The chains of the runs.
    truth
        True readout, if given.
    """

    runs: list[DescribedChain]
    truth: Electronics | None = None

    @cached_property
    def true_values(self) -> Numbers:
        """The same quantities of the true readout; empty if it is not given."""
        if self.truth is None:
            return {}
        first, chain = self.runs[0].run, true_chain_of(self.truth)
        numbers = chain_numbers(chain, first.recipe.preparation, first.dt_ns)
        return true_parameters(self.truth) | numbers

    @cached_property
    def difference(self) -> Numbers:
        """Difference of the first run from the truth."""
        values = self.runs[0].values
        return {n: values[n] - true for n, true in self.true_values.items() if n in values}

    @cached_property
    def sigma(self) -> Numbers:
        """The same in units of the error; without those that have no error."""
        errors = self.runs[0].errors
        return {
            name: difference / errors[name]
            for name, difference in self.difference.items()
            if errors.get(name)
        }

    @property
    def values(self) -> DataFrame:
        """A row per quantity, a column per run, and ``truth``."""
        from pandas import DataFrame

        columns = {chain.run.name: chain.values for chain in self.runs}
        if self.truth is not None:
            columns["truth"] = self.true_values
        return DataFrame(columns).reindex(self._names)

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
        content: dict[str, Any] = {"cpunet": cpunet.__version__, "runs": []}
        for chain in self.runs:
            facts = {"path": chain.run.name, "recipe": chain.run.recipe.name}
            facts |= {name: getattr(chain.run, name) for name in _OF_RUN}
            content["runs"].append(facts | {name: getattr(chain, name) for name in _OF_CHAIN})
        if self.truth is not None:
            content["truth"] = {
                "name": self.truth.name,
                "values": self.true_values,
                "difference": self.difference,
                "sigma": self.sigma,
            }
        folders = [chain.run.folder for chain in self.runs]
        with folder_written_aside(Path(path), RESPONSE, *folders, force=force) as folder:
            text = json.dumps(content, indent=1, ensure_ascii=False)
            (folder / MARKER).write_text(text + "\n", encoding="utf-8")
            chains = {chain.run.name: chain for chain in self.runs}
            (folder / "response.yaml").write_text(as_yaml(chains), encoding="utf-8")
            (folder / "response.csv").write_text(as_csv(chains), encoding="utf-8")
            if len(chains) > 1:
                (folder / "response.html").write_text(array_page(chains), encoding="utf-8")
            self.plot().savefig(folder / "response.png", dpi=_DPI)

    def __str__(self) -> str:
        alone = len(self.runs) == 1  # with several runs errors have no room
        head = ["", *(Path(chain.run.name).name for chain in self.runs)]
        sources = [(chain.values, chain.errors if alone else {}) for chain in self.runs]
        if self.truth is not None:
            head += [self.truth.name, *(["difference", "σ"] if alone else [])]
            sources.append((self.true_values, {}))
        rows = []
        for name in self._names:
            _, label, unit = _row(name)
            scale = {"%": 100.0, "‰": 1000.0}.get(unit, 1.0)
            cells = [f"{label} [{unit}]" if unit else label]
            for pair in sources:
                scaled = (scale * of[name] if name in of else None for of in pair)
                cells.append(with_std(*scaled))
            if self.truth is not None and alone:
                difference, true, text = (
                    self.difference.get(name),
                    self.true_values.get(name),
                    "",
                )
                if difference is not None and unit == "%":  # of shares in percentage points
                    text = f"{100 * difference:+.2f} pp"
                elif difference is not None and true:
                    text = f"{100 * difference / true:+.1f} %"
                cells += [text, f"{self.sigma[name]:+.1f}" if name in self.sigma else ""]
            rows.append(cells)
        return text_table(head, rows, title="Readout response")

    def __repr__(self) -> str:
        truth = "" if self.truth is None else f", truth {self.truth.name}"
        names = ", ".join(Path(chain.run.name).name for chain in self.runs)
        return f"<{type(self).__name__} of {names}{truth}>"

    @property
    def _names(self) -> list[str]:
        """Quantities that any run or the truth has, in the order of `ROWS`."""
        sources = [*(chain.values for chain in self.runs), self.true_values]
        names = {name: None for source in sources for name in source}
        return sorted(names, key=lambda name: _row(name)[0])


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


def _row(name: str) -> tuple[int, str, str]:
    """Place, label and unit of a quantity in `ROWS`."""
    return next(
        (place, re.sub(pattern, text, name), unit)
        for place, (pattern, (text, unit)) in enumerate(ROWS.items())
        if re.fullmatch(pattern, name)
    )
