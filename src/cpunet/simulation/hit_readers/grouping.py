"""Which steps are one event of a detector: by number, by job, and by time."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

# Numbers in a row that rise, on average, in files of jobs
_LONG_RISE = 3

IntArray = npt.NDArray[np.int64]


def event_of_step(
    number: IntArray, time_ns: npt.NDArray[np.float64] | None, window_us: float
) -> IntArray:
    """Label of the event of each step; labels are arbitrary, equal within an event.

    Steps of a number are parted where none comes for `window_us` (the decays of a chain are
    simulated as one event), and where the numbering starts anew (jobs joined in one file).

    Examples
    --------
    >>> event_of_step(np.array([4, 4, 9]), np.array([0.0, 3e9, 5.0]), 10)
    array([0, 1, 2])
    >>> event_of_step(np.array([0, 1, 2, 0, 1, 2]), None, 10)
    array([0, 2, 4, 1, 3, 5])
    """
    job = _job_of_step(number)
    keys = (job, number) if time_ns is None else (time_ns, job, number)
    order = np.lexsort(keys)
    new = (np.diff(number[order]) != 0) | (np.diff(job[order]) != 0)
    if time_ns is not None:
        new |= np.diff(time_ns[order]) > 1000 * window_us
    label = np.empty(len(number), np.int64)
    label[order] = np.cumsum(np.append(0, new))[: len(number)]
    return label


def _job_of_step(number: IntArray) -> IntArray:
    """Index of the job of each step among those with its number.

    The numbers of a job rise. An event that a thread wrote in two blocks ends one such rise and
    begins another; where more come back otherwise, the numbering has started anew. Rows in
    another order, as that of time, rise and fall all the time (by two on average).
    """
    starts = np.flatnonzero(np.append(True, np.diff(number) != 0)[: len(number)])
    runs = number[starts]
    falls = np.diff(runs) < 0
    begins, ends = np.append(True, falls), np.append(falls, True)
    order = np.argsort(runs, kind="stable")
    again = np.diff(runs[order]) == 0
    again &= ~(ends[order[:-1]] & begins[order[1:]])
    job = np.zeros(len(runs), np.int64)
    if again.sum() > 1 and len(runs) >= _LONG_RISE * begins.sum():
        job[order[1:]] = np.cumsum(again)
    return np.repeat(job, np.diff(np.append(starts, len(number))))
