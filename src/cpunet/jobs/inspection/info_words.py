"""Names and texts of the results of `describe`."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from cpunet.training.run import Run

Lines = list[tuple[str, str]]
NOTHING = "–"


def in_words(told: Mapping[str, Any]) -> Lines:
    """Return names and texts for the result of `describe` of pulses, hits or a run."""
    if told["kind"] == "run":
        run: Run = told["run"]
        return run.summary()
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
        ("lines", counted(told["peaks"])),
        ("source", told.get("found", "")),
        ("amplitudes", told.get("amplitudes", "")),
        ("samples", f"values {_span(told['samples'])}{_odd(told)}"),
    ]
    lines += [("", traces)] if isinstance(traces, str) else _traces(traces)
    return [(n, t) for n, t in lines + remains_lines(told.get("remains")) if t]


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
        ("saturated", percent(told["saturated_percent"])),
        ("pile-up", f"{percent(told['pile_up_percent'])} (tails that are no single decay)"),
        ("left out", f"{counted(told['rejected']) or 'none'} of {told['looked_at']} traces"),
    ]


def remains_lines(told: Mapping[str, Any] | str | None) -> Lines:
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
        ("lines", counted(told["peaks"])),
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


def counted(counts: Mapping[str, Any]) -> str:
    return ", ".join(f"{n} {name.replace('_', ' ')}" for name, n in counts.items() if n)


def _span(values: Any, digits: int = 9) -> str:
    """Both ends to six digits, and no more than `digits` after the point."""
    return " … ".join(f"{round(v, digits):.6g}" for v in values) if values else NOTHING


def percent(value: float) -> str:
    """Two digits, and whole numbers from 99.5 on."""
    return f"{value:.2g} %" if abs(value) < 99.5 else f"{value:.0f} %"


def short(value: Any) -> str:
    return f"{value:.4g}" if isinstance(value, float) else str(value)
