"""Export a run as parameters of LEGEND's simulation chain.

The files are those of legend-simflow: electronics (``elecmod``), the mean of A/E against energy
(``aoemeanmod``) and its resolution (``aoeresmod``), each under the detector's name.

The electronics are approximated by Gaussian ⊗ exponential. As in production, sigma and tau are
fitted to the averaged current around its maximum, weighted by its square. The deviations from
the chain are reported with them.
"""

from __future__ import annotations

import logging
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import scipy.optimize
from scipy.special import log_ndtr, ndtr

import cpunet
from cpunet.errors import CpunetError
from cpunet.legend.currents import WINDOW, WINDOWS, averaged
from cpunet.legend.translate_library import known_detector
from cpunet.outputs import FolderKind, folder_written_aside, refuse_existing
from cpunet.progress import stage
from cpunet.settings import plain, yaml_text
from cpunet.training.chain_description import StepResponse, describe_chain
from cpunet.training.response import as_csv, as_yaml
from cpunet.training.run import RunLike, as_run
from cpunet.validation.report import METRICS, read_metrics

log = logging.getLogger(__name__)

Values = npt.NDArray[np.float64]

AROUND_NS = 500  # compared range on either side of the maximum
START_NS = (40.0, 60.0)  # initial sigma and tau
LONGEST_NS = 500.0
LENGTH, BEGIN = 8192, 1500  # number of 1 ns samples, and the one at which charge moves
WIDTHS_NS = (1, 20, 50, 100, 150, 200, 300)  # of constant currents, as in a detector
LEGEND_PARS = FolderKind(
    name="legend-pars",
    command="cpunet export legend",
    own=r"(elecmod|aoemeanmod|aoeresmod|cpunet|response)\.yaml|response\.csv",
)
EVERY_DETECTOR = "default"  # name under which production looks up detectors without an entry


def equivalent_kernel(undecayed: StepResponse) -> dict[str, float]:
    """Fit the Gaussian and exponential kernel nearest to a chain.

    Parameters
    ----------
    undecayed
        The chain without its decays, like data after pole-zero correction.

    Returns
    -------
    sigma_ns, tau_ns
        Standard deviation of the Gaussian and time constant of the exponential.
    prompt_share
        Factor by which the kernel's current fits the chain's: the fraction of the charge in
        the peak.
    current_error_percent
        Largest difference between the averaged currents within 500 ns of the maximum, relative
        to its height.
    late_charge_percent
        Charge that arrives more than 500 ns after the maximum, minus that of the kernel.
    ae_error_percent
        Half the range of the ratio of A/E of kernel and chain, over constant currents that last
        from 1 to 300 ns, divided by its median.
    delay_ns
        Time of the maximum of the averaged current for charge that arrives instantaneously.
        The three averages look back over 48 ns each; half of their total length is subtracted,
        so that they add no delay.

    Examples
    --------
    >>> from cpunet.electronics.chain import Exponentials
    >>> chain = Exponentials.low_pass(60.0) * Exponentials.low_pass(30.0)
    >>> nearest = equivalent_kernel(chain.step)
    >>> 10 < nearest["sigma_ns"] < 30, 60 < nearest["tau_ns"] < 90
    (True, True)
    """
    time = np.arange(LENGTH, dtype=float) - BEGIN
    step = undecayed(time)
    current = averaged(step)
    wanted = _about_peak(current)

    def fitted(parameters: Values) -> tuple[Values, float]:
        shape, weight = _about_peak(averaged(kernel_step(time, *parameters))), wanted**2
        height = float((weight * shape * wanted).sum() / (weight * shape**2).sum())
        return height * shape, height

    sigma, tau = scipy.optimize.least_squares(
        lambda parameters: wanted * (fitted(parameters)[0] - wanted) / wanted.max() ** 2,
        START_NS,
        bounds=(0.5, LONGEST_NS),
        diff_step=1e-4,
    ).x
    nearest, height = fitted(np.array([sigma, tau]))
    kernel = kernel_step(time, sigma, tau)
    late = int(current.argmax()) - (WINDOW - 1) * WINDOWS // 2 + AROUND_NS
    # A of the kernel over A of the chain for constant currents
    ratios = np.array([averaged(kernel, w).max() / averaged(step, w).max() for w in WIDTHS_NS])
    return {
        "sigma_ns": float(sigma),
        "tau_ns": float(tau),
        "prompt_share": height,
        "current_error_percent": float(100 * np.abs(nearest - wanted).max() / wanted.max()),
        "late_charge_percent": float(100 * ((1 - step[late]) - (1 - kernel[late]))),
        "ae_error_percent": float(50 * np.ptp(ratios) / np.median(ratios)),
        "delay_ns": float(current.argmax() - BEGIN - 0.5 * WINDOWS * (WINDOW - 1)),
    }


def kernel_step(time_ns: Values, sigma_ns: float, tau_ns: float) -> Values:
    """Response of Gaussian ⊗ exponential to a step of charge at time 0."""
    scaled = time_ns / sigma_ns
    shift = sigma_ns / tau_ns
    late = np.exp(np.minimum(0.5 * shift**2 - time_ns / tau_ns + log_ndtr(scaled - shift), 0))
    return np.asarray(ndtr(scaled) - late, np.float64)


def _about_peak(current: Values) -> Values:
    """Current around its maximum, whose position is interpolated between samples."""
    peak = int(current.argmax())
    low, mid, high = current[peak - 1 : peak + 2]
    time = peak + 0.5 * (low - high) / (low - 2 * mid + high)
    at = time + np.arange(-AROUND_NS, AROUND_NS + 1)
    return np.asarray(np.interp(at, np.arange(len(current)), current), np.float64)


