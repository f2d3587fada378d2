"""A trained run in physical quantities with their errors, and in words.

Readout chains, fitted or true, are in closed form: sums of exponentials, and numbers of them.
Parameters of a fit can be degenerate: two nearly equal poles are individually unconstrained, as
is a long decay with a fast decay, while their rise time and common decay are well determined.
Errors of derived numbers are therefore propagated with the full covariance of the parameters,
along each of its axes.
"""

from __future__ import annotations

import copy
import re
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import numpy.typing as npt
import scipy.fft
from scipy.interpolate import CubicSpline
from scipy.ndimage import uniform_filter1d

from cpunet.electronics.baseline_noise import record_samples
from cpunet.electronics.chain import Decay, Electronics, Exponentials, FloatArray, moved_apart
from cpunet.electronics.readout import noise_power
from cpunet.errors import CpunetError
from cpunet.networks.generators import ResponseGenerator
from cpunet.networks.response_layer import (
    LATE_NS,
    MIN_LEFT,
    ElectronicsResponse,
    deviation_lags,
    padded_length,
)
from cpunet.recipes.schema import PreparationConfig, ResponseConfig
from cpunet.tables import counted, percent, with_std
from cpunet.training.chain_fit import SmoothParameters, with_settings
from cpunet.training.run import Run
from cpunet.training.verdict import FitInfo, beyond, stretched

Numbers = dict[str, float]

FINE_NS = 0.5
TIMES_NS = np.arange(0, 10_000, FINE_NS)  # of step responses
_RISES = {"rise_10_90_ns": 0.1, "rise_1_99_ns": 0.01, "rise_0.1_99.9_ns": 0.001}
# Range in which a spectrum is flat, in units of half the sampling rate, and smoothing bins.
_PLATEAU, _SMOOTHED = (0.03, 0.1), 41
_MIN_SLOW = 0.005  # share of the charge below which a mean time is meaningless
_FOREVER_US = 1e9  # decay time of a chain without decay
FEW_AXES = 6  # of the errors of a deviation: the largest, and of the others relative ones
# The division of a chain into parts is degenerate, and times of slow parts and decays are
# fixed: a true part between two of them is split, which the errors do not contain.
PARTS = re.compile(r"slow_|decay_|fast_decay_")
# The parts of a chain that deviates are not what its step response consists of.
HIDDEN = ("slow_", "pole_", "decay_", "ringing", "sharpness")
_LONG_DRIFT_NS = 1000.0  # maximum lead of a slowly drifting charge over a prompt charge
WORST = 8  # maximum number of deviating moments of a fit
UNITS = {"ns": "ns", "us": "µs", "mhz": "MHz", "kev": "keV"}
_FAR = 3.0  # standard deviations

StepResponse = Callable[[npt.ArrayLike], FloatArray]
"""A step response, in units of the full charge, at times in ns after the step."""


def _pole_zeroed(step: StepResponse) -> StepResponse:
    """A step response without the decay of its late part, which becomes 1."""
    late_ns = np.linspace(*LATE_NS, 100)
    slope, level = np.polyfit(late_ns, np.log(step(late_ns)), 1)
    return lambda t_ns: step(t_ns) * np.exp(-slope * np.asarray(t_ns, float) - level)


@dataclass(frozen=True, eq=False)
class Chain:
    """A readout chain in closed form.

    Parameters
    ----------
    name
        Name in legends.
    step, undecayed
        Step response of the chain, and of the chain without its decays, which ends at 1.
    noise
        Equally spaced frequencies from 0 in MHz and noise power density in keV²/MHz; None if
        unknown.
    draws
        Deviations of the step response within its errors, see `ElectronicsResponse`.
    """

    name: str
    step: StepResponse
    undecayed: StepResponse
    noise: tuple[FloatArray, FloatArray] | None = None
    draws: CubicSpline | None = None


