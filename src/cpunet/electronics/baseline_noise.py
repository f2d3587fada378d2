"""Noise with the spectrum of measured baselines, of any length.

Noise in ADC counts is the same for all pulses of a channel. After normalisation it scales as
1/energy, so it is stored in prepared units times keV. The spectrum is estimated from the raw
samples before the pulse. The short baseline of the prepared window would lose the low
frequencies, which determine the scatter of drift time and tail slope.
"""

from __future__ import annotations

import warnings
from dataclasses import dataclass, replace
from typing import Self

import numpy as np
import numpy.typing as npt
import scipy.fft
import scipy.ndimage
import scipy.optimize

from cpunet.electronics.chain import FloatArray as Values
from cpunet.electronics.drawn_pile_up import DrawnTails
from cpunet.errors import CpunetError
from cpunet.pulses.baselines import SHORTEST_SHARE, Baselines
from cpunet.pulses.container import FloatArray, blocks, line_slope

MIN_BASELINES = 30
MIN_NS = 1600.0  # of a baseline; what is slower follows from the drift over it
TRACES = 64  # drawn at a time, to bound memory
# Robust standard deviations within which traces stay, and number of iterations.
FLAT_SIGMAS, CLIPS = 4.0, 3
# Baselines are clustered along directions in which their band powers spread this many times
# more than those of baselines from a single spectrum.
KINDS, BANDS, DIFFERENT, OUTLIER = 48, 16, 1.3, 8.0
FIRST_OF_BANDS = 4  # bins below it hold residuals of the mean, and drifts
# Below the third bin of a baseline, its mean and the window's leakage hide the spectrum.
# There it is inferred from the structure function over the baseline's length.
FIRST_CLEAN_BIN, RECORD_NS = 3, 131_072.0
# A line exceeds the median of the ten bins on either side by this factor. The window spreads
# it over two bins on either side.
LINE_HEIGHT, LINE_AROUND, LINE_HALF_WIDTH = 3.0, 10, 2
CORNERS, LAGS = 8, 40  # Lorentzians of the slow part; lags at which the drift is compared


def record_samples(dt_ns: float) -> int:
    """Even number of samples of the records whose frequencies spectra have."""
    return 2 * round(0.5 * RECORD_NS / dt_ns)


