"""Tables and lines of text: what results print."""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping, Sequence
from typing import Any, TypeAlias

Lines: TypeAlias = Sequence[tuple[str, str]]

NO_VALUE = "–"
MAX_DIGITS = 9  # after the decimal point
ROUNDING = 1e-12  # of values of which an error is none
SHOWN = 6  # names in a list


def text_table(
    head: Sequence[str], rows: Sequence[Sequence[object]], *, words: int = 1, title: str = ""
) -> str:
    """Columns as wide as their content; the first `words` are aligned left, others right.

    Examples
    --------
    >>> print(text_table(["peak", "IoU"], [["SEP", "87.6"], ["DEP", "5.1"]]))
    peak   IoU
    SEP   87.6
    DEP    5.1
    """
    lines = [list(map(str, line)) for line in (head, *rows)]
    widths = [max(map(len, column)) for column in zip(*lines, strict=True)]
    aligned = [
        "  ".join(
            text.ljust(width) if number < words else text.rjust(width)
            for number, (text, width) in enumerate(zip(line, widths, strict=True))
        ).rstrip()
        for line in lines
    ]
    return "\n".join([title, *aligned] if title else aligned)


def aligned(lines: Lines) -> str:
    """Names and texts, a line each; those without a text are left out.

    Examples
    --------
    >>> print(aligned([("fit", "good"), ("causes", ""), ("off", "none")]))
    fit  good
    off  none
    """
    lines = [(name, text) for name, text in lines if text]
    width = max((len(name) for name, _ in lines), default=0)
    return "\n".join(f"{name:<{width}}  {text}" if width else text for name, text in lines)


def counted(counts: Mapping[str, object]) -> str:
    """Counts above 0 with their names, which have spaces for underscores.

    Examples
    --------
    >>> counted({"FEP": 3, "no_peak": 2, "DEP": 0})
    '3 FEP, 2 no peak'
    """
    return ", ".join(f"{n} {name.replace('_', ' ')}" for name, n in counts.items() if n)


def shortened(names: Iterable[str]) -> str:
    """A readable list of names that stays on one line.

    Examples
    --------
    >>> shortened(["FEP", "SEP"])
    'FEP, SEP'
    >>> shortened(f"ch{i}" for i in range(20))
    'ch0, ch1, ch2, ch3, ch4, ch5 and 14 more'
    """
    listed = list(names)
    text = ", ".join(listed[:SHOWN]) or "nothing"
    rest = len(listed) - SHOWN
    return f"{text} and {rest} more" if rest > 0 else text


def span(ends: Sequence[float] | None, digits: int = 9) -> str:
    """Both ends to six digits, and no more than `digits` after the point."""
    return " … ".join(f"{round(v, digits):.6g}" for v in ends) if ends else "–"


def percent(value: float) -> str:
    """Two digits, and whole numbers from 99.5 on."""
    return f"{value:.2g} %" if abs(value) < 99.5 else f"{value:.0f} %"


def number(value: Any, form: str = ".4g") -> str:
    """Format a value with a true minus sign; four digits suffice to compare two scores.

    Examples
    --------
    >>> number(-0.52094), number(-0.52094, "+.1f"), number(7), number(None)
    ('−0.5209', '−0.5', '7', '–')
    """
    if value is None:
        return NO_VALUE
    text = f"{value:{form}}" if isinstance(value, float) else str(value)
    return re.sub(r"^-", "−", text)


def with_std(value: Any, error: Any) -> str:
    """Format a value with its error, if any, to two digits of the error.

    Examples
    --------
    >>> with_std(0.52094, 0.0171), with_std(-0.52094, 0.0996), with_std(0.1, None)
    ('0.521 ± 0.017', '−0.52 ± 0.10', '0.1')
    """
    if value is None or error is None:
        return number(value)
    # the exponent of the rounded error: 0.0996 is 0.10
    seen = error > abs(value) * ROUNDING
    exponent = int(f"{error:.1e}".partition("e")[2]) if seen else -MAX_DIGITS
    digits = max(1 - exponent, 0)
    if digits >= MAX_DIGITS:
        return f"{number(value)} ± {error if seen else 0:.2g}"
    return f"{number(float(value), f'.{digits}f')} ± {error:.{digits}f}"
