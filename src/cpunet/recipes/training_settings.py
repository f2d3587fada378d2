"""Settings of the two training methods: a CycleGAN, and a response matched by moments."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field, model_validator

from cpunet.recipes.network_settings import DriftTerms
from cpunet.settings import Config, Count, Fraction, NonNegative, Positive, Samples

_Number = Annotated[int, Field(ge=1, le=1000)]


class LossConfig(Config):
    """Weights of the eight losses and of the three windows of the L1 terms.

    ``gradient_penalty`` weighs the mean squared gradient of the discriminators on
    real and translated pulses (Mescheder et al. 2018, arXiv:1801.04406; 0 in the
    paper): it keeps a discriminator from growing so steep that it throws the
    generators off.
    """

    baseline_len: Samples
    rising_edge_len: Samples
    tail_len: Samples
    baseline_weight: NonNegative
    rising_edge_weight: NonNegative
    tail_weight: NonNegative
    cycle_weight: NonNegative
    identity_weight: NonNegative
    adversarial_weight: NonNegative
    gradient_penalty: NonNegative


class TrainingConfig(Config):
    """Settings of the training loop.

    The final generators are running averages of the trained ones, with
    ``average_decay`` per iteration (0: the last weights, as in the paper); their
    batch-norm statistics are computed again over ``statistics_batches``.
    After a start from another run, the rates rise from zero over ``warmup`` iterations.
    ``instance_noise`` is the RMS of white noise added to all that the discriminators
    see, falling with the rates (Sønderby et al. 2017, arXiv:1610.04490; 0 in the
    paper): translations have no electronic noise, and a discriminator that recognises
    them by that alone teaches nothing about the shape.  After every
    ``checkpoint_interval`` iterations all that is needed to resume the training is saved.
    ``precision`` is that of the generators' passes; ``compiled`` fuses them by torch.compile.
    With ``noise`` from ``baselines``, the generators do not make noise: noise drawn from the
    data's own baselines is added to all that a discriminator or a score sees.
    """

    method: Literal["cyclegan"]
    iterations: Count
    decay_start: Annotated[int, Field(ge=0, le=100_000_000)]
    warmup: Annotated[int, Field(ge=0, le=100_000_000)]
    batch_size: Annotated[int, Field(ge=2, le=100_000)]
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
    precision: Literal["float32", "bf16"]
    compiled: bool
    noise: Literal["none", "baselines"]
    losses: LossConfig


class MatchingConfig(Config):
    """A response matched to data by moments, see `cpunet.training.moments`.

    Pulses are compared from ``before`` to ``after`` samples around their half maximum, with the
    mean of ``baseline`` (range of samples before it) shifted to 0 and that of the last
    ``level_samples`` scaled to the level of the preparation.  ``segments`` are the edges, in
    samples from the half maximum, of stretches whose means are compared; ``components`` is the
    number of principal components of the data, and the first ``squares`` of them are also
    squared; ``amplitude_bins`` is the number of bins of the logarithm of the current amplitude,
    no narrower than ``amplitude_width``.  Each deviation is clipped at ``clip`` robust standard
    deviations.  ``ridge`` is the fraction of the identity in the correlation matrix of all of
    these.  The valley is searched for with ``search_pulses`` of each side, in fits of at most
    ``steps`` iterations.  A fit that ends in the wrong valley is started again with the
    response's poles times the next of ``start_factors``; the best of all is kept.  If it is
    still poor, a ringing at one of ``ringing_mhz`` is tried.  If pulses begin differently than
    simulated, up to ``drift_terms`` parameters that stretch the drift are tried first.
    Each of these is kept if held-out pulses gain.  Finally, all pulses are compared with
    ``noise_sets`` draws of the noise each, optimally weighted with the components in
    ``conditional_bins`` of the current amplitude; or, if the drift was stretched, by their
    moments and by the single sites of the continuum.
    """

    method: Literal["matching"]
    before: Samples
    after: Samples
    baseline: tuple[Samples, Samples]
    level_samples: Samples
    segments: Annotated[tuple[int, ...], Field(min_length=2, max_length=1000)]
    components: _Number
    squares: _Number
    amplitude_bins: _Number
    amplitude_width: Positive
    clip: Positive
    ridge: Fraction
    search_pulses: Annotated[int, Field(ge=200, le=10_000_000)]
    conditional_bins: Annotated[int, Field(ge=2, le=1000)]
    steps: Count
    start_factors: Annotated[tuple[Positive, ...], Field(min_length=1, max_length=100)]
    ringing_mhz: Annotated[tuple[Positive, ...], Field(max_length=100)]
    drift_terms: DriftTerms
    noise_sets: _Number

    @model_validator(mode="after")
    def _stretches_fit(self) -> MatchingConfig:
        if sorted({*self.segments}) != [*self.segments]:
            raise ValueError("segments must be in rising order")
        if self.segments[0] < -self.before or self.segments[-1] > self.after:
            raise ValueError("segments must lie within before and after")
        if not self.baseline[0] > self.baseline[1]:
            raise ValueError("baseline goes from more samples before the edge to fewer")
        if self.level_samples >= self.after:
            raise ValueError("level_samples must be fewer than after")
        if self.squares > self.components:
            raise ValueError("squares must be no more than components")
        return self