def chain_numbers(chain: Chain, preparation: PreparationConfig, dt_ns: float) -> Numbers:
    """Parametrisation-independent numbers, by which fitted and true chains are compared.

    Parameters
    ----------
    chain
        Fitted or true chain.
    preparation, dt_ns
        Preparation settings and sampling period in ns, which define the window in which the
        decay is visible.

    Returns
    -------
    dict
        Values by name, with the unit as suffix.  ``rise_…_ns``: rise times of the step
        response between fractions of its maximum.  ``missing_…_ns``: fraction of the charge
        that has not arrived so long after half of the rise (how late a response is as a whole
        cannot be seen in unpaired pulses), and ``overshoot``, both after the decay of its part
        from 4 to 6 µs is taken off: how much is a decay and how much late charge cannot be seen
        earlier.
        ``effective_decay_us``: from the slope of the logarithm over the fitted tail.
        ``noise_rms_kev`` and ``noise_corner_mhz``, the frequency at which the noise power falls
        to half.
    """
    step, flat = chain.step(TIMES_NS), _pole_zeroed(chain.step)
    numbers = {
        name: reaches_ns(step, 1 - low) - reaches_ns(step, low) for name, low in _RISES.items()
    }
    for time in (500, 1000):
        numbers[f"missing_{time}_ns"] = float(1 - flat(reaches_ns(step, 0.5) + time))
    numbers["overshoot"] = max(0.0, float(flat(TIMES_NS[LATE_NS[0] > TIMES_NS]).max()) - 1)
    end_ns = reaches_ns(step, 0.5) + preparation.after_ns  # aligned at half of the height
    tail_ns = np.arange(end_ns - preparation.decay_fit_ns, end_ns, dt_ns)
    slope = np.polyfit(tail_ns, np.log(np.maximum(chain.step(tail_ns), 1e-3)), 1)[0]
    if slope < 0:
        numbers["effective_decay_us"] = float(-1e-3 / slope)
    if chain.noise is None:
        return numbers
    frequency, density = chain.noise
    # frequency 0 is the baseline; the last represents half a step
    power = (density[1:-1].sum() + density[-1] / 2) * frequency[1]
    numbers["noise_rms_kev"] = float(np.sqrt(power))
    low, high = (part * frequency[-1] for part in _PLATEAU)
    plateau = np.median(density[(frequency >= low) & (frequency <= high)])
    fallen = (uniform_filter1d(density, _SMOOTHED) < 0.5 * plateau) & (frequency > high)
    if fallen.any():
        numbers["noise_corner_mhz"] = float(frequency[fallen.argmax()])
    return numbers


def reaches_ns(step: FloatArray, fraction: float) -> float:
    """Time at which a step response at `TIMES_NS` first reaches a fraction of its maximum."""
    level = fraction * step.max()
    after = max(1, int((step >= level).argmax()))
    low, high = step[after - 1], step[after]
    return FINE_NS * (after - 1 + float((level - low) / (high - low)))


def learned_chain(response: ElectronicsResponse, name: str) -> Chain:
    """The closed form of a fitted chain: a sum of exponentials, like a true chain."""
    poles, main = np.exp(response.log_poles_ns).tolist(), np.exp(response.log_decay_us).item()
    slow, fast = response.slow_weights.tolist(), response.decay_weights.tolist()
    fast_ns = [1e3 * tau for tau in response.fast_decays_us.tolist()]
    taus = moved_apart([*poles, *response.slow_ns.tolist(), 1e3 * main, *fast_ns])
    n, n_slow = len(poles), len(slow)
    slow_taus = taus[n : n + n_slow]
    undecayed = Exponentials.of_step(1.0, [-weight for weight in slow], slow_taus)
    for tau in taus[:n]:
        undecayed = undecayed * Exponentials.low_pass(tau)
    shares, decays = [1 - sum(fast), *fast], taus[n + n_slow :]
    if response.config.deviations:  # those of samples, whose decays are half a period late
        sooner = np.exp(0.5 * float(response.dt_ns) / np.array(decays))
        shares = (sooner * shares).tolist()
    whole = undecayed * Exponentials.of_step(0.0, shares, decays)
    if not response.config.deviations:
        return Chain(name, whole.step, undecayed.step)
    # a sample is the mean over its period
    time_ns = np.asarray(deviation_lags(dt_ns := float(response.dt_ns)) + 0.5) * dt_ns
    without = with_settings(response, deviations=False)
    without.sharpness[:] = 0
    padded = padded_length(2 * len(time_ns))
    both = (scipy.fft.irfft(of.transfer(padded), padded) for of in (response, without))
    deviation = np.subtract(*both)[deviation_lags(dt_ns)]
    spline = CubicSpline(time_ns, deviation)

    def inside(time: FloatArray) -> FloatArray:
        added = np.where(time < time_ns[0], 0.0, spline(time))
        return np.asarray(whole.step(time) + added)

    # later, the whole decays as at the end of the windows, see `ElectronicsResponse`
    early, late = inside(np.array(LATE_NS))
    rate = np.log(max(late / early, MIN_LEFT)) / (LATE_NS[1] - LATE_NS[0])

    def deviating(t_ns: npt.ArrayLike) -> FloatArray:
        time = np.asarray(t_ns, float)
        after = np.maximum(time - time_ns[-1], 0.0)
        return np.asarray(inside(time - after) * np.exp(rate * after))

    draws = CubicSpline(time_ns, response.deviation_draws.T)
    return Chain(name, deviating, _pole_zeroed(deviating), draws=draws)


