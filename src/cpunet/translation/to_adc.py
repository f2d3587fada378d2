"""Translated pulses as raw traces in ADC counts: the inverse of the preparation.

``raw = baseline + scale * prepared``, with a scale proportional to the energy.  A readout
chain produces records of any length with noise throughout.  Its noise is added once and
nothing is normalised afterwards, so it does not change the height of a pulse.  A network
produces windows of fixed length.  They are padded with the baseline before them and with the
decay fitted to their end after them, both without noise.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
import torch

from cpunet.electronics.drawn_tails import DrawnTails
from cpunet.electronics.finishing import extended
from cpunet.electronics.in_trace_pile_up import DrawnPileUp, InTracePileUp
from cpunet.errors import CpunetError
from cpunet.pulses.container import FloatArray, Pulses
from cpunet.pulses.preparation import Codes, Rejection, prepare
from cpunet.training.run import Run
from cpunet.translation.backends import Backend
from cpunet.translation.output_form import Formed, drawn_kev, rng_of, truth_of
from cpunet.translation.translator import BATCH, REN

HIGHEST = int(np.iinfo(np.uint16).max)
RISE_SAMPLES = 20  # of the pulse whose height defines the gain
MIN_ADC = 20.0  # raw traces have a larger median scale

Floats = npt.NDArray[np.float64]


@dataclass(frozen=True)
class AdcScale:
    """Conversion from prepared units to ADC counts.

    Parameters
    ----------
    per_kev
        ADC counts per prepared unit and keV.
    baseline
        Baseline in ADC counts.
    """

    per_kev: float
    baseline: float


def to_adc(
    windows: FloatArray, scale: npt.ArrayLike, baseline: npt.ArrayLike
) -> tuple[npt.NDArray[np.uint16], npt.NDArray[np.bool_]]:
    """Invert ``prepared = (raw - baseline) / scale``, round, and clip to 16 bits.

    Parameters
    ----------
    windows
        Prepared pulses, shape (n, samples); a row with NaN becomes a row of 0.
    scale, baseline
        Scale and baseline in ADC counts, per row or common.

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
    saturated = ((counts < 0) | (counts > HIGHEST)).any(axis=1)
    return counts.clip(0, HIGHEST).astype(np.uint16), saturated


def adc_scale(
    run: Run, ren: REN, *, adc_per_kev: float | None, baseline: float | None
) -> AdcScale:
    """Gain and baseline: as given, or else those of the run's training data.

    Parameters
    ----------
    run, ren
        The run, and its translator.
    adc_per_kev
        Height of a fast pulse above the baseline in ADC counts per keV, the inverse of
        ``kev_per_adc`` of the data.
    baseline
        Baseline in ADC counts.

    Raises
    ------
    CpunetError
        If one of the two is neither given nor known, the gain is not positive, or the baseline
        is negative.
    """
    if adc_per_kev is not None and not (np.isfinite(adc_per_kev) and adc_per_kev > 0):
        raise CpunetError(f"`adc_per_kev` is {adc_per_kev}; expected a number above 0")
    if baseline is not None and not (np.isfinite(baseline) and baseline >= 0):
        raise CpunetError(f"`baseline` is {baseline}; expected a number that is not negative")
    known_gain, known_baseline = _of_the_data(run)
    per_kev = known_gain if adc_per_kev is None else adc_per_kev / _height(ren)
    level = known_baseline if baseline is None else baseline
    if per_kev is None:
        raise CpunetError(
            f"{run.name}: does not say how many ADC counts a keV is; give `adc_per_kev`"
        )
    if level is None:
        raise CpunetError(f"{run.name}: does not say where the baseline is; give `baseline`")
    return AdcScale(per_kev, level)


