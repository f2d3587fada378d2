"""Low-rank approximation of a library of currents: components, and coefficients of each node.

Once aligned at their maxima, the currents of a detector differ in a few ways only.  The
components are determined from some of the templates, the error from all of them.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass, field

import numpy as np
import numpy.typing as npt
import scipy.linalg

from cpunet.errors import CpunetError
from cpunet.legend.peak_currents import PEAK

MAX_TEMPLATES = 2000  # maximum number of templates that determine the components
Floats = npt.NDArray[np.float32]


def components(templates: Floats, rank: int) -> Floats:
    """Leading principal components, without centring: orthonormal, shape ``(rank, samples)``.

    They minimise the squared error of templates of shape ``(n, samples)``.  Templates that span
    fewer dimensions have fewer components.

    Raises
    ------
    CpunetError
        If there are fewer templates than components.
    """
    if len(templates) < rank:
        raise CpunetError(
            f"`low_rank` {rank} of {len(templates)} templates; give a smaller number"
        )
    n = len(templates)
    gram = np.asarray(templates @ templates.T, np.float64)
    values, vectors = scipy.linalg.eigh(gram, subset_by_index=(n - rank, n - 1))
    kept = values > 1e-12 * values[-1]
    made = (vectors[:, kept] / np.sqrt(values[kept])).T @ templates
    # orthonormalise again, since the sums above are in single precision
    orthonormal = np.linalg.qr(made[::-1].T)[0].T
    return np.asarray(orthonormal, np.float32)


@dataclass
class Loss:
    """Error of the low-rank approximation, in units of the most frequent A/E.

    Attributes
    ----------
    largest, rms
        Largest absolute value and RMS of the differences of all samples.
    a_over_e_percent, a_over_e_rms_percent
        Largest absolute value and RMS of the relative changes of A/E, in percent.
    """

    largest: float = 0.0
    a_over_e_percent: float = 0.0
    rms: float = 0.0
    a_over_e_rms_percent: float = 0.0
    _samples: int = field(default=0, repr=False)
    _templates: int = field(default=0, repr=False)

    def add(self, templates: Floats, coefficients: Floats, basis: Floats) -> None:
        """Add templates, shape ``(n, samples)``, with coefficients ``(n, rank)``."""
        if not len(templates):
            return
        apart = coefficients @ basis - templates
        of_height = 100 * (apart[:, PEAK] / templates[:, PEAK]).astype(float)
        self.largest = max(self.largest, float(np.abs(apart).max()))
        self.a_over_e_percent = max(self.a_over_e_percent, float(np.abs(of_height).max()))
        squares = float(np.square(apart, dtype=float).sum())
        self.rms = _merged(self.rms, self._samples, squares, apart.size)
        self.a_over_e_rms_percent = _merged(
            self.a_over_e_rms_percent, self._templates, float(of_height @ of_height), len(apart)
        )
        self._samples += apart.size
        self._templates += len(apart)

    def told(self) -> dict[str, float]:
        """Errors by name."""
        return {name: v for name, v in asdict(self).items() if not name.startswith("_")}


def _merged(rms: float, n: int, squares: float, more: int) -> float:
    return float(np.sqrt((n * rms**2 + squares) / (n + more)))