def true_chain_of(electronics: Electronics) -> Chain:
    """The closed form of a true chain."""
    forever = Decay(fraction=1, tau_us=_FOREVER_US)
    endless = electronics.model_copy(update={"decays": (forever,)})
    name = f"true response ({electronics.name})"
    samples, dt_ns = record_samples(electronics.dt_ns), electronics.dt_ns
    power = noise_power(electronics.noise.spectrum, dt_ns, samples)
    frequency = np.asarray(np.fft.rfftfreq(samples, dt_ns * 1e-3), float)
    density = electronics.noise.rms_kev**2 * power / frequency[1]
    return Chain(name, electronics.transfer.step, endless.transfer.step, (frequency, density))


def true_parameters(electronics: Electronics) -> Numbers:
    """Parameters of a true chain under the names of `ElectronicsResponse.describe`."""
    poles = sorted(electronics.bandwidth_poles_ns, reverse=True)
    numbers = {f"pole_{i + 1}_ns": tau for i, tau in enumerate(poles)}
    # an overshoot is a slow part of negative sign
    parts = [(electronics.slow, 1), (electronics.overshoot, -1)]
    slow = [(part.tau_ns, sign * part.fraction) for part, sign in parts if part]
    numbers |= slow_numbers(slow)
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


def moved_along_axes(
    response: ElectronicsResponse,
    covariance: Sequence[Sequence[float]],
    numbers: Callable[[ElectronicsResponse], Numbers],
) -> dict[str, FloatArray]:
    r"""Changes of derived numbers of a response along each axis of its error ellipsoid.

    .. math:: \Delta_k = \tfrac{1}{2} \left(
        f(p + \sigma_k e_k) - f(p - \sigma_k e_k) \right)

    with the axes :math:`\sigma_k e_k` for the parameters :math:`p`, the decays among them in
    the coordinates of `SmoothParameters`.  The variance of a number is
    :math:`\sum_k \Delta_k^2`, and covariances are scalar products.

    Parameters
    ----------
    response
        Fitted response.
    covariance
        Covariance of its parameters, in the order of its vector.
    numbers
        Function that returns the derived numbers of a response by name.

    Returns
    -------
    dict
        Changes by name, shape (axes,), of numbers that are defined at both ends of every axis;
        empty if the covariance does not match the parameters.
    """
    ends = [(numbers(a), numbers(b)) for a, b in error_ends(response, covariance)]
    names = [n for n in (ends[0][0] if ends else ()) if all(n in a and n in b for a, b in ends)]
    return {n: np.array([0.5 * (a[n] - b[n]) for a, b in ends]) for n in names}


