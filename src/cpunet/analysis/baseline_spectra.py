"""Noise of measured and translated pulses: its size and its spectrum before the pulse.

Baselines of prepared windows are normalised to the pulse height, so that noise of one
size in keV is larger for lower energies: only pulses of one peak are to be compared.
Their slow part is gone, since the preparation takes the mean of the baseline off.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
import numpy.typing as npt
from matplotlib.figure import Figure

from cpunet.analysis.style import colours, label, styled
from cpunet.errors import CpunetError
from cpunet.pulses.container import FloatArray

Values = npt.NDArray[np.float64]

FEWEST = 10  # baselines for a spectrum with an error
BANDS_PER_OCTAVE = 2


def baseline_spectra(
    windows: Mapping[str, FloatArray], samples: int, dt_ns: float
) -> dict[str, Any]:
    """Compare the noise of each method's baselines with the data's.

    Parameters
    ----------
    windows
        Prepared pulses of one peak by method, ``"data"`` among them, shape (n, length).
    samples
        First samples of a window that hold no pulse.
    dt_ns
        Sampling period.

    Returns
    -------
    dict
        JSON-ready: ``frequency_mhz`` (middle of each band), and by method ``power`` and
        ``power_std`` (mean square in each band, in squared pulse heights), ``rms`` and
        ``rms_std``, and for methods but the data ``rms_ratio``, its ``sigma`` from 1 and
        ``worst_band_sigma``; or ``missing`` and the reason.

    Raises
    ------
    CpunetError
        If the data are not there.

    Examples
    --------
    >>> rng = np.random.default_rng(1)
    >>> sets = {m: rng.normal(0, s, (400, 64)) for m, s in (("data", 1), ("ren", 1.1))}
    >>> found = baseline_spectra(sets, samples=64, dt_ns=16)
    >>> round(found["ren"]["rms_ratio"], 1), found["ren"]["sigma"] > 5
    (1.1, True)
    """
    if "data" not in windows:
        raise CpunetError("the measured pulses are missing; their noise is the reference")
    edges = _band_edges(samples)
    frequencies = np.sqrt(edges[1:] * np.maximum(edges[:-1], 0.5)) / (samples * dt_ns * 1e-3)
    found: dict[str, Any] = {"frequency_mhz": frequencies.tolist()}
    for method, pulses in windows.items():
        power = _band_powers(pulses[:, :samples], edges)
        if len(power) < FEWEST:
            found[method] = {"missing": f"{len(power)} baselines; {FEWEST} are needed"}
            continue
        found[method] = _summary(power)
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
    return {
        "rms_ratio": own["rms"] / data["rms"] if data["rms"] else None,
        "sigma": float((own["rms"] - data["rms"]) / error) if error else None,
        "worst_band_sigma": float(bands.max()) if bands.size else None,
    }
