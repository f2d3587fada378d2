"""What maps pulses: readouts, and the networks of CPU-Net, which need torch."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
import numpy.typing as npt

from cpunet.errors import CpunetError

Array = npt.NDArray[Any]


class Stored:
    """An object whose arrays, and those of its parts, are what a run stores of it.

    Examples
    --------
    >>> class Filter(Stored):
    ...     def __init__(self):
    ...         self.weights = np.zeros(2)
    >>> filter = Filter()
    >>> filter.fill({"weights": np.array([1, 2])})
    >>> filter.arrays()
    {'weights': array([1., 2.])}
    """

    def arrays(self) -> dict[str, Array]:
        """The arrays themselves, names of those of a part begin with its own."""
        arrays = {}
        for name, value in vars(self).items():
            if isinstance(value, np.ndarray):
                arrays[name] = value
            elif isinstance(value, Stored):
                arrays |= {f"{name}.{own}": values for own, values in value.arrays().items()}
        return arrays

    def fill(self, values: Mapping[str, Array]) -> None:
        """Set all arrays, of which each must be given in its shape."""
        for name, array in self.arrays().items():
            array[...] = values[name]


def require_torch() -> None:
    """Raise a `CpunetError` if torch is not installed, which networks need."""
    try:
        import torch  # noqa: F401
    except ModuleNotFoundError:
        raise CpunetError(
            "networks need torch, which is not installed", "pip install 'cpunet-hpge[networks]'"
        ) from None
