"""The inverse of a fitted readout chain, in closed form.

A response translates as many simulated pulses as wanted, so that both sides of each are
known, and its noise has a known spectrum.  The linear map with the least mean square error
(LMMSE) then follows from covariances.  That of the noise is calculated, not drawn: drawn
noise would have to be many times more than the pulses not to be taken for signal.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
import scipy.fft
import scipy.linalg
import torch
from torch import Tensor

from cpunet.electronics.baseline_noise import BaselineNoise, require_energies
from cpunet.electronics.finishing import blocks
from cpunet.errors import CpunetError
from cpunet.networks.linear_inverse import LinearInverse, Sizes, stretch
from cpunet.networks.response_generator import ResponseGenerator
from cpunet.networks.response_layer import PADDING_BEFORE
from cpunet.pulses.container import FloatArray, Pulses
from cpunet.pulses.preparation import prepare
from cpunet.recipes.schema import Recipe
from cpunet.training.moments import MIN_N

Values = npt.NDArray[np.float64]

# RMS, in pulse heights, of white noise beside that of the baselines: rounding to float32,
# and what the response does not describe.
FLOOR = 1e-5
MOST = 4096  # pulses that are translated for it
RECORD_SAMPLES = 8192  # of the transform from which the noise's correlations follow


def fit_inverse(
    generator: ResponseGenerator,
    sim: FloatArray,
    energy_kev: Values,
    recipe: Recipe,
    *,
    seed: int,
) -> LinearInverse:
    """Fit the inverse of a response with its noise.

    Parameters
    ----------
    generator
        The fitted response, and the noise of the data.
    sim
        Prepared simulated windows, shape (n, samples).
    energy_kev
        Of each, shape (n,): the noise goes as its inverse.
    recipe
        With a response to be matched.
    seed
        Of the choice of pulses, if there are more than `MOST`.

    Returns
    -------
    LinearInverse
        With its weights.

    Raises
    ------
    CpunetError
        If there are too few pulses, or an energy is not a positive number.
    """
    _, training = recipe.matching
    _check(sim, energy_kev)
    rng = np.random.default_rng(seed)
    rows = np.sort(rng.choice(len(sim), min(len(sim), MOST), replace=False))
    windows, delay, used = _translated(generator, sim[rows], recipe)
    inverse = LinearInverse(Sizes.of(recipe.preparation.length, training))
    inverse.half_height.fill_(0.5 * float(windows.amax(dim=1).median()))
    sample = inverse.half_sample(windows)
    measured = inverse.region(windows, sample).numpy()
    before, after = inverse.sizes.before, inverse.sizes.after
    charge = torch.from_numpy(sim[rows[used]])
    wanted = stretch(charge, sample + delay, -before, after).double().numpy()
    _, level = inverse.base_and_level(windows, sample)
    noise = _noise_covariance(generator.noise, inverse.sizes, measured.mean(axis=0))
    noise *= float(np.mean(energy_kev[rows] ** -2.0)) / float(level.mean()) ** 2
    _regress(inverse, measured, wanted, noise)
    return inverse


def _check(sim: FloatArray, energy_kev: Values) -> None:
    if len(sim) < MIN_N:
        raise CpunetError(
            f"{len(sim)} simulated pulses for the inverse; {MIN_N} or more are needed: "
            "select more energies (--peak) or simulate more"
        )
    if energy_kev.shape != (len(sim),):
        raise CpunetError(
            f"the inverse of {len(sim)} pulses needs {len(sim)} energies; "
            f"energy_kev has shape {energy_kev.shape}"
        )
    require_energies(energy_kev)


@torch.no_grad()
def _translated(
    generator: ResponseGenerator, sim: FloatArray, recipe: Recipe
) -> tuple[Tensor, Tensor, npt.NDArray[np.int64]]:
    """Noise-free windows made as those of the data, by how much to read each pulse later.

    Returns
    -------
    tuple
        Windows (n', samples); the sample of the simulated pulse at their sample 0, (n',);
        rows of the pulses that could be prepared, (n',).
    """
    preparation = recipe.preparation
    records = torch.cat([generator(torch.from_numpy(sim[rows])) for rows in blocks(len(sim))])
    # a record without noise may well have equal samples at its top; none is clipped
    config = preparation.model_copy(update={"saturation_run": records.shape[1] + 1})
    dt_ns = float(generator.response.dt_ns)
    prepared = prepare(Pulses.of(records.numpy(), dt_ns=dt_ns), config, "measured")
    if len(prepared) < MIN_N:
        raise CpunetError(
            f"only {len(prepared)} of {len(sim)} translated pulses can be prepared, the "
            f"inverse needs {MIN_N}: {prepared.rejections}; check the fit of the response"
        )
    delay = prepared.align_sample - preparation.samples_before - PADDING_BEFORE
    return torch.from_numpy(prepared.pulses.waveforms), torch.from_numpy(delay), prepared.index


def _noise_covariance(noise: BaselineNoise, sizes: Sizes, pulse: Values) -> Values:
    """Covariance that the noise has in a region, for windows and an energy of 1.

    The baseline that is subtracted has noise, and so has the level by which a window is
    divided: that moves all samples together, or scales the pulse.
    """
    first = min(-sizes.before, sizes.baseline[0])
    samples = max(sizes.after, sizes.level[1]) - first
    density = noise.density_of(max(RECORD_SAMPLES, 2 * samples))
    correlation = scipy.fft.irfft(density)[:samples]

    def mean_over(stretch: tuple[int, int]) -> Values:
        row = np.zeros(samples)
        row[stretch[0] - first : stretch[1] - first] = 1 / (stretch[1] - stretch[0])
        return row

    base, level = mean_over(sizes.baseline), mean_over(sizes.level)
    taken = np.eye(sizes.before + sizes.after, samples, -sizes.before - first)
    taken = taken - base - np.outer(pulse, level - base)
    return np.asarray(taken @ scipy.linalg.toeplitz(correlation) @ taken.T, float)


def _regress(inverse: LinearInverse, measured: Values, wanted: Values, noise: Values) -> None:
    """Put means and the least-squares weights into `inverse`."""
    mean_in, mean_out = measured.mean(axis=0), wanted.mean(axis=0)
    measured, wanted = measured - mean_in, wanted - mean_out
    own = measured.T @ measured / len(measured) + noise
    own[np.diag_indices(len(own))] += FLOOR**2
    weights = scipy.linalg.solve(own, measured.T @ wanted / len(measured), assume_a="pos").T
    for buffer, values in (
        (inverse.mean_in, mean_in),
        (inverse.mean_out, mean_out),
        (inverse.weights, weights),
    ):
        buffer.copy_(torch.from_numpy(np.ascontiguousarray(values)))
