"""Forms of translated pulses: normalised windows, or raw traces in ADC counts.

Raw traces are the inverse of the preparation: ``raw = baseline + scale * prepared``, with a
scale proportional to the energy.  A readout chain produces records of any length with noise
throughout.  Its noise is added once and nothing is normalised afterwards, so it does not change
the height of a pulse.  A network produces windows of fixed length.  They are padded with the
baseline before them and with the decay fitted to their end after them, both without noise.
"""

from __future__ import annotations

import logging
from dataclasses import replace
from typing import Any

import numpy as np
import numpy.typing as npt

from cpunet.electronics.drawn_pile_up import Columns, DrawnTails, InTracePileUp
from cpunet.electronics.finishing import extended
from cpunet.errors import CpunetError
from cpunet.networks.response_layer import padding, record_length
from cpunet.pulses.container import FloatArray, Pulses
from cpunet.pulses.preparation import Rejection
from cpunet.training.run import Run
from cpunet.translation.options import LEARNED, NONE, Adc, TranslateOptions
from cpunet.translation.translator import TranslatedPulses, Translator

log = logging.getLogger(__name__)

HIGHEST = int(np.iinfo(np.uint16).max)
MAX_BITS = 24  # of whole numbers in single precision
RISE_NS = 320.0  # of the pulse whose height defines the gain
MIN_ADC = 20.0  # raw traces have a larger median scale


class Form:
    """Prepared windows, NaN for rejected pulses, or raw traces in ADC counts, 0 for these.

    Parameters
    ----------
    run, translator
        Trained run, and its translator.
    options
        What is asked for.

    Attributes
    ----------
    n_pre, length
        Samples of a trace before the alignment of a pulse without noise, and all.
    tails
        Distribution of the pile-up tails, which raise the baseline at the start of a trace;
        None for none.
    scale
        ADC counts per prepared unit and keV, and baseline in ADC counts; None for windows.
    ends
        Lowest and highest count.
    samples
        Type of the stored samples.

    Raises
    ------
    CpunetError
        If the run lacks information, or `n_pre` is not within the trace.
    """

    def __init__(self, run: Run, translator: Translator, options: TranslateOptions) -> None:
        self.translator, self.options, adc = translator, options, options.adc
        config, rate_khz = translator.recipe.preparation, options.pile_up_khz
        self.tails = wanted_tails(translator, options.tails, raw=adc is not None)
        if not (np.isfinite(rate_khz) and rate_khz >= 0):
            raise CpunetError(f"`pile_up_khz` {rate_khz:g}: expected a rate in kHz, 0 or more")
        self.energies_kev: tuple[float, ...] = ()  # of piled-up pulses
        if rate_khz:
            learned = _tails_of(translator, f"`pile_up_khz` {rate_khz:g}")
            self.energies_kev = learned.energies_kev
        self.n_pre, self.length = config.samples_before, config.length
        self.scale: tuple[float, float] | None = None
        self.ends, self.samples = (0, HIGHEST), np.dtype(np.float32)
        if adc is None:
            return
        self.scale, self.ends = adc_scale(run, translator, adc), adc_ends(run, adc)
        self.samples = _kind(self.ends)
        if rate_khz and translator.backend.chain is None:
            raise CpunetError(
                "a network knows no shapes beyond its windows, so it gives no raw traces with "
                "piled-up pulses; leave out `pile_up_khz` or `adc`"
            )
        self.length = self.length if adc.length is None else adc.length
        self.n_pre = self.n_pre if adc.n_pre is None else adc.n_pre
        if not 0 <= self.n_pre < self.length:
            raise CpunetError(
                f"`n_pre` {self.n_pre} is not within a trace of {self.length} samples; "
                "give less, or a longer `length`"
            )

    @property
    def fills_in(self) -> bool:
        """Whether traces are padded with baseline and decay without noise."""
        config = self.translator.recipe.preparation
        after = self.length - self.n_pre
        beyond = self.n_pre > config.samples_before or after > config.samples_after
        return self.translator.backend.chain is None and beyond

    def __call__(self, pulses: Pulses, generator: np.random.Generator) -> TranslatedPulses:
        """Translate pulses, of which all rows stay; raw traces need energies."""
        translator, dt_ns = self.translator, self.translator.dt_ns
        left, piled, n = None, None, len(pulses)
        truth: Columns = {}
        if self.tails is not None:
            left = self.tails.draw_kev(n, generator)
            truth = {"tails_kev": (left, "keV")}
        if self.options.pile_up_khz:
            record = self.n_pre, self.length
            if self.scale is None:
                record = padding(dt_ns)[0] + self.n_pre, record_length(self.length, dt_ns)
            rate = self.options.pile_up_khz
            piled = InTracePileUp.draw(n, rate, self.energies_kev, dt_ns, *record, generator)
            truth |= piled.columns()
        chain = translator.backend.chain is not None
        done = translator.translate_pulses(
            pulses,
            noise=self.options.noise,
            generator=generator,
            tails_kev=left if chain or self.scale is None else None,
            piled=piled,
            trace=(self.n_pre, self.length) if chain and self.scale is not None else None,
        )
        if self.scale is None:
            return replace(done, truth=truth)
        codes, windows, t0_ns = done.codes, done.pulses.waveforms, done.pulses.t0_ns
        if not chain:
            config = translator.recipe.preparation
            windows = extended(windows, config, dt_ns, self.length, self.n_pre)
            t0_ns = t0_ns - (self.n_pre - config.samples_before) * dt_ns
        unknown = ~(np.isfinite(pulses.energy_kev) & (pulses.energy_kev > 0))
        codes[unknown & (codes == Rejection.ACCEPTED)] = Rejection.ENERGY_UNKNOWN
        if left is not None and self.tails is not None:
            with np.errstate(divide="ignore", invalid="ignore"):
                heights = left * self.tails.height / pulses.energy_kev
            windows += heights[:, np.newaxis] * self.tails.decay(self.length, lead_us=0.0)
        windows[codes != Rejection.ACCEPTED] = np.nan
        per_kev, baseline = self.scale
        scale = np.where(unknown, 0.0, per_kev * pulses.energy_kev)
        traces, saturated = to_adc(windows, scale, baseline, self.ends)
        # single precision represents these integers exactly
        whole = replace(pulses, waveforms=traces.astype(np.float32), t0_ns=t0_ns)
        return TranslatedPulses(whole, codes, saturated, truth)


