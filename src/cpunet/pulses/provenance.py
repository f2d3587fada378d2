"""How the pulses of a file were made, as far as this program recorded it."""

from __future__ import annotations

import json
from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any

from cpunet.pulses.reading.source import PulseSource
from cpunet.pulses.side import (
    MADE_BY,
    RUN,
    SIDE,
    SIMULATION,
    TRANSLATED_BY,
    TRANSLATION,
    recorded_attributes,
)

# default values of the options of a translation; that of all others is None
_DEFAULTS = {
    "inverse": False,
    "noise": True,
    "seed": 0,
    "realisations": 1,
    "remains": "none",
    "pile_up_khz": 0.0,
}


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
    words |= _of_simulation(_parsed(told.get(SIMULATION)))
    if TRANSLATED_BY in told:
        part = told[TRANSLATED_BY].rpartition(" ")[2].upper()
        words["translated"] = f"by the {part} of {told.get(RUN, 'an unknown run')}"
        words |= _of_translation(_parsed(told.get(TRANSLATION)))
    return {name: text for name, text in words.items() if text}


def _parsed(text: str | None) -> Mapping[str, Any]:
    with suppress(ValueError, TypeError):
        found = json.loads(text or "")
        if isinstance(found, dict):
            return found
    return {}


def _of_simulation(made: Mapping[str, Any]) -> dict[str, str]:
    detector, hits, settings = (
        found if isinstance(found := made.get(name), Mapping) else {}
        for name in ("detector", "hits", "settings")
    )
    if not detector:
        return {}
    physics = [str(detector.get("name"))]
    physics += [
        f"{detector[name]:g} {unit}"
        for name, unit in (("bias_V", "V"), ("temperature_K", "K"))
        if isinstance(detector.get(name), int | float)
    ]
    if isinstance(settings.get("cloud_fwhm_mm"), int | float):
        physics.append(f"charge clouds of {settings['cloud_fwhm_mm']:g} mm")
    return {
        "detector": ", ".join(physics),
        "hits": _of_hits(hits),
        "events": _of_events(made),
    }


def _of_events(made: Mapping[str, Any]) -> str:
    """Numbers of events and the seed; a stand records them in its ``stand.json``."""
    if "events" not in made:
        return ""
    lost = made.get("events_without_signal")
    return f"{made['events']}, of which {lost} without a signal; seed {made.get('seed')}"


def _of_hits(hits: Mapping[str, Any]) -> str:
    if "file" not in hits:
        return str(hits.get("monte_carlo", ""))
    frame = f"origin {hits.get('origin_mm')} mm" + (", z flipped" if hits.get("flip_z") else "")
    return f"{Path(str(hits['file'])).name}, {frame}"


def _of_translation(record: Mapping[str, Any]) -> dict[str, str]:
    source, chosen = record.get("source"), record.get("options")
    words = {}
    if isinstance(source, Mapping) and isinstance(source.get("files"), list):
        names = [str(one.get("name")) for one in source["files"] if isinstance(one, Mapping)]
        words["from"] = ", ".join(names)
    if isinstance(chosen, Mapping):
        words["options"] = ", ".join(_given(chosen))
    return words


def _given(options: Mapping[str, Any]) -> list[str]:
    """Names and values of the options that differ from their defaults."""
    words = []
    for name, value in options.items():
        if isinstance(value, Mapping):  # settings of traces in ADC counts
            words.append(" ".join([name, *_given(value)]))
        elif value != _DEFAULTS.get(name):
            words.append(f"{name} {value}")
    return words
