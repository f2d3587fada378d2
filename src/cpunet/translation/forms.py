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

import numpy as np

from cpunet.electronics.drawn_pile_up import Columns, InTracePileUp
from cpunet.errors import CpunetError
from cpunet.networks.response_layer import padding, record_length
from cpunet.pulses.container import Pulses
from cpunet.pulses.preparation import Rejection
from cpunet.training.run import Run
from cpunet.translation.backends import ResponseBackend
from cpunet.translation.options import LEARNED, NONE, Adc, TranslateOptions
from cpunet.translation.translator import TranslatedPulses, Translator

log = logging.getLogger(__name__)

HIGHEST = int(np.iinfo(np.uint16).max)
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
        config, tails = translator.recipe.preparation, translator.tails
        if tails is None and (options.tails != NONE or options.pile_up_khz):
            name = "tails" if options.tails != NONE else "pile_up_khz"
            raise CpunetError(
                f"`{name}` {getattr(options, name)}: the run tells nothing of pile-up tails "
                "and of other pulses (a network, or trained without raw traces)",
                "train a readout chain on raw traces, or leave it out",
            )
        if options.tails == NONE:
            tails = None
        elif tails is not None and options.tails != LEARNED:
            tails = replace(tails, rate_khz=float(options.tails), passed=None)
        elif tails is not None and adc is not None:
            tails = replace(tails, passed=None)
        self.tails = tails if tails is not None and tails.rate_khz > 0 else None
        self.n_pre, self.length = config.samples_before, config.length
        self.scale: tuple[float, float] | None = None
        self.ends, self.samples = (0, HIGHEST), "f4"
        if adc is None:
            return
        self.scale, self.ends = adc_scale(run, translator, adc), adc_ends(run, adc)
        kinds = {kind: np.iinfo(kind) for kind in ("u2", "i2", "u4", "i4")}
        low, high = self.ends
        self.samples = next(k for k, of in kinds.items() if of.min <= low and high <= of.max)
        self.length = self.length if adc.length is None else adc.length
        self.n_pre = self.n_pre if adc.n_pre is None else adc.n_pre
        if not 0 <= self.n_pre < self.length:
            raise CpunetError(
                f"`n_pre` {self.n_pre} is not within a trace of {self.length} samples; "
                "give less, or a longer `length`"
            )
        if isinstance(translator.backend, ResponseBackend):
            return
        if options.pile_up_khz:
            raise CpunetError(
                "a network knows no shapes beyond its windows, so it gives no raw traces with "
                "piled-up pulses; leave out `pile_up_khz` or `adc`"
            )
        after = self.length - self.n_pre
        if self.n_pre > config.samples_before or after > config.samples_after:
            log.warning(
                f"a network knows windows of {config.length} samples alone; beyond them stand "
                "baseline and decay without noise"
            )

    def __call__(self, pulses: Pulses, generator: np.random.Generator) -> TranslatedPulses:
        """Translate pulses, of which all rows stay; raw traces need energies."""
        n, dt_ns, rate_khz = len(pulses), self.translator.dt_ns, self.options.pile_up_khz
        left, piled, energies = None, None, pulses.energy_kev
        truth: Columns = {}
        if self.tails is not None:
            left = self.tails.draw_kev(n, generator)
            truth = {"tails_kev": (left, "keV")}
        if rate_khz and (learned := self.translator.tails) is not None:
            record = self.n_pre, self.length
            if self.scale is None:
                record = padding(dt_ns)[0] + self.n_pre, record_length(self.length, dt_ns)
            sizes = learned.energies_kev
            piled = InTracePileUp.draw(n, rate_khz, sizes, dt_ns, *record, generator)
            truth |= piled.columns()
        windows = self.scale is None
        done = self.translator.translate_pulses(
            pulses,
            noise=self.options.noise,
            generator=generator,
            tails_kev=left if windows else None,
            piled=piled,
            trace=None if windows else (self.n_pre, self.length),
        )
        if self.scale is None:
            return replace(done, truth=truth)

        unknown = ~(np.isfinite(energies) & (energies > 0))
        done.codes[unknown & done.valid] = Rejection.ENERGY_UNKNOWN
        levels = done.pulses.waveforms
        if left is not None and self.tails is not None:
            with np.errstate(divide="ignore", invalid="ignore"):
                heights = left * self.tails.height / energies
            levels += heights[:, np.newaxis] * self.tails.decay(self.length, lead_us=0.0)
        levels[~done.valid] = np.nan

        per_kev, baseline = self.scale
        counts = np.rint(levels * (per_kev * energies)[:, np.newaxis] + baseline)
        counts[~np.isfinite(counts).all(axis=1)] = 0
        clipped = counts.clip(*self.ends)
        saturated = int((clipped != counts).any(axis=1).sum())
        # single precision represents these integers exactly
        traces = done.pulses.with_waveforms(clipped.astype(np.float32))
        return TranslatedPulses(traces, done.codes, saturated, truth)


def adc_ends(run: Run, adc: Adc) -> tuple[int, int]:
    """Lowest and highest count of a digitiser: of `bits`, or of those that the data need.

    Data that leave out saturated pulses end at their highest count.
    """
    low, high = run.data.counts or (0, HIGHEST)
    signed = low < 0
    bits = adc.bits or max(high.bit_length(), (-low - 1).bit_length()) + signed
    first, last = (-(2 ** (bits - 1)), 2 ** (bits - 1) - 1) if signed else (0, 2**bits - 1)
    if adc.bits is None and run.data.rejections.get(Rejection.SATURATED.label):
        last = high
    log.info(f"counts from {first} to {last}, beyond which they are clipped (`bits`)")
    return first, last


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
        If one of the two is neither given nor in the run.
    """
    per_kev, baseline, cuts = None, adc.baseline, run.data.cuts
    if cuts is not None and cuts.amplitude >= MIN_ADC:
        peak = run.recipe.peaks.get(run.peak)
        per_kev = None if peak is None else cuts.amplitude / peak.energy_kev
        if baseline is None:
            baseline = {window.name: window.centre for window in cuts.windows}.get("baseline")
    if adc.adc_per_kev is not None:  # of the maximum, in prepared units, of a fast pulse
        config = translator.recipe.preparation
        time = np.arange(config.length) - config.samples_before
        ramp = np.clip(time * translator.dt_ns / RISE_NS + 1, 0, 1).astype(np.float32)
        pulse = translator.apply(ramp[np.newaxis], energy_kev=np.ones(1), noise=False)
        height = float(pulse.max())
        if not (np.isfinite(height) and height > 0):
            raise CpunetError("the run cannot translate a fast pulse; train again")
        per_kev = adc.adc_per_kev / height
    if per_kev is None:
        raise CpunetError(
            f"{run.name}: does not say how many ADC counts a keV is; give `adc_per_kev`"
        )
    if baseline is None:
        raise CpunetError(f"{run.name}: does not say where the baseline is; give `baseline`")
    return per_kev, baseline