def error_ends(
    response: ElectronicsResponse, covariance: Sequence[Sequence[float]], *, few: bool = False
) -> list[tuple[ElectronicsResponse, ElectronicsResponse]]:
    """A response at both ends of each axis of its error ellipsoid, or of a few that matter.

    Edges have the largest errors. Those of tails are small at each sample, but all alike.
    """
    parameters, matrix = SmoothParameters(response, poles=False), np.asarray(covariance, float)
    here, deviates = parameters.vector(), response.config.deviations
    if deviates:  # draws of its deviation contain the parameters of the chain
        moves = response.deviation_draws
        if few:
            edges, rest = _largest(moves, 1.0)
            tails, _ = _largest(rest, np.linalg.norm(rest, axis=0).clip(1e-12))
            moves = np.concatenate([edges, tails])
    elif matrix.shape == (len(here), len(here)) and np.isfinite(matrix).all():
        turn = parameters.turn()
        variances, axes = np.linalg.eigh(turn @ matrix @ turn.T)
        moves = (np.sqrt(np.maximum(variances, 0)) * axes).T
    else:
        return []

    def end(move: FloatArray) -> ElectronicsResponse:
        moved = copy.deepcopy(response)
        if deviates:
            moved.deviation += move
        else:
            SmoothParameters(moved, poles=False).set(here + move)
        return moved

    return [(end(move), end(-move)) for move in moves]


def _largest(draws: FloatArray, unit: FloatArray | float) -> tuple[FloatArray, FloatArray]:
    """The largest axes of draws in a unit at each lag, and what these leave of the draws."""
    among, sizes, axes = np.linalg.svd(draws / unit, full_matrices=False)
    axes = (sizes[:, np.newaxis] * axes * unit)[:FEW_AXES]
    return axes, draws - among[:, :FEW_AXES] @ axes


@dataclass(frozen=True, eq=False)
class DescribedChain:
    """The readout chain of a run, in numbers.

    Parameters
    ----------
    run, chain
        The run, and its chain in closed form with its noise.
    values, errors
        Numbers by name, with the unit as suffix (shares of the full charge have none); errors
        of the fitted quantities and of the noise.
    parameters, parameter_errors
        All parameters of the fit.
    doubts
        Reasons why these do not describe a readout alone.
    moved
        Changes of derived numbers along each axis of the error ellipsoid, see
        `moved_along_axes`.
    """

    run: Run
    chain: Chain
    values: Numbers
    errors: Numbers
    parameters: Numbers
    parameter_errors: Numbers
    doubts: list[str]
    moved: dict[str, FloatArray]


def describe_chain(run: Run) -> DescribedChain:
    """The readout chain of a run, in numbers.

    Raises
    ------
    CpunetError
        If the run has no response in closed form.
    """
    recipe, fit = run.recipe, run.fit or FitInfo()
    if not isinstance(recipe.generator, ResponseConfig):
        raise CpunetError(
            f"{run.name}: recipe {recipe.name} trains a network (or imports one), which has no "
            "response in closed form; give a run of the recipe fast, or score it with "
            "`cpunet validate`"
        )
    network = run.fill("ren", ResponseGenerator(recipe.generator, run.dt_ns))
    response, preparation = network.response, recipe.preparation
    chain = learned_chain(response, Path(run.name).name)
    aligned_ns = reaches_ns(chain.step(TIMES_NS), 0.5)
    if int(network.n_baselines):  # converted from the units of prepared pulses to keV
        noise, dt_us = network.noise, 1e-3 * network.noise.dt_ns
        # height of a full charge whose tail has the level of prepared pulses
        tail_ns = preparation.after_ns - 0.5 * preparation.tail_ns + aligned_ns
        height = preparation.tail_level / float(chain.step(tail_ns))
        frequency = np.asarray(np.fft.rfftfreq(noise.samples, dt_us), float)
        # both signs of the frequency
        chain = replace(chain, noise=(frequency, 2 * dt_us * noise.density / height**2))
    parameters = response.describe()

    def derived(moved: ElectronicsResponse, own: Chain | None = None) -> Numbers:
        numbers = chain_numbers(own or learned_chain(moved, ""), preparation, run.dt_ns)
        if moved.config.deviations:
            return numbers
        slow = list(zip(moved.slow_ns.tolist(), moved.slow_weights.tolist(), strict=True))
        return slow_numbers(slow) | numbers

    hidden = "slow_" if "deviation" not in parameters else HIDDEN
    values = {n: v for n, v in parameters.items() if not n.startswith(hidden)}
    values |= derived(response, chain)
    if fit.chi_square_per_moment is not None:
        values["chi_square_per_moment"] = fit.chi_square_per_moment
    errors = {  # of the fit; those of times are of their logarithms
        name: (value if label.startswith("log_") else 1.0) * fit.errors[label]
        for name, (label, value) in response.named().items()
        if label in fit.errors
    }
    moved = moved_along_axes(response, fit.covariance, derived)
    errors |= {name: float(np.sqrt(sum(changes**2))) for name, changes in moved.items()}
    of_values = {n: e for n, e in errors.items() if n in values and not PARTS.match(n)}
    error, rms = fit.noise.get("rms_error"), fit.noise.get("rms")
    if error and rms and chain.noise is not None:
        # of the baselines, and of the height of a full charge
        end_ns = aligned_ns + preparation.after_ns
        sooner, at_once = (float(chain.step(end_ns + t)) for t in (_LONG_DRIFT_NS, 0.0))
        relative = float(np.hypot(error / rms, sooner / at_once - 1))
        of_values["noise_rms_kev"] = values["noise_rms_kev"] * relative
    doubts = beyond(parameters) + stretched(parameters, fit.gains)
    if response.by_height is not None:
        doubts.append("the electronics act by the height of a pulse; this is their linear part")
    if fit.causes:
        substitute = "these numbers stand in for what is wrong with the simulation, too"
        doubts.insert(0, f"the fit is {fit.verdict}; {substitute}: {fit.causes[0]}")
    return DescribedChain(run, chain, values, of_values, parameters, errors, doubts, moved)


