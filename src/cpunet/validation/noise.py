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

import numpy as np
from pydantic import Field
from scipy.special import erfc, ndtri

from cpunet.pulses.container import FloatArray
from cpunet.pulses.parameters import Values
from cpunet.validation.comparisons import Number, Result

MIN_BASELINES = 10  # baselines for a spectrum with an error
BANDS_PER_OCTAVE = 2
# A pulse rises slowly before it crosses 1 %, its nominal start; margin before that.
MARGIN_NS = 960.0
EARLY_SHARE = 0.1  # of the measured pulses that may begin too early and are left out
MIN_SAMPLES = 32  # of the stretch


class Spectrum(Result):
    """Noise of one method, and how it differs from that of the data.

    Attributes
    ----------
    n, samples
        Numbers of pulses, and of the samples that are compared of each.
    frequency_mhz, power, power_std
        Centre of each band, and the mean square in it, in squared pulse heights.
    rms, rms_std
        RMS and its error in pulse heights.
    rms_ratio, sigma
        RMS over that of the data, and its difference from that in standard deviations.
    worst_band_sigma, spectrum_sigma
        Largest difference of a band, and the same corrected for the number of bands.
    missing
        Reason why there is none.
    """

    n: int | None = None
    samples: int | None = None
    frequency_mhz: list[float] = Field(default_factory=list)
    power: list[float] = Field(default_factory=list)
    power_std: list[float] = Field(default_factory=list)
    rms: Number = None
    rms_std: Number = None
    rms_ratio: Number = None
    sigma: Number = None
    worst_band_sigma: Number = None
    spectrum_sigma: Number = None
    missing: str | None = None


def baseline_spectra(
    windows: Mapping[str, FloatArray], begins: Mapping[str, Values], samples: int, dt_ns: float
) -> dict[str, Spectrum]:
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

    Examples
    --------
    >>> rng = np.random.default_rng(1)
    >>> sets = {m: rng.normal(0, s, (400, 64)) for m, s in (("data", 1), ("ren", 1.1))}
    >>> begins = dict.fromkeys(sets, np.full(400, 200.0))
    >>> spectra = baseline_spectra(sets, begins, samples=64, dt_ns=16)
    >>> round(spectra["ren"].rms_ratio, 1), spectra["ren"].sigma > 5
    (1.1, True)
    """
    free = {method: begins[method] - MARGIN_NS / dt_ns for method in windows}
    times = free["data"][np.isfinite(free["data"])]
    samples = min(samples, int(np.quantile(times, EARLY_SHARE)) if times.size else 0)
    if samples < MIN_SAMPLES:
        few = f"{max(samples, 0)} samples before measured pulses begin"
        early = f"{few}; {MIN_SAMPLES} are needed"
        return {method: Spectrum(missing=early) for method in windows}
    # bands of half an octave, from the lowest frequency to the highest
    steps = 2 ** np.arange(0, np.log2(samples // 2 + 1), 1 / BANDS_PER_OCTAVE)
    edges = np.unique(np.append(np.ceil(steps), samples // 2 + 1)).astype(float)
    frequencies = np.sqrt(edges[1:] * np.maximum(edges[:-1], 0.5)) / (samples * dt_ns * 1e-3)
    taper = np.hanning(samples + 1)[:-1]
    spectra: dict[str, Spectrum] = {}
    for method, pulses in windows.items():
        baselines = pulses[free[method] >= samples, :samples]
        baselines = baselines[np.isfinite(baselines).all(axis=1)].astype(float)
        if (n := len(baselines)) < MIN_BASELINES:
            spectra[method] = Spectrum(missing=f"{n} baselines; {MIN_BASELINES} are needed")
            continue
        centred = (baselines - baselines.mean(axis=1, keepdims=True)) * taper
        power = np.abs(np.fft.rfft(centred, axis=1)) ** 2 * 2 / (samples * (taper @ taper))
        if samples % 2 == 0:
            power[:, -1] /= 2  # the highest frequency occurs only once
        power = np.add.reduceat(power, edges[:-1].astype(int), axis=1)
        total = power.sum(axis=1)
        rms = float(np.sqrt(total.mean()))
        spectra[method] = Spectrum(
            samples=samples,
            n=n,
            frequency_mhz=frequencies.tolist(),
            power=power.mean(axis=0).tolist(),
            power_std=(power.std(axis=0, ddof=1) / np.sqrt(n)).tolist(),
            rms=rms,
            rms_std=float(total.std(ddof=1) / np.sqrt(n) / (2 * rms)) if rms else 0.0,
        )
    data = spectra["data"]
    for method, own in spectra.items():
        if method == "data" or own.missing or data.missing:
            continue
        difference = np.subtract(own.power, data.power)
        errors = np.hypot(own.power_std, data.power_std)
        bands = np.abs(difference[errors > 0] / errors[errors > 0])
        error = np.hypot(own.rms_std or 0.0, data.rms_std or 0.0)
        own.rms_ratio = (own.rms or 0.0) / data.rms if data.rms else None
        own.sigma = ((own.rms or 0.0) - (data.rms or 0.0)) / error if error else None
        own.worst_band_sigma = bands.max() if bands.size else None
        # a one-sided deviation as unlikely as the largest of so many two-sided ones (Šidák),
        # which equal spectra do not have
        own.spectrum_sigma, worst = None, float(bands.max(initial=0))
        if (of_one := erfc(worst / np.sqrt(2))) < 1:
            chance = -np.expm1(bands.size * np.log1p(-of_one))
            # beyond 37 standard deviations the probability underflows, and it does not matter
            own.spectrum_sigma = float(-ndtri(chance)) if chance > 0 else worst
    return spectra
