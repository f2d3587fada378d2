"""The inverse of a fitted readout chain, in closed form.

A response translates any number of simulated pulses, so that charge and record of each are
given, and so is the spectrum of its noise.  The linear map of least mean square error (LMMSE)
then follows from covariances.  The covariance of the noise is calculated: noise drawn at
random would be mistaken for signal unless it was drawn many times for each pulse.
"""

from __future__ import annotations

import numpy as np
import scipy.fft
import scipy.linalg

from cpunet.errors import CpunetError
from cpunet.networks.generators import LinearInverse, ResponseGenerator, stretch
from cpunet.networks.response_layer import padding
from cpunet.pulses.container import FloatArray, Pulses, blocks
from cpunet.pulses.preparation import prepare
from cpunet.recipes.schema import Recipe
from cpunet.training.aligned import Values
from cpunet.training.energy_bands import MIN_PULSES

# RMS, in pulse heights, of white noise added to that of the baselines: rounding to float32,
# and effects that the response does not describe.
FLOOR = 1e-5
MAX_PULSES = 4096  # maximum number of translated pulses


def fit_inverse(
    generator: ResponseGenerator,
    sim: FloatArray,
    energy_kev: Values,
    recipe: Recipe,
    *,
    seed: int,
) -> LinearInverse:
    r"""Fit the inverse of a response with its noise.

    For measured pulses :math:`x` and charge :math:`y`, the linear map of the least mean square
    error (Wiener filter; e.g. Kay, Fundamentals of Statistical Signal Processing I, ch. 12) is

    .. math:: y = \bar y + C_{yx} (C_{xx} + C_{\mathrm{noise}} + \epsilon)^{-1} (x - \bar x)

    Parameters
    ----------
    generator
        The fitted response, and the noise of the data.
    sim
        Prepared simulated windows, shape (n, samples).
    energy_kev
        Energy of each pulse, shape (n,); noise scales as 1/energy.
    recipe
        Recipe that matches a response.
    seed
        Seed of the choice of pulses, beyond `MAX_PULSES`.

    Returns
    -------
    LinearInverse
        The inverse with its weights.

    Raises
    ------
    CpunetError
        If the pulses are too few.
    """
    _, training = recipe.matching
    if len(sim) < MIN_PULSES:
        raise CpunetError(
            f"{len(sim)} simulated pulses for the inverse; {MIN_PULSES} or more are needed: "
            "select more energies (`peak`) or simulate more"
        )
    rng = np.random.default_rng(seed)
    rows = np.sort(rng.choice(len(sim), min(len(sim), MAX_PULSES), replace=False))
    # windows without noise, prepared like the data
    records = np.concatenate([generator(sim[rows[some]]) for some in blocks(len(rows))])
    if (by_height := generator.response.by_height) is not None:
        records = np.asarray(by_height(records, energy_kev[rows]), np.float32)
    # a record without noise can have equal samples at its top without being clipped
    update = {"saturation_run": records.shape[1] + 1}
    preparation, dt_ns = recipe.preparation.model_copy(update=update), generator.noise_dt_ns
    prepared = prepare(Pulses.of(records, dt_ns=dt_ns), preparation, "measured")
    if len(prepared) < MIN_PULSES:
        raise CpunetError(
            f"only {len(prepared)} of {len(rows)} translated pulses can be prepared, the "
            f"inverse needs {MIN_PULSES}: {prepared.rejections}; check the fit of the response"
        )
    # sample of the simulated pulse at sample 0 of its window
    delay = prepared.align_sample - preparation.samples_before - padding(dt_ns)[0]
    windows, used = prepared.pulses.waveforms, prepared.index
    inverse = LinearInverse(recipe.preparation.length, training)
    inverse.half_height[...] = 0.5 * np.median(windows.max(axis=1))
    sample, measured, level = inverse.region(windows)
    charge = sim[rows[used]].astype(float)
    wanted = stretch(charge, sample + delay, -inverse.before, inverse.after)
    mean_in, mean_out = measured.mean(axis=0), wanted.mean(axis=0)

    # Noise in the region, for a level of 1 and an energy of 1 keV.  The subtracted baseline and
    # the level by which a window is divided are noisy, too: the former shifts all samples
    # together, the latter scales the pulse.
    first = min(-inverse.before, inverse.baseline[0])
    samples = max(inverse.after, inverse.level[1]) - first
    density = generator.noise.density_of(max(generator.noise.samples, 2 * samples))
    correlation = scipy.linalg.toeplitz(scipy.fft.irfft(density)[:samples])
    base, top = means = np.zeros((2, samples))
    for row, (begin, stop) in zip(means, (inverse.baseline, inverse.level), strict=True):
        row[begin - first : stop - first] = 1 / (stop - begin)
    taken = np.eye(inverse.before + inverse.after, samples, -inverse.before - first)
    taken = taken - base - np.outer(mean_in, top - base)
    noise = taken @ correlation @ taken.T
    noise *= float(np.mean(energy_kev[rows] ** -2.0)) / float(level.mean()) ** 2

    measured, wanted = measured - mean_in, wanted - mean_out
    own = measured.T @ measured / len(measured) + noise
    own[np.diag_indices(len(own))] += FLOOR**2
    weights = scipy.linalg.solve(own, measured.T @ wanted / len(measured), assume_a="pos").T
    inverse.mean_in[:], inverse.mean_out[:], inverse.weights[:] = mean_in, mean_out, weights
    return inverse
