"""Side and origin of the pulses of a file: as recorded by this program, or as they look."""

from __future__ import annotations

import json
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from cpunet.errors import CpunetError
from cpunet.pulses.reading.source import PulseSource
from cpunet.settings import flat

if TYPE_CHECKING:  # compiled loops, which a look into a file does not need
    from cpunet.pulses.preparation import Kind

# attributes of a table, and of a file
SIDE, MADE_BY, TRANSLATED_BY, RUN, SIMULATION = (
    "side", "made_by", "translated_by", "run", "simulation",
)  # fmt: skip
TRANSLATION = "cpunet_translation"
REN, IREN, SIMULATE = "cpunet ren", "cpunet iren", "cpunet simulate"

_FIRST_PULSES = 256  # pulses
_MIN_SAMPLES = 100  # per trace; a shorter one has no baseline and tail to inspect
_FULL_HEIGHT = 10.0  # in ADC counts; smaller whole numbers may be a charge in its own units
_TURNS = 3  # turning points of the baseline: noise has at least this many, a signal fewer
_SMALL = 1e-5  # of the height: rounding of a flat line
_MIN_END = 0.98  # of the height: without electronics a pulse ends at its maximum


@dataclass(frozen=True)
class Recognised:
    """Recognised side of a set of pulses.

    Parameters
    ----------
    side
        Simulated or measured; translated pulses count as the side they imitate.
    why
        Reason, phrased to follow "these".
    certain
        Whether the file states the side; otherwise it is a guess.
    """

    side: Kind
    why: str
    certain: bool


def require_side(source: PulseSource, wanted: Kind, remedy: str, *, insist: bool) -> None:
    """Refuse pulses of the wrong side.

    Parameters
    ----------
    source
        File of pulses.
    wanted
        Side that the user states.
    remedy
        Remedy to suggest if the pulses are of the other side.
    insist
        Whether to override a guess.

    Raises
    ------
    CpunetError
        If the file states that its pulses are of the other side, or if they appear to be
        and `insist` is False.
    """
    found = recorded_side(source)
    if found is None and not insist:
        found = apparent_side(next(iter(source.blocks(_FIRST_PULSES))).waveforms)
    refuse_other_side(found, source.path, wanted, remedy)


def refuse_other_side(found: Recognised | None, path: Path, wanted: Kind, remedy: str) -> None:
    """Refuse pulses of a file that are `found` to be of the other side; see `require_side`."""
    if found is not None and found.side != wanted:
        begin = " If" if remedy.endswith("?") else "; if"
        sure = "" if found.certain else f"{begin} they are {wanted}, say so with `insist`"
        raise CpunetError(
            f"{path}: given as {wanted} pulses, but these {found.why}", f"{remedy}{sure}"
        )


def recorded_side(source: PulseSource) -> Recognised | None:
    """Side recorded in a file that this program wrote; None for other files."""
    told = recorded_attributes(source)
    side, made_by, translated_by = (
        told.get(name, "") for name in (SIDE, MADE_BY, TRANSLATED_BY)
    )
    if translated_by in (REN, IREN):
        kind: Kind = "measured" if translated_by == REN else "simulated"
        name = translated_by.rpartition(" ")[2].upper()
        return Recognised(kind, f"were translated by {name} already", certain=True)
    if made_by.startswith(SIMULATE) or side == "simulated":
        return Recognised("simulated", f"were simulated by {made_by}", certain=True)
    if side == "measured":
        return Recognised(
            "measured", f"are traces behind electronics ({made_by})", certain=True
        )
    return None


def recorded_attributes(source: PulseSource) -> dict[str, str]:
    """Attributes in which this program records how it made the pulses; none in other files."""
    names = (SIDE, MADE_BY, TRANSLATED_BY, RUN, SIMULATION, TRANSLATION)
    return {name: text for name in names if (text := source.table.attrs.get(name))}


def recorded_detector(source: PulseSource) -> str | None:
    """Name of the simulated detector; None if the file does not contain it."""
    with suppress(ValueError, LookupError, TypeError):
        return str(json.loads(recorded_attributes(source)[SIMULATION])["detector"]["name"])
    return None


