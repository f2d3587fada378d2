"""Pages from the templates in ``page/``: self-contained, escaped, and without requests.

Values that are put into a template are escaped, unless they are `Markup`.
"""

from __future__ import annotations

import base64
import io
from functools import cache
from importlib.resources import files
from typing import Any

from jinja2 import Environment, PackageLoader, StrictUndefined
from markupsafe import Markup
from matplotlib.backend_bases import FigureCanvasBase
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

DPI = 150
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


def figure_html(caption: str, figure: Figure, png: bytes | None = None) -> Markup:
    """Return a figure with its caption; `png` is the drawn figure if there is one."""
    width, height = figure.get_size_inches()
    data = base64.b64encode(figure_png(figure) if png is None else png).decode("ascii")
    kind = Markup(' class="wide"') if width >= WIDE * height else ""
    return Markup(
        '<figure{}><img alt="{}" src="data:image/png;base64,{}">'
        "<figcaption>{}</figcaption></figure>"
    ).format(kind, caption, data, caption)


def figure_png(figure: Figure) -> bytes:
    """Draw a figure; equal figures give equal bytes."""
    stream = io.BytesIO()
    figure.set_dpi(DPI)
    # ``Figure.savefig`` would process every figure twice, once without drawing;
    # without the program's name and version, equal figures give equal files
    FigureCanvasAgg(figure).print_png(  # type: ignore[no-untyped-call]
        stream, metadata={"Software": None}, pil_kwargs={"compress_level": COMPRESSION}
    )
    FigureCanvasBase(figure)  # releases the pixel buffer, which the figure would keep
    return stream.getvalue()
