r"""Functions of single pulses whose means a calibration compares.

The first principal component of aligned pulses is how early their charge begins to move: their
drift time :math:`t`.  Velocities and impurities change its density, above all at its end.  The
other components :math:`c_i` and the current amplitude :math:`A` are evaluated in slices of the
drift time: what depends on it, such as the growth of the charge cloud, is thus distinguished
from what does not, the readout.  With Gaussian bins :math:`g_k` the functions are those of
`cpunet.training.comparison`, :math:`g_k(t)`, :math:`c_i\, g_k(t)`, and
:math:`g_j(\ln A)\, g_k(t)`.
"""

from __future__ import annotations

import numpy as np

from cpunet.training.aligned import Aligned, Floats, Values
from cpunet.training.comparison import SEGMENTS, Joint, gaussian_bins
from cpunet.training.pulse_sets import Sides

# Bins of the drift time, its slices, and bins of the current amplitude in each: number (half as
# many for few pulses), ranks of the first and the last, width in units of the spacing, and
# minimum width, twice the effect of noise.
DENSITY = (24, (0.01, 0.99), 1.0, 0.02)
SLICES = (8, (0.03, 0.97), 0.8, 0.05)
AMPLITUDES = (8, (0.05, 0.98), 1.0, 0.008)
OTHERS, FEW = 6, 700  # components in each slice; few pulses


class SlicedJoint(Joint):
    """Differences of both sides in slices of drift time, for any response.

    Parameters
    ----------
    sides, wider
        See `cpunet.training.comparison.Joint`.
    band
        Energies of the pulses, if these are several bands.
    """

    def __init__(self, sides: Sides, wider: float = 1.0, band: str = "") -> None:
        super().__init__(sides, wider)
        self.band = band
        drift = self._shape(sides.data)[:, -1]
        amplitude, parts = sides.data.log_amplitude, 2 if len(drift) < FEW else 1
        self._bands = []
        for values, (n, ranks, factor, least) in (
            (drift, DENSITY),
            (drift, SLICES),
            (amplitude, AMPLITUDES),
        ):
            centres = np.quantile(values, np.linspace(*ranks, n // parts))
            gaps = np.diff(centres)
            # the density ends abruptly at the longest drift times
            between = np.concatenate([gaps[:1], np.minimum(gaps[1:], gaps[:-1]), gaps[-1:]])
            self._bands.append((centres, wider * np.maximum(factor * between, least)))

    @property
    def names(self) -> dict[str, list[str]]:
        """Names of the functions by group, both beginning with the band of several."""
        times, n = np.array_split(self.sides.time_ns, SEGMENTS), self.matrix.shape[1] - SEGMENTS
        components = [f"component {i}" for i in range(n, 0, -1)]
        bins = [f"current amplitude, bin {k + 1}" for k in range(len(self.places))]
        products = [f"{c}, {bin_}" for bin_ in bins if self.products for c in components]
        density, slices, amplitudes = (range(1, len(c) + 1) for c, _ in self._bands)
        sliced = [f"component {c}" for c in range(2, OTHERS + 2)]
        several = [f"current amplitude, bin {j}" for j in amplitudes]
        groups = {
            "samples": [f"samples about {t[len(t) // 2]:.0f} ns" for t in times],
            "components": components,
            "current amplitude": bins,
            "components with current amplitude": products,
            "drift time": [f"drift time, bin {k}" for k in density],
            "components in slices": [f"{c}, slice {k}" for c in sliced for k in slices],
            "current amplitude in slices": [f"{b}, slice {k}" for b in several for k in slices],
        }
        band = f"{self.band}: " if self.band else ""
        return {
            f"{band}{of}": [f"{band}{name}" for name in own]
            for of, own in groups.items()
            if own
        }

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
