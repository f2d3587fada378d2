"""HTML tables of the report, from plain rows or nested values."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from markupsafe import Markup

from cpunet.html_pages import joined, part
from cpunet.plotting import LABELS, NO_NOISE, label
from cpunet.tables import NO_VALUE, number, with_std

ERRORS = ("_std", "_error")  # suffixes of the name of an error
UNITS = {"ns": "ns", "kev": "keV", "percent": "%", "mm": "mm"}  # at the end of a key
SPELT = {"auc": "AUC", "iou": "IoU", "rms": "RMS", "wasserstein": "W₁"}
LONG = 12  # longer lists are summarised
BROAD = 6  # tables with more columns than this are transposed if they have fewer rows


def html_table(
    head: Sequence[str],
    rows: Sequence[Sequence[str]],
    words: frozenset[int] | set[int] = frozenset(),
) -> Markup:
    """Return a table; the columns `words` are aligned as text, all others as numbers."""
    return part("table", head, rows, words)


def nested_html(value: Any, level: int = 4) -> Markup:
    """Return nested mappings, lists and values as tables under headings.

    An error, under the name of its value with ``_std`` or ``_error``, is shown with the value.
    ``missing`` with a text becomes a sentence.  Long lists are summarised; `metrics.json` has
    them in full.

    Parameters
    ----------
    value
        Any part of ``metrics.json``.
    level
        Level of the headings, 1 … 6.
    """
    if isinstance(value, list) and value and all(isinstance(item, Mapping) for item in value):
        return _matrix({str(i + 1): item for i, item in enumerate(value)}, "")
    if not isinstance(value, Mapping):
        return part("p", _cell(value))
    parts = []
    if isinstance(value.get("missing"), str):
        parts.append(part("p", f"Missing: {value['missing']}."))
        value = {name: item for name, item in value.items() if name != "missing"}
    value = _with_errors(value)
    plain = {name: item for name, item in value.items() if not _nests(item)}
    if plain:
        rows = [[words_of(name), _cell(item)] for name, item in plain.items()]
        parts.append(html_table(["Quantity", "Value"], rows))
    deeper = {name: item for name, item in value.items() if name not in plain}
    flat = {name: item for name, item in deeper.items() if _is_row(item)}
    if len(flat) > 1:
        parts.append(_matrix(flat, "Quantity"))
        deeper = {name: item for name, item in deeper.items() if name not in flat}
    for name, item in deeper.items():
        parts.append(part("heading", level, words_of(name)))
        parts.append(nested_html(item, min(level + 1, 6)))
    return joined(parts)


def _matrix(rows: Mapping[str, Mapping[str, Any]], corner: str) -> Markup:
    """Return mappings of values as one table: one row each, or one column each if shorter.

    Missing rows are listed in a sentence, with the reasons.
    """
    reasons: dict[str, list[str]] = {}
    for name, row in rows.items():
        if isinstance(row.get("missing"), str):
            reasons.setdefault(row["missing"], []).append(name)
    told = "; ".join(f"{_rows_told(names)}: {reason}" for reason, names in reasons.items())
    sentence = part("p", f"Missing: {told}.") if told else Markup()
    absent = {name for names in reasons.values() for name in names}
    rows = {name: _with_errors(row) for name, row in rows.items() if name not in absent}
    if not rows:
        return sentence
    names = list(dict.fromkeys(column for row in rows.values() for column in row))
    if len(names) > BROAD and len(names) > len(rows):
        turned = {
            name: {r: row[name] for r, row in rows.items() if name in row} for name in names
        }
        rows, names = turned, list(rows)
    body = [
        [words_of(name), *(_cell(row[n]) if n in row else NO_VALUE for n in names)]
        for name, row in rows.items()
    ]
    return joined([html_table([corner, *map(words_of, names)], body), sentence])


def _rows_told(names: Sequence[str]) -> str:
    """Names of rows as a list, with consecutive numbers as ranges.

    Examples
    --------
    >>> _rows_told(["2", "3", "4", "7"]), _rows_told(["ren", "raw"])
    ('2–4, 7', 'REN translation, Simulation')
    """
    told: list[tuple[str, str]] = []
    for name in names:
        first, last = told[-1] if told else ("", "")
        if name.isdecimal() and last.isdecimal() and int(name) == int(last) + 1:
            told[-1] = (first, name)
        else:
            told.append((name, name))
    return ", ".join(words_of(a) if a == b else f"{a}–{b}" for a, b in told)


def _with_errors(values: Mapping[str, Any]) -> dict[str, Any]:
    """Join each value with the error of the same name, also where both are mappings."""
    joined: dict[str, Any] = {}
    for name, value in values.items():
        if any(name.removesuffix(end) in values for end in ERRORS if name.endswith(end)):
            continue
        error = next((values[name + end] for end in ERRORS if name + end in values), None)
        if isinstance(error, Mapping) and _is_row(value):
            joined[name] = {k: _join(v, error.get(k)) for k, v in value.items()}
        else:
            joined[name] = _join(value, error)
    return joined


def _join(value: Any, error: Any) -> Any:
    number = isinstance(value, (int, float)) and not isinstance(value, bool)
    return with_std(value, error) if number and isinstance(error, (int, float)) else value


def _nests(value: Any) -> bool:
    of_mappings = isinstance(value, list) and any(isinstance(item, Mapping) for item in value)
    return isinstance(value, Mapping) or of_mappings


def _is_row(value: Any) -> bool:
    return isinstance(value, Mapping) and bool(value) and not any(map(_nests, value.values()))


def _cell(value: Any) -> str:
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, list):
        if any(isinstance(item, list) for item in value):
            return f"{len(value)} rows of values"
        known = [v for v in value if isinstance(v, (int, float))]
        if len(value) > LONG and known:
            return f"{len(value)} values from {number(min(known))} to {number(max(known))}"
        return ", ".join(map(_cell, value)) or NO_VALUE
    return number(value)


def words_of(name: str) -> str:
    """Return a key of the metrics as the page writes it.

    Examples
    --------
    >>> words_of("time_ns"), words_of("drift_time_wasserstein")
    ('time [ns]', 'drift time W₁')
    """
    if name.removesuffix(NO_NOISE) in LABELS:
        return label(name)
    words = [SPELT.get(word, word) for word in name.split("_")]
    if len(words) > 1 and words[-1] in UNITS:
        words[-1] = f"[{UNITS[words[-1]]}]"
    return " ".join(words)
