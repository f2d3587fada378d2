r"""What the finite number of simulated events does to a fit, and to its errors.

Deviations :math:`r` and derivatives :math:`J` are means over the same simulated events, so
their sampling errors go together. At the true parameters the mean of :math:`J^T r` is then not
zero but some :math:`N_r`, and :math:`J^T J` is too large by the noise :math:`N_J` of the
derivatives: along weak directions a fit is biased, and its errors are too small (statisticians
call it the problem of many weak instruments). The spread between parts of the events tells
both. With priors :math:`P` and :math:`H = J^T J - N_J + P`, a fit is moved by
:math:`H^{-1} N_r`, and its covariance is :math:`H^{-1} (J^T J + P) H^{-1}`.

The weights have sampling errors, too: they are the inverse covariance of :math:`d` functions,
from :math:`n` pulses. They scatter :math:`p` parameters further, and make errors too small: the
covariance's :math:`J^T J`, but not its :math:`P`, grows by a factor (Dodelson and Schneider,
Phys. Rev. D 88 (2013) 063537; Percival et al., MNRAS 439 (2014) 2531).
"""

from __future__ import annotations

import numpy as np

from cpunet.calibration.nuisances import Values

# Largest share of the information along a direction that is taken for noise: the parts of the
# events do not determine a larger share well enough.
MOST = 0.9


def of_parts(
    jacobian: Values, slopes: Values, deviations: Values, factor: float = 1.0
) -> tuple[Values, Values]:
    """Move of fitted parameters without sampling noise, and their covariance.

    Parameters
    ----------
    jacobian
        Derivatives of all residuals and priors, shape (residuals, parameters); those of means
        over events first.
    slopes
        Derivatives of the residuals that are means over events, from each of several equal
        parts of the events, shape (parts, means, parameters).
    deviations
        These residuals from each part, shape (parts, means).
    factor
        Of the variances that these residuals have, but not the priors.
    """
    parts = len(slopes)
    slopes, deviations = slopes - slopes.mean(axis=0), deviations - deviations.mean(axis=0)
    noise = np.einsum("kij,kil->jl", slopes, slopes) / (parts * (parts - 1))
    gradient = np.einsum("kij,ki->j", slopes, deviations) / (parts * (parts - 1))
    means, whole = jacobian[: slopes.shape[1]], jacobian.T @ jacobian
    inverse = np.linalg.inv(np.linalg.cholesky(whole))
    share, axes = np.linalg.eigh(inverse @ noise @ inverse.T)
    root, back = inverse.T @ axes / (1 - np.minimum(share, MOST)), axes.T @ inverse
    solve = root @ back  # the inverse of H
    covariance = solve @ (whole + (factor - 1) * means.T @ means) @ solve.T
    return solve @ gradient, covariance


def of_weights(n: float, d: float, p: int) -> float:
    """Factor of the variances of `p` parameters if `d` functions are weighted by `n` pulses.

    Examples
    --------
    >>> [round(of_weights(n, 86, 16), 2) for n in (950, 10_000)]
    [1.19, 1.02]
    """
    return n / (n - d) * (1 + max(0.0, d - p) / (n - d))
