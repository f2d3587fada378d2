"""A trained run in physical quantities with their errors, and in words."""

from __future__ import annotations

import re
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from cpunet.electronics.chain import FloatArray
from cpunet.errors import CpunetError
from cpunet.networks.generators import ResponseGenerator
from cpunet.networks.response_layer import ElectronicsResponse
from cpunet.pulses.loading import SideInfo
from cpunet.recipes.schema import ResponseConfig
from cpunet.tables import counted, percent, with_std
from cpunet.training.closed_forms import (
    TIMES_NS,
    Chain,
    Numbers,
    chain_numbers,
    learned_chain,
    moved_along_axes,
    reaches_ns,
    slow_numbers,
    with_noise,
)
from cpunet.training.run import Run
from cpunet.training.verdict import FitInfo

# The division of a chain into parts is degenerate, and times of slow parts and decays are
# fixed: a true part between two of them is split, which the errors do not contain.
PARTS = re.compile(r"slow_|decay_|fast_decay_")
# The parts of a chain that deviates are not what its step response consists of.
HIDDEN = ("slow_", "pole_", "decay_", "ringing", "sharpness")
_LONG_DRIFT_NS = 1000.0  # maximum lead of a slowly drifting charge over a prompt charge
# Limits of the fraction of charge that arrives late; an overshoot makes it a few percent
# negative.
MAX_NEGATIVE, MAX_SLOW = -0.25, 0.5
DRIFT = {1: "drift-time scale", 2: "its change with time"}  # by number of terms
WORST = 8  # maximum number of deviating moments of a fit
UNITS = {"ns": "ns", "us": "µs", "mhz": "MHz", "kev": "keV"}
_FAR = 3.0  # standard deviations


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
    if int(network.n_baselines):
        chain = with_noise(chain, network, preparation)
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
        aligned_ns = reaches_ns(chain.step(TIMES_NS), preparation.align_fraction)
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


def beyond(parameters: Mapping[str, float]) -> list[str]:
    """Properties of a fitted chain that no readout has, in words.

    Parameters
    ----------
    parameters
        Parameters from `ElectronicsResponse.describe`.

    Examples
    --------
    >>> beyond({"pole_1_ns": 40.0, "slow_100_ns": -0.5, "slow_400_ns": -0.2})
    ['70 % of the charge would arrive too early, which electronics cannot cause; see the fit']
    """
    if "deviation" in parameters:  # the parts of its chain are not what it consists of
        return []
    slow = sum(value for name, value in parameters.items() if name.startswith("slow_"))
    if MAX_NEGATIVE <= slow <= MAX_SLOW:
        return []
    how = "late, as of slower pulses than simulated"
    if slow < 0:
        how = "too early, which electronics cannot cause"
    return [f"{100 * abs(slow):.0f} % of the charge would arrive {how}; see the fit"]


def stretched(parameters: Mapping[str, float], gains: Mapping[str, str] = {}) -> list[str]:
    """Say in words that the simulated drift was stretched, if it was, and what that may mean.

    Parameters
    ----------
    parameters
        Parameters from `ElectronicsResponse.describe`.
    gains
        What held-out pulses say of each part that was tried.

    Examples
    --------
    >>> print(stretched({"drift_stretch": 0.052})[0])
    charges drift for 5.2 % longer than simulated, as in a warmer detector, at a lower bias or \
with other impurities: cpunet calibrate tells which
    """
    if (stretch := parameters.get("drift_stretch")) is None:
        return []
    change = parameters.get("drift_stretch_per_us", 0.0)
    late, early = (
        f"{100 * abs(of):.1f} % {'longer' if of > 0 else 'shorter'}"
        for of in (stretch, stretch + change)
    )
    size = f"charges drift for {early} than simulated"
    if change:
        size += f" in the last microsecond, {late} near its end"
    if (gain := gains.get(DRIFT[1], "").partition("; ")[2]) != "":
        size += f" ({gain})"
    how = ("warmer", "a lower") if stretch > 0 else ("colder", "a higher")
    cause = "{} detector, at {} bias".format(*how)
    return [f"{size}, as in a {cause} or with other impurities: cpunet calibrate tells which"]


def summary(run: Run) -> list[tuple[str, str]]:
    """Topics and texts on a run."""
    fit, where = run.fit or FitInfo(), run.name
    worst = sorted(fit.pulls, key=lambda name: -abs(fit.pulls[name]))[:WORST]
    off = (f"{name} {fit.pulls[name]:+.1f} σ" for name in worst if abs(fit.pulls[name]) > _FAR)
    when = f"{run.started[:16].replace('T', ' ')}, {run.seconds:.4g} s on {run.device}"
    taken = "ns, half rise of a step; translated pulses have it taken off t0"
    lines = [
        ("run", where),
        ("trained", f"recipe {run.recipe.name} on {run.peak}, seed {run.seed}; {when}"),
        ("simulated", _side(run.sim)),
        ("measured", _side(run.data)),
        ("fit", fit.verdict),
        ("off", ", ".join(off)),
        *(("cause", cause) for cause in fit.causes),
        ("response", ", ".join(_parameter(*item) for item in fit.parameters.items())),
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


def _side(side: SideInfo) -> str:
    if side.file is None:
        return ""
    read_as = ", ".join(f"{n} {v}" for n, v in side.read_as.items())
    text = f"{side.file}" + (f" ({read_as})" if read_as else "")
    text += f": {side.used} of {side.read} pulses used"
    lost = counted(side.rejections)
    return f"{text}, left out {lost}" if lost else text


def _parameter(name: str, value: float) -> str:
    """A parameter of a readout chain; ``slow_100_ns`` and such are shares of the charge."""
    name = name.replace("drift_stretch_per_us", "drift-time scale, per µs")
    name = name.replace("drift_stretch", "drift-time scale")
    stem, _, unit = name.rpartition("_")
    shown = f" {UNITS[unit]}" if unit in UNITS else ""
    called = (stem if shown else name).replace("_", " ")
    if re.fullmatch(r"(slow|decay)_\d\S*_(ns|us)|deviation|drift-.*", name):
        return f"{called}{shown} {percent(100 * value)}"
    return f"{called} {value:.4g}{shown}"
