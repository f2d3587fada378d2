"""A trained run in physical quantities with their errors, and in words."""

from __future__ import annotations

import re
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from cpunet.errors import CpunetError
from cpunet.networks.generators import ResponseGenerator
from cpunet.networks.response_layer import ElectronicsResponse
from cpunet.pulses.loading import SideInfo
from cpunet.recipes.schema import ResponseConfig
from cpunet.tables import counted, percent, with_std
from cpunet.training.closed_forms import (
    Chain,
    Numbers,
    chain_numbers,
    fitted_errors,
    learned_chain,
    noise_numbers,
    propagated,
    reaches_ns,
    slow_numbers,
    with_noise,
)
from cpunet.training.diagnosis import beyond, stretched
from cpunet.training.run import Run
from cpunet.training.verdict import FitInfo

# The division of a chain into parts is degenerate, and times of slow parts and decays are
# fixed: a true part between two of them is split, which the errors do not contain.
PARTS = re.compile(r"slow_|decay_|fast_decay_")
# The parts of a chain that deviates are not what its step response consists of.
HIDDEN = ("slow_", "pole_", "decay_", "ringing", "sharpness")
_LONG_DRIFT_NS = 1000.0  # maximum lead of a slowly drifting charge over a prompt charge


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
    """

    run: Run
    chain: Chain
    values: Numbers
    errors: Numbers
    parameters: Numbers
    parameter_errors: Numbers
    doubts: list[str]


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

    def derived(moved: ElectronicsResponse) -> Numbers:
        numbers = chain_numbers(learned_chain(moved, ""), preparation, run.dt_ns)
        if moved.config.deviations:
            return numbers
        slow = list(zip(moved.slow_ns.tolist(), moved.slow_weights.tolist(), strict=True))
        return slow_numbers(slow) | numbers

    errors = fitted_errors(response, fit.errors)
    errors |= propagated(response, fit.covariance, derived)
    hidden = "slow_" if "deviation" not in parameters else HIDDEN
    values = {n: v for n, v in parameters.items() if not n.startswith(hidden)}
    values |= derived(response) | noise_numbers(chain)
    if fit.chi_square_per_moment is not None:
        values["chi_square_per_moment"] = fit.chi_square_per_moment
    doubts = beyond(parameters) + stretched(parameters, fit.gains)
    if response.by_height is not None:
        doubts.append("the electronics act by the height of a pulse; this is their linear part")
    if fit.causes:
        substitute = "these numbers stand in for what is wrong with the simulation, too"
        doubts.insert(0, f"the fit is {fit.verdict}; {substitute}: {fit.causes[0]}")
    of_values = {n: e for n, e in errors.items() if n in values and not PARTS.match(n)}
    of_values |= _noise_error(run, chain)
    return DescribedChain(run, chain, values, of_values, parameters, errors, doubts)


def _noise_error(run: Run, chain: Chain) -> Numbers:
    """Error of the noise in keV, from the baselines and the height of a full charge."""
    measured = {} if run.fit is None else run.fit.noise
    error, rms = measured.get("rms_error"), measured.get("rms")
    if not error or not rms or chain.noise is None:
        return {}
    preparation = run.recipe.preparation
    end_ns = reaches_ns(chain, preparation.align_fraction) + preparation.after_ns
    sooner, at_once = (float(chain.whole.step(end_ns + t)) for t in (_LONG_DRIFT_NS, 0.0))
    kev = noise_numbers(chain)["noise_rms_kev"]
    return {"noise_rms_kev": kev * float(np.hypot(error / rms, sooner / at_once - 1))}


WORST = 8  # maximum number of deviating moments of a fit
UNITS = {"ns": "ns", "us": "µs", "mhz": "MHz", "kev": "keV"}
_FAR = 3.0  # standard deviations


def summary(run: Run) -> list[tuple[str, str]]:
    """Topics and texts on a run."""
    fit = run.fit or FitInfo()
    where = run.name
    response = f"cpunet response {where}; " if run.recipe.generator.name == "response" else ""
    when = run.started[:16].replace("T", " ")
    tails = fit.tails
    lines = [
        ("run", where),
        (
            "trained",
            f"recipe {run.recipe.name} on {run.peak}, seed {run.seed}; "
            f"{when}, {run.seconds:.4g} s on {run.device}",
        ),
        ("from", run.init or ""),
        ("simulated", _side(run.sim)),
        ("measured", _side(run.data)),
        ("fit", fit.verdict),
        ("off", _deviations(fit.pulls)),
        *(("cause", cause) for cause in fit.causes),
        ("response", _parameters(fit.parameters)),
        ("delay", _delay(fit)),
    ]
    if "baselines" in fit.noise:
        size = ""
        with suppress(CpunetError):  # no chain
            chain = describe_chain(run)
            kev, error = (of.get("noise_rms_kev") for of in (chain.values, chain.errors))
            size = f"{with_std(kev, error)} keV (RMS), "
        lines.append(("noise", f"{size}of {fit.noise['baselines']:.0f} baselines"))
    if tails is not None and "rate_khz" in tails.model_fields_set:
        lines += tails.in_words()
    versions = ", ".join(f"{name} {version}" for name, version in run.versions.items())
    lines += [("versions", versions), ("next", f"{response}cpunet validate {where} …")]
    return [(topic, text) for topic, text in lines if text]


def _delay(fit: FitInfo) -> str:
    if not fit.delay_ns:
        return ""
    return f"{fit.delay_ns:.1f} ns, half rise of a step; translated pulses have it taken off t0"


def _side(side: SideInfo) -> str:
    if side.file is None:
        return ""
    read_as = ", ".join(f"{n} {v}" for n, v in side.read_as.items())
    text = f"{side.file}" + (f" ({read_as})" if read_as else "")
    text += f": {side.used} of {side.read} pulses used"
    lost = counted(side.rejections)
    return f"{text}, left out {lost}" if lost else text


def _deviations(pulls: Mapping[str, float]) -> str:
    """Parts of the pulses that deviate, worst first."""
    worst = sorted(pulls, key=lambda name: -abs(pulls[name]))[:WORST]
    return ", ".join(f"{n} {pulls[n]:+.1f} σ" for n in worst if abs(pulls[n]) > _FAR)


def _parameters(values: Mapping[str, float]) -> str:
    """Parameters of a readout chain; ``slow_100_ns`` and such are shares of the charge."""
    words = []
    for name, value in values.items():
        name = name.replace("drift_stretch_per_us", "drift-time scale, per µs")
        name = name.replace("drift_stretch", "drift-time scale")
        stem, _, unit = name.rpartition("_")
        shown = f" {UNITS[unit]}" if unit in UNITS else ""
        called = (stem if shown else name).replace("_", " ")
        if re.fullmatch(r"(slow|decay)_\d\S*_(ns|us)|deviation|drift-.*", name):
            words.append(f"{called}{shown} {percent(100 * value)}")
        else:
            words.append(f"{called} {value:.4g}{shown}")
    return ", ".join(words)