def summary(run: Run) -> list[tuple[str, str]]:
    """Topics and texts on a run."""
    fit, where, sides, parameters = run.fit or FitInfo(), run.name, list[str](), list[str]()
    for side in (run.sim, run.data):
        read_as = ", ".join(f"{n} {v}" for n, v in side.read_as.items())
        text = f"{side.file}" + (f" ({read_as})" if read_as else "")
        text += f": {side.used} of {side.read} pulses used"
        lost = counted(side.rejections)
        text += f", left out {lost}" if lost else ""
        sides.append("" if side.file is None else text)
    for name, value in fit.parameters.items():
        name = name.replace("drift_stretch_per_us", "drift-time scale, per µs")
        name = name.replace("drift_stretch", "drift-time scale")
        stem, _, unit = name.rpartition("_")
        shown = f" {UNITS[unit]}" if unit in UNITS else ""
        called = (stem if shown else name).replace("_", " ")
        number = f"{called} {value:.4g}{shown}"
        if re.fullmatch(r"(slow|decay)_\d\S*_(ns|us)|deviation|drift-.*", name):
            number = f"{called}{shown} {percent(100 * value)}"  # a share of the charge
        parameters.append(number)
    worst = sorted(fit.pulls, key=lambda name: -abs(fit.pulls[name]))[:WORST]
    off = (f"{name} {fit.pulls[name]:+.1f} σ" for name in worst if abs(fit.pulls[name]) > _FAR)
    started = run.started[:16].replace("T", " ") + ", " * bool(run.started)
    when = f"{started}{run.seconds:.4g} s on {run.device}"
    taken = "ns, half rise of a step; translated pulses have it taken off t0"
    lines = [
        ("run", where),
        ("trained", f"recipe {run.recipe.name} on {run.peak}, seed {run.seed}; {when}"),
        ("simulated", sides[0]),
        ("measured", sides[1]),
        ("fit", fit.verdict),
        ("off", ", ".join(off)),
        *(("cause", cause) for cause in fit.causes),
        ("response", ", ".join(parameters)),
        ("delay", f"{fit.delay_ns:.1f} {taken}" if fit.delay_ns else ""),
    ]
    if "baselines" in fit.noise:
        size = ""
        with suppress(CpunetError):  # no chain
            chain = describe_chain(run)
            kev, error = (of.get("noise_rms_kev") for of in (chain.values, chain.errors))
            size = f"{with_std(kev, error)} keV (RMS), "
        lines.append(("noise", f"{size}of {fit.noise['baselines']:.0f} baselines"))
    if fit.tails is not None and "rate_khz" in fit.tails.model_fields_set:
        lines += fit.tails.in_words()
    versions = ", ".join(f"{name} {version}" for name, version in run.versions.items())
    response = f"cpunet response {where}; " if run.recipe.generator.name == "response" else ""
    lines += [("versions", versions), ("next", f"{response}cpunet validate {where} …")]
    return [(topic, text) for topic, text in lines if text]
