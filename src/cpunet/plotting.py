"""Common style of all figures: fonts, and a fixed colour, label and group for each method."""

from __future__ import annotations

from collections.abc import Callable
from functools import wraps
from typing import TYPE_CHECKING, Any, ParamSpec, TypeVar

import numpy.typing as npt

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

P = ParamSpec("P")
R = TypeVar("R")

# Colours of Okabe and Ito, which colour-blind readers can distinguish.
COLOURS = {
    "data": "black",
    "raw": "#D55E00",
    "ren": "#0072B2",
    "iren": "#CC79A7",
    "truth": "#009E73",
    # fixed, so that a method has one colour in all figures of a page
    "rc": "#E69F00",
    "rc_late": "#8C6D1F",
    "gauss_exp": "#56B4E9",
    "superpulse": "#5B3A8C",
}
SPARE_COLOURS = ("#3D7A3D", "#9E2A2B", "#4F6D7A", "#B8A200")
DATA_FILL = "0.88"

GROUP = "method-"  # begins the group id of what a figure draws of a method

LABELS = {
    "data": "Data",
    "raw": "Simulation",
    "ren": "REN translation",
    "iren": "IREN translation",
    "truth": "True response",
    "rc": "RC",
    "rc_late": "RC + late charge",
    "gauss_exp": "Gaussian ⊗ exponential",
    "superpulse": "Superpulse ratio",
    "ceiling": "Data vs data",
}

# two panels above each other, the lower one smaller
STACKED: dict[str, Any] = {"sharex": True, "height_ratios": (3, 2)}

# Inches around panels, from an axis to its label, and of a line of a legend.
LEFT, RIGHT, BOTTOM, TOP, LABEL, LINE = 1.0, 0.15, 0.48, 0.3, 0.6, 0.18

_STYLE = {
    "font.size": 10.0,
    "axes.labelsize": 10.0,
    "axes.titlesize": 10.0,
    "legend.fontsize": 8.5,
    "legend.frameon": False,
    "lines.linewidth": 1.4,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.grid": True,
    "grid.color": "0.92",
    "axes.axisbelow": True,
    "figure.constrained_layout.use": True,
    "axes.titley": 1.0,  # else the title is placed by the labels, which takes long
}


def styled(make_figure: Callable[P, R]) -> Callable[P, R]:
    """Decorator that runs a figure function in the common style."""

    @wraps(make_figure)
    def in_style(*args: P.args, **kwargs: P.kwargs) -> R:
        from matplotlib import style

        # based on matplotlib's defaults, so that user settings do not change a report
        with style.context(["default", _STYLE]):
            return make_figure(*args, **kwargs)

    return in_style


def line(axes: Axes, x: Any, y: Any, method: str, text: str | None = None) -> None:
    """Draw a line of a method; that of the data is broad, to show below others."""
    width = 3.0 if method == "data" else None
    axes.plot(x, y, label=text, color=COLOURS[method], linewidth=width, gid=GROUP + method)


def points(axes: Axes, x: Any, y: Any, error: Any, method: str, **look: Any) -> None:
    """Draw points with errors of a method, as `Axes.errorbar` says."""
    drawn = axes.errorbar(x, y, error, color=COLOURS[method], marker="o", **look)
    for artist in drawn.get_children():
        artist.set_gid(GROUP + method)  # by which a page hides them


def panels(
    size: tuple[float, float],
    rows: int = 1,
    columns: int = 1,
    *,
    labels: bool = True,
    **how: Any,
) -> tuple[Figure, npt.NDArray[Any]]:
    """A figure of a size in inches with a grid of panels, made as `Figure.subplots` says.

    Margins and places of labels are fixed: to measure all texts takes most of the time.
    """
    from matplotlib.figure import Figure
    from matplotlib.transforms import ScaledTranslation

    figure, (width, height) = Figure(figsize=size, layout="none"), size  # type: ignore[arg-type]
    grid = figure.subplots(rows, columns, squeeze=False, **how)
    across = 0.15 if how.get("sharey") or not labels else LEFT
    down = 0.15 if how.get("sharex") else BOTTOM + 0.1
    left = LEFT if labels else 0.15
    wide = (width - left - RIGHT - across * (columns - 1)) / columns
    high = (height - BOTTOM - TOP - down * (rows - 1)) / rows
    figure.subplots_adjust(
        left=left / width,
        right=1 - RIGHT / width,
        bottom=BOTTOM / height,
        top=1 - TOP / height,
        wspace=across / wide,
        hspace=down / high,
    )
    for axes in grid.flat:
        below = axes.transAxes + ScaledTranslation(0, -0.25, figure.dpi_scale_trans)
        left_of = axes.transAxes + ScaledTranslation(-LABEL, 0, figure.dpi_scale_trans)
        axes.xaxis.set_label_coords(0.5, 0, transform=below)
        axes.yaxis.set_label_coords(0, 0.5, transform=left_of)
    return figure, grid


def own_axes(ax: Axes | None) -> Axes:
    """The axes that a user gives, or those of a new figure of pyplot, for its `savefig`."""
    if ax is not None:
        return ax
    from matplotlib import pyplot

    new: Axes = pyplot.subplots()[1]
    return new


def legend_above(
    figure: Figure, axes: Axes, columns: int = 1, title: str | None = None
) -> None:
    """Put the legend of one panel above all."""
    handles, texts = axes.get_legend_handles_labels()
    titles = title.count("\n") + 1 if title else 0
    lines = -(-len(texts) // columns) + 1.3 * titles
    height = figure.get_figheight()
    figure.legend(
        handles,
        texts,
        loc="upper left",
        bbox_to_anchor=(0, 1),
        borderaxespad=0.2,
        ncols=columns,
        title=title,
        alignment="left",
    )
    # titles of panels stand below it
    panel = LINE if axes.get_title() else 0.0
    figure.subplots_adjust(top=1 - (0.12 + LINE * lines + panel) / height)


def steps(axes: Axes, heights: Any, edges: Any, method: str, text: str) -> None:
    """Draw a histogram of a method: that of the data filled, others as a line."""
    colour = COLOURS[method]
    look: dict[str, Any] = {"fill": False, "edgecolor": colour, "linewidth": 1.5, "zorder": 2}
    if method == "data":
        look = {"fill": True, "facecolor": DATA_FILL, "edgecolor": colour, "linewidth": 0.8}
    axes.stairs(heights, edges, label=text, gid=GROUP + method, **look)


def label(method: str) -> str:
    """Label of a method in legends."""
    return LABELS.get(method, method)