@dataclass(frozen=True, eq=False)
class BaselineNoise:
    r"""Spectrum of baseline noise.

    The real FFT bins :math:`X_k` of :math:`N` samples have the density

    .. math:: S_k = \langle |X_k|^2 \rangle / N, \qquad
        \mathrm{RMS}^2 = \frac{1}{N} \Big(S_0 + 2 \sum_{0<k<N/2} S_k + S_{N/2}\Big).

    Parameters
    ----------
    density
        Density :math:`S_k` at the frequencies of a real FFT of `samples`, in (prepared units
        x keV)^2.
    samples, dt_ns
        Length :math:`N` of that FFT, and the sampling period in ns.
    n_baselines
        Number of flat baselines in the estimate.
    kinds, lines, shares
        Continuum and narrow lines of several kinds of baselines, shape ``(kinds, bins)``, and
        the fraction of each kind, shape ``(kinds,)``. `density` is their mean. None for
        Gaussian noise with a single spectrum. Traces of several channels or days have noise
        of different RMS and spectrum, which a mean would hide. A line is a sine of fixed
        amplitude, not Gaussian noise.
    rms_error
        Standard error of `rms`. It includes the spread of the baselines and all noise that is
        extrapolated to periods longer than a baseline. None if not estimated from baselines.
    tails
        Pile-up tails that are drawn together with the noise, or None for noise alone.

    Examples
    --------
    White noise with a variance of 4 in each sample.

    >>> white = BaselineNoise(np.full(513, 4.0), 1024, 16.0, 100)
    >>> white.rms
    2.0
    >>> drawn = white.draw(np.full(50, 2.0), 1024, np.random.default_rng(1))
    >>> bool(abs(drawn.std() - white.rms / 2.0) < 0.02)  # scales as 1/energy
    True
    """

    density: Values
    samples: int
    dt_ns: float
    n_baselines: int
    kinds: Values | None = None
    lines: Values | None = None
    shares: Values | None = None
    rms_error: float | None = None
    tails: DrawnTails | None = None

    @classmethod
    def of(cls, baselines: Baselines, chosen: npt.NDArray[np.bool_] | None = None) -> Self:
        """Estimate the spectrum from the samples before the pulses of raw traces.

        Parameters
        ----------
        baselines
            Baselines of measured traces of one channel, from any mixture of peaks.
        chosen
            Mask of the traces to use; those without a known energy are left out.

        Raises
        ------
        CpunetError
            If too few traces have a known energy and a flat baseline, or the
            baselines are shorter than `MIN_NS`.
        """
        if chosen is None:
            chosen = np.ones(len(baselines), bool)
        # samples before the pulse in prepared units times keV, the same number for each trace
        energy_kev = baselines.first.energy_kev
        usable = chosen & np.isfinite(energy_kev) & (energy_kev > 0)
        rows = np.flatnonzero(usable[baselines.prepared.index])
        if len(rows) < MIN_BASELINES:
            raise CpunetError(
                f"only {len(rows)} of {len(baselines)} traces have a known energy and can be "
                f"prepared; give {MIN_BASELINES} or more to take the noise from"
            )
        before = baselines.before[rows]
        length = min(int(np.quantile(before, SHORTEST_SHARE)), baselines.first.length)
        if (known_ns := max(length, 0) * baselines.first.dt_ns) < MIN_NS:
            raise CpunetError(
                f"the traces have {known_ns:.0f} ns before the pulse; the noise needs "
                f"{MIN_NS:.0f} or more, so give traces with a longer baseline"
            )
        used = baselines.prepared[rows[before >= length]]
        values = baselines.first.waveforms[used.index, :length].astype(float)
        kev, dt_ns = used.pulses.energy_kev / used.scale, baselines.first.dt_ns
        values = (values - used.baseline[:, np.newaxis]) * kev[:, np.newaxis]
        if not np.median(np.ptp(values, axis=1)):
            raise CpunetError(
                "most baselines are constant: there is no noise to learn; give measured traces"
            )
        # those that neither slope nor contain another pulse, nor are constant
        slope = values @ line_slope(length)
        line = slope[:, np.newaxis] * (np.arange(length) - 0.5 * (length - 1))
        width, fine = (values - line).std(axis=1), np.ptp(values, axis=1) > 0
        for _ in range(CLIPS):
            for off in (np.abs(slope - np.median(slope[fine])), width - np.median(width[fine])):
                sigma = 1.4826 * np.median(np.abs(off[fine]))
                fine &= off <= FLAT_SIGMAS * sigma  # quiet baselines are as flat as others
        flat = values[fine]
        if len(flat) < MIN_BASELINES:
            raise CpunetError(
                f"only {len(flat)} flat baselines among {chosen.sum()} traces; give more "
                f"traces (at least {MIN_BASELINES} with known energy)"
            )
        samples = record_samples(dt_ns)
        mean = cls(np.add(*spectrum(flat, samples)), samples, dt_ns, len(flat))
        which = _kinds(flat, mean)
        spectra = [spectrum(flat[which == kind], samples) for kind in range(which.max() + 1)]
        kinds, lines = np.swapaxes(spectra, 0, 1)
        shares = np.bincount(which) / len(flat)
        # standard error of an RMS that is partly extrapolated beyond the baselines
        power = flat.var(axis=1)
        seen = float(np.sqrt(power.mean()))
        chance = float(power.std(ddof=1)) / (2 * seen * len(flat) ** 0.5)
        error = float(np.hypot(chance, mean.rms - seen))
        return replace(mean, kinds=kinds, lines=lines, shares=shares, rms_error=error)

    @property
    def rms(self) -> float:
        """Root mean square in prepared units times keV."""
        # all bins but the first and the last represent both signs of frequency
        both = 2 * self.density.sum() - self.density[0] - self.density[-1]
        return float(np.sqrt(both / self.samples))

    def draw(self, energy_kev: Values, length: int, rng: np.random.Generator) -> FloatArray:
        """Draw Gaussian noise, and pile-up tails if any, for pulses of given energies.

        Each long trace of one kind is cut into parts for several pulses, assigned in random
        order and with random signs. Noise slower than a record is nearly the same in these
        parts except for the sign, so it does not shift all their means together.

        Parameters
        ----------
        energy_kev
            Energy of each pulse in keV, shape ``(n,)``.
        length
            Number of samples per pulse.
        rng
            Random generator.

        Returns
        -------
        numpy.ndarray
            Noise in prepared units, float32, shape ``(n, length)``.

        Raises
        ------
        CpunetError
            If an energy is not a positive number.
        """
        require_energies(energy_kev)
        n = len(energy_kev)
        # Twice as long as needed, so that its end is independent of its beginning.
        long = max(scipy.fft.next_fast_len(2 * length, real=True), self.samples)
        each = max(1, (long - length) // length)  # parts of a trace, with a gap at its end
        continua, lines, shares = self.at(long)
        # variances of the real and imaginary parts of FFT bins
        variances = 0.5 * long * np.stack([continua, lines])
        # these bins are real: all their power is in the real part
        variances[..., 0] *= 2
        if long % 2 == 0:
            variances[..., -1] *= 2
        size, lines = np.sqrt(variances).astype(np.float32)
        noise = np.empty((n, length), np.float32)
        order = rng.permutation(n)
        # each kind as often as among the baselines, in random order
        places = rng.permutation((np.arange(-(-n // each)) + rng.random()) * each / n)
        kinds = np.searchsorted(shares.cumsum()[:-1], places)
        for first in range(0, n, each * TRACES):
            rows = order[first : first + each * TRACES]
            kind = kinds[first // each :][: min(TRACES, -(-len(rows) // each))]
            shape = (len(kind), 2 * size.shape[1])
            bins = rng.standard_normal(shape, np.float32).view(np.complex64)
            bins *= size[kind]
            # lines are sines of random phase: of fixed amplitude, the RMS modulus of a
            # Gaussian bin
            trace, column = np.nonzero(lines[kind])
            phase = rng.uniform(0, 2 * np.pi, len(trace))
            heights = np.sqrt(2) * lines[kind][trace, column]
            bins[trace, column] += heights * np.exp(1j * phase)
            traces = scipy.fft.irfft(bins, long, axis=1, overwrite_x=True)
            noise[rows] = traces[:, : each * length].reshape(-1, length)[: len(rows)]
        noise *= (rng.choice((-1.0, 1.0), n) / energy_kev)[:, np.newaxis]
        if self.tails is not None:
            factors = self.tails.factors(energy_kev, rng)
            noise += factors[:, np.newaxis] * self.tails.decay(length).astype(np.float32)
        return noise

    def density_of(self, length: int) -> Values:
        """Density at the frequencies of a real FFT of `length` samples, shape ``(bins,)``."""
        return np.asarray(replace(self, kinds=None).at(length)[0][0], float)

    def at(self, length: int) -> tuple[Values, Values, Values]:
        """Continua and lines of all kinds, shape ``(kinds, bins)``, and share of each kind.

        The bins are those of a real FFT of `length` samples. A line stays in a single bin.
        """
        mean = self.density[np.newaxis]
        continua, lines, shares = mean, np.zeros_like(mean), np.ones(1)
        if self.kinds is not None and self.lines is not None and self.shares is not None:
            continua, lines, shares = self.kinds, self.lines, self.shares
        at, bins = np.arange(length // 2 + 1) / length, np.arange(len(self.density))
        continua = np.array([np.interp(at, bins / self.samples, kind) for kind in continua])
        (kind, place), longer = np.nonzero(lines), length / self.samples
        moved, nearest = np.zeros_like(continua), np.rint(place * longer).astype(int)
        np.add.at(moved, (kind, nearest), lines[kind, place] * longer)
        return continua, moved, shares


def require_energies(energy_kev: Values, events: npt.NDArray[np.integer] | None = None) -> None:
    """Raise a `CpunetError` unless all energies are positive numbers."""
    usable = np.isfinite(energy_kev) & (energy_kev > 0)
    if not usable.all():
        row = int(np.argmin(usable))
        name = f"pulse {row}" if events is None else f"event {events[row]}"
        raise CpunetError(
            f"{name} has an energy of {energy_kev[row]} keV; give each pulse one above 0"
        )


def _kinds(flat: Values, mean: BaselineNoise) -> npt.NDArray[np.intp]:
    """Cluster baselines into kinds; all are of kind 0 if they differ only statistically.

    The features are the logarithms of the power in bands of equal width, along directions in
    which their spread exceeds that of baselines drawn from the mean spectrum.
    """
    import scipy.cluster.vq  # loads half of SciPy: only for those who need kinds

    alike, kinds = np.zeros(len(flat), np.intp), min(KINDS, len(flat) // MIN_BASELINES)
    if kinds < 2 or flat.shape[1] // 2 + 1 < FIRST_OF_BANDS + BANDS:
        return alike
    rng = np.random.default_rng(0)
    powers, window = list[Values](), np.hanning(flat.shape[1])
    for baselines in (flat, mean.draw(np.ones(len(flat)), flat.shape[1], rng).astype(float)):
        centred = (baselines - baselines.mean(axis=1, keepdims=True)) * window
        power = np.abs(scipy.fft.rfft(centred, axis=1)) ** 2
        bands = np.array_split(power[:, FIRST_OF_BANDS:], BANDS, axis=1)
        powers.append(np.log(np.stack([band.mean(axis=1) for band in bands], axis=1)))
    own, chance = powers
    scale = chance.std(axis=0)
    own, chance = (own - own.mean(axis=0)) / scale, (chance - chance.mean(axis=0)) / scale
    _, _, axes = np.linalg.svd(np.clip(own, -OUTLIER, OUTLIER), full_matrices=False)
    axes = axes[(own @ axes.T).std(axis=0) > DIFFERENT * (chance @ axes.T).std(axis=0)]
    if not len(axes):
        return alike
    points = np.clip(own @ axes.T, -OUTLIER, OUTLIER)
    # kmeans2 warns of an empty kind, which is harmless: it is left out below
    with warnings.catch_warnings(action="ignore"):
        centres, which = scipy.cluster.vq.kmeans2(points, kinds, minit="++", rng=rng, iter=50)
    # baselines of kinds with too few are assigned to the nearest kind with enough: the largest
    # at least has as many
    enough = np.bincount(which, minlength=kinds) >= MIN_BASELINES
    return np.asarray(scipy.cluster.vq.vq(points, centres[enough])[0], np.intp)


def spectrum(baselines: Values, samples: int) -> tuple[Values, Values]:
    r"""Power spectrum of a set of baselines: mean square per sample and frequency bin.

    The Hann-windowed periodogram of the baselines :math:`x_j`,

    .. math:: S(\nu) = \frac{\langle |\sum_j w_j (x_j - \bar x)
        e^{-2\pi i \nu j}|^2 \rangle}{\sum_j w_j^2},

    without its lines, continued to low frequencies by a constant and Lorentzians fitted to the
    structure function :math:`\frac{1}{2} \langle (x_{j+k} - x_j)^2 \rangle`.

    Parameters
    ----------
    baselines
        Baselines at any level, shape ``(n, length)``.
    samples
        Even number of samples of the FFT whose frequencies the result has.

    Returns
    -------
    tuple of array
        Continuum and lines at the frequencies of a real FFT of `samples`. Their sum is
        the density. A line, which the baselines do not resolve, occupies one bin.

    Examples
    --------
    The spectrum of white noise is its variance.

    >>> white = np.random.default_rng(1).normal(0, 2, size=(200, 512))
    >>> continuum, lines = spectrum(white, 8192)
    >>> bool(abs(continuum[1000:].mean() - 4) < 0.1), bool(lines.any())
    (True, False)
    """
    n, length = baselines.shape
    window = np.hanning(length + 1)[:-1]
    centred = baselines - baselines.mean(axis=1, keepdims=True)
    power = np.abs(scipy.fft.rfft(centred * window, axis=1)) ** 2
    density = np.asarray(power.mean(axis=0) / (window @ window), float)
    # split a periodogram into its continuum and its lines on the grid of the records
    around = scipy.ndimage.median_filter(density, 2 * LINE_AROUND + 1, mode="nearest")
    lines = np.zeros(samples // 2 + 1)
    continuum = density.copy()
    bins = np.arange(len(density))
    peaks = scipy.ndimage.maximum_filter1d(density, 2 * LINE_HALF_WIDTH + 1) == density
    peaks &= (bins > FIRST_CLEAN_BIN) & (bins < len(density) - LINE_HALF_WIDTH)
    for peak in np.flatnonzero(peaks & (density > LINE_HEIGHT * around)):
        near = slice(peak - LINE_HALF_WIDTH, peak + LINE_HALF_WIDTH + 1)
        excess = np.maximum(density[near] - around[near], 0)
        centre = (excess @ bins[near]) / excess.sum() / length
        # the bins of the periodogram are wider than those of the records
        lines[round(centre * samples)] += excess.sum() * samples / length
        continuum[near] = np.minimum(continuum[near], around[near])
    # From `FIRST_CLEAN_BIN` upwards the continuum is the measured one. Below, it is a sum of a
    # constant and Lorentzians, not negative, with a structure function closest to the measured.
    # That needs no subtraction of the mean, so noise slower than the baseline is retained.
    padded = scipy.fft.next_fast_len(2 * length, real=True)
    of_lags = np.zeros(padded // 2 + 1)
    for rows in blocks(n, 512):
        of_lags += (np.abs(scipy.fft.rfft(centred[rows], padded)) ** 2).sum(axis=0)
    products, squares = scipy.fft.irfft(of_lags, padded), np.cumsum((centred**2).sum(axis=0))
    # sums of squares over samples with a later partner, and over those with an earlier one
    lags = np.unique(np.geomspace(4, 0.9 * length, LAGS).astype(int))
    pairs = squares[length - 1 - lags] + (squares[-1] - squares[lags - 1])
    drift = (0.5 * pairs - products[lags]) / (n * (length - lags))
    frequency, measured = np.arange(len(lines)) / samples, bins[FIRST_CLEAN_BIN:] / length
    fast = np.interp(frequency, measured, continuum[FIRST_CLEAN_BIN:])
    constant, fast = np.where(frequency < measured[0], (fast, 0 * fast), (0 * fast, fast))
    corners = np.geomspace(2 / samples, measured[0], CORNERS)[:, np.newaxis]
    slow = 1 / (1 + (frequency / corners) ** 2) - 1 / (1 + (measured[0] / corners) ** 2)
    slow = np.vstack([constant, np.maximum(slow, 0)])
    # both signs of the frequency: a density of 1 is a mean square of 1
    oscillation = 2 * (1 - np.cos(2 * np.pi * lags[:, np.newaxis] * frequency)) / samples
    weights = 1 / drift
    rest = (drift - oscillation @ (fast + lines)) * weights
    heights, _ = scipy.optimize.nnls((oscillation @ slow.T) * weights[:, np.newaxis], rest)
    return np.asarray(fast + heights @ slow), lines
