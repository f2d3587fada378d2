"""Tables as text: what results print."""

from __future__ import annotations

from collections.abc import Sequence


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