def adc_ends(run: Run, adc: Adc) -> tuple[int, int]:
    """Lowest and highest count of a digitiser: of `bits`, or of those that the data need.

    Data that leave out saturated pulses end at their highest count.

    Raises
    ------
    CpunetError
        If there are no such digitisers.
    """
    if adc.bits is not None and not 1 <= adc.bits <= MAX_BITS:
        raise CpunetError(f"`bits` is {adc.bits}; expected 1 to {MAX_BITS}")
    low, high = run.data.counts or (0, HIGHEST)
    signed = low < 0
    bits = adc.bits or max(high.bit_length(), (-low - 1).bit_length()) + signed
    first, last = (-(2 ** (bits - 1)), 2 ** (bits - 1) - 1) if signed else (0, 2**bits - 1)
    if adc.bits is None and run.data.rejections.get(Rejection.SATURATED.label):
        last = high
    log.info(f"counts from {first} to {last}, beyond which they are clipped (`bits`)")
    return first, last


def to_adc(
    windows: FloatArray,
    scale: npt.ArrayLike,
    baseline: npt.ArrayLike,
    ends: tuple[int, int] = (0, HIGHEST),
) -> tuple[npt.NDArray[np.integer], npt.NDArray[np.bool_]]:
    """Invert ``prepared = (raw - baseline) / scale``, round, and clip.

    Parameters
    ----------
    windows
        Prepared pulses, shape (n, samples); a row with NaN becomes a row of 0.
    scale, baseline
        Scale and baseline in ADC counts, per row or common.
    ends
        The lowest and the highest count.

    Returns
    -------
    traces
        Raw traces in ADC counts, shape (n, samples).
    saturated
        Mask of the clipped rows, shape (n,).

    Examples
    --------
    >>> to_adc(np.array([[0, 0.8], [0, 80]], np.float32), 1000.0, 200.0)
    (array([[  200,  1000],
           [  200, 65535]], dtype=uint16), array([False,  True]))
    """
    factor = np.asarray(scale, float).reshape(-1, 1)
    counts = np.rint(windows * factor + np.asarray(baseline, float).reshape(-1, 1))
    missing = ~np.isfinite(counts).all(axis=1)
    counts[missing] = 0
    saturated = ((counts < ends[0]) | (counts > ends[1])).any(axis=1)
    return counts.clip(*ends).astype(_kind(ends)), saturated


