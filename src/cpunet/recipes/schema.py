"""Every setting of a run, validated: a small class per part of a recipe.

The values are in the YAML files next to this module.  A missing field is an error,
and so is an unknown key.  Times are in ns, so that a recipe means the same at any sampling
period; `Recipe.at` makes numbers of samples of them.
"""

from __future__ import annotations

import math
from typing import Annotated, Literal, NamedTuple, Self

from pydantic import AfterValidator, Field, PrivateAttr, field_validator, model_validator

from cpunet.errors import CpunetError
from cpunet.settings import Config, Count, Fraction, NonNegative, Positive, Samples, Width

# parameters that stretch the simulated drift, see `cpunet.networks.response_layer`
DriftTerms = Annotated[int, Field(ge=0, le=2)]


def _rising(ends: tuple[float, float]) -> tuple[float, float]:
    if not ends[0] < ends[1]:
        raise ValueError("must go from a lower to a higher value")
    return ends


class Timed(Config):
    """Settings with times, which are numbers of samples at a sampling period."""

    _dt_ns: float | None = PrivateAttr(None)

    def at(self, dt_ns: float) -> Self:
        """The same settings, with all parts, for pulses with a sampling period in ns."""
        parts = {name: part.at(dt_ns) for name, part in self if isinstance(part, Timed)}
        timed = self.model_copy(update=parts)
        timed._dt_ns = float(dt_ns)  # noqa: SLF001  # of a copy
        return timed

    @property
    def sampled_ns(self) -> float:
        """The sampling period; `at` comes first."""
        assert self._dt_ns is not None
        return self._dt_ns

    def samples(self, time_ns: float) -> int:
        """Number of samples of a time in ns."""
        return round(time_ns / self.sampled_ns)


_RangeKev = Annotated[tuple[Positive, Positive], AfterValidator(_rising)]


class PunetConfig(Config):
    """The Positional U-Net (paper, section 2.2.1).

    As published, it is all of a generator.  Behind a ``linear`` part, ``learned`` with it or
    ``solved``, it adds to pulses, nothing at first, and has no batch norm, draw or dropout.
    """

    name: Literal["punet"]
    width: Annotated[int, Field(ge=2, le=1024, multiple_of=2)]
    dropout: Fraction
    linear: Literal["none", "learned", "solved"]


class ResponseConfig(Config):
    """A differentiable readout chain, see `cpunet.networks.response_layer`.

    ``poles_ns`` and ``decay_us`` are initial values of free times.  ``slow_ns`` and
    ``fast_decays_us`` are fixed times whose weights are free: sums of exponentials with free
    times have long valleys in which a fit gets lost, weights have none.  ``drift_terms`` is
    the number of parameters that stretch the simulated drift, see
    `cpunet.networks.response_layer`; 0 for the drift as simulated.
    ``deviations`` are those of the step response from that of the chain, which are added where
    the pulses ask for them; ``by_height`` is what the electronics do by the height of a pulse,
    see `cpunet.networks.by_height`.
    """

    name: Literal["response"]
    poles_ns: Annotated[tuple[Positive, ...], Field(min_length=1, max_length=4)]
    slow_ns: Annotated[tuple[Positive, ...], Field(max_length=100)]
    decay_us: Positive
    fast_decays_us: Annotated[tuple[Positive, ...], Field(max_length=100)]
    drift_terms: DriftTerms
    deviations: bool
    by_height: bool

    @field_validator("slow_ns", "fast_decays_us")
    @classmethod
    def _times_differ(cls, times: tuple[float, ...]) -> tuple[float, ...]:
        if len({*times}) < len(times):
            raise ValueError("times must differ")
        return times


class GruConfig(Config):
    """The GRU discriminator with attention (paper, section 2.2.2).

    The GRU takes a step per ``samples_per_step`` samples (1 in the paper); more samples
    make it that many times faster, on the same embedded samples.  The table of
    vectors spans ``value_range``, or each pulse's own minimum to maximum (the
    paper's choice, blind to the pulse height) if that is null.  It reads the ``window`` or, in
    units of the ``spread`` of the real pulses, charge and current in turn, and then
    ``components``; see `cpunet.training.views`.  A batch norm of its context, as published,
    is another difference between training and use.
    """

    name: Literal["gru"]
    embedding_rows: Annotated[int, Field(ge=2, le=100_000)]
    embedding_dim: Width
    hidden: Width
    samples_per_step: Samples
    value_range: Annotated[tuple[float, float], AfterValidator(_rising)] | None
    view: Literal["window", "spread"]
    components: Samples
    batch_norm: bool


