"""Names and texts of the results of `describe`."""

from __future__ import annotations

import re
from collections.abc import Mapping
from contextlib import suppress
from typing import Any

Lines = list[tuple[str, str]]
NOTHING = "–"
PARTS = 8  # maximum number of deviating parts of a fit
UNITS = {"ns": "ns", "us": "µs", "mhz": "MHz", "kev": "keV"}
_OFF = 3.0  # standard deviations


def in_words(told: Mapping[str, Any]) -> Lines:
    """Return names and texts for the result of `describe` of pulses, hits or a run."""
    if told["kind"] == "run":
        return _run(told)
    return _hits(told) if told["kind"] == "hits" else _pulses(told)


def _pulses(told: Mapping[str, Any]) -> Lines:
    traces = told.get("traces", {})
    lines = [
        ("file", str(told["path"])),
        ("format", f"{told['format']}, table {told['table']}"),
        (
            "traces",
            f"{told['n_pulses']} of {told['length']} samples, every {told['dt_ns']:g} ns",
        ),
        ("columns", ", ".join(told["columns"])),
        *((name, text) for name, text in told.get("provenance", {}).items()),
        ("energy", _energy(told)),
        ("lines", _counts(told["peaks"])),
        ("source", told.get("found", "")),
        ("amplitudes", told.get("amplitudes", "")),
        ("samples", f"values {_span(told['samples'])}{_odd(told)}"),
    ]
    lines += [("", traces)] if isinstance(traces, str) else _traces(traces)
    return [(n, t) for n, t in lines + _remains(told.get("remains")) if t]


def _energy(told: Mapping[str, Any]) -> str:
    text = str(told["energy"])
    if told["energy_kev"]:
        text += f", {_span(told['energy_kev'])} keV"
        if told["n_without_energy"]:
            text += f"; {told['n_without_energy']} pulses have none"
    return text


def _odd(told: Mapping[str, Any]) -> str:
    """Numbers of traces that are not pulses, if any."""
    counts = {"not finite": told["n_not_finite"], "constant": told["n_constant"]}
    return "".join(f"; {n} traces {what}" for what, n in counts.items() if n)


def _traces(told: Mapping[str, Any]) -> Lines:
    if not told:
        return []
    low, middle, high = told["trigger_sample"]
    noise = f"{told['noise_adc']:.3g} ADC"
    if "noise_kev" in told:
        noise += f", {told['noise_kev']:.3g} keV"
    decay = told.get("decay_us")
    return [
        ("trigger", f"half of the height at sample {middle} (90 % from {low} to {high})"),
        ("baseline", f"{told['baseline_samples']} samples before nearly all pulses"),
        ("decay", f"{decay:.3g} µs" if decay else "the tails do not decay"),
        ("noise", f"{noise} (RMS of a baseline, median)"),
        ("saturated", _percent(told["saturated_percent"])),
        ("pile-up", f"{_percent(told['pile_up_percent'])} (tails that are no single decay)"),
        ("left out", f"{_counts(told['rejected']) or 'none'} of {told['looked_at']} traces"),
    ]


def _remains(told: Mapping[str, Any] | str | None) -> Lines:
    if told is None or isinstance(told, str):
        return [("remains", told or "")]
    if not told["rate_khz"]:
        return [("remains", "of earlier pulses: none that are certain")]
    shares = ", ".join(
        f"{share['measured']:.3g} % above {size.partition('_')[0]} keV"
        for size, share in told["percent_above"].items()
    )
    rate = f"{told['rate_khz']:.3g} ± {told['rate_error_khz']:.2g} kHz"
    by = f"told by {told['told_by']}, error {told['error_kev']:.2g} keV"
    return [
        ("remains", f"of earlier pulses: {rate}, decaying with {told['decay_us']:.3g} µs"),
        ("", f"{shares} ({by})"),
    ]


def _hits(told: Mapping[str, Any]) -> Lines:
    lines = [("file", str(told["path"]))]
    for name, one in told["detectors"].items():
        if name:
            lines.append(("detector", name))
        lines += [("hits", one)] if isinstance(one, str) else _hits_of(one)
    return lines


def _hits_of(told: Mapping[str, Any]) -> Lines:
    extents = ", ".join(f"{axis} {_span(told[f'{axis}_mm'], 2)}" for axis in "xyzr")
    lines = [
        ("hits", f"{told['hits']} of {told['events']} events"),
        ("energy", f"{_span(told['energy_kev'])} keV an event"),
        ("lines", _counts(told["peaks"])),
        ("extents", f"{extents} mm"),
    ]
    crystal = told.get("crystal")
    if crystal:
        size = f"radius {crystal['radius_mm']:g} mm, z 0 to {crystal['length_mm']:g} mm"
        lines += [
            ("crystal", f"{crystal['name']}, {size}"),
            (
                "inside",
                f"{crystal['inside_percent']:.2f} % of the hits, outside "
                f"{crystal['outside_percent']:.2f} %",
            ),
            ("frame", _frame(crystal)),
        ]
    return [(n, t) for n, t in lines if t]


