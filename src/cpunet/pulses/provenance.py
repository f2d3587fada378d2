"""Side and origin of the pulses of a file: as recorded by this program, or as they look."""

from __future__ import annotations

import json
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

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
    side = recorded_side(source)
    if side is None and not insist:
        side = apparent_side(next(iter(source.blocks(_FIRST_PULSES))).waveforms)
    refuse_other_side(side, source.path, wanted, remedy)


def refuse_other_side(side: Recognised | None, path: Path, wanted: Kind, remedy: str) -> None:
    """Refuse pulses of a file that are of the other side; see `require_side`."""
    if side is not None and side.side != wanted:
        begin = " If" if remedy.endswith("?") else "; if"
        sure = "" if side.certain else f"{begin} they are {wanted}, say so with `insist`"
        raise CpunetError(
            f"{path}: given as {wanted} pulses, but these {side.why}", f"{remedy}{sure}"
        )


def recorded_side(source: PulseSource) -> Recognised | None:
    """Side recorded in a file that this program wrote; None for other files."""
    side, made_by = source.attrs.get(SIDE), source.attrs.get(MADE_BY, "")
    translated_by = source.attrs.get(TRANSLATED_BY)
    if translated_by in (REN, IREN):
        kind: Kind = "measured" if translated_by == REN else "simulated"
        why = f"were translated by {_network(translated_by)} already"
        return Recognised(kind, why, certain=True)
    if made_by.startswith(SIMULATE) or side == "simulated":
        return Recognised("simulated", f"were simulated by {made_by}", certain=True)
    if side == "measured":
        return Recognised(
            "measured", f"are traces behind electronics ({made_by})", certain=True
        )
    return None


def _network(translated_by: str) -> str:
    return translated_by.rpartition(" ")[2].upper()


def recorded_detector(source: PulseSource) -> str | None:
    """Name of the simulated detector; None if the file does not contain it."""
    with suppress(ValueError, LookupError, TypeError):
        return str(json.loads(source.attrs[SIMULATION])["detector"]["name"])
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
    traces = waveforms[:_FIRST_PULSES]
    traces = traces[np.isfinite(traces).all(axis=1)].astype(float)
    traces = traces[np.ptp(traces, axis=1) > 0] if traces.size else traces
    if not len(traces) or traces.shape[1] < _MIN_SAMPLES:
        return None
    height, few, turns = np.ptp(traces, axis=1), traces.shape[1] // 10, []
    for part in (traces[:, :few], traces[:, -few:]):  # before the pulse and after it
        steps = np.diff(part, axis=1)
        signs = np.where(np.abs(steps) > _SMALL * height[:, np.newaxis], np.sign(steps), 0)
        turns.append(np.median([np.count_nonzero(np.diff(row[row != 0])) for row in signs]))
    whole = (traces == np.round(traces)).all() and np.median(height) > _FULL_HEIGHT
    if whole and turns[0] >= _TURNS:
        why = "look measured (whole numbers with noise before the pulse)"
        return Recognised("measured", why, certain=False)
    end = (traces[:, -few:].mean(axis=1) - traces.min(axis=1)) / height
    if max(turns) < _TURNS and np.median(end) > _MIN_END:
        return Recognised("simulated", "look simulated (no noise, no decay)", certain=False)
    return None


def provenance(source: PulseSource) -> dict[str, str]:
    """Describe how the pulses of a file were made.

    Returns
    -------
    dict
        Text by name, such as ``made by``, ``detector``, ``hits`` and ``translated``; empty for
        files of other programs.
    """
    attrs = source.attrs
    words = {"made by": attrs.get(MADE_BY, ""), "side": attrs.get(SIDE, "")}
    if translated_by := attrs.get(TRANSLATED_BY):
        run = attrs.get(RUN) or "an unknown run"
        words["translated"] = f"by the {_network(translated_by)} of {run}"
    # other programs may have attributes of these names
    with suppress(ValueError, LookupError, TypeError, AttributeError):
        made = json.loads(attrs[SIMULATION])
        detector, hits, fwhm = made["detector"], made["hits"], made["settings"]["cloud_fwhm_mm"]
        physics = f"{detector['bias_V']:g} V, {detector['temperature_K']:g} K"
        simulated = {
            "detector": f"{detector['name']}, {physics}, charge clouds of {fwhm:g} mm",
            "hits": hits.get("monte_carlo", ""),
        }
        if "file" in hits:
            flipped = ", z flipped" if hits["flip_z"] else ""
            origin = f"origin {hits['origin_mm']} mm{flipped}"
            simulated["hits"] = f"{Path(hits['file']).name}, {origin}"
        if "events" in made:  # a stand records them in its ``stand.json``
            lost = f"of which {made['events_without_signal']} without a signal"
            simulated["events"] = f"{made['events']}, {lost}; seed {made['seed']}"
        words |= simulated
    with suppress(ValueError, LookupError, TypeError, AttributeError):
        given = flat(json.loads(attrs[TRANSLATION])["options"], " ")
        words["options"] = ", ".join(f"{k} {v}" for k, v in given if v is not None)
    return {name: text for name, text in words.items() if text}