class ConvolutionalConfig(Config):
    """A critic that reads charge and current about the half maximum by convolutions.

    It has ``channels`` in its first layer, and ``hidden`` numbers join what it reads with
    means of the pulse, the highest currents and ``components``; see `cpunet.training.views`.
    """

    name: Literal["convolutional"]
    channels: Width
    hidden: Width
    components: Samples


class PeakConfig(Config):
    """A gamma line and the half-width of the energy window around it, in keV."""

    energy_kev: Positive
    half_width_kev: Positive


class PreparationConfig(Timed):
    """From raw trace to the window a network sees (paper, section 3.3).

    A window reaches from ``before_ns`` before the alignment to ``after_ns`` after it.  With
    ``align_at`` ``half_height``, pulses are aligned where they cross half of the height that a
    straight line through the last ``decay_fit_ns`` of the window has then; with a number, at
    that fraction of their maximum (paper: 0.999).  ``padding_before_ns`` and
    ``padding_after_ns`` limit how much of a *measured* window may lie outside its record; it
    is filled with the baseline and with the last value.  Simulated pulses are padded without
    limit, since they are constant outside it.  A trace with ``saturation_run`` equal samples at
    its top is saturated.
    """

    before_ns: Positive
    after_ns: Positive
    align_at: Literal["half_height"] | Annotated[float, Field(gt=0, le=1)]
    baseline_ns: Positive
    tail_ns: Positive
    tail_level: Positive
    decay_fit_ns: Positive
    padding_before_ns: NonNegative
    padding_after_ns: NonNegative
    saturation_run: Samples

    @property
    def samples_before(self) -> int:
        """Samples of a window before its alignment."""
        return self.samples(self.before_ns)

    @property
    def samples_after(self) -> int:
        """Samples of a window from its alignment on."""
        return self.samples(self.after_ns)

    @property
    def length(self) -> int:
        """Samples of a prepared pulse."""
        return self.samples_before + self.samples_after

    @property
    def baseline_samples(self) -> int:
        """Samples at the start of a window that are its baseline."""
        return max(1, self.samples(self.baseline_ns))

    @property
    def tail_samples(self) -> int:
        """Samples at the end of a window that are scaled to the level of the tail."""
        return max(1, self.samples(self.tail_ns))

    @property
    def decay_fit_samples(self) -> int:
        """Samples at the end of a window to which the decay is fitted."""
        return max(3, self.samples(self.decay_fit_ns))

    @model_validator(mode="after")
    def _fits(self) -> PreparationConfig:
        if self.baseline_ns >= self.before_ns:
            raise ValueError("baseline_ns must be less than before_ns")
        if max(self.tail_ns, self.decay_fit_ns) > self.after_ns:
            raise ValueError("tail_ns and decay_fit_ns must fit in after_ns")
        return self


class CutConfig(Config):
    """Half-widths of the quality cuts, in robust standard deviations of the data.

    The windows follow from median and MAD of the set itself, so that no constant
    of a particular detector enters.
    """

    decay_sigmas: Positive
    chi2_sigmas: Positive
    baseline_sigmas: Positive


class LossConfig(Timed):
    """Weights of the eight losses and of the three windows of the L1 terms."""

    baseline_ns: Positive
    rising_edge_ns: Positive
    tail_ns: Positive
    baseline_weight: NonNegative
    rising_edge_weight: NonNegative
    tail_weight: NonNegative
    cycle_weight: NonNegative
    identity_weight: NonNegative
    adversarial_weight: NonNegative


