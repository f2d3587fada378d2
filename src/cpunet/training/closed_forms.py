"""Readout chains in closed form: sums of exponentials, whether fitted or true."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from cpunet.electronics.chain import Decay, Electronics
from cpunet.electronics.exponentials import Exponentials, moved_apart
from cpunet.electronics.readout import noise_power
from cpunet.networks.kept_noise import NOISE_BINS
from cpunet.networks.response_generator import ResponseGenerator
from cpunet.networks.response_layer import ElectronicsResponse
from cpunet.recipes.schema import PreparationConfig
from cpunet.training.response_figure import Chain, Numbers, align_ns

_MIN_SLOW = 0.005  # share of the charge below which a mean time is meaningless
_FOREVER_US = 1e9  # decay time of a chain without decay


def learned_chain(response: ElectronicsResponse, name: str) -> Chain:
    """The closed form of a fitted chain: a sum of exponentials, like a true chain."""
    poles, main = response.log_poles_ns.exp().tolist(), response.log_decay_us.exp().item()
    slow, fast = response.slow_weights.tolist(), response.decay_weights.tolist()
    fast_ns = [1e3 * tau for tau in response.fast_times_us.tolist()]
    taus = moved_apart([*poles, *response.slow_ns.tolist(), 1e3 * main, *fast_ns])
    n, n_slow = len(poles), len(slow)
    slow_taus = taus[n : n + n_slow]
    undecayed = Exponentials.of_real(
        1 - sum(slow),
        slow_taus,
        [weight / tau for weight, tau in zip(slow, slow_taus, strict=True)],
    )
    for tau in taus[:n]:
        undecayed = undecayed * Exponentials.low_pass(tau)
    if len(response.ringing):
        undecayed = undecayed * _ringing(response)
    shares = [1 - sum(fast), *fast]
    whole = undecayed * Exponentials.decaying(shares, taus[n + n_slow :])
    return Chain(name, whole, undecayed)


def true_chain_of(electronics: Electronics) -> Chain:
    """The closed form of a true chain; its nonlinearity is left out."""
    endless = electronics.model_copy(
        update={"decays": (Decay(fraction=1, tau_us=_FOREVER_US),)}
    )
    frequency = density = None
    spectrum, dt_ns = electronics.noise.spectrum, electronics.dt_ns
    if spectrum is not None:
        samples = 2 * (NOISE_BINS - 1)
        power = noise_power(spectrum, dt_ns, samples)
        frequency = np.asarray(np.fft.rfftfreq(samples, dt_ns * 1e-3), float)
        density = electronics.noise.rms_kev**2 * power / frequency[1]
    return Chain(
        f"true response ({electronics.name})",
        electronics.transfer,
        endless.transfer,
        frequency,
        density,
    )


def with_noise(
    chain: Chain, network: ResponseGenerator, preparation: PreparationConfig
) -> Chain:
    """Add the noise, converted from the units of prepared pulses to keV."""
    noise = network.noise
    # height of a full charge whose tail has the level of prepared pulses
    tail = preparation.samples_after - 0.5 * preparation.tail_samples
    tail_ns = align_ns(chain, preparation) + tail * noise.dt_ns
    height = preparation.tail_level / float(chain.whole.step(tail_ns))
    dt_us = 1e-3 * noise.dt_ns
    return Chain(
        chain.name,
        chain.whole,
        chain.undecayed,
        np.asarray(np.fft.rfftfreq(noise.samples, dt_us), float),
        # both signs of the frequency
        2 * dt_us * noise.density / height**2,
    )


def _ringing(response: ElectronicsResponse) -> Exponentials:
    """Step response ``1 + exp(-t/damping) (a sin + b cos)``."""
    frequency_mhz, damping_ns = response.log_ringing.exp().tolist()
    sine, cosine = response.ringing.tolist()
    pole = complex(-1 / damping_ns, 2e-3 * np.pi * frequency_mhz)
    residue = 0.5 * complex(cosine, -sine) * pole
    poles = np.array([pole, pole.conjugate()])
    return Exponentials(1 + cosine, poles, np.array([residue, residue.conjugate()]))


def true_parameters(electronics: Electronics) -> Numbers:
    """Parameters of a true chain under the names of `ElectronicsResponse.describe`."""
    poles = sorted(electronics.bandwidth_poles_ns, reverse=True)
    numbers = {f"pole_{i + 1}_ns": tau for i, tau in enumerate(poles)}
    # an overshoot is a slow part of negative sign
    parts = [(electronics.slow, 1), (electronics.overshoot, -1)]
    numbers |= slow_numbers(
        [(part.tau_ns, sign * part.fraction) for part, sign in parts if part]
    )
    if ring := electronics.ringing:
        numbers["ringing"] = ring.fraction
        numbers["ringing_mhz"] = ring.frequency_MHz
        numbers["ringing_damping_ns"] = ring.damping_ns
    *fast, main = sorted(electronics.decays, key=lambda part: part.tau_us)
    numbers["decay_us"] = main.tau_us
    return numbers | {f"decay_{part.tau_us:g}_us": part.fraction for part in fast}


def slow_numbers(parts: Sequence[tuple[float, float]]) -> Numbers:
    """Total late share and its mean time, from times in ns and their shares."""
    total = sum(share for _, share in parts)
    numbers = {"slow_share": total}
    if abs(total) >= _MIN_SLOW:
        numbers["slow_time_ns"] = sum(tau * share for tau, share in parts) / total
    return numbers