@dataclass(frozen=True)
class LegendParameters:
    """A folder of parameters.

    Parameters
    ----------
    folder
        The folder.
    detector
        Name of the entries.
    content
        Content of ``cpunet.yaml`` under this name.
    """

    folder: Path
    detector: str
    content: dict[str, Any]

    def __str__(self) -> str:
        two = self.content["electronics"]["equivalent"]
        lines = [
            f"{self.folder}: {self.detector}: sigma {two['sigma_ns']:.1f} ns, tau "
            f"{two['tau_ns']:.1f} ns; the current is up to "
            f"{two['current_error_percent']:.1f} % of its height off, A/E "
            f"± {two['ae_error_percent']:.1f} % between currents of 1 and 300 ns"
        ]
        for method, numbers in self.content["ae_against_energy"].items():
            line = numbers["mean"]
            lines.append(
                f"A/E against energy, {method}: {line['per_mev_percent']:+.3f} ± "
                f"{line['per_mev_error_percent']:.3f} % per MeV"
            )
        if not self.content["ae_against_energy"]:
            lines.append("A/E against energy: none, since no `report` was given")
        return "\n".join(lines)


def export_legend(
    run: RunLike,
    out: str | Path,
    *,
    detector: str | None = None,
    report: str | Path | None = None,
    force: bool = False,
) -> LegendParameters:
    """Export a readout chain as parameters for LEGEND's simulation chain.

    ``elecmod.yaml`` holds sigma and tau of the nearest Gaussian ⊗ exponential, in ns;
    ``aoemeanmod.yaml`` the translation's mean of A/E against energy in keV, 1 at 1592.5 keV;
    ``aoeresmod.yaml`` the data's resolution of A/E; ``cpunet.yaml`` the whole chain with its
    errors, the error of this two-parameter kernel, and the delay to subtract for drift times.

    Parameters
    ----------
    run
        A trained run with a readout chain, or its folder.
    out
        Folder to create.
    detector
        Name of the entries; by default that of the detector that the run was trained with,
        or else ``default``.
    report
        Report on this run, as source of A/E.  Without it, the two files on A/E are not
        written.
    force
        Replace an existing folder.

    Returns
    -------
    LegendParameters
        The folder, and what was written.

    Raises
    ------
    CpunetError
        If the run has no readout chain, or the report belongs to another run or has no A/E.

    Examples
    --------
    cpunet export legend run --report report --out pars
    """
    out = Path(out)
    report, run = None if report is None else Path(report), as_run(run)
    given = (run.folder, report)
    refuse_existing(out, *given, force=force)
    described = describe_chain(run)
    for doubt in described.doubts:
        log.warning(doubt)
    trained = {"recipe": run.recipe.name, "peak": run.peak, "seed": run.seed}
    name = detector or known_detector(run) or EVERY_DETECTOR
    methods, ae_pars = ({}, {}) if report is None else _against_energy(report, trained)
    with stage("Two numbers for the chain"):
        nearest = equivalent_kernel(described.chain.undecayed)
    delay_ns = nearest.pop("delay_ns")
    whole = {
        "made_of": {
            "cpunet": cpunet.__version__,
            "weights": run.weights_sha256,
            **trained,
            "dt_ns": run.dt_ns,
        },
        "electronics": {
            "equivalent": nearest,
            "chain": described.parameters,
            "chain_errors": described.parameter_errors,
            "numbers": described.values,
        },
        "drift_time": {
            "current_maximum_delay_ns": delay_ns,
            "about": "time of the largest averaged current less this is a charge's drift time",
        },
        "ae_against_energy": methods,
    }
    pars = {"elecmod": {"sigma": nearest["sigma_ns"], "tau": nearest["tau_ns"]}} | ae_pars
    with folder_written_aside(out, LEGEND_PARS, *given, force=force) as folder:
        for kind, content in (pars | {"cpunet": whole}).items():
            text = yaml_text(plain({name: content}))
            (folder / f"{kind}.yaml").write_text(text, encoding="utf-8")
        (folder / "response.yaml").write_text(as_yaml({name: described}), encoding="utf-8")
        (folder / "response.csv").write_text(as_csv({name: described}), encoding="utf-8")
    return LegendParameters(out, name, whole)


def _against_energy(
    report: Path, trained: Mapping[str, Any]
) -> tuple[dict[str, Any], dict[str, Any]]:
    """A/E against energy of a report on this run, and the entries of production for it."""
    metrics = read_metrics(report / METRICS, "give the folder that `cpunet validate` made")
    for key, value in trained.items():
        if (other := metrics.training.get(key)) != value:
            raise CpunetError(
                f"{report}: of a run with {key} {other}, this one has {value}; validate "
                "this run"
            )
    methods = metrics.ae_energy.methods
    if not {"ren", "data"} <= methods.keys():
        missing = metrics.ae_energy.missing or "give the folder that `cpunet validate` made"
        raise CpunetError(f"{report}: no A/E against energy: {missing}")
    # the mean of the translation, and the width of the data
    line, law = methods["ren"].mean, methods["data"].resolution
    pars = {"a": line.a, "b": line.b}
    of_ae: dict[str, Any] = {"aoemeanmod": {"psl": {"expression": "x*a+b", "pars": pars}}}
    if law.b > 0:
        width = {"a": law.a, "b": law.b, "c": law.c}
        of_ae["aoeresmod"] = {"expression": "SigmaFit", "parameters": width}
    else:
        log.warning(
            f"{report}: widths of A/E do not determine the part of the noise (b = 0); "
            "aoeresmod.yaml is not written: give events of more energies"
        )
    return {name: asdict(course) for name, course in methods.items()}, of_ae