class TrainingConfig(Timed):
    """Settings of the game of generators and critics, see `cpunet.training.adversarial`.

    Rates rise over ``warmup`` iterations, and fall from ``decay_start`` on as the part that is
    left, to ``decay_power``; those of critics to no less than the part ``least_rate``.
    Critics learn every ``discriminator_interval`` iterations; cycles, identities and the
    simulated side are visited every ``cycle_interval`` with ``cycle_size`` pulses.
    With ``paired``, the adversarial loss compares pairs of real and translated pulses
    (relativistic), and the squared slope of critics costs ``penalty``; else it is the
    published cross-entropy.  What counts in the end is the moving ``average`` of the weights.
    The part ``held_out`` of both sides is not trained on.
    Batch-norm statistics of the final generators, if any, are computed again over
    ``statistics_batches``.  With ``noise`` from ``baselines``, noise drawn from the data's own
    baselines is added to all translations that a critic or a score sees.
    """

    method: Literal["cyclegan"]
    iterations: Count
    decay_start: Annotated[int, Field(ge=0, le=100_000_000)]
    decay_power: Positive
    warmup: Annotated[int, Field(ge=0, le=100_000_000)]
    batch_size: Annotated[int, Field(ge=2, le=100_000)]
    rate_generators: Positive
    rate_linear: Positive
    rate_discriminators: Positive
    least_rate: Fraction
    betas: tuple[Fraction, Fraction]
    weight_decay: NonNegative
    max_grad_norm: Positive
    discriminator_interval: Count
    cycle_interval: Count
    cycle_size: Annotated[int, Field(ge=2, le=100_000)]
    paired: bool
    penalty: NonNegative
    average: Fraction
    held_out: Fraction
    statistics_batches: Count
    log_interval: Count
    checkpoint_interval: Count
    noise: Literal["none", "baselines"]
    losses: LossConfig


class MatchingConfig(Timed):
    """A response matched to data, see `cpunet.training.response_fit`.

    Pulses are compared from ``before_ns`` before their half maximum to ``after_ns`` after it,
    with the mean of ``baseline_ns`` (range of times before it) shifted to 0 and that of the
    last ``level_ns`` scaled to the level of the preparation.  The valley is searched for with
    ``search_pulses`` of each side, in fits of at most ``steps`` iterations.  A fit that ends in
    the wrong valley is started again with the response's poles times the next of
    ``start_factors``; the best of all counts.  If a fit is bad and pulses begin differently
    than simulated, up to ``drift_terms`` parameters that stretch the drift are tried, and used
    if held-out pulses gain.
    """

    method: Literal["matching"]
    before_ns: Positive
    after_ns: Positive
    baseline_ns: tuple[Positive, Positive]
    level_ns: Positive
    search_pulses: Annotated[int, Field(ge=200, le=10_000_000)]
    steps: Count
    start_factors: Annotated[tuple[Positive, ...], Field(min_length=1, max_length=100)]
    drift_terms: DriftTerms

    @model_validator(mode="after")
    def _stretches_fit(self) -> MatchingConfig:
        if not self.baseline_ns[0] > self.baseline_ns[1]:
            raise ValueError("baseline_ns goes from a longer time before the edge to a shorter")
        if self.level_ns >= self.after_ns:
            raise ValueError("level_ns must be less than after_ns")
        return self


class ScoreConfig(Timed):
    """Histograms and resampling for the comparison of two distributions.

    ``sideband_kev`` are the nearest and farthest distances of the sidebands from a line, where
    only background is.  ``continuum_kev`` are the limits of named ranges without lines,
    for which the survival of an A/E cut is also reported.
    """

    max_bins: Annotated[int, Field(ge=2, le=100_000)]
    bootstraps: Annotated[int, Field(ge=2, le=100_000)]
    drift_start_fraction: Annotated[float, Field(gt=0, lt=1)]
    edge_ns: Positive
    sideband_kev: _RangeKev
    continuum_kev: dict[str, _RangeKev]


Critics = Annotated[GruConfig | ConvolutionalConfig, Field(discriminator="name")]


class CycleGanConfig(Timed):
    """A CycleGAN: alone, or behind a matched response and its inverse, which it corrects."""

    generator: PunetConfig
    discriminator: Critics
    training: TrainingConfig


class MatchingSettings(NamedTuple):
    """The parts of a recipe that make a matched response."""

    generator: ResponseConfig
    training: MatchingConfig