def _frame(crystal: Mapping[str, Any]) -> str:
    fits = crystal.get("fits")
    if fits:
        return f"{fits['inside_percent']:.2f} % would be inside with {fits['options']}"
    if crystal["outside_percent"] < 1:
        return "that of the crystal"
    return "no other fits; these hits are of another detector, or of other dimensions"


def _run(told: Mapping[str, Any]) -> Lines:
    fit = _mapping(told, "fit")
    parameters = _mapping(fit, "parameters")
    chain = any(name.startswith("pole_") for name in parameters)
    response = f"cpunet response {told['path']}; " if chain else ""
    when = str(told.get("started", ""))[:16].replace("T", " ")
    lines = [
        ("run", str(told["path"])),
        (
            "trained",
            f"recipe {told.get('recipe')} on {told.get('peak')}, seed {told.get('seed')}; "
            f"{when}, {_text(told.get('seconds'))} s on {told.get('device')}",
        ),
        ("from", str(told.get("init") or "")),
        ("simulated", _side(told, "sim")),
        ("measured", _side(told, "data")),
        ("fit", str(fit.get("verdict") or "")),
        ("off", _deviations(_mapping(fit, "pulls"))),
        *(("cause", str(cause)) for cause in _texts(fit.get("causes"))),
        ("response", _parameters(parameters)),
        ("drift", str(_mapping(fit, "drift").get("verdict") or "")),
    ]
    if "baselines" in (noise := _mapping(fit, "noise")):
        lines.append(("noise", f"{_noise(told)}of {noise['baselines']} baselines"))
    if "rate_khz" in (remains := _mapping(fit, "remains")):
        with suppress(LookupError, TypeError, ValueError):  # run.json is damaged
            lines += _remains(remains)
    versions = _mapping(told, "versions")
    lines += [
        ("versions", ", ".join(f"{name} {version}" for name, version in versions.items())),
        ("next", f"{response}cpunet validate {told['path']} …"),
    ]
    return [(n, t) for n, t in lines if t]


def _noise(told: Mapping[str, Any]) -> str:
    if "noise_kev" not in told:
        return ""
    # loads matplotlib, which the help of a command does not need
    from cpunet.analysis.nested_tables import with_std

    return f"{with_std(told['noise_kev'], told.get('noise_kev_error'))} keV (RMS), "


def _mapping(told: Mapping[str, Any], name: str) -> Mapping[str, Any]:
    found = told.get(name)
    return found if isinstance(found, Mapping) else {}


def _texts(value: Any) -> list[str]:
    return [str(one) for one in value] if isinstance(value, list) else []


def _side(told: Mapping[str, Any], side: str) -> str:
    one = _mapping(told, side)
    if not one:
        return ""
    read_as = ", ".join(f"{n} {v}" for n, v in _mapping(one, "read_as").items())
    text = f"{one.get('file')}" + (f" ({read_as})" if read_as else "")
    text += f": {one.get('used')} of {one.get('read')} pulses used"
    lost = _counts(_mapping(one, "rejections"))
    return f"{text}, left out {lost}" if lost else text


def _deviations(pulls: Mapping[str, Any]) -> str:
    """Parts of the pulses that deviate, worst first."""
    known = {name: value for name, value in pulls.items() if isinstance(value, int | float)}
    worst = sorted(known, key=lambda name: -abs(known[name]))[:PARTS]
    return ", ".join(f"{n} {known[n]:+.1f} σ" for n in worst if abs(known[n]) > _OFF)


def _parameters(values: Mapping[str, Any]) -> str:
    """Parameters of a readout chain; ``slow_100_ns`` and such are shares of the charge."""
    words = []
    for name, value in values.items():
        stem, _, unit = name.rpartition("_")
        shown = f" {UNITS[unit]}" if unit in UNITS else ""
        called = (stem if shown else name).replace("_", " ")
        share = re.fullmatch(r"(slow|decay)_\d\S*_(ns|us)|ringing_(sine|cosine)", name)
        if share and isinstance(value, int | float):
            words.append(f"{called}{shown} {_percent(100 * value)}")
        else:
            words.append(f"{called} {_text(value)}{shown}")
    return ", ".join(words)


def _counts(counts: Mapping[str, Any]) -> str:
    return ", ".join(f"{n} {name.replace('_', ' ')}" for name, n in counts.items() if n)


def _span(values: Any, digits: int = 9) -> str:
    """Both ends to six digits, and no more than `digits` after the point."""
    return " … ".join(f"{round(v, digits):.6g}" for v in values) if values else NOTHING


def _percent(value: float) -> str:
    """Two digits, and whole numbers from 99.5 on."""
    return f"{value:.2g} %" if abs(value) < 99.5 else f"{value:.0f} %"


def _text(value: Any) -> str:
    return f"{value:.4g}" if isinstance(value, float) else str(value)
