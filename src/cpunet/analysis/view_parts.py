"""Data of the interactive charts: arrays as base64, labels without TeX."""

from __future__ import annotations

import base64
import re
from collections.abc import Mapping
from typing import Any

import numpy as np
import numpy.typing as npt

from cpunet.pulses.parameters import Parameter

_TEX = {
    r"\,": "\N{NARROW NO-BREAK SPACE}",
    r"\%": "%",
    r"\mu": "µ",
    r"\tau": "τ",
    r"\sigma": "σ",
    r"\chi": "χ",
}
_LOWERED = str.maketrans("0123456789aehklmnopstx", "₀₁₂₃₄₅₆₇₈₉ₐₑₕₖₗₘₙₒₚₛₜₓ")


def plain_label(text: str) -> str:
    """Convert a label with TeX between dollar signs to plain text.

    Examples
    --------
    >>> plain_label("Current amplitude $I_{max}$")
    'Current amplitude Iₘₐₓ'
    """

    def plain(formula: re.Match[str]) -> str:
        inner = formula[1]
        for command, character in _TEX.items():
            inner = inner.replace(command, character)
        inner = re.sub(r"_(?:\{([^{}]*)\}|(.))", _lowered, inner)
        return re.sub(r"[{}\\^]", "", inner)

    return re.sub(r"\$([^$]*)\$", plain, text)


def packed(
    values: npt.ArrayLike, bits: int = 16, *, about_zero: bool = False
) -> dict[str, Any]:
    """Return an array as base64 of little-endian integers.

    ``value = offset + scale * integer``; the most negative integer represents NaN.

    Parameters
    ----------
    values
        Array of any shape; non-finite values become NaN.
    bits
        Size of the integers, 16 or 32.
    about_zero
        Whether the offset is 0, whatever the range of the values.

    Examples
    --------
    >>> packed([0.0, 1.0])["shape"]
    [2]
    """
    array = np.asarray(values, dtype=float)
    known = np.isfinite(array)
    low, high = (array[known].min(), array[known].max()) if known.any() else (0.0, 0.0)
    if about_zero:
        high = max(high, -low)
        low = -high
    top = 2 ** (bits - 1) - 1
    offset, scale = (low + high) / 2, (high - low) / 2 / top or 1.0
    integers = np.rint((np.where(known, array, offset) - offset) / scale)
    integers = np.where(known, integers, -top - 1)
    data = np.ascontiguousarray(integers.astype(f"<i{bits // 8}")).tobytes()
    return {
        "shape": list(array.shape),
        "bits": bits,
        "offset": float(offset),
        "scale": float(scale),
        "data": base64.b64encode(data).decode("ascii"),
    }


def axis_info(name: str, parameters_info: Mapping[str, Parameter]) -> dict[str, str]:
    """Return the label and the unit of a parameter, both in plain text."""
    known = parameters_info.get(name)
    if known is None:
        return {"label": name.replace("_", " ").capitalize(), "unit": ""}
    return {"label": plain_label(known.label), "unit": plain_label(known.unit)}


def _lowered(index: re.Match[str]) -> str:
    return (index[1] or index[2] or "").translate(_LOWERED)