class Recipe(Timed):
    """Everything that determines a run except its files, its seed and its device."""

    name: str
    description: str
    peaks: Annotated[dict[str, PeakConfig], Field(min_length=1, max_length=1000)]
    preparation: PreparationConfig
    cuts: CutConfig
    generator: Annotated[PunetConfig | ResponseConfig, Field(discriminator="name")]
    discriminator: Critics | None
    residual: CycleGanConfig | None = None
    training: Annotated[TrainingConfig | MatchingConfig, Field(discriminator="method")]
    scores: ScoreConfig

    def at(self, dt_ns: float) -> Self:
        """The same recipe for pulses with a sampling period in ns.

        A U-Net without a linear part halves its windows four times, and a GRU that reads
        windows takes several samples a step: either side of the alignment has the nearest
        multiple of so many samples, and the first and last windows of the losses follow.

        Examples
        --------
        >>> from cpunet.recipes import load_recipe
        >>> [load_recipe("published").at(dt).preparation.length for dt in (16, 10, 4)]
        [800, 1280, 3200]
        """
        timed, preparation = super().at(dt_ns), self.preparation
        if isinstance(self.generator, PunetConfig) and self.generator.linear == "none":
            critic, losses, samples = self.discriminator, timed.cyclegan.training.losses, 8
            if isinstance(critic, GruConfig) and critic.view == "window":
                samples = math.lcm(samples, critic.samples_per_step)
            sides, step = (preparation.before_ns, preparation.after_ns), samples * dt_ns
            before, after = (round(ns / step) * step for ns in sides)
            whole = {"before_ns": before, "after_ns": after}
            ends = {
                "baseline_ns": losses.baseline_ns + before - preparation.before_ns,
                "tail_ns": losses.tail_ns + after - preparation.after_ns,
            }
            training = {"losses": losses.model_copy(update=ends)}
            parts = {
                "preparation": timed.preparation.model_copy(update=whole),
                "training": timed.training.model_copy(update=training),
            }
            return timed.model_copy(update=parts)
        return timed

    @property
    def networks(self) -> bool:
        """Whether networks are trained."""
        return self.residual is not None or self.training.method == "cyclegan"

    @property
    def cyclegan(self) -> CycleGanConfig:
        """The settings of a CycleGAN.

        Raises
        ------
        CpunetError
            If the recipe does not train a CycleGAN.
        """
        if self.residual is not None:
            return self.residual
        if not self.networks:
            raise CpunetError(f"recipe {self.name}: does not train a CycleGAN")
        parts = {name: getattr(self, name) for name in CycleGanConfig.model_fields}
        return CycleGanConfig(**parts)

    @property
    def matching(self) -> MatchingSettings:
        """The settings of a response matched to data.

        Raises
        ------
        CpunetError
            If the recipe does not match a response.
        """
        match self.generator, self.training:
            case ResponseConfig() as generator, MatchingConfig() as training:
                return MatchingSettings(generator, training)
        raise CpunetError(f"recipe {self.name}: fits no readout chain; give the recipe fast")

    @model_validator(mode="after")
    def _parts_belong_together(self) -> Recipe:
        network = isinstance(self.generator, PunetConfig)
        if network != isinstance(self.training, TrainingConfig):
            raise ValueError(
                "generator punet goes with training method cyclegan, others with matching"
            )
        if not network and self.preparation.align_at != "half_height":
            raise ValueError("preparation.align_at must be half_height for a matched response")
        if network != (self.discriminator is not None):
            raise ValueError("a discriminator is needed for punet, and for it alone")
        if network and self.residual is not None:
            raise ValueError("a residual goes with a response, not with punet")
        if not network and self.residual is None:
            return self
        if (self.cyclegan.generator.linear == "solved") == network:
            raise ValueError("generator.linear must be solved in a residual, and only in it")
        critic = self.cyclegan.discriminator
        windows = isinstance(critic, GruConfig) and critic.view == "window"
        if windows and self.cyclegan.generator.linear != "none":
            raise ValueError("discriminator.view must be spread behind a linear part")
        losses, window = self.cyclegan.training.losses, self.preparation
        covered = losses.baseline_ns + losses.rising_edge_ns + losses.tail_ns
        length = window.before_ns + window.after_ns
        if abs(covered - length) > 1e-6 * length:
            raise ValueError(
                f"the loss windows cover {covered:g} ns, a prepared pulse has {length:g} ns"
            )
        return self
