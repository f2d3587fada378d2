"""Noise of measured and translated pulses: its size and its spectrum before the pulse.

Baselines of prepared windows are normalised to the pulse height, so that noise of one
size in keV is larger for lower energies: only pulses of one peak are to be compared.
Their slow part is gone, since the preparation takes the mean of the baseline off.

A window is placed by where its pulse ends, so that a slow pulse may begin within what a recipe
calls the baseline; a few such edges would outweigh all noise.  The stretch compared therefore
ends well before nine of ten measured pulses begin, and the others are left out.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
import numpy.typing as npt
from matplotlib.figure import Figure
from scipy.special import erfc
from scipy.stats import norm

from cpunet.analysis.style import colours, label, styled
from cpunet.errors import CpunetError
from cpunet.pulses.container import FloatArray

Values = npt.NDArray[np.float64]

FEWEST = 10  # baselines for a spectrum with an error
BANDS_PER_OCTAVE = 2
# A pulse has crept up before it is seen to begin, at 1 %; so many samples are left free.
MARGIN = 60
EARLY_SHARE = 0.1  # of the measured pulses may begin too early and be left out
LEAST_SAMPLES = 32  # of the stretch


def baseline_spectra(
    windows: Mapping[str, FloatArray],
    begins: Mapping[str, Values],
    samples: int,
    dt_ns: float,
) -> dict[str, Any]:
    """Compare the noise of each method's baselines with the data's.

    Parameters
    ----------
    windows
        Prepared pulses of one peak by method, ``"data"`` among them, shape (n, length).
    begins
        By method, the sample at which each pulse begins, shape (n,); NaN if not known.
    samples
        The most, from the first of a window, that are compared.
    dt_ns
        Sampling period.

    Returns
    -------
    dict
        JSON-ready: ``frequency_mhz`` (middle of each band), and by method the ``samples``
        compared of each of ``n`` pulses, ``power`` and ``power_std`` (mean square in each
        band, in squared pulse heights), ``rms`` and ``rms_std``, and for methods but the data
        ``rms_ratio``, its ``sigma`` from 1, ``worst_band_sigma``, and
        ``spectrum_sigma``: as unlikely as that worst of so many bands; or ``missing`` and
        the reason.

    Raises
    ------
    CpunetError
        If the data are not there, or pulses and beginnings not equally many.

    Examples
    --------
    >>> rng = np.random.default_rng(1)
    >>> sets = {m: rng.normal(0, s, (400, 64)) for m, s in (("data", 1), ("ren", 1.1))}
    >>> begins = dict.fromkeys(sets, np.full(400, 200.0))
    >>> found = baseline_spectra(sets, begins, samples=64, dt_ns=16)
    >>> round(found["ren"]["rms_ratio"], 1), found["ren"]["sigma"] > 5
    (1.1, True)
    """
    if "data" not in windows:
        raise CpunetError("the measured pulses are missing; their noise is the reference")
    free = {method: _free(pulses, begins, method) for method, pulses in windows.items()}
    samples = min(samples, _stretch(free["data"]))
    if samples < LEAST_SAMPLES:
        few = f"{max(samples, 0)} samples before measured pulses begin"
        early = f"{few}; {LEAST_SAMPLES} are needed"
        return {"frequency_mhz": []} | {method: {"missing": early} for method in windows}
    edges = _band_edges(samples)
    frequencies = np.sqrt(edges[1:] * np.maximum(edges[:-1], 0.5)) / (samples * dt_ns * 1e-3)
    found: dict[str, Any] = {"frequency_mhz": frequencies.tolist()}
    for method, pulses in windows.items():
        power = _band_powers(pulses[free[method] >= samples, :samples], edges)
        if len(power) < FEWEST:
            found[method] = {"missing": f"{len(power)} baselines; {FEWEST} are needed"}
            continue
        found[method] = {"samples": samples} | _summary(power)
    data = found["data"]
    for method in windows:
        if method != "data" and "missing" not in data | found[method]:
            found[method] |= _against(found[method], data)
    return found


@styled
def spectrum_of_noise(found: Mapping[str, Any], peak: str) -> Figure:
    """Draw the noise's power by band and method, and its ratio to the data's.

    Parameters
    ----------
    found
        The result of `baseline_spectra`.
    peak
        For the title.
    """
    methods = [m for m, s in found.items() if m != "frequency_mhz" and "missing" not in s]
    palette = colours(methods)
    frequency = np.asarray(found["frequency_mhz"])
    figure = Figure(figsize=(5.6, 4.4))
    above, below = figure.subplots(2, 1, sharex=True, height_ratios=(3, 2))
    data = np.asarray(found["data"]["power"])
    for method in methods:
        power, error = (np.asarray(found[method][key]) for key in ("power", "power_std"))
        look = {"color": palette[method], "label": label(method)}
        above.errorbar(frequency, power, error, marker="o", markersize=3, **look)
        if method != "data":
            below.errorbar(
                frequency,
                power / data,
                error / data,
                marker="o",
                markersize=3,
                color=palette[method],
            )
    below.axhline(1, color="black", linewidth=0.8)
    above.set(
        title=f"{peak}: noise before the pulse",
        ylabel="Mean square per band\n[pulse height²]",
        xscale="log",
        yscale="log",
    )
    above.legend()
    below.set(xlabel="Frequency [MHz]", ylabel="Method / data")
    return figure


def _free(windows: FloatArray, begins: Mapping[str, Values], method: str) -> Values:
    """Samples of each window that its pulse does not reach; NaN if not known."""
    known = begins.get(method, np.empty(0))
    if known.shape != (len(windows),):
        raise CpunetError(
            f"{method}: {len(windows)} pulses beside {known.size} beginnings; give one for each"
        )
    return known - MARGIN


def _stretch(free: Values) -> int:
    """Samples that are free in all measured pulses but the earliest."""
    known = free[np.isfinite(free)]
    return int(np.quantile(known, EARLY_SHARE)) if known.size else 0


def _band_edges(samples: int) -> Values:
    """Edges, in bins of a spectrum, of bands of half an octave; without the mean."""
    octaves = np.log2(samples // 2 + 1)
    steps = 2 ** np.arange(0, octaves, 1 / BANDS_PER_OCTAVE)
    edges = np.unique(np.append(np.ceil(steps), samples // 2 + 1))
    return edges.astype(float)


def _band_powers(baselines: FloatArray, edges: Values) -> Values:
    """Mean square of each baseline in each band, shape (baselines, bands)."""
    known = baselines[np.isfinite(baselines).all(axis=1)].astype(float)
    samples = baselines.shape[1]
    window = np.hanning(samples + 1)[:-1]
    centred = (known - known.mean(axis=1, keepdims=True)) * window
    power = np.abs(np.fft.rfft(centred, axis=1)) ** 2 * 2 / (samples * (window @ window))
    if samples % 2 == 0:
        power[:, -1] /= 2  # the highest frequency is there once
    starts = edges[:-1].astype(int)
    return (
        np.asarray(np.add.reduceat(power, starts, axis=1)) if len(known) else power[:, starts]
    )


def _summary(power: Values) -> dict[str, Any]:
    n, mean = len(power), power.mean(axis=0)
    total = power.sum(axis=1)
    rms = float(np.sqrt(total.mean()))
    return {
        "n": n,
        "power": mean.tolist(),
        "power_std": (power.std(axis=0, ddof=1) / np.sqrt(n)).tolist(),
        "rms": rms,
        "rms_std": float(total.std(ddof=1) / np.sqrt(n) / (2 * rms)) if rms else 0.0,
    }


def _against(own: Mapping[str, Any], data: Mapping[str, Any]) -> dict[str, float | None]:
    """How far the noise is from the data's; None where neither has an error."""
    error = np.hypot(own["rms_std"], data["rms_std"])
    difference, errors = (
        np.asarray(own["power"]) - np.asarray(data["power"]),
        np.hypot(own["power_std"], data["power_std"]),
    )
    bands = np.abs(difference[errors > 0] / errors[errors > 0])
    worst = float(bands.max()) if bands.size else None
    return {
        "rms_ratio": own["rms"] / data["rms"] if data["rms"] else None,
        "sigma": float((own["rms"] - data["rms"]) / error) if error else None,
        "worst_band_sigma": worst,
        "spectrum_sigma": None if worst is None else _of_so_many(worst, bands.size),
    }


def _of_so_many(worst: float, n: int) -> float:
    """One-sided deviation as unlikely as the largest of `n` two-sided ones (Šidák)."""
    chance = -np.expm1(n * np.log1p(-erfc(worst / np.sqrt(2))))
    # beyond 37 standard deviations there is no such number, nor does it matter
    return float(norm.isf(chance)) if chance > 0 else worst