class AdcForm:
    """Raw traces in ADC counts; 0 for rejected pulses.

    Parameters
    ----------
    ren
        Trained run.
    scale
        Gain and baseline.
    length, n_pre
        Number of samples of a trace, and of those before the pulse without noise reaches
        99.9 % of its maximum; the values of the prepared window if None.
    tails
        Distribution of the pile-up tails, which raise the baseline at the start
        of a trace; None for none.
    pile_up
        Rate and energies of piled-up pulses within a trace; None for none.

    Raises
    ------
    CpunetError
        If `n_pre` is not within the trace.
    """

    samples: npt.DTypeLike = np.uint16
    units = "ADC"

    def __init__(
        self,
        ren: REN,
        scale: AdcScale,
        length: int | None = None,
        n_pre: int | None = None,
        tails: DrawnTails | None = None,
        pile_up: DrawnPileUp | None = None,
    ) -> None:
        self.ren, self.scale, self.tails, self.pile_up = ren, scale, tails, pile_up
        self.config = ren.recipe.preparation
        if pile_up is not None and ren.backend.chain is None:
            raise CpunetError(
                "a network knows no shapes beyond its windows, so it gives no raw traces with "
                "piled-up pulses; leave out `pile_up_khz` or `adc`"
            )
        self.length = self.config.length if length is None else length
        self.n_pre = self.config.samples_before if n_pre is None else n_pre
        if not 0 <= self.n_pre < self.length:
            raise CpunetError(
                f"`n_pre` {self.n_pre} is not within a trace of {self.length} samples; "
                "give less, or a longer `length`"
            )
        self.t0_ns = -self.n_pre * ren.dt_ns

    @property
    def fills_in(self) -> bool:
        """Whether traces are padded with baseline and decay without noise."""
        before = self.n_pre - self.config.samples_before
        after = self.length - self.n_pre - self.config.samples_after
        return self.ren.backend.chain is None and max(before, after) > 0

    def __call__(
        self, pulses: Pulses, *, noise: bool, generator: torch.Generator | None
    ) -> Formed:
        """Translate pulses, keeping their rows; pulses without energy are rejected."""
        backend, left = self.ren.backend, drawn_kev(self.tails, len(pulses), generator)
        piled = None
        if self.pile_up is not None:
            piled = self.pile_up.draw(len(pulses), self.n_pre, self.length, rng_of(generator))
        if backend.chain is not None:
            windows, codes = self._of_chain(backend, pulses, noise, generator, piled)
        else:
            done = self.ren.translate_pulses(pulses, noise=noise, generator=generator)
            codes = done.codes.copy()
            windows = extended(
                done.pulses.waveforms, self.config, self.ren.dt_ns, self.length, self.n_pre
            )
        unknown = ~(np.isfinite(pulses.energy_kev) & (pulses.energy_kev > 0))
        codes[unknown & (codes == Rejection.ACCEPTED)] = Rejection.ENERGY_UNKNOWN
        if left is not None and self.tails is not None:
            with np.errstate(divide="ignore", invalid="ignore"):
                heights = left * self.tails.height / pulses.energy_kev
            decay = self.tails.decay(self.length, lead_us=0.0)
            windows += heights[:, np.newaxis] * decay
        windows[codes != Rejection.ACCEPTED] = np.nan
        scale = np.where(unknown, 0.0, self.scale.per_kev * pulses.energy_kev)
        traces, saturated = to_adc(windows, scale, self.scale.baseline)
        # single precision represents 16-bit integers exactly
        whole = pulses.with_waveforms(traces.astype(np.float32))
        return Formed(whole, codes, saturated, truth_of(left, piled))

    def _of_chain(
        self,
        backend: Backend,
        pulses: Pulses,
        noise: bool,
        generator: torch.Generator | None,
        piled: InTracePileUp | None,
    ) -> tuple[FloatArray, Codes]:
        """Traces in prepared units from a readout chain, and a `Rejection` for each row."""
        prepared = prepare(pulses, self.config, "simulated")
        traces = np.full((len(pulses), self.length), np.nan, np.float32)
        codes = prepared.codes.copy()
        usable = np.isfinite(pulses.energy_kev) & (pulses.energy_kev > 0)
        kept = usable[prepared.index]
        index = prepared.index[kept]
        windows = prepared.pulses.waveforms[kept]
        rng, electronic = rng_of(generator), backend.noise
        for first in range(0, len(windows), BATCH):
            rows = index[first : first + BATCH]
            batch = windows[first : first + BATCH]
            levels, codes[rows] = backend.levels(batch, self.n_pre, self.length)
            energies = pulses.energy_kev[rows]
            if noise and electronic is not None:
                levels += electronic.draw(energies, self.length, rng)
            if piled is not None:
                levels += self._piled(backend, batch, energies, piled.of_rows(rows))
            traces[rows] = levels
        return traces, codes

    def _piled(
        self,
        backend: Backend,
        windows: FloatArray,
        energy_kev: Floats,
        piled: InTracePileUp,
    ) -> Floats:
        """Piled-up pulses with shapes of the same batch, in prepared units."""
        if not len(piled.row):
            return np.zeros((len(windows), self.length))
        # early piled-up pulses need longer traces
        reached = self.length + piled.reach(self.ren.dt_ns)
        shapes, _ = backend.levels(windows[piled.partner], self.n_pre, reached)
        return piled.added(np.nan_to_num(shapes), energy_kev, self.ren.dt_ns, self.length)


def _of_the_data(run: Run) -> tuple[float | None, float | None]:
    """Gain (ADC counts per prepared unit and keV) and baseline of the data, if recorded."""
    cuts, peak = run.data.cuts, run.recipe.peaks.get(run.peak)
    if cuts is None or cuts.amplitude < MIN_ADC:
        return None, None
    centres = {window.name: window.centre for window in cuts.windows}
    return (None if peak is None else cuts.amplitude / peak.energy_kev), centres.get("baseline")


def _height(ren: REN) -> float:
    """Maximum, in prepared units, of a fast pulse without noise."""
    config = ren.recipe.preparation
    time = np.arange(config.length) - config.samples_before
    ramp = np.clip(time / RISE_SAMPLES + 1, 0, 1).astype(np.float32)
    height = float(ren.apply(ramp[np.newaxis], noise=False).max())
    if not (np.isfinite(height) and height > 0):
        raise CpunetError("the run cannot translate a fast pulse; train again")
    return height
