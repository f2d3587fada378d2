"""Times and late charge as LEGEND computes them: pole-zero corrected, by dspeed's processors.

The decay is the median one of the pulses themselves, as an analysis takes it from the tails of
a channel; pulses that do not decay are not corrected.  The height is that of a trapezoid.
"""

from __future__ import annotations

import sys
from functools import cache
from importlib.util import find_spec, module_from_spec
from threading import Lock
from typing import Any

import numpy as np
from scipy.signal import fftconvolve

from cpunet.pulses.parameters import Values

# Rise and flat top of the trapezoid, and times over which charge is compared with that later.
TRAP_NS, LATE_NS, EFFECTIVE_NS = 2000.0, 2000.0, 3000.0
T0_RISE_NS, T0_FALL_NS = 128.0, 2000.0  # of the filter that finds the begin of a pulse
_IMPORT = Lock()
SILENT = 1e-4  # heights: noise of pulses without any
FRACTIONS = {"tp_99": 0.99, "tp_90": 0.9, "tp_80": 0.8, "tp_50": 0.5, "tp_10": 0.1}


def legend_parameters(
    waveforms: Values, decay_ns: float, noise: Values, dt_ns: float, aligned: int
) -> dict[str, Values]:
    r"""Times in ns from the aligned sample, and areas over the height in ns.

    With the corrected pulse :math:`w` of height :math:`E` (`docs/parameters.md`),

    .. math:: \mathrm{LQ} = \frac{1}{E} \int_{t_{80}}^{t_{80} + 2\,\mu s}
        [w(t + 2\,\mu s) - w(t)] \, dt

    and the effective drift time is the same from :math:`t_0`, over 3 µs.

    Parameters
    ----------
    waveforms
        Prepared pulses, shape (n, samples).
    decay_ns
        Time constant of their tails; infinite if they do not decay.
    noise
        RMS of each baseline in pulse heights, shape (n,).
    dt_ns
        Sampling period in ns.
    aligned
        Sample from which times count.
    """
    with _IMPORT:
        pole_zero, interpolated_time_point_thresh, trap_norm, trap_pickoff = _processors()
    corrected = np.asarray(waveforms, float)
    if np.isfinite(decay_ns):
        corrected = pole_zero(corrected, decay_ns / dt_ns)
    half = round(TRAP_NS / dt_ns)
    trapezoid = np.empty_like(corrected)
    trap_norm(corrected, half, half, trapezoid)
    height, top = trapezoid.max(axis=1), corrected.argmax(axis=1)

    times: dict[str, Values] = {}
    last: Values = top.astype(float)
    for name, fraction in FRACTIONS.items():
        times[name] = last = interpolated_time_point_thresh(
            corrected, fraction * height, np.ceil(np.nan_to_num(last)).astype(int), 0, ord("l")
        )
    # behind dspeed's ``t0_filter``: the mean just now minus that before
    rise, fall = round(T0_RISE_NS / dt_ns), round(T0_FALL_NS / dt_ns)
    ramp = 2 * np.arange(rise, 0, -1) / (rise * (rise + 1))
    weights = np.concatenate([ramp, np.full(fall, -1 / fall)])
    filtered = fftconvolve(corrected, weights[np.newaxis], axes=1)[:, : corrected.shape[1]]
    filtered[:, : len(weights)] = 0.0  # which needs samples before the record
    threshold = np.maximum(noise, SILENT)
    times["tp_0_est"] = interpolated_time_point_thresh(
        filtered, threshold, filtered.argmax(axis=1), 0, ord("l")
    )

    areas = {}
    for name, begin, over_ns in (
        ("lq", times.pop("tp_80"), LATE_NS),
        ("dt_eff", times["tp_0_est"], EFFECTIVE_NS),
    ):
        n = round(over_ns / dt_ns)
        areas[name] = over_ns * trap_pickoff(corrected, n, 0, begin + 2 * n) / height
    times = {name: (time - aligned) * dt_ns for name, time in times.items()}
    times["rise_time"] = times["tp_90"] - times.pop("tp_10")
    return times | areas


@cache
def _processors() -> tuple[Any, ...]:
    """Dspeed's processors, without its reading of files, which takes seconds to import."""
    bare = "dspeed" not in sys.modules
    if bare and (spec := find_spec("dspeed")) is not None:
        sys.modules["dspeed"] = module_from_spec(spec)  # its folder alone, nothing is run
    try:
        from dspeed.processors.pole_zero import pole_zero
        from dspeed.processors.time_point_thresh import interpolated_time_point_thresh
        from dspeed.processors.trap_filters import trap_norm, trap_pickoff
    finally:
        for name in [m for m in sys.modules if bare and m.partition(".")[0] == "dspeed"]:
            del sys.modules[name]
    return pole_zero, interpolated_time_point_thresh, trap_norm, trap_pickoff
