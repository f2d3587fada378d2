"""Survival of gamma lines and of the continuum after the A/E cut, by energy range.

Under a gamma line there is background, mostly Compton events of other lines, which the cut
removes more or less than the events of the line.  It is estimated from sidebands and
subtracted.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import pairwise
from typing import Any

import numpy as np
import numpy.typing as npt

from cpunet.errors import CpunetError
from cpunet.validation.a_over_e import sideband_survival, survival_error

Values = npt.NDArray[np.float64]
Range = tuple[float, float]


def peak_survival(
    amplitude: Values,
    energy_kev: Values,
    cut: float,
    peak: Range,
    sidebands: Sequence[Range] = (),
) -> dict[str, Any]:
    """Survival of a gamma line after a low-A/E cut, with its background subtracted.

    Without sidebands, as for a range of the continuum, nothing is subtracted.

    Parameters
    ----------
    amplitude, energy_kev
        Current amplitude and energy in keV of each event, shape ``(n,)``.
    cut
        Lowest amplitude that survives.
    peak
        Range of the line in keV: lower end (included) and upper end (excluded).
    sidebands
        Ranges in keV beside the line that contain only background.

    Returns
    -------
    dict
        JSON-ready: ``survival`` and ``survival_std`` in percent (without the error of the
        cut); ``peak``, ``peak_pass``, ``sideband``, ``sideband_pass``, the numbers of events
        in the ranges and of those that survive; ``scale``, the width of the peak's range over
        that of the sidebands; ``undefined``, events in the ranges without a finite amplitude,
        which are not counted.  If the survival is undefined, ``missing`` with the reason.

    Raises
    ------
    CpunetError
        If a range is empty or overlaps another, or the arrays differ in length.
    """
    if amplitude.shape != energy_kev.shape:
        raise CpunetError(
            f"{len(amplitude)} amplitudes beside {len(energy_kev)} energies; give one for each"
        )
    _check_ranges([peak, *sidebands])
    finite = np.isfinite(amplitude)
    in_peak = _within(energy_kev, [peak])
    beside = _within(energy_kev, sidebands)
    survives = finite & (np.where(finite, amplitude, -np.inf) >= cut)
    counts = {
        "peak": int((finite & in_peak).sum()),
        "peak_pass": int((survives & in_peak).sum()),
        "sideband": int((finite & beside).sum()),
        "sideband_pass": int((survives & beside).sum()),
    }
    width = sum(high - low for low, high in sidebands)
    scale = (peak[1] - peak[0]) / width if width else 0.0
    result: dict[str, Any] = {
        **counts,
        "scale": scale,
        "undefined": int((~finite & (in_peak | beside)).sum()),
    }
    return result | _survival(counts, scale, peak, cut)


def survival_by_range(
    amplitude: Mapping[str, Values],
    energy_kev: Mapping[str, Values],
    cuts: Mapping[str, float],
    lines: Mapping[str, tuple[Range, Sequence[Range]]],
    continua: Mapping[str, Range],
) -> dict[str, dict[str, Any]]:
    """`peak_survival` of every line and range, by method.

    Parameters
    ----------
    amplitude, energy_kev, cuts
        Amplitudes, energies in keV and cut by method; each method has its own cut (see
        `a_over_e.ae_survival`), NaN if it has none.
    lines
        Range and sidebands of each gamma line in keV, by name.
    continua
        Ranges of the continuum in keV, by name.

    Returns
    -------
    dict
        Results of `peak_survival` by name and method.
    """
    ranges = dict(lines) | {name: (span, ()) for name, span in continua.items()}
    return {
        name: {
            method: peak_survival(values, energy_kev[method], cuts[method], span, sidebands)
            for method, values in amplitude.items()
        }
        for name, (span, sidebands) in ranges.items()
    }


def _check_ranges(ranges: Sequence[Range]) -> None:
    for low, high in ranges:
        if not low < high:
            raise CpunetError(f"range {low:g}-{high:g} keV is empty; give from < to")
    for (_, high), (low, _) in pairwise(sorted(ranges)):
        if low < high:
            raise CpunetError(f"two ranges overlap at {low:g} keV; keep sidebands off the peak")


def _within(energy_kev: Values, ranges: Sequence[Range]) -> npt.NDArray[np.bool_]:
    inside = np.zeros(len(energy_kev), bool)
    for low, high in ranges:
        inside |= (energy_kev >= low) & (energy_kev < high)
    return inside


def _survival(
    counts: Mapping[str, int], scale: float, peak: Range, cut: float
) -> dict[str, Any]:
    if not np.isfinite(cut):
        return {"missing": "there is no cut: too few events of the double-escape peak"}
    if not counts["peak"]:
        return {"missing": f"no events from {peak[0]:g} to {peak[1]:g} keV"}
    survival, std = sideband_survival(
        counts["peak_pass"], counts["peak"], counts["sideband_pass"], counts["sideband"], scale
    )
    if not np.isfinite(survival):
        return {
            "missing": f"the sidebands leave no events of {counts['peak']} "
            f"from {peak[0]:g} to {peak[1]:g} keV"
        }
    if not scale or not std:
        std = 100 * survival_error(counts["peak_pass"], counts["peak"])
    return {"survival": survival, "survival_std": std}
