"""The messages that the troubleshooting page quotes are the program's own."""

from __future__ import annotations

import ast
import re
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
PAGE = ROOT / "docs" / "troubleshooting.md"
QUOTED = re.findall(r"^\| `(.+?)` \|", PAGE.read_text(), re.MULTILINE)


@pytest.fixture(scope="module")
def messages() -> str:
    """All texts of the package; those with values in them as their fixed parts, in order."""
    texts = []
    for path in sorted((ROOT / "src").rglob("*.py")):
        for node in ast.walk(ast.parse(path.read_text())):
            if isinstance(node, ast.JoinedStr):
                fixed = (getattr(part, "value", None) for part in node.values)
                texts.append("…".join(part for part in fixed if isinstance(part, str)))
            elif isinstance(node, ast.Constant) and isinstance(node.value, str):
                texts.append(node.value)
    return "\n".join(texts)


@pytest.mark.parametrize("quoted", QUOTED)
def test_a_quoted_message_is_one_of_the_program(quoted, messages):
    for part in quoted.split("…"):
        assert part.strip("… ") in messages, f"no message has {part!r}; correct {PAGE.name}"


def test_there_are_messages_on_the_page():
    assert len(QUOTED) > 20
