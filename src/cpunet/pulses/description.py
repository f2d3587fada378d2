"""What is in a file of pulses: counts, energies, lines, traces, and all in words."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from cpunet.errors import CpunetError
from cpunet.pulses.container import Pulses
from cpunet.pulses.peaks import label_peaks
from cpunet.pulses.provenance import provenance
from cpunet.pulses.reading import open_pulses
from cpunet.pulses.reading.energies import amplitude
from cpunet.pulses.reading.opening import table_sizes
from cpunet.pulses.reading.source import PulseSource
from cpunet.pulses.spectrum import Spectrum, Values, suggested_calibration
from cpunet.recipes.schema import PeakConfig, Recipe
from cpunet.tables import counted, percent, span

BLOCKS, BLOCK = 4, 1024  # number of blocks, traces per block: a few thousand are enough
START = 0.01  # share of the height at which a pulse begins
START_SIGMAS = 5.0  # the same in standard deviations of the noise, if that is more
MIN_BASELINE = 16  # minimum number of samples to estimate the noise
MIN_NUMBER = 10  # minimum number of traces
SHORTEST = 0.05  # share of the traces whose baseline may be shorter than reported


def trace_properties(blocks: Iterable[Pulses], recipe: Recipe) -> dict[str, Any]:
    """Describe the traces of a digitiser.

    Parameters
    ----------
    blocks
        Measured traces of one channel; the first few thousand are used.
    recipe
        Settings of preparation and quality cuts.

    Returns
    -------
    dict
        ``looked_at`` (number of traces); ``trigger_sample`` (5, 50 and 95 % quantiles of the
        sample at half of the height); ``baseline_samples`` (before nearly all pulses);
        ``noise_adc`` and, with known energies, ``noise_kev`` (median RMS of the baselines);
        ``decay_us`` (median of the tails); ``rejected`` (number of traces by reason: the
        selection of preparation and quality cuts without energies), with ``saturated`` and
        ``pile_up`` (tails that do not fit a decay) also as shares in percent.

    Raises
    ------
    CpunetError
        If too few traces contain a pulse.
    """
    # compiled loops, which a look at plain pulses does not need
    from cpunet.pulses.cuts import apply_cuts, fit_cuts
    from cpunet.pulses.preparation import Prepared, Rejection, prepare

    seen = list(islice(blocks, BLOCKS))
    found = [_edges(block) for block in seen]
    half, start, noise = (np.concatenate(part) for part in zip(*found, strict=True))
    with_pulse = np.isfinite(half)
    if with_pulse.sum() < MIN_NUMBER:
        raise CpunetError(f"only {with_pulse.sum()} of {len(half)} traces hold a pulse")
    told: dict[str, Any] = {
        "looked_at": len(half),
        "trigger_sample": [round(float(q)) for q in np.nanquantile(half, (0.05, 0.5, 0.95))],
        "baseline_samples": int(np.nanquantile(start, SHORTEST)),
        "noise_adc": float(np.nanmedian(noise)),
    }
    kev = np.concatenate([block.energy_kev for block in seen])[with_pulse]
    kev /= np.concatenate([amplitude(block.waveforms) for block in seen])[with_pulse]
    if np.isfinite(kev).sum() >= MIN_NUMBER:
        told["noise_kev"] = told["noise_adc"] * float(np.nanmedian(kev))
    prepared = Prepared.concatenate([prepare(b, recipe.preparation, "measured") for b in seen])
    if len(prepared) >= MIN_NUMBER:
        slope = float(np.median(prepared.tail_slope))
        if slope < 0:
            told["decay_us"] = -1e3 / slope
        prepared = apply_cuts(prepared, fit_cuts(prepared, recipe.cuts))
    reasons = prepared.rejections
    piled = sum(reasons.get(r.label, 0) for r in (Rejection.TAIL_SLOPE, Rejection.CHI2))
    return told | {
        "rejected": reasons,
        "saturated_percent": 100 * reasons.get(Rejection.SATURATED.label, 0) / len(half),
        "pile_up_percent": 100 * piled / len(half),
    }


def traces_in_words(told: Mapping[str, Any]) -> list[tuple[str, str]]:
    """Names and texts for the result of `trace_properties`."""
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


def _edges(block: Pulses) -> tuple[Values, Values, Values]:
    """Sample at half of the height, first sample of the pulse, RMS of the baseline before it.

    NaN where a trace has no pulse; shape ``(n,)`` each.
    """
    waveforms = np.asarray(block.waveforms, np.float32)
    few = max(MIN_BASELINE, waveforms.shape[1] // 20)
    with np.errstate(invalid="ignore", over="ignore"):
        baseline = waveforms[:, :few].mean(axis=1)
        top = waveforms.argmax(axis=1)
        height = waveforms.max(axis=1) - baseline
        rms = waveforms[:, :few].std(axis=1)
        pulse = np.isfinite(height) & (height > START_SIGMAS * rms) & (top > 0)
        half = _last_below(waveforms, top, baseline + height / 2)
        level = np.maximum(START * height, START_SIGMAS * rms)
        start = _last_below(waveforms, top, baseline + level)
    return tuple(np.where(pulse, v, np.nan).astype(float) for v in (half, start, rms))  # type: ignore[return-value]


def _last_below(
    waveforms: npt.NDArray[np.float32], top: npt.NDArray[np.intp], level: npt.NDArray[Any]
) -> npt.NDArray[np.intp]:
    """Number of samples up to the last one below a level before the maximum."""
    below = waveforms < level[:, np.newaxis]
    below &= np.arange(waveforms.shape[1]) < top[:, np.newaxis]
    samples = waveforms.shape[1] - below[:, ::-1].argmax(axis=1)
    return np.where(below.any(axis=1), samples, 0)


def describe_pulses(
    source: PulseSource, peaks: Mapping[str, PeakConfig]
) -> tuple[dict[str, Any], Spectrum]:
    """Describe the pulses of one table; also return their spectrum.

    The file is read in blocks; only energies or amplitudes of all pulses are held in memory.

    Parameters
    ----------
    source
        The opened file.
    peaks
        Gamma lines to count.

    Returns
    -------
    dict
        The result of `PulseSource.describe`, and: ``n_pulses``; ``energy_kev`` (lowest and
        highest, None if unknown) and ``n_without_energy``; ``peaks`` (number of pulses by
        line); ``amplitudes``, a suggested calibration if no energy is known, or else
        ``found``, the source whose lines are there, and at which share of their energies;
        ``samples`` (lowest and highest of the finite traces); the numbers ``n_not_finite``
        and ``n_constant`` of traces; ``provenance``, if the file records it.
    Spectrum
        Energies, or amplitudes if no energy is known.
    """
    counts = _Counts(dict.fromkeys(peaks, 0))
    for block in source.blocks():
        counts.add(block, peaks)
    spectrum = counts.spectrum()
    told = {"path": str(source.path), **source.describe(), **counts.summary(spectrum)}
    made = provenance(source)
    return told | ({"provenance": made} if made else {}), spectrum


def describe_tables(path: Path, dt_ns: float | None) -> dict[str, Any]:
    """Description of each table without reading its traces, or why it cannot be read."""
    told: dict[str, Any] = {}
    for table, number in table_sizes(path).items():
        try:
            source = open_pulses(path, table=table, dt_ns=dt_ns)
        except CpunetError as error:
            told[table] = str(error).removeprefix(f"{path}: ")
        else:
            told[table] = source.describe()
            if number is not None:
                told[table]["n_pulses"] = number
    return told


def pulses_in_words(told: Mapping[str, Any]) -> list[tuple[str, str]]:
    """Names and texts for the result of `describe_pulses`."""
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
        ("samples", f"values {span(told['samples'])}{_odd(told)}"),
    ]
    return [(name, text) for name, text in lines if text]


def _energy(told: Mapping[str, Any]) -> str:
    text = str(told["energy"])
    if told["energy_kev"]:
        text += f", {span(told['energy_kev'])} keV"
        if told["n_without_energy"]:
            text += f"; {told['n_without_energy']} pulses have none"
    return text


def _odd(told: Mapping[str, Any]) -> str:
    """Numbers of traces that are not pulses, if any."""
    counts = {"not finite": told["n_not_finite"], "constant": told["n_constant"]}
    return "".join(f"; {n} traces {what}" for what, n in counts.items() if n)


@dataclass
class _Counts:
    """Sums and extremes over blocks."""

    peaks: dict[str, int]
    n_pulses: int = 0
    n_without_energy: int = 0
    n_not_finite: int = 0
    n_constant: int = 0
    amplitudes: list[Values] = field(default_factory=list)
    energies: list[Values] = field(default_factory=list)
    energy_kev: list[float] = field(default_factory=list)
    samples: list[float] = field(default_factory=list)

    def add(self, block: Pulses, peaks: Mapping[str, PeakConfig]) -> None:
        self.n_pulses += len(block)
        known = block.energy_kev[np.isfinite(block.energy_kev)]
        self.n_without_energy += len(block) - len(known)
        if len(known):
            self.energies.append(known)
        else:
            self.amplitudes.append(amplitude(block.waveforms))
        self.energy_kev = _range([*self.energy_kev, *_extremes(known)])
        names, counts = np.unique(label_peaks(known, peaks), return_counts=True)
        for name, count in zip(names, counts, strict=True):
            if name:
                self.peaks[str(name)] += int(count)
        # A sum is NaN or infinite if any sample is; this needs no mask as large as the block.
        with np.errstate(invalid="ignore", over="ignore"):
            finite = np.isfinite(block.waveforms.sum(axis=1, dtype=np.float64))
        self.n_not_finite += int((~finite).sum())
        good = block.waveforms if finite.all() else block.waveforms[finite]
        low, high = good.min(axis=1), good.max(axis=1)
        self.n_constant += int((low == high).sum())
        self.samples = _range([*self.samples, *_extremes(low), *_extremes(high)])

    def spectrum(self) -> Spectrum:
        """Energies of the pulses, or their amplitudes if no energy is known, with lines."""
        known = bool(self.energies)
        values = np.concatenate(self.energies or self.amplitudes or [np.empty(0)])
        return Spectrum(values, in_kev=known, found=suggested_calibration(values))

    def summary(self, spectrum: Spectrum) -> dict[str, Any]:
        found = spectrum.found
        lines = {} if spectrum.in_kev else {"amplitudes": "no lines that stand out"}
        if found is not None and spectrum.in_kev:
            place = 1 / found.kev_per_adc
            lines = {"found": f"lines of {found.source}, at {place:.4f} of their energies"}
        elif found is not None:
            lines = {"amplitudes": f"like {found}"}
        return {
            "n_pulses": self.n_pulses,
            "energy_kev": self.energy_kev or None,
            "n_without_energy": self.n_without_energy,
            "peaks": self.peaks,
            **lines,
            "samples": self.samples or None,
            "n_not_finite": self.n_not_finite,
            "n_constant": self.n_constant,
        }


def _extremes(values: np.typing.NDArray[Any]) -> list[float]:
    return [float(values.min()), float(values.max())] if values.size else []


def _range(values: list[float]) -> list[float]:
    return [min(values), max(values)] if values else []