def _kind(ends: tuple[int, int]) -> np.dtype[Any]:
    """The smallest type of integers, of 16 bits or more, that has both ends."""
    kinds = [np.iinfo(kind) for kind in ("u2", "i2", "u4", "i4")]
    return next(kind.dtype for kind in kinds if kind.min <= ends[0] and ends[1] <= kind.max)


def adc_scale(run: Run, translator: Translator, adc: Adc) -> tuple[float, float]:
    """ADC counts per prepared unit and keV, and baseline: as given, or those of the data.

    Parameters
    ----------
    run, translator
        The run, and its translator.
    adc
        Height of a fast pulse above the baseline per keV, and baseline, if they are given.

    Raises
    ------
    CpunetError
        If one of the two is neither given nor in the run, the gain is not positive, or the
        baseline is negative.
    """
    adc_per_kev, baseline = adc.adc_per_kev, adc.baseline
    if adc_per_kev is not None and not (np.isfinite(adc_per_kev) and adc_per_kev > 0):
        raise CpunetError(f"`adc_per_kev` is {adc_per_kev}; expected a number above 0")
    if baseline is not None and not (np.isfinite(baseline) and baseline >= 0):
        raise CpunetError(f"`baseline` is {baseline}; expected a number that is not negative")
    per_kev, cuts, peak = None, run.data.cuts, run.recipe.peaks.get(run.peak)
    if cuts is not None and cuts.amplitude >= MIN_ADC:
        per_kev = None if peak is None else cuts.amplitude / peak.energy_kev
        if baseline is None:
            baseline = {window.name: window.centre for window in cuts.windows}.get("baseline")
    if adc_per_kev is not None:  # of the maximum, in prepared units, of a fast pulse
        config = translator.recipe.preparation
        time = np.arange(config.length) - config.samples_before
        ramp = np.clip(time * translator.dt_ns / RISE_NS + 1, 0, 1).astype(np.float32)
        pulse = translator.apply(ramp[np.newaxis], energy_kev=np.ones(1), noise=False)
        height = float(pulse.max())
        if not (np.isfinite(height) and height > 0):
            raise CpunetError("the run cannot translate a fast pulse; train again")
        per_kev = adc_per_kev / height
    if per_kev is None:
        raise CpunetError(
            f"{run.name}: does not say how many ADC counts a keV is; give `adc_per_kev`"
        )
    if baseline is None:
        raise CpunetError(f"{run.name}: does not say where the baseline is; give `baseline`")
    return per_kev, baseline


def wanted_tails(
    translator: Translator, wanted: str | float, *, raw: bool = False
) -> DrawnTails | None:
    """Pile-up tails to add to translations.

    Parameters
    ----------
    translator
        Trained run.
    wanted
        ``"learned"`` for the tails of the data, ``"none"``, or a rate in kHz.
    raw
        Whether the tails are for raw traces, which have not passed any cuts.

    Raises
    ------
    CpunetError
        If `wanted` is invalid, or the run lacks the necessary information.
    """
    if wanted == NONE:
        return None
    rate = None
    if wanted != LEARNED:
        try:
            rate = float(wanted)
        except ValueError:
            rate = np.nan
        if not (np.isfinite(rate) and rate >= 0):
            raise CpunetError(f"`tails` {wanted}: expected learned, none, or a rate in kHz")
    tails = _tails_of(translator, f"`tails` {wanted}")
    if rate is not None:
        tails = replace(tails, rate_khz=rate, passed=None)
    elif raw:
        tails = replace(tails, passed=None)
    return tails if tails.rate_khz > 0 else None


def _tails_of(translator: Translator, asked: str) -> DrawnTails:
    if translator.tails is None:
        raise CpunetError(
            f"{asked}: the run tells nothing of pile-up tails and of other pulses (a network, "
            "or trained without raw traces)",
            "train a readout chain on raw traces, or leave it out",
        )
    return translator.tails