def apparent_side(waveforms: npt.NDArray[np.floating]) -> Recognised | None:
    """Side that pulses appear to be of; None if it is ambiguous.

    Whole numbers with noise before the pulse are measured; pulses with neither noise nor a
    decay are simulated.  A charge signal with noise, or a trace without its baseline, may be
    either.

    Parameters
    ----------
    waveforms
        Traces of shape ``(n, samples)``, of which the first few hundred are looked at.

    Examples
    --------
    >>> time = np.arange(400)
    >>> charge = 1 / (1 + np.exp((200 - time) / 5))
    >>> apparent_side(charge[None]).side
    'simulated'
    >>> noise = np.random.default_rng(1).normal(0, 10, 400)
    >>> apparent_side(np.round(3000 * charge + noise)[None]).side
    'measured'
    >>> apparent_side((charge + noise / 3000)[None]) is None
    True
    """
    known = waveforms[:_FIRST_PULSES]
    known = known[np.isfinite(known).all(axis=1)].astype(float)
    known = known[np.ptp(known, axis=1) > 0] if known.size else known
    if not len(known) or known.shape[1] < _MIN_SAMPLES:
        return None
    height = np.ptp(known, axis=1)
    few = known.shape[1] // 10
    before = np.median(_turns(known[:, :few], height))
    after = np.median(_turns(known[:, -few:], height))
    whole = (known == np.round(known)).all() and np.median(height) > _FULL_HEIGHT
    if whole and before >= _TURNS:
        why = "look measured (whole numbers with noise before the pulse)"
        return Recognised("measured", why, certain=False)
    end = (known[:, -few:].mean(axis=1) - known.min(axis=1)) / height
    if max(before, after) < _TURNS and np.median(end) > _MIN_END:
        return Recognised("simulated", "look simulated (no noise, no decay)", certain=False)
    return None


def _turns(
    part: npt.NDArray[np.float64], height: npt.NDArray[np.float64]
) -> npt.NDArray[np.int64]:
    """Number of turning points of each trace."""
    steps = np.diff(part, axis=1)
    signs = np.where(np.abs(steps) > _SMALL * height[:, np.newaxis], np.sign(steps), 0)
    return np.array([np.count_nonzero(np.diff(row[row != 0])) for row in signs])


def provenance(source: PulseSource) -> dict[str, str]:
    """Describe how the pulses of a file were made.

    Returns
    -------
    dict
        Text by name, such as ``made by``, ``detector``, ``hits`` and ``translated``; empty for
        files of other programs.
    """
    told = recorded_attributes(source)
    words = {"made by": told.get(MADE_BY, ""), "side": told.get(SIDE, "")}
    if TRANSLATED_BY in told:
        part = told[TRANSLATED_BY].rpartition(" ")[2].upper()
        words["translated"] = f"by the {part} of {told.get(RUN, 'an unknown run')}"
    # other programs may have attributes of these names
    with suppress(ValueError, LookupError, TypeError, AttributeError):
        words |= _of_simulation(json.loads(told[SIMULATION]))
    with suppress(ValueError, LookupError, TypeError, AttributeError):
        given = flat(json.loads(told[TRANSLATION])["options"], " ")
        words["options"] = ", ".join(f"{k} {v}" for k, v in given if v is not None)
    return {name: text for name, text in words.items() if text}


def _of_simulation(made: Any) -> dict[str, str]:
    detector, hits, cloud = made["detector"], made["hits"], made["settings"]["cloud_fwhm_mm"]
    physics = f"{detector['name']}, {detector['bias_V']:g} V, {detector['temperature_K']:g} K"
    words = {
        "detector": f"{physics}, charge clouds of {cloud:g} mm",
        "hits": hits.get("monte_carlo", ""),
    }
    if "file" in hits:
        flipped = ", z flipped" if hits["flip_z"] else ""
        words["hits"] = f"{Path(hits['file']).name}, origin {hits['origin_mm']} mm{flipped}"
    if "events" in made:  # a stand records them in its ``stand.json``
        lost, seed = made["events_without_signal"], made["seed"]
        words["events"] = f"{made['events']}, of which {lost} without a signal; seed {seed}"
    return words
