"""Pages from the templates in ``page/``: self-contained, escaped, and without requests.

Values that are put into a template are escaped, unless they are `Markup`.
"""

from __future__ import annotations

import base64
import io
import re
from functools import cache
from importlib.resources import files
from pathlib import Path
from typing import Any

from jinja2 import Environment, PackageLoader, StrictUndefined
from markupsafe import Markup
from matplotlib import rc_context
from matplotlib.figure import Figure

from cpunet.plotting import GROUP

NOTEBOOK_DPI = 80
WIDE = 2.0  # aspect ratio from which a figure takes the full width of the page


@cache
def _environment() -> Environment:
    return Environment(
        loader=PackageLoader("cpunet.validation", "page"),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )


def rendered(template: str, **values: Any) -> str:
    """Return a page of ``page/`` with its values."""
    return _environment().get_template(template).render(css=Markup(asset("page.css")), **values)


def asset(name: str) -> str:
    """Content of a file of ``page/``."""
    return files("cpunet.validation").joinpath("page", name).read_text("utf-8")


def part(name: str, *values: Any, **named: Any) -> Markup:
    """Return a piece of a page, made by a macro of ``page/parts.html``.

    Examples
    --------
    >>> part("object", "1 < 2").strip()
    Markup('<strong>1 &lt; 2</strong>')
    """
    macro = getattr(_environment().get_template("parts.html").module, name)
    return Markup(macro(*values, **named))


def figure_html(caption: str, figure: Figure, file: Path, shows: str = "") -> Markup:
    """Return a figure with its caption, as SVG, and write it to a file of its own.

    `shows` says what it shows to who cannot see it.
    """
    stream = io.StringIO()
    # equal figures give equal text
    with rc_context({"svg.fonttype": "none", "svg.hashsalt": caption}):
        metadata = dict.fromkeys(("Creator", "Date", "Format", "Type"))
        figure.savefig(stream, format="svg", metadata=metadata)
    file.write_text(stream.getvalue(), encoding="utf-8")
    svg = stream.getvalue().partition("<svg ")[2]
    svg = re.sub(rf'<g id="{GROUP}', '<g data-method="', f'<svg role="img" {svg}')
    # other figures of a page have the same
    svg = re.sub(r'(?<=<g) id="[^"]*"| xmlns(:xlink)?="[^"]*"', "", svg)
    width, height = figure.get_size_inches()
    alt = f"{caption}: {shows}" if shows else caption
    return part("figure", caption, Markup(svg), width, width >= WIDE * height, alt)


def notebook_picture(figure: Figure) -> Markup:
    """Return a figure as a small PNG in base64."""
    stream = io.BytesIO()
    # without the program's name and version, equal figures give equal bytes
    figure.savefig(stream, format="png", dpi=NOTEBOOK_DPI, metadata={"Software": None})
    return Markup(base64.b64encode(stream.getvalue()).decode("ascii"))
