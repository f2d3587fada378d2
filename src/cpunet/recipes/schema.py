"""Every setting of a run, validated: one small class per room.

The numbers live in the YAML files beside this module; a field without a value
in the recipe that needs it is an error, and so is one that nobody reads.
"""

from __future__ import annotations

from typing import Annotated, Any, Literal, NamedTuple

from pydantic import BaseModel, ConfigDict, Field, model_validator

from cpunet.errors import CpunetError

Positive = Annotated[float, Field(gt=0)]
NonNegative = Annotated[float, Field(ge=0)]
Count = Annotated[int, Field(ge=1)]
Fraction = Annotated[float, Field(ge=0, lt=1)]


class Config(BaseModel):
    """Base of all settings: unknown keys are refused, values never change."""

    model_config = ConfigDict(extra="forbid", frozen=True)


class PeakConfig(Config):
    """A gamma line and the half-width of the energy window around it, in keV."""

    energy_kev: Positive
    half_width_kev: Positive


class PreparationConfig(Config):
    """From raw trace to the window a network sees (paper, section 3.3).

    Lengths are in samples of the record.  ``max_padding_before`` and
    ``max_padding_after`` say how many samples of a *measured* window may lie
    outside its record, and are filled with the baseline and with the last value;
    simulated pulses are padded without limit, since nothing but charge moves in
    them.  ``saturation_run`` equal samples at the top make a trace saturated.
    """

    samples_before: Count
    samples_after: Count
    align_fraction: Annotated[float, Field(gt=0, le=1)]
    baseline_samples: Count
    tail_samples: Count
    tail_level: Positive
    decay_fit_samples: Annotated[int, Field(ge=3)]
    max_padding_before: Annotated[int, Field(ge=0)]
    max_padding_after: Annotated[int, Field(ge=0)]
    saturation_run: Count

    @property
    def length(self) -> int:
        """Samples of a prepared pulse."""
        return self.samples_before + self.samples_after

    @model_validator(mode="after")
    def _fits(self) -> PreparationConfig:
        if self.baseline_samples >= self.samples_before:
            raise ValueError("baseline_samples must be fewer than samples_before")
        if max(self.tail_samples, self.decay_fit_samples) > self.samples_after:
            raise ValueError("tail_samples and decay_fit_samples must fit in samples_after")
        return self


class CutConfig(Config):
    """Half-widths of the quality cuts, in robust standard deviations of the data.

    Median and MAD of the set itself give the windows, so that no constant of
    one detector enters.
    """

    decay_sigmas: Positive
    chi2_sigmas: Positive
    baseline_sigmas: Positive


class PunetConfig(Config):
    """The Positional U-Net (paper, section 2.2.1).

    ``residual`` makes the network a correction added to its input, zero at the
    start of the training, instead of having it learn the identity first.
    """

    name: Literal["punet"]
    width: Annotated[int, Field(ge=2, multiple_of=2)]
    dropout: Fraction
    residual: bool


class ResponseConfig(Config):
    """A differentiable readout chain, see `cpunet.networks.response`.

    ``poles_ns`` and ``decay_us`` are where free times start.  ``slow_ns`` and
    ``fast_decays_us`` are fixed times whose weights are free: sums of exponentials with free
    times have long valleys in which a fit gets lost, weights have none.  ``ringing_mhz`` and
    ``ringing_ns`` are where the frequency and the damping of a ringing start; none if null.
    """

    name: Literal["response"]
    poles_ns: Annotated[tuple[Positive, ...], Field(min_length=1, max_length=4)]
    slow_ns: tuple[Positive, ...]
    decay_us: Positive
    fast_decays_us: tuple[Positive, ...]
    ringing_mhz: Positive | None
    ringing_ns: Positive


class ResidualConfig(Config):
    """A small network beside a matched response, see `cpunet.training.residual`.

    ``width`` is that of its first layer.  ``iterations`` of ``batch_size`` pulses, with a
    ``rate`` that falls to zero; the kept weights are a running average with
    ``average_decay`` per iteration.  ``projections`` are the directions along which sets are
    compared in an iteration, ``amplitude_weight`` weighs the density of the current
    amplitude, ``size_weight`` the mean square of what is added, and ``slope_weight`` that of
    its steps from sample to sample.  A ``held_out`` part of both sets judges: the distance of
    these must fall by the fraction ``least_fall``, and by more than chance.
    """

    width: Annotated[int, Field(ge=2, multiple_of=2)]
    iterations: Count
    batch_size: Annotated[int, Field(ge=16)]
    rate: Positive
    average_decay: Fraction
    projections: Count
    amplitude_weight: NonNegative
    size_weight: NonNegative
    slope_weight: NonNegative
    held_out: Annotated[float, Field(gt=0, lt=1)]
    least_fall: Fraction


class HybridConfig(ResponseConfig):
    """A readout chain with a small network beside it, see `cpunet.networks.hybrid`."""

    name: Literal["hybrid"]  # type: ignore[assignment]
    residual: ResidualConfig


