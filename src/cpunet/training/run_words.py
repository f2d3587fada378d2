"""A trained run in words: what was trained, on what, and how well it fits."""

from __future__ import annotations

import re
from collections.abc import Mapping
from contextlib import suppress

from cpunet.electronics.pile_up_tails import tails_in_words
from cpunet.errors import CpunetError
from cpunet.pulses.loading import SideInfo
from cpunet.tables import counted, percent, with_std
from cpunet.training.chain_description import noise_kev
from cpunet.training.run import FitInfo, Run

PARTS = 8  # maximum number of deviating parts of a fit
UNITS = {"ns": "ns", "us": "µs", "mhz": "MHz", "kev": "keV"}
_OFF = 3.0  # standard deviations


def summary(run: Run) -> list[tuple[str, str]]:
    """Topics and texts on a run."""
    fit = run.fit or FitInfo()
    where = run.name
    response = f"cpunet response {where}; " if run.recipe.generator.name == "response" else ""
    when = run.started[:16].replace("T", " ")
    known, drift = fit.tails, (fit.model_extra or {}).get("drift") or {}
    lines = [
        ("run", where),
        (
            "trained",
            f"recipe {run.recipe.name} on {run.peak}, seed {run.seed}; "
            f"{when}, {run.seconds:.4g} s on {run.device}",
        ),
        ("from", run.init or ""),
        ("simulated", _side(run.sim)),
        ("measured", _side(run.data)),
        ("fit", fit.verdict),
        ("off", _deviations(fit.pulls)),
        *(("cause", cause) for cause in fit.causes),
        ("response", _parameters(fit.parameters)),
        ("drift", str(drift.get("verdict") or "")),
    ]
    if "baselines" in fit.noise:
        lines.append(("noise", f"{_noise(run)}of {fit.noise['baselines']:.0f} baselines"))
    if known is not None and "rate_khz" in known.model_fields_set:
        lines += tails_in_words(known.model_dump())
    versions = ", ".join(f"{name} {version}" for name, version in run.versions.items())
    lines += [("versions", versions), ("next", f"{response}cpunet validate {where} …")]
    return [(topic, text) for topic, text in lines if text]


def _noise(run: Run) -> str:
    with suppress(CpunetError):  # no chain
        kev, error = noise_kev(run)
        return f"{with_std(kev, error)} keV (RMS), "
    return ""


def _side(side: SideInfo) -> str:
    if side.file is None:
        return ""
    read_as = ", ".join(f"{n} {v}" for n, v in side.read_as.items())
    text = f"{side.file}" + (f" ({read_as})" if read_as else "")
    text += f": {side.used} of {side.read} pulses used"
    lost = counted(side.rejections)
    return f"{text}, left out {lost}" if lost else text


def _deviations(pulls: Mapping[str, float]) -> str:
    """Parts of the pulses that deviate, worst first."""
    worst = sorted(pulls, key=lambda name: -abs(pulls[name]))[:PARTS]
    return ", ".join(f"{n} {pulls[n]:+.1f} σ" for n in worst if abs(pulls[n]) > _OFF)


def _parameters(values: Mapping[str, float]) -> str:
    """Parameters of a readout chain; ``slow_100_ns`` and such are shares of the charge."""
    words = []
    for name, value in values.items():
        stem, _, unit = name.rpartition("_")
        shown = f" {UNITS[unit]}" if unit in UNITS else ""
        called = (stem if shown else name).replace("_", " ")
        if re.fullmatch(r"(slow|decay)_\d\S*_(ns|us)|ringing_(sine|cosine)", name):
            words.append(f"{called}{shown} {percent(100 * value)}")
        else:
            words.append(f"{called} {value:.4g}{shown}")
    return ", ".join(words)
