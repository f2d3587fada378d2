"""Noise of measured and translated pulses: RMS and spectrum of the baseline.

Baselines of prepared windows are normalised to the pulse height, so noise of a given RMS
in keV appears larger at lower energies: compare only pulses of one peak.  The slowest
part of the noise is absent, since the preparation subtracts the mean of the baseline.

A window is placed by the end of the rise, so a slow pulse can begin within the recipe's
baseline; a few such edges would outweigh all noise.  The compared stretch therefore ends
well before the start of nine out of ten measured pulses, and the others are left out.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from scipy.special import erfc
from scipy.stats import norm

from cpunet.plotting import COLOURS, STACKED, group, label, panels, styled
from cpunet.pulses.container import FloatArray
from cpunet.pulses.parameters import Values

MIN_BASELINES = 10  # baselines for a spectrum with an error
BANDS_PER_OCTAVE = 2
# A pulse rises slowly before it crosses 1 %, its nominal start; margin before that.
MARGIN_NS = 960.0
EARLY_SHARE = 0.1  # of the measured pulses that may begin too early and are left out
MIN_SAMPLES = 32  # of the stretch


def baseline_spectra(
    windows: Mapping[str, FloatArray],
    begins: Mapping[str, Values],
    samples: int,
    dt_ns: float,
) -> dict[str, Any]:
    """Compare the baseline noise of each method with that of the data.

    Parameters
    ----------
    windows
        Prepared pulses of one peak by method, including ``"data"``, shape (n, length).
    begins
        Sample at which each pulse begins, by method, shape (n,); NaN if unknown.
    samples
        Maximum number of samples that are compared, from the start of the window.
    dt_ns
        Sampling period in ns.

    Returns
    -------
    dict
        JSON-ready: ``frequency_mhz`` (centre of each band), and by method the number ``n`` of
        pulses, the ``samples`` compared of each, ``power`` and ``power_std`` (mean square in
        each band, in squared pulse heights), ``rms`` and ``rms_std``.  For methods other than
        the data also ``rms_ratio``, its ``sigma`` from 1, ``worst_band_sigma``, and
        ``spectrum_sigma``, which corrects the latter for the number of bands; or ``missing``
        with the reason.

    Examples
    --------
    >>> rng = np.random.default_rng(1)
    >>> sets = {m: rng.normal(0, s, (400, 64)) for m, s in (("data", 1), ("ren", 1.1))}
    >>> begins = dict.fromkeys(sets, np.full(400, 200.0))
    >>> spectra = baseline_spectra(sets, begins, samples=64, dt_ns=16)
    >>> round(spectra["ren"]["rms_ratio"], 1), spectra["ren"]["sigma"] > 5
    (1.1, True)
    """
    free = {method: begins[method] - MARGIN_NS / dt_ns for method in windows}
    times = free["data"][np.isfinite(free["data"])]
    samples = min(samples, int(np.quantile(times, EARLY_SHARE)) if times.size else 0)
    if samples < MIN_SAMPLES:
        few = f"{max(samples, 0)} samples before measured pulses begin"
        early = f"{few}; {MIN_SAMPLES} are needed"
        return {"frequency_mhz": []} | {method: {"missing": early} for method in windows}
    # bands of half an octave, from the lowest frequency to the highest
    steps = 2 ** np.arange(0, np.log2(samples // 2 + 1), 1 / BANDS_PER_OCTAVE)
    edges = np.unique(np.append(np.ceil(steps), samples // 2 + 1)).astype(float)
    frequencies = np.sqrt(edges[1:] * np.maximum(edges[:-1], 0.5)) / (samples * dt_ns * 1e-3)
    by_method: dict[str, Any] = {"frequency_mhz": frequencies.tolist()}
    for method, pulses in windows.items():
        power = _band_powers(pulses[free[method] >= samples, :samples], edges)
        if len(power) < MIN_BASELINES:
            by_method[method] = {
                "missing": f"{len(power)} baselines; {MIN_BASELINES} are needed"
            }
            continue
        n, mean, total = len(power), power.mean(axis=0), power.sum(axis=1)
        rms = float(np.sqrt(total.mean()))
        by_method[method] = {
            "samples": samples,
            "n": n,
            "power": mean.tolist(),
            "power_std": (power.std(axis=0, ddof=1) / np.sqrt(n)).tolist(),
            "rms": rms,
            "rms_std": float(total.std(ddof=1) / np.sqrt(n) / (2 * rms)) if rms else 0.0,
        }
    data = by_method["data"]
    for method in windows:
        if method != "data" and "missing" not in data | by_method[method]:
            # deviation of the noise from that of the data; None where it is undefined
            own = by_method[method]
            error = np.hypot(own["rms_std"], data["rms_std"])
            difference = np.subtract(own["power"], data["power"])
            errors = np.hypot(own["power_std"], data["power_std"])
            bands = np.abs(difference[errors > 0] / errors[errors > 0])
            by_method[method] |= {
                "rms_ratio": own["rms"] / data["rms"] if data["rms"] else None,
                "sigma": float((own["rms"] - data["rms"]) / error) if error else None,
                "worst_band_sigma": float(bands.max()) if bands.size else None,
                "spectrum_sigma": _of_so_many(float(bands.max(initial=0)), bands.size),
            }
    return by_method


@styled
def spectrum_of_noise(by_method: Mapping[str, Any], peak: str) -> Figure:
    """Draw the noise power by band and method, and its ratio to that of the data.

    Parameters
    ----------
    found
        Result of `baseline_spectra`.
    peak
        Name of the gamma line, for the title.
    """
    methods = [m for m, s in by_method.items() if m != "frequency_mhz" and "missing" not in s]
    frequency = np.asarray(by_method["frequency_mhz"])
    figure, ((above,), (below,)) = panels((5.6, 4.4), 2, **STACKED)
    data = np.asarray(by_method["data"]["power"])
    for method in methods:
        power, error = (np.asarray(by_method[method][key]) for key in ("power", "power_std"))
        look = {"color": COLOURS[method], "marker": "o", "markersize": 3}
        group(above.errorbar(frequency, power, error, label=label(method), **look), method)
        if method != "data":
            # bands without noise in the data have no ratio
            ratio, spread = (
                np.divide(values, data, where=data > 0, out=np.full_like(data, np.nan))
                for values in (power, error)
            )
            group(below.errorbar(frequency, ratio, spread, **look), method)
    below.axhline(1, color="black", linewidth=0.8)
    silent = not any(np.any(by_method[method]["power"]) for method in methods)
    above.set(
        title=f"{peak}: noise before the pulse",
        ylabel="Mean square per band\n[pulse height²]",
        xscale="log",
        yscale="linear" if silent else "log",
    )
    above.legend()
    for axis in (above.yaxis, below.xaxis):
        axis.set_major_formatter("{x:g}")  # powers as formulas take long to set
        axis.set_minor_formatter("")
    below.set(xlabel="Frequency [MHz]", ylabel="Method / data")
    return figure


def _band_powers(baselines: FloatArray, edges: Values) -> Values:
    """Mean square of each baseline in each band, shape (baselines, bands)."""
    whole = baselines[np.isfinite(baselines).all(axis=1)].astype(float)
    samples = baselines.shape[1]
    window = np.hanning(samples + 1)[:-1]
    centred = (whole - whole.mean(axis=1, keepdims=True)) * window
    power = np.abs(np.fft.rfft(centred, axis=1)) ** 2 * 2 / (samples * (window @ window))
    if samples % 2 == 0:
        power[:, -1] /= 2  # the highest frequency occurs only once
    starts = edges[:-1].astype(int)
    return np.asarray(np.add.reduceat(power, starts, axis=1))


def _of_so_many(worst: float, n: int) -> float | None:
    """One-sided deviation as unlikely as the largest of `n` two-sided ones (Šidák).

    None if the spectra are equal, which no one-sided deviation expresses.
    """
    of_one = erfc(worst / np.sqrt(2))
    if of_one == 1:
        return None
    chance = -np.expm1(n * np.log1p(-of_one))
    # beyond 37 standard deviations the probability underflows, and it does not matter
    return float(norm.isf(chance)) if chance > 0 else worst
