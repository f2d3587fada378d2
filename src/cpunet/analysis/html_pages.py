"""Pages from the templates in ``page/``: self-contained, escaped, and without requests.

Values that are put into a template are escaped, unless they are `Markup`.
"""

from __future__ import annotations

import base64
import io
import json
from collections.abc import Iterable
from functools import cache
from importlib.resources import files
from typing import Any

from jinja2 import Environment, PackageLoader, StrictUndefined
from markupsafe import Markup
from matplotlib.backend_bases import FigureCanvasBase
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

DPI = 150
NOTEBOOK_DPI = 80
COMPRESSION = 1  # of PNG, 0 … 9: files a tenth larger than with the usual 6, in half the time
WIDE = 2.0  # aspect ratio from which a figure takes the full width of the page


@cache
def _environment() -> Environment:
    return Environment(
        loader=PackageLoader("cpunet.analysis", "page"),
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
    return files("cpunet.analysis").joinpath("page", name).read_text("utf-8")


def part(name: str, *values: Any, **named: Any) -> Markup:
    """Return a piece of a page, made by a macro of ``page/parts.html``.

    Examples
    --------
    >>> part("gap", "1 < 2")
    Markup('<p class="gap">None recorded: 1 &lt; 2.</p>')
    """
    macro = getattr(_environment().get_template("parts.html").module, name)
    return Markup(macro(*values, **named))


def joined(parts: Iterable[str]) -> Markup:
    """Join pieces of a page, one per line."""
    return Markup("\n").join(parts)


def script(data: Any, names: Iterable[str]) -> Markup:
    """Return data and the files of ``page/`` that draw them, as elements of a page."""
    # escaped, so that no text in the data can close its element
    text = json.dumps(data, allow_nan=False, separators=(",", ":")).replace("<", "\\u003c")
    code = "\n".join(asset(f"{name}.js") for name in names)
    return part("script", Markup(text), Markup(code))


def figure_html(caption: str, figure: Figure, png: bytes | None = None) -> Markup:
    """Return a figure with its caption; `png` is the drawn figure if there is one."""
    width, height = figure.get_size_inches()
    data = _base64(figure_png(figure) if png is None else png)
    return part("figure", caption, data, width, width >= WIDE * height)


def notebook_picture(figure: Figure) -> Markup:
    """Return a figure as a small PNG in base64."""
    return _base64(figure_png(figure, NOTEBOOK_DPI))


def _base64(png: bytes) -> Markup:
    return Markup(base64.b64encode(png).decode("ascii"))


def figure_png(figure: Figure, dpi: int = DPI) -> bytes:
    """Draw a figure; equal figures give equal bytes."""
    stream = io.BytesIO()
    figure.set_dpi(dpi)
    # ``Figure.savefig`` would process every figure twice, once without drawing;
    # without the program's name and version, equal figures give equal files
    FigureCanvasAgg(figure).print_png(  # type: ignore[no-untyped-call]
        stream, metadata={"Software": None}, pil_kwargs={"compress_level": COMPRESSION}
    )
    FigureCanvasBase(figure)  # releases the pixel buffer, which the figure would keep
    return stream.getvalue()
