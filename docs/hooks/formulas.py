"""Formulas as MathML, which every browser draws by itself: no script, no font, no network."""

from __future__ import annotations

import re
from html import unescape
from typing import Any

from griffe import Extension, Object
from latex2mathml.converter import convert

INLINE = re.compile(r'<span class="arithmatex">\\\((.*?)\\\)</span>', re.DOTALL)
BLOCK = re.compile(r'<div class="arithmatex">\s*\\\[(.*?)\\\]\s*</div>', re.DOTALL)
ROLE = re.compile(r":math:`([^`]+)`")
DIRECTIVE = re.compile(
    r"^\.\. math::[ \t]*(.*(?:\n(?:[ \t]+\S.*|[ \t]*(?=\n[ \t]+\S)))*)", re.M
)
LITERAL = re.compile(r"(^|\S)::[ \t]*$", re.MULTILINE)  # an indented block of code follows
OTHER_ROLE = re.compile(r":(?:func|class|meth|mod|attr):`~?([^`]+)`")


def on_page_content(html: str, **_: Any) -> str:
    html = BLOCK.sub(lambda found: mathml(found[1], "block"), html)
    return INLINE.sub(lambda found: mathml(found[1], "inline"), html)


def mathml(latex: str, display: str) -> str:
    return convert(unescape(latex).strip(), display=display)


def as_markdown(text: str) -> str:
    """Formulas, code and references of reStructuredText, as Markdown writes them."""
    text = DIRECTIVE.sub(lambda found: f"$$\n{' '.join(found[1].split())}\n$$\n", text)
    text = ROLE.sub(lambda found: f"${' '.join(found[1].split())}$", text)
    text = LITERAL.sub(lambda found: found[1] and f"{found[1]}:", text)
    return OTHER_ROLE.sub(r"`\1`", text)


class Docstrings(Extension):
    """Docstrings are written for NumPy's conventions; the site is written in Markdown."""

    def on_object(self, *, obj: Object, **_: Any) -> None:
        if obj.docstring:
            obj.docstring.value = as_markdown(obj.docstring.value)
