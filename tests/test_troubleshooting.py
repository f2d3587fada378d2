"""The messages that the troubleshooting page quotes are the program's own."""

from __future__ import annotations

import ast
import re
from pathlib import Path

import pytest

from cpunet.cli import with_options

ROOT = Path(__file__).resolve().parents[1]
PAGE = ROOT / "docs" / "troubleshooting.md"
QUOTED = re.findall(r"^\| `(.+?)` \|", PAGE.read_text(), re.MULTILINE)


def text_of(node: ast.AST) -> str:
    """A text; one with values in it as its fixed parts, in order; an error with its remedy."""
    if isinstance(node, ast.JoinedStr):
        return "…".join(filter(None, map(text_of, node.values)))
    if isinstance(node, ast.Call) and getattr(node.func, "id", "") == "CpunetError":
        return "; ".join(map(text_of, node.args))
    value = getattr(node, "value", None)
    return value if isinstance(value, str) else ""


@pytest.fixture(scope="module")
def messages() -> str:
    """All texts of the package, as the command line shows them."""
    paths = sorted((ROOT / "src").rglob("*.py"))
    return with_options(
        "\n".join(
            text_of(node) for path in paths for node in ast.walk(ast.parse(path.read_text()))
        )
    )


@pytest.mark.parametrize("quoted", QUOTED)
def test_a_quoted_message_is_one_of_the_program(quoted, messages):
    for part in quoted.removeprefix("warning: ").split("…"):  # its level
        assert part.strip("… ") in messages, f"no message has {part!r}; correct {PAGE.name}"


def test_there_are_messages_on_the_page():
    assert len(QUOTED) > 20