class GruConfig(Config):
    """The GRU discriminator with attention (paper, section 2.2.2).

    The GRU takes one step per ``samples_per_step`` samples (1 in the paper); more
    make it that many times faster, on the same embedded samples.  The table of
    vectors spans ``value_range``, or each pulse's own minimum to maximum (the
    paper's choice, blind to the pulse height) if that is null.
    """

    name: Literal["gru"]
    embedding_rows: Annotated[int, Field(ge=2)]
    embedding_dim: Count
    hidden: Count
    samples_per_step: Count
    value_range: tuple[float, float] | None

    @model_validator(mode="after")
    def _range_is_not_empty(self) -> GruConfig:
        if self.value_range is not None and not self.value_range[0] < self.value_range[1]:
            raise ValueError("value_range must go from a lower to a higher value")
        return self


class LossConfig(Config):
    """Weights of the eight losses and of the three windows of the L1 terms.

    ``gradient_penalty`` weighs the mean squared gradient of the discriminators on
    real and translated pulses (Mescheder et al. 2018, arXiv:1801.04406; 0 in the
    paper): it keeps a discriminator from growing so steep that it throws the
    generators off.
    """

    baseline_len: Count
    rising_edge_len: Count
    tail_len: Count
    baseline_weight: NonNegative
    rising_edge_weight: NonNegative
    tail_weight: NonNegative
    cycle_weight: NonNegative
    identity_weight: NonNegative
    adversarial_weight: NonNegative
    gradient_penalty: NonNegative


class TrainingConfig(Config):
    """The loop: how long, how fast, how often.

    The generators that are kept are running averages of the trained ones, with
    ``average_decay`` per iteration (0: the last weights, as in the paper); their
    batch-norm statistics are taken anew over ``statistics_batches``.
    ``instance_noise`` is the RMS of white noise added to all that the discriminators
    see, falling with the rates (Sønderby et al. 2017, arXiv:1610.04490; 0 in the
    paper): translations carry no electronic noise, and a discriminator that can tell
    them by that alone teaches nothing about the shape.  After every
    ``checkpoint_interval`` iterations all that a training needs to go on is stored.
    """

    method: Literal["cyclegan"]
    iterations: Count
    decay_start: Annotated[int, Field(ge=0)]
    batch_size: Annotated[int, Field(ge=2)]
    rate_generators: Positive
    rate_discriminators: Positive
    betas: tuple[Fraction, Fraction]
    weight_decay: NonNegative
    max_grad_norm: Positive
    discriminator_interval: Count
    instance_noise: NonNegative
    average_decay: Fraction
    statistics_batches: Count
    log_interval: Count
    checkpoint_interval: Count
    losses: LossConfig


class MatchingConfig(Config):
    """A response matched to data by moments, see `cpunet.training.moments`.

    Pulses are compared from ``before`` to ``after`` samples about their half maximum, once
    the mean of ``baseline`` (samples before it, from and to) is 0 and that of the last
    ``level_samples`` the level of the preparation.  ``segments`` are the edges, in samples
    from the half maximum, of stretches whose means are compared; ``components`` the principal
    components of the data that are, the first ``squares`` of them also in their squares;
    ``amplitude_bins`` the bins of the logarithm of the current amplitude, no narrower than
    ``amplitude_width``.  Each deviation is clipped at ``clip`` robust standard deviations.
    ``ridge`` is the share of a diagonal matrix added to the correlations of all of these.
    ``max_pulses`` bounds the sets, ``steps`` the iterations of a fit.  A fit that ends in the
    wrong valley is begun again with the response's poles times the next of
    ``start_factors``; the best of all is kept.  If it is still poor, a ringing is looked for at
    ``ringing_mhz``.  The last steps average over up to ``noise_sets`` draws of the noise, if
    there are so few pulses that ``max_pulses`` allows it.
    """

    method: Literal["matching"]
    before: Count
    after: Count
    baseline: tuple[Count, Count]
    level_samples: Count
    segments: tuple[int, ...]
    components: Count
    squares: Count
    amplitude_bins: Count
    amplitude_width: Positive
    clip: Positive
    ridge: Fraction
    max_pulses: Annotated[int, Field(ge=100)]
    steps: Count
    start_factors: Annotated[tuple[Positive, ...], Field(min_length=1)]
    ringing_mhz: tuple[Positive, ...]
    noise_sets: Count

    @property
    def iterations(self) -> int:
        """The most steps of the training: every start, a ringing, and two last fits."""
        return self.steps * (len(self.start_factors) + 3)

    @model_validator(mode="after")
    def _stretches_fit(self) -> MatchingConfig:
        first, *rest = self.segments
        if sorted({*self.segments}) != [*self.segments] or not rest:
            raise ValueError("segments must be two samples or more, in rising order")
        if first < -self.before or rest[-1] > self.after:
            raise ValueError("segments must lie within before and after")
        if not self.baseline[0] > self.baseline[1]:
            raise ValueError("baseline goes from more samples before the edge to fewer")
        if self.level_samples >= self.after:
            raise ValueError("level_samples must be fewer than after")
        if self.squares > self.components:
            raise ValueError("squares must be no more than components")
        return self


