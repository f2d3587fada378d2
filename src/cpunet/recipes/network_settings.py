"""Settings of the networks: generators, discriminator, readout chains."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field, field_validator, model_validator

from cpunet.settings import Config, Fraction, Positive, Samples, Width

# parameters that stretch the simulated drift, see `cpunet.networks.response_layer`
DriftTerms = Annotated[int, Field(ge=0, le=2)]


class PunetConfig(Config):
    """The Positional U-Net (paper, section 2.2.1)."""

    name: Literal["punet"]
    width: Annotated[int, Field(ge=2, le=1024, multiple_of=2)]
    dropout: Fraction


class ResponseConfig(Config):
    """A differentiable readout chain, see `cpunet.networks.response_layer`.

    ``poles_ns`` and ``decay_us`` are initial values of free times.  ``slow_ns`` and
    ``fast_decays_us`` are fixed times whose weights are free: sums of exponentials with free
    times have long valleys in which a fit gets lost, weights have none.  ``ringing_mhz`` and
    ``ringing_ns`` are initial values of the frequency and the damping of a ringing; there is
    none if ``ringing_mhz`` is null.  With ``free_decays`` the ``fast_decays_us`` are initial
    values of free times, too.  ``drift_terms`` is the number of parameters that stretch the
    simulated drift, see `cpunet.networks.response_layer`; 0 for the drift as simulated.
    """

    name: Literal["response"]
    poles_ns: Annotated[tuple[Positive, ...], Field(min_length=1, max_length=4)]
    slow_ns: Annotated[tuple[Positive, ...], Field(max_length=100)]
    decay_us: Positive
    fast_decays_us: Annotated[tuple[Positive, ...], Field(max_length=100)]
    free_decays: bool
    ringing_mhz: Positive | None
    ringing_ns: Positive
    drift_terms: DriftTerms

    @field_validator("slow_ns", "fast_decays_us")
    @classmethod
    def _times_differ(cls, times: tuple[float, ...]) -> tuple[float, ...]:
        if len({*times}) < len(times):
            raise ValueError("times must differ")
        return times


class LearnedConfig(Config):
    """A learned step response behind a U-Net, see `cpunet.networks.learned_response`.

    ``coordinates`` is the number of parameters of the step response; with ``ringing`` there
    are more, for a ringing.  ``width`` is that of the U-Net's first layer, which is there with
    ``drift``.  Both are tried if the fit without them is poor.
    """

    name: Literal["learned"]
    coordinates: Annotated[int, Field(ge=1, le=60)]
    width: Annotated[int, Field(ge=2, le=1024, multiple_of=2)]
    ringing: bool
    drift: bool


class GruConfig(Config):
    """The GRU discriminator with attention (paper, section 2.2.2).

    The GRU takes one step per ``samples_per_step`` samples (1 in the paper); more samples
    make it that many times faster, on the same embedded samples.  The table of
    vectors spans ``value_range``, or each pulse's own minimum to maximum (the
    paper's choice, blind to the pulse height) if that is null.
    """

    name: Literal["gru"]
    embedding_rows: Annotated[int, Field(ge=2, le=100_000)]
    embedding_dim: Width
    hidden: Width
    samples_per_step: Samples
    value_range: tuple[float, float] | None

    @model_validator(mode="after")
    def _range_is_not_empty(self) -> GruConfig:
        if self.value_range is not None and not self.value_range[0] < self.value_range[1]:
            raise ValueError("value_range must go from a lower to a higher value")
        return self
