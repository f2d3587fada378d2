"""Export a run as parameters of LEGEND's simulation chain.

The files are those of legend-simflow: electronics (``elecmod``), the mean of A/E against energy
(``aoemeanmod``) and its resolution (``aoeresmod``), each under the detector's name.
"""

from __future__ import annotations

import logging
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import yaml

import cpunet
from cpunet.electronics.exponentials import Exponentials
from cpunet.errors import CpunetError
from cpunet.hdf5_files import opened
from cpunet.legend.equivalent import Equivalent, ae_ratios, current_delay_ns
from cpunet.legend.equivalent import equivalent_kernel as fitted_kernel
from cpunet.legend.library_files import (
    IdealLibrary,
    chosen_libraries,
    known_detector,
    n_not_ending,
    require_charge,
)
from cpunet.outputs import FolderKind, folder_written_aside, refuse_existing
from cpunet.progress import stage
from cpunet.settings import plain, read_json
from cpunet.training.chain_description import describe_chain
from cpunet.training.run import RunLike, as_run

log = logging.getLogger(__name__)

WHOLE = "cpunet.yaml"
LEGEND_PARS = FolderKind(
    name="legend-pars",
    command="cpunet export legend",
    own=r"(elecmod|aoemeanmod|aoeresmod|cpunet)\.yaml",
)
TEMPLATES = 2000  # approximate number of templates of a library to test the kernel on
EVERY_DETECTOR = "default"  # name under which production looks up detectors without an entry
SAME = ("recipe", "peak", "seed")  # entries that a report and its run share


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
        if found := two.get("of_library"):
            alone, pairs = found["single_site"], found["two_sites"]
            lines.append(
                f"on {found['templates']} places of {found['library']}, A/E is off by "
                f"{alone['rms_percent']:.2g} % RMS, {alone['largest_percent']:.2g} % at most; "
                f"on pairs of them by {pairs['rms_percent']:.2g} and "
                f"{pairs['largest_percent']:.2g} %"
            )
        for method, one in self.content["ae_against_energy"].items():
            line = one["mean"]
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
    library: str | Path | None = None,
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
    library
        Library of ideal charge pulses on which the error of the kernel is determined.
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
    cpunet export legend run --report report --library ideal.lh5 --out pars
    """
    out = Path(out)
    report, library = (None if path is None else Path(path) for path in (report, library))
    run = as_run(run)
    given = (run.folder, report, library)
    refuse_existing(out, *given, force=force)
    told = describe_chain(run)
    for doubt in told.doubts:
        log.warning(doubt)
    known = known_detector(run)
    trained = {"recipe": run.recipe.name, "peak": run.peak, "seed": run.seed}
    name = detector or known or EVERY_DETECTOR
    methods, ae_pars = ({}, {}) if report is None else _against_energy(report, trained)
    undecayed = told.chain.undecayed
    with stage("Two numbers for the chain"):
        nearest = fitted_kernel(undecayed)
        equivalent: dict[str, Any] = asdict(nearest)
        if library is not None:
            wanted = () if detector is None else (detector,)
            equivalent["of_library"] = _of_library(library, wanted, known, undecayed, nearest)
    whole = {
        "made_of": {
            "cpunet": cpunet.__version__,
            "weights": run.weights_sha256,
            **trained,
            "dt_ns": run.dt_ns,
        },
        "electronics": {
            "equivalent": equivalent,
            "chain": told.parameters,
            "chain_errors": told.parameter_errors,
            "numbers": told.values,
        },
        "drift_time": {
            "current_maximum_delay_ns": current_delay_ns(undecayed),
            "about": "time of the largest averaged current less this is a charge's drift time",
        },
        "ae_against_energy": methods,
    }
    pars = {"elecmod": {"sigma": nearest.sigma_ns, "tau": nearest.tau_ns}} | ae_pars
    with folder_written_aside(out, LEGEND_PARS, *given, force=force) as folder:
        for kind, content in (pars | {"cpunet": whole}).items():
            text = yaml.safe_dump(plain({name: content}), sort_keys=False, allow_unicode=True)
            (folder / f"{kind}.yaml").write_text(text, encoding="utf-8")
    return LegendParameters(out, name, whole)


def _against_energy(
    report: Path, trained: Mapping[str, Any]
) -> tuple[dict[str, Any], dict[str, Any]]:
    """A/E against energy of a report on this run, and the entries of production for it."""
    path = report / "metrics.json"
    metrics = read_json(path, "give the folder that `cpunet validate` made")
    try:
        training, found = metrics["training"], metrics["ae_energy"]
        other = [key for key in SAME if training[key] != trained[key]]
        missing = found.get("missing")
        methods = {} if missing else dict(found["methods"])
        pars = {} if missing else _ae_pars(methods)
    except (ValueError, KeyError, TypeError, AttributeError) as error:
        raise CpunetError(
            f"{path}: no A/E against energy; give the folder that `cpunet validate` made"
        ) from error
    if other:
        raise CpunetError(
            f"{report}: of a run with {other[0]} {training[other[0]]}, this one has "
            f"{trained[other[0]]}; validate this run"
        )
    if missing:
        raise CpunetError(f"{report}: no A/E against energy: {missing}")
    return methods, pars


def _ae_pars(methods: Mapping[str, Any]) -> dict[str, Any]:
    """Production entries for A/E: mean of the translation and width of the data."""
    mean, width = methods["ren"]["mean"], methods["data"]["resolution"]
    return {
        "aoemeanmod": {
            "psl": {"expression": "x*a+b", "pars": {k: mean[k] for k in ("a", "b")}}
        },
        "aoeresmod": {
            "expression": "SigmaFit",
            "parameters": {k: width[k] for k in ("a", "b", "c")},
        },
    }


def _of_library(
    source: Path,
    wanted: Sequence[str],
    known: str | None,
    undecayed: Exponentials,
    nearest: Equivalent,
) -> dict[str, Any]:
    """Errors of A/E by the kernel, relative to the chain, for templates of a detector."""
    with opened(source) as file:
        held = chosen_libraries(file, source, wanted, known)
        library = IdealLibrary.of(file, held[0], source)
        values = file[f"{library.path}/waveform_{library.angles[0]}"]
        charge = _some(values)
    if not len(charge):
        raise CpunetError(f"{source}: {library.path}: no template of charge")
    n = len(charge)
    require_charge(f"{source}: {library.path}", n, n, n_not_ending(charge))
    rng = np.random.default_rng(0)
    share = rng.random((n, 1), np.float32)
    two_sites = share * charge + (1 - share) * charge[rng.permutation(n)]
    alone = ae_ratios(charge, undecayed, nearest)
    usual = float(np.median(alone))  # divided out, since A/E is calibrated
    return {"library": library.path, "templates": n} | {
        name: {"rms_percent": float(apart.std()), "largest_percent": float(np.abs(apart).max())}
        for name, apart in (
            ("single_site", 100 * (alone / usual - 1)),
            ("two_sites", 100 * (ae_ratios(two_sites, undecayed, nearest) / usual - 1)),
        )
    }


def _some(values: Any) -> npt.NDArray[np.float32]:
    """Templates of regularly spaced rows of r, a few thousand at most."""
    n_r, n_z, _ = values.shape
    step = max(1, n_r * n_z // TEMPLATES)
    rows = [np.asarray(values[i], np.float32) for i in range(0, n_r, step)]
    block = np.concatenate(rows)
    return block[np.isfinite(block).all(axis=1) & block.any(axis=1)]
