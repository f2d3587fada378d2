"""Can a classifier distinguish measured pulses from simulated ones?

The classifier two-sample test (Lopez-Paz & Oquab, ICLR 2017) trains a classifier on part
of both datasets and tests on the rest how well it separates them.  An area under the ROC
curve (AUC) of 0.5 means that it sees no difference; 1 means that it is never wrong.

The classifier is a ridge regression on ±1 labels with expanded features: the pulse shape,
and products and sinusoids of its leading components.  On synthetic pulses with small
differences of width, noise or ripple it was as sensitive as a network of two layers of 32
or more units, in a fifth of the time.  Where only the spread of a width differed it was less
sensitive (AUC 0.70, 0.75).  It has no random initialisation.  Since one
factorisation serves any number of labels, the same test on shuffled labels costs almost
nothing.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from cpunet.errors import CpunetError
from cpunet.pulses.container import FloatArray, Rows, blocks
from cpunet.pulses.parameters import Values

Parameters = Mapping[str, Values]

MIN_PULSES = 40  # pulses per side: 8 in each test fold
LARGEST = 1000  # pulses per side, drawn at random: resolves an AUC to 0.013
BLOCK = 256  # pulses per block: bounds memory
FOLDS = 5
SHUFFLES = 40  # determine the spread of the null to a ninth

COMPONENTS = 30  # principal components used as features
LEADING = 12  # components whose products and sinusoids are used; all 30 would dilute them
WAVES = (1.5, 2.5)  # radians per standard deviation: between a slope and a histogram bin
OUTLIER = 5.0  # standard deviations at which features are clipped
SMALLEST = 1e-6  # pulse heights: smaller values are rounding
PENALTIES = np.geomspace(1e-4, 1e2, 13)  # per pulse, of features of variance 1 or less


@dataclass(frozen=True)
class TwoSample:
    """Outcome of `classifier_auc`.

    Attributes
    ----------
    auc, auc_std
        AUC of pulses outside the classifier's training, averaged over the folds, and its
        standard error.  The error is DeLong's, scaled by the ratio of the scatter of the
        AUCs of shuffled labels to DeLong's estimate of it (about 1.4), because the folds
        share training pulses.  It is 0 if the separation is perfect.
    null_mean, null_std
        Mean and standard deviation of the AUC for shuffled labels, which is that of two
        samples of one distribution.  The significance of a difference is
        ``(auc - null_mean) / null_std``.
    n_data, n_sim
        Numbers of pulses used.  They are equal: the larger side is subsampled.
    missing_data, missing_sim
        Numbers of pulses left out because a value is not finite.
    of_fit
        Mean increase of the AUC of two samples of one distribution by the errors of a fit.
    """

    auc: float
    auc_std: float
    null_mean: float
    null_std: float
    n_data: int
    n_sim: int
    missing_data: int
    missing_sim: int
    of_fit: float = 0.0


def classifier_auc(
    data: FloatArray,
    others: FloatArray,
    *,
    seed: int | np.random.Generator,
    features: tuple[Parameters, Parameters] | None = None,
    same_events: bool = False,
) -> TwoSample:
    """Test whether two sets of pulses can be distinguished.

    The windows are used unchanged, so both sets must be prepared in the same way.  The
    features are the principal components of both sets together, and the size and roughness
    of the remainder, which reveals missing noise.  Pulses of the same events on both sides
    would bias the AUC to below 0.5, unless both are trained on, or none.

    Parameters
    ----------
    data, others
        Prepared windows in pulse heights, measured and simulated or translated ones
        of the same peak, of shape ``(n, length)``.
    seed
        Seed of the choice of pulses, the folds and the shuffles.
    features
        Further values per pulse by name, the same ones of the data and of the others.
    same_events
        Whether each row is the same event on both sides, for which both share their folds.

    Returns
    -------
    TwoSample
        AUC in five-fold cross-validation, and its null.

    Raises
    ------
    CpunetError
        If a side has fewer than 40 pulses with only finite values.
    """
    sides, rng = (data, others), np.random.default_rng(seed)
    extras, usable = list[Values](), list[Rows]()
    for side, values in zip(sides, features or ({}, {}), strict=True):
        extras.append(np.column_stack([np.empty((len(side), 0)), *values.values()]))
        finite = np.isfinite(side).all(axis=1) & np.isfinite(extras[-1]).all(axis=1)
        usable.append(np.flatnonzero(finite))
    if same_events:
        usable = [np.intersect1d(usable[0], usable[1])] * 2
    size = min(LARGEST, *map(len, usable))
    if size < MIN_PULSES:
        both = f"{len(usable[0])} measured and {len(usable[1])} simulated pulses are usable"
        needed = f"a two-sample test needs {MIN_PULSES} of each"
        raise CpunetError(f"{both}, and {size} of each would be compared; {needed}")
    rows = [np.sort(rng.choice(own, size, replace=False)) for own in usable]
    if same_events:
        rows[1] = rows[0]
    windows = np.concatenate([s[r] for s, r in zip(sides, rows, strict=True)]).astype(float)
    extra = np.concatenate([e[r] for e, r in zip(extras, rows, strict=True)])

    # Equal numbers of both sides in each fold, in which labels are shuffled: unequal ones would
    # bias the AUC to below 0.5, since a side that is rare in the training is frequent in the
    # test.
    folds = [rng.permutation(np.arange(size) % FOLDS) for _ in range(2)]
    fold = np.concatenate([folds[0], folds[0] if same_events else folds[1]])
    labels = np.repeat(np.repeat([-1.0, 1.0], size)[:, np.newaxis], 1 + SHUFFLES, axis=1)
    for k in range(FOLDS):
        inside = np.flatnonzero(fold == k)
        labels[inside, 1:] = rng.permuted(labels[inside, 1:], axis=0)

    # AUC of the true labels and of each shuffle, and their errors for independent folds
    expanded, by_fold = _expanded(windows, extra), np.empty((2, FOLDS, 1 + SHUFFLES))
    for k in range(FOLDS):
        test = fold == k
        scores = expanded[test] @ _ridge(expanded[~test], labels[~test])
        by_label = np.argsort(labels[test], axis=0, kind="stable")
        halves = np.split(np.take_along_axis(scores, by_label, axis=0), 2)
        by_fold[:, k] = auc_and_variance(*halves)
    aucs, stds = by_fold[0].mean(axis=0), np.sqrt(by_fold[1].sum(axis=0)) / FOLDS
    null_std, delong = aucs[1:].std(ddof=1), np.sqrt((stds[1:] ** 2).mean())
    widened = max(1.0, null_std / delong) if delong > 0 else 1.0
    missing = (len(side) - len(rows) for side, rows in zip(sides, usable, strict=True))
    auc, auc_std, null_mean = float(aucs[0]), float(widened * stds[0]), float(aucs[1:].mean())
    return TwoSample(auc, auc_std, null_mean, float(null_std), size, size, *missing)


def auc_and_variance(negatives: Values, positives: Values) -> tuple[Values, Values]:
    r"""Area under the ROC curve of two sets of scores, and its variance after DeLong.

    With :math:`n` negative scores :math:`x`, :math:`m` positive scores :math:`y`, and
    :math:`\psi` equal to 1 for :math:`y > x`, 1/2 for :math:`y = x` and 0 otherwise,

    .. math:: A = \frac{1}{n m} \sum_{i, j} \psi(x_i, y_j), \qquad
        \sigma^2_A = \frac{s^2(\bar{\psi}_i)}{n} + \frac{s^2(\bar{\psi}_j)}{m}

    where :math:`\bar{\psi}_i` is the mean of :math:`\psi` over the positive scores,
    :math:`\bar{\psi}_j` the mean over the negative scores, and :math:`s^2` the sample
    variance.

    Parameters
    ----------
    negatives, positives
        Scores along the first axis, at least two of each; ties count as half.

    Returns
    -------
    tuple of numpy.ndarray
        Probability that a positive score exceeds a negative one, and the variance of this
        estimate; of the shape of one row.

    Examples
    --------
    >>> import numpy as np
    >>> auc_and_variance(np.array([[0.0], [1.0]]), np.array([[0.5], [2.0]]))
    (array([0.75]), array([0.125]))
    """
    from scipy.stats import rankdata

    n, m = len(negatives), len(positives)
    ranks = rankdata(np.concatenate([negatives, positives]), axis=0)
    # fraction of the other set over which each score is ranked correctly
    above = (ranks[n:] - rankdata(positives, axis=0)) / n
    below = 1 - (ranks[:n] - rankdata(negatives, axis=0)) / m
    variance = above.var(axis=0, ddof=1) / m + below.var(axis=0, ddof=1) / n
    return np.asarray(above.mean(axis=0)), np.asarray(variance)


def _expanded(windows: Values, extra: Values) -> Values:
    """Features of all pulses, independent of their side; the windows are overwritten.

    They are the leading principal components, log RMS of the remainder and of its differences,
    and products and sinusoids of these.  All blocks have about the same total variance, so that
    the many products do not outweigh the shape itself.
    """
    from scipy.linalg import eigh

    centred = windows
    centred -= np.median(windows, axis=0)  # in place: the array is the caller's own copy
    norms = np.linalg.norm(centred, axis=1, keepdims=True)
    # a few corrupted pulses must not determine the principal components
    limit = 3 * np.median(norms)
    weighted = centred * (limit / np.maximum(norms, limit) if limit > 0 else 1)
    squares, length = weighted.T @ weighted, windows.shape[1]
    del weighted
    first = max(0, length - COMPONENTS)
    vectors = eigh(squares, subset_by_index=[first, length - 1])[1][:, ::-1]
    components, sizes = centred @ vectors, np.empty((len(windows), 2))
    for rows in blocks(len(windows), BLOCK):
        rest = centred[rows] - components[rows] @ vectors.T
        for column, values in enumerate((rest, np.diff(rest, axis=1))):
            sizes[rows, column] = np.sqrt(np.mean(values**2, axis=1))
    rough = _standard(np.log(np.maximum(sizes, SMALLEST)))
    plain = np.column_stack([_standard(components, SMALLEST), rough, _standard(extra)])

    main = np.delete(plain, np.s_[LEADING : components.shape[1]], axis=1)
    i, j = np.triu_indices(main.shape[1])
    products = main[:, i] * main[:, j]
    waves = [np.sin(WAVES[0] * main), *(np.cos(frequency * main) for frequency in WAVES)]
    parts = [plain]
    for part in (products, np.column_stack(waves)):
        part = part - part.mean(axis=0)
        spread = part.std(axis=0)
        weight = np.sqrt(2 * main.shape[1] / part.shape[1])
        parts.append(weight * part / np.where(spread > 0, spread, 1))
    return np.concatenate(parts, axis=1)


def _standard(values: Values, smallest: float = 0.0) -> Values:
    """Columns scaled to median 0 and the quartiles of a standard normal, then clipped."""
    lower, middle, upper = np.quantile(values, [0.25, 0.5, 0.75], axis=0)
    spread = np.where(upper > lower, (upper - lower) / 1.349, values.std(axis=0))
    # a column without spread becomes 0: rounding must not be amplified to a feature
    scale = np.where(spread > smallest, spread, np.inf)
    return np.asarray(np.clip((values - middle) / scale, -OUTLIER, OUTLIER))


def _ridge(features: Values, labels: Values) -> Values:
    """Coefficients of a ridge regression on each column of `labels`.

    Each penalty minimises the leave-one-out error.  The intercept is omitted: it does not
    change the order of the scores.
    """
    n = len(features)
    centred = features - features.mean(axis=0)
    targets = labels - labels.mean(axis=0)
    eigenvalues, vectors = np.linalg.eigh(centred.T @ centred)
    rotated = centred @ vectors
    shrink = 1 / (np.maximum(eigenvalues, 0)[:, np.newaxis] + PENALTIES * n)
    leverage = rotated**2 @ shrink + 1 / n
    projected = rotated.T @ targets
    # float32 suffices to choose among penalties at factors of three
    few_digits, wanted = rotated.astype(np.float32), targets.astype(np.float32)
    errors = []
    for shrunk, h in zip(shrink.T[..., np.newaxis], leverage.T[..., np.newaxis], strict=True):
        left_out = wanted - few_digits @ (shrunk * projected).astype(np.float32)
        left_out /= (1 - h).astype(np.float32)
        errors.append(np.einsum("ij,ij->j", left_out, left_out, dtype=float))
    best = np.argmin(errors, axis=0)
    return np.asarray(vectors @ (shrink[:, best] * projected))
