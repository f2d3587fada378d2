"""Bins of a pulse parameter, from the values themselves."""

from __future__ import annotations

import hist
import numpy as np
import numpy.typing as npt

from cpunet.errors import CpunetError
from cpunet.pulses.shape_parameters import SHAPE_PARAMETERS

Values = npt.NDArray[np.float64]

MAX_BINS = 49
# Tukey's far-out fence: wide enough for both peaks of an escape line's I_max, and
# unaffected as long as less than a quarter of the events are outliers.
FENCE = 3.0


def data_axis(data: Values, max_bins: int) -> hist.axis.Regular:
    r"""Binning of a parameter from its measured values alone.

    The axis spans the data within three interquartile ranges (IQR) of the quartiles, with
    bins of the Freedman–Diaconis width

    .. math:: w = 2 \, \mathrm{IQR} / \sqrt[3]{n}

    Values outside are counted in the underflow and overflow bins.

    Parameters
    ----------
    data
        Measured values of one parameter; non-finite values are ignored.
    max_bins
        Maximum number of bins (49 in the paper).

    Raises
    ------
    CpunetError
        If no value is finite.

    Examples
    --------
    >>> import numpy as np
    >>> axis = data_axis(np.r_[np.linspace(0, 1, 1000), 1e9], max_bins=49)
    >>> axis.size, axis.edges[[0, -1]].round(3)
    (23, array([0.   , 2.252]))
    """
    finite = data[np.isfinite(data)]
    if finite.size == 0:
        raise CpunetError("the data have no finite value to bin; check the peak's selection")
    lower, upper = np.quantile(finite, [0.25, 0.75])
    spread = upper - lower
    if spread > 0:
        low = max(finite.min(), lower - FENCE * spread)
        high = min(finite.max(), upper + FENCE * spread)
        width = 2 * spread / np.cbrt(finite.size)
        bins = int(np.clip(np.ceil((high - low) / width), 1, max_bins))
    else:
        # Half of the values are equal: one bin contains them, the others are outside.
        half_width = 1e-3 * max(abs(lower), 1.0)
        low, high, bins = lower - half_width, upper + half_width, 1
    # The last edge is exclusive, but a maximum inside the fence is not an overflow: after
    # rounding, (maximum - low) / (last edge - low) must be less than 1.
    margin = 4 * np.spacing(max(abs(low), abs(high)))
    return hist.axis.Regular(bins, low, high + margin)


def labelled(axis: hist.axis.Regular, parameter: str) -> hist.axis.Regular:
    """The same bins, with the parameter's name and label."""
    edges = axis.edges
    label = SHAPE_PARAMETERS[parameter].axis_label
    return hist.axis.Regular(axis.size, edges[0], edges[-1], name=parameter, label=label)
