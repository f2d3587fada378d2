"""Common style of all figures: fonts, and a fixed colour, label and group for each method."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping
from functools import wraps
from typing import TYPE_CHECKING, Any, ParamSpec, TypeVar

if TYPE_CHECKING:
    from matplotlib.artist import Artist
    from matplotlib.axes import Axes
    from matplotlib.container import Container
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
    "gauss_exp": "#56B4E9",
    "superpulse": "#7F7F7F",
}
SPARE_COLOURS = ("#8C6D1F", "#5B3A8C", "#9E2A2B", "#4F6D7A", "#B8A200")
DATA_FILL = "0.80"

GROUP = "method-"  # begins the group id of what a figure draws of a method
# suffix of the name of a method without noise
NO_NOISE = "_no_noise"

LABELS = {
    "data": "Data",
    "raw": "Simulation",
    "ren": "REN translation",
    "iren": "IREN translation",
    "truth": "True response",
    "rc": "RC",
    "gauss_exp": "Gaussian ⊗ exponential",
    "superpulse": "Superpulse ratio",
    "ceiling": "Ceiling",
}

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
}


def styled(make_figure: Callable[P, R]) -> Callable[P, R]:
    """Decorator that runs a figure function in the common style."""

    @wraps(make_figure)
    def in_style(*args: P.args, **kwargs: P.kwargs) -> R:
        from matplotlib import style
        from matplotlib.figure import Figure

        # based on matplotlib's defaults, so that user settings do not change a report
        with style.context(["default", _STYLE]):
            made = make_figure(*args, **kwargs)
            if isinstance(made, Figure):
                _group_legends(made)
            return made

    return in_style


def colours(methods: Iterable[str]) -> Mapping[str, str]:
    """Colour of each method: its own, or else the next spare one.

    Examples
    --------
    >>> colours(["data", "other"])
    {'data': 'black', 'other': '#8C6D1F'}
    """
    methods = list(methods)
    others = [method for method in methods if method not in COLOURS]
    spare = {m: SPARE_COLOURS[i % len(SPARE_COLOURS)] for i, m in enumerate(others)}
    return {method: COLOURS.get(method) or spare[method] for method in methods}


def line_look(method: str, colour: str) -> dict[str, Any]:
    """Look of a line; that of the data is broad and grey, so that it shows below others."""
    look = {"color": "0.65", "linewidth": 4.0} if method == "data" else {"color": colour}
    return look | {"gid": GROUP + method}


def group(drawn: Container, method: str) -> None:
    """Mark points with errors as those of a method, by which a page hides them."""
    for artist in drawn.get_children():
        artist.set_gid(GROUP + method)


def linear_within(axes: Axes, limit: float) -> None:
    """Make a y axis logarithmic, but linear up to ± `limit`.

    Small differences then show beside those of an untranslated simulation.
    """
    axes.set_yscale("symlog", linthresh=limit)
    axes.yaxis.set_major_formatter("{x:g}")


def label(method: str) -> str:
    """Label of a method in legends."""
    name = method.removesuffix(NO_NOISE)
    return LABELS.get(name, name) + (", no noise" if name != method else "")


def _group_legends(figure: Figure) -> None:
    """Mark the entries of legends, which begin with the label of a method, as its own."""
    from matplotlib.legend import Legend
    from matplotlib.offsetbox import HPacker, TextArea

    artists = list(_without_ticks(figure))
    ids = {artist.get_gid() or "" for artist in artists}
    by_label = {label(i.removeprefix(GROUP)): i for i in sorted(ids) if i.startswith(GROUP)}
    for legend in (artist for artist in artists if isinstance(artist, Legend)):
        for entry in legend.findobj(HPacker):
            for text in entry.get_children():
                if isinstance(text, TextArea):
                    begins = [name for name in by_label if text.get_text().startswith(name)]
                    for artist in entry.findobj() if begins else ():
                        artist.set_gid(by_label[max(begins, key=len)])


def _without_ticks(artist: Artist) -> Iterator[Artist]:
    """An artist and its children, but no scales: asked for their ticks, they make them."""
    from matplotlib.axis import Axis

    yield artist
    for child in artist.get_children():
        if not isinstance(child, Axis):
            yield from _without_ticks(child)
