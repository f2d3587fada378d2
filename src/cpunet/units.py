"""Units of time, length and energy as files spell them."""

from __future__ import annotations

import re
import unicodedata

# A table rather than a units library: any other unit must be refused, not converted.
_POWERS = {
    "ns": {"ps": -12, "ns": -9, "us": -6, "ms": -3, "s": 0},
    "mm": {"nm": -9, "um": -6, "mm": -3, "cm": -2, "m": 0},
    "keV": {"eV": 0, "keV": 3, "MeV": 6, "GeV": 9},
}
_LONG = (
    ("electronvolts?$", "ev"),
    ("(seconds?|secs?)$", "s"),
    ("(meters?|metres?)$", "m"),
    ("^micro", "u"),
    ("^(p)ico|^(n)ano|^(m)illi(?!ev)|^(c)enti|^(k)ilo|^(m)ega|^(g)iga", r"\1\2\3\4\5\6\7"),
)


def factor(unit: str, to: str) -> float | None:
    """Factor from a unit to ns, mm or keV; None if it is no unit of that kind.

    Letters may be large or small, prefixes words, and the mu a Greek letter or a micro sign.

    Examples
    --------
    >>> factor("\u03bcs", "ns"), factor("\u00b5s", "ns"), factor("microseconds", "ns")
    (1000.0, 1000.0, 1000.0)
    >>> factor("MeV", "keV"), factor("meV", "keV"), factor("ns", "keV")
    (1000.0, None, None)
    """
    text = re.sub(r"[\s_()\[\]-]", "", unicodedata.normalize("NFKC", unit))
    if text == "meV":  # which no gamma has; small letters alone are MeV
        return None
    text = text.casefold().replace("\u03bc", "u")
    for long, short in _LONG:
        text = re.sub(long, short, text)
    powers = {name.casefold(): power for name, power in _POWERS[to].items()}
    return 10.0 ** (powers[text] - _POWERS[to][to]) if text in powers else None


def unit_names(to: str) -> str:
    """The units that `factor` has, for messages."""
    return ", ".join(sorted(_POWERS[to], key=lambda name: name != to))
