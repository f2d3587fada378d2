r"""Functions of single pulses whose means a calibration compares.

The first principal component of aligned pulses is how early their charge begins to move: their
drift time :math:`t`.  Velocities and impurities change its density, above all at its end.  The
other components :math:`c_i` and the current amplitude :math:`A` are evaluated in slices of the
drift time: what depends on it, such as the growth of the charge cloud, is thus distinguished
from what does not, the readout.  With Gaussian bins :math:`g_k` the functions are those of
`cpunet.training.joint`, :math:`g_k(t)`, :math:`c_i\, g_k(t)`, and
:math:`g_j(\ln A)\, g_k(t)`.
"""

from __future__ import annotations

import numpy as np

from cpunet.training.aligned import Aligned, Floats, Values
from cpunet.training.bands import Sides
from cpunet.training.joint import SEGMENTS, Joint, gaussian_bins

# Bins of the drift time; slices of drift time; components and current amplitude bins in each.
# For few pulses, half as many.
DENSITY, SLICES, OTHERS, AMPLITUDES = 24, 8, 6, 8
FEW = 700
# Widths in units of the spacing, and minimum widths: twice the effect of noise.
NARROW, WIDE = 1.0, 0.8
MIN_DENSITY, MIN_SLICE, MIN_AMPLITUDE = 0.02, 0.05, 0.008


class SlicedJoint(Joint):
    """Differences of both sides in slices of drift time, for any response.

    Parameters
    ----------
    sides, wider
        See `cpunet.training.joint.Joint`.
    band
        Energies of the pulses, if these are several bands.
    """

    def __init__(self, sides: Sides, wider: float = 1.0, band: str = "") -> None:
        super().__init__(sides, wider)
        self.band = band
        drift = self._shape(sides.data)[:, -1]
        parts = 2 if len(drift) < FEW else 1
        # the density ends abruptly at the longest drift times
        self._bands = [
            (centres, wider * widths)
            for centres, widths in (
                _points(drift, DENSITY // parts, (0.01, 0.99), NARROW, MIN_DENSITY),
                _points(drift, SLICES // parts, (0.03, 0.97), WIDE, MIN_SLICE),
                _points(
                    sides.data.log_amplitude,
                    AMPLITUDES // parts,
                    (0.05, 0.98),
                    NARROW,
                    MIN_AMPLITUDE,
                ),
            )
        ]

    @property
    def names(self) -> dict[str, list[str]]:
        """Names of the functions by group, both beginning with the band of several."""
        times, n = np.array_split(self.sides.time_ns, SEGMENTS), self.matrix.shape[1] - SEGMENTS
        components = [f"component {i}" for i in range(n, 0, -1)]
        bins = [f"current amplitude, bin {k + 1}" for k in range(len(self.places))]
        density, slices, amplitudes = (range(1, len(c) + 1) for c, _ in self._bands)
        others = range(2, OTHERS + 2)
        groups = {
            "samples": [f"samples about {t[len(t) // 2]:.0f} ns" for t in times],
            "components": components,
            "current amplitude": bins,
            "components with current amplitude": [
                f"{component}, {bin_}" for bin_ in bins for component in components
            ],
            "drift time": [f"drift time, bin {k}" for k in density],
            "components in slices": [
                f"component {c}, slice {k}" for c in others for k in slices
            ],
            "current amplitude in slices": [
                f"current amplitude, bin {j}, slice {k}" for j in amplitudes for k in slices
            ],
        }
        if not self.products:
            del groups["components with current amplitude"]
        band = f"{self.band}: " if self.band else ""
        return {f"{band}{of}": [f"{band}{name}" for name in own] for of, own in groups.items()}

    @property
    def pairs(self) -> float:
        """Number of pulses that errors refer to: half of the harmonic mean of both sides."""
        return 1 / (1 / len(self.sides) + 1 / len(self.sides.data))

    def _functions(self, pulses: Aligned) -> Values:
        shape = self._shape(pulses)
        (density, _), (slices, _), (amplitudes, _) = self._sliced(shape, pulses)
        columns = [super()._functions(pulses), density]
        for values in (shape[:, -2 : -2 - OTHERS : -1], amplitudes):
            products = values[:, :, np.newaxis] * slices[:, np.newaxis]
            columns.append(products.reshape(len(shape), -1))
        return np.concatenate(columns, axis=1)

    def _slopes(self, pulses: Aligned, changes: Floats, of_log: Floats) -> Values:
        shape, (n, coordinates) = self._shape(pulses), of_log.shape
        (_, density), (slices, sliding), (amplitudes, turned) = self._sliced(shape, pulses)
        drift, others = changes[:, -1], slice(-2, -2 - OTHERS, -1)
        slopes = [n * super()._slopes(pulses, changes, of_log), density.T @ drift]
        moved = (turned[:, :, np.newaxis] * of_log[:, np.newaxis]).reshape(n, -1)
        for values, own in (
            (shape[:, others], changes[:, others].reshape(n, -1)),
            (amplitudes, moved),
        ):
            along = (values[:, :, np.newaxis] * drift[:, np.newaxis]).reshape(n, -1)
            each = slices.T @ own + sliding.T @ along  # (slices, values * coordinates)
            each = each.reshape(len(each), -1, coordinates).swapaxes(0, 1)
            slopes.append(each.reshape(-1, coordinates))
        return np.asarray(np.concatenate(slopes) / n)

    def _sliced(self, shape: Values, pulses: Aligned) -> list[tuple[Values, Values]]:
        """Bins of density, slices of drift time, and bins of the amplitude in these."""
        drift = shape[:, -1]
        own = (drift, drift, pulses.log_amplitude)
        return [gaussian_bins(of, *band) for of, band in zip(own, self._bands, strict=True)]


def _points(
    values: Values, n: int, range_: tuple[float, float], factor: float, least: float
) -> tuple[Values, Values]:
    """Equally populated centres, and a width for each."""
    centres = np.quantile(values, np.linspace(*range_, n))
    gaps = np.diff(centres)
    between = np.concatenate([gaps[:1], np.minimum(gaps[1:], gaps[:-1]), gaps[-1:]])
    return centres, np.maximum(factor * between, least)
