r"""What electronics do to a signal by its height in keV: a follower, and a curve.

No linear readout does either.  A follower (an amplifier of limited slew rate) moves to its
input :math:`y` by a part of the distance that is left,

.. math:: z_k = z_{k-1} + d\,e^{-g(|d|)}, \qquad d = y_k - z_{k-1}, \qquad g(0) = 0,

and a curve adds to the signal what depends on its height alone, as an ADC or a preamplifier
that compresses.  Both are tables.  They act on pulses with their noise, in absolute height:
a line of energy cannot determine them, a line and a continuum can.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt
from scipy.interpolate import CubicSpline

from cpunet.kernels import kernel
from cpunet.networks import Stored

Floats = npt.NDArray[np.floating[Any]]

LAG_KNOTS, PER_STEP = 17, 6.0  # knots of the follower, and how many within the largest step
CURVE_KNOTS = 41
FINE, SLEWED = 8, 1.5  # table points per knot; largest steps whose slew rate is given


class ByHeight(Stored):
    """Follower and curve, which begin as nothing.

    Attributes
    ----------
    step_kev, top_kev
        Largest step from sample to sample and largest height of the pulses, to which the tables
        refer.
    lag
        Logarithm of what a step is divided by, at knots, the first of which stays 0.
    curve
        What is added, in units of `top_kev`, at knots; 0 at both ends.

    Examples
    --------
    A follower that moves by half of a step, and no curve:

    >>> circuit = ByHeight()
    >>> circuit.step_kev[...], circuit.top_kev[...] = 100.0, 2000.0
    >>> circuit.lag[1:] = np.log(2)
    >>> circuit(np.array([[0.0, 0.2, 0.2]]), np.array([1000.0])).round(2).tolist()
    [[0.0, 0.1, 0.15]]
    """

    def __init__(self) -> None:
        self.step_kev, self.top_kev = np.array(1.0), np.array(1.0)
        self.lag, self.curve = np.zeros(LAG_KNOTS), np.zeros(CURVE_KNOTS)

    def __call__(
        self,
        records: Floats,
        energy_kev: npt.NDArray[np.float64],
        noise: Floats | float = 0.0,
    ) -> Floats:
        """Pulses as they leave the electronics.

        Parameters
        ----------
        records
            In units of the charge, shape (pulses, samples).
        energy_kev
            Energy of each pulse.
        noise
            As it is in baselines, in units of the charge, shape (pulses, samples).  Baselines
            have passed the curve at a height of zero, whose slope is taken out.
        """
        kev, curve = np.asarray(energy_kev, np.float32)[:, np.newaxis], _fine(self.curve)
        slope = float(curve[1] - curve[0]) * (len(curve) - 1)  # at a height of zero
        entering = records + noise / np.float32(1 + slope)
        signal = np.asarray(entering * kev, np.float32)
        if self.lag.any():
            moved = np.exp(-_fine(self.lag))
            _follow(signal, moved, PER_STEP * FINE / float(self.step_kev))
        if self.curve.any():
            added = self.top_kev * curve
            _add(signal, added.astype(np.float32), (len(added) - 1) / float(self.top_kev))
        return np.asarray(signal / kev, records.dtype)

    def describe(self, dt_ns: float) -> dict[str, float]:
        """Rate to which `SLEWED` times the largest step is limited, and largest part added."""
        values = {}
        if self.lag.any():
            lag = np.interp(SLEWED * PER_STEP, np.arange(LAG_KNOTS), self.lag)
            values["slew_kev_per_ns"] = float(SLEWED * self.step_kev * np.exp(-lag)) / dt_ns
        if self.curve.any():
            values["nonlinearity"] = float(np.abs(self.curve).max())
        return values


def _fine(knots: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
    """Values between knots, `FINE` for each."""
    place = np.arange(len(knots))
    return np.asarray(CubicSpline(place, knots)(np.arange((len(knots) - 1) * FINE + 1) / FINE))


@kernel
def _add(signal: Any, added: Any, per_kev: float) -> None:  # pragma: no cover - compiled
    """Add what depends on the height alone, in place: a line below 0, nothing above."""
    last = len(added) - 1
    for row in range(len(signal)):
        for i in range(signal.shape[1]):
            place = signal[row, i] * per_kev
            if place < last:
                k = max(int(place), 0)
                signal[row, i] += added[k] + (place - k) * (added[k + 1] - added[k])


@kernel
def _follow(signal: Any, moved: Any, per_kev: float) -> None:  # pragma: no cover - compiled
    """Follow each signal in place; `moved` is the part of a step that is made."""
    last = len(moved) - 1
    for row in range(len(signal)):
        z = signal[row, 0]
        for i in range(1, signal.shape[1]):
            d = signal[row, i] - z
            place = abs(d) * per_kev
            k = int(place)
            if k >= last:  # no step is larger
                z += d * moved[last] * last / place
            else:
                z += d * (moved[k] + (place - k) * (moved[k + 1] - moved[k]))
            signal[row, i] = z