class ScoreConfig(Config):
    """Histograms and resampling of the comparison of two distributions.

    ``sideband_kev`` are the nearest and farthest distances from a line at which there is
    nothing but its background, and ``continuum_kev`` named ranges without lines, from and to:
    the survival of an A/E cut is told for them too.
    """

    max_bins: Annotated[int, Field(ge=2)]
    bootstraps: Annotated[int, Field(ge=2)]
    drift_start_fraction: Annotated[float, Field(gt=0, lt=1)]
    edge_samples: Count
    sideband_kev: tuple[Positive, Positive]
    continuum_kev: dict[str, tuple[Positive, Positive]]

    @model_validator(mode="after")
    def _ranges_are_not_empty(self) -> ScoreConfig:
        ranges = {"sideband_kev": self.sideband_kev, **self.continuum_kev}
        for name, (low, high) in ranges.items():
            if not low < high:
                raise ValueError(f"{name} must go from a lower to a higher energy")
        return self


class SearchConfig(Config):
    """Values of a setting that ``cpunet tune`` tries.

    Either all from ``low`` to ``high``, on a logarithmic scale if ``log``, or one of
    ``choices``.  Numbers from a whole to a whole number are whole if the setting is.
    """

    low: int | float | None = None
    high: int | float | None = None
    log: bool = False
    choices: Annotated[tuple[Any, ...], Field(min_length=2)] | None = None

    @model_validator(mode="after")
    def _one_kind(self) -> SearchConfig:
        if (self.choices is None) == (self.low is None or self.high is None):
            raise ValueError("give either low and high, or choices")
        if self.low is not None and self.high is not None:
            if not self.low < self.high:
                raise ValueError("low must be less than high")
            if self.log and self.low <= 0:
                raise ValueError("log needs low above 0")
        return self


class CycleGanSettings(NamedTuple):
    """The parts of a recipe that make a CycleGAN."""

    generator: PunetConfig
    discriminator: GruConfig
    training: TrainingConfig


class MatchingSettings(NamedTuple):
    """The parts of a recipe that make a matched response."""

    generator: ResponseConfig
    training: MatchingConfig


class Recipe(Config):
    """All that determines a run but its files, its seed and its device."""

    name: str
    description: str
    peaks: dict[str, PeakConfig]
    preparation: PreparationConfig
    cuts: CutConfig
    generator: Annotated[
        PunetConfig | ResponseConfig | HybridConfig, Field(discriminator="name")
    ]
    discriminator: GruConfig | None
    training: Annotated[TrainingConfig | MatchingConfig, Field(discriminator="method")]
    scores: ScoreConfig
    search: dict[str, SearchConfig] | None = None

    @property
    def cyclegan(self) -> CycleGanSettings:
        """The settings of a CycleGAN.

        Raises
        ------
        CpunetError
            If the recipe trains otherwise.
        """
        if not (
            isinstance(self.generator, PunetConfig)
            and isinstance(self.training, TrainingConfig)
            and self.discriminator is not None
        ):
            raise CpunetError(f"recipe {self.name}: does not train a CycleGAN")
        return CycleGanSettings(self.generator, self.discriminator, self.training)

    @property
    def matching(self) -> MatchingSettings:
        """The settings of a response matched to data.

        Raises
        ------
        CpunetError
            If the recipe trains otherwise.
        """
        if not (
            isinstance(self.generator, ResponseConfig)
            and isinstance(self.training, MatchingConfig)
        ):
            raise CpunetError(f"recipe {self.name}: does not match a response")
        return MatchingSettings(self.generator, self.training)

    @property
    def residual(self) -> ResidualConfig:
        """The settings of a network beside a response.

        Raises
        ------
        CpunetError
            If the recipe has none.
        """
        if not isinstance(self.generator, HybridConfig):
            raise CpunetError(f"recipe {self.name}: has no residual")
        return self.generator.residual

    @model_validator(mode="after")
    def _parts_belong_together(self) -> Recipe:
        network = isinstance(self.generator, PunetConfig)
        if network != isinstance(self.training, TrainingConfig):
            raise ValueError(
                "generator punet goes with training method cyclegan, the others with matching"
            )
        if network != (self.discriminator is not None):
            raise ValueError("a discriminator is needed for punet, and for it alone")
        return self

    @model_validator(mode="after")
    def _windows_cover(self) -> Recipe:
        if not isinstance(self.training, TrainingConfig):
            return self
        losses = self.training.losses
        covered = losses.baseline_len + losses.rising_edge_len + losses.tail_len
        if covered != self.preparation.length:
            raise ValueError(
                f"the loss windows cover {covered} samples, "
                f"a prepared pulse has {self.preparation.length}"
            )
        return self

    @model_validator(mode="after")
    def _networks_fit(self) -> Recipe:
        if self.discriminator is None:
            return self
        length, step = self.preparation.length, self.discriminator.samples_per_step
        if length % 16 or length % step:
            raise ValueError(
                f"a prepared pulse has {length} samples, no multiple of 16 (the generators "
                f"halve it four times) and of samples_per_step ({step})"
            )
        return self
