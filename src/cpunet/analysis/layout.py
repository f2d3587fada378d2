"""Positions of the panels of a figure, with room for their labels.

matplotlib's constrained layout measures each panel several times and creates all its ticks anew
each time, which takes longer than drawing it.  Here the labels of a panel are measured once;
the positions of panels in one grid then follow from sums.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import numpy.typing as npt
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import RendererAgg
from matplotlib.figure import Figure
from matplotlib.gridspec import SubplotSpec
from matplotlib.layout_engine import ConstrainedLayoutEngine
from matplotlib.transforms import Bbox

Pixels = npt.NDArray[np.float64]


class MeasuredLayout(ConstrainedLayoutEngine):
    """A constrained layout that measures labels once, for panels in one grid.

    Legends of the figure are at its top.  Other figures are left to matplotlib: those with
    colour bars beside panels, with several grids, or with panels of a fixed aspect ratio.
    """

    def execute(self, fig: Figure) -> None:
        """Place the panels of a figure."""
        panels = [axes for axes in fig.axes if axes.get_in_layout()]
        specs = [spec for axes in panels if (spec := axes.get_subplotspec()) is not None]
        simple = len({spec.get_gridspec() for spec in specs}) == 1 == len(fig.subfigs) + 1
        if (
            not simple
            or len(specs) < len(panels)
            or any(a.get_aspect() != "auto" for a in panels)
        ):
            super().execute(fig)
            return
        pads = self.get()
        renderer = RendererAgg(*fig.bbox.size, fig.dpi)  # type: ignore[no-untyped-call]
        rooms = [_room(axes, renderer) for axes in panels]
        top, bottom = _beyond_panels(fig, renderer, fig.dpi * pads["h_pad"])
        x = _columns(fig, specs, rooms, fig.dpi * pads["w_pad"])
        y = _rows(fig, specs, rooms, fig.dpi * pads["h_pad"], top, bottom)
        if x is None or y is None:
            super().execute(fig)  # which warns that there is no room
            return
        for axes, spec in zip(panels, specs, strict=True):
            (left, right), (high, low) = (
                (begins[span.start], ends[span.stop - 1])
                for (begins, ends), span in ((x, spec.colspan), (y, spec.rowspan))
            )
            place = Bbox.from_extents(
                left, fig.bbox.height - low, right, fig.bbox.height - high
            )
            axes.set_position(place.transformed(fig.transFigure.inverted()))
            axes.set_in_layout(True)  # to be placed again if its labels change


class _Room(NamedTuple):
    """Pixels that labels take beyond the four sides of a panel."""

    left: float
    right: float
    top: float
    bottom: float


def _room(axes: Axes, renderer: RendererAgg) -> _Room:
    panel = axes.bbox
    if axes.child_axes:
        boxes = [axes.get_tightbbox(renderer, for_layout_only=True)]
    else:
        shown = [axis for axis in (axes.xaxis, axes.yaxis) if axes.axison]
        boxes = [axis.get_tightbbox(renderer, for_layout_only=True) for axis in shown]
        boxes += [text.get_tightbbox(renderer) for text in (axes.title, *axes.texts)]
        legend = axes.get_legend()
        if legend is not None and legend.get_bbox_to_anchor() is not panel:
            boxes.append(legend.get_window_extent(renderer))
    whole = Bbox.union([panel, *(box for box in boxes if box is not None and box.width > 0)])
    return _Room(
        panel.x0 - whole.x0, whole.x1 - panel.x1, whole.y1 - panel.y1, panel.y0 - whole.y0
    )


def _beyond_panels(fig: Figure, renderer: RendererAgg, pad: float) -> tuple[float, float]:
    """Pixels at the top and at the bottom that the figure's own legends and texts take."""
    top = bottom = 0.0
    for legend in fig.legends:
        top = max(top, legend.get_window_extent(renderer).height + 2 * pad)
    for text in fig.texts:
        box = text.get_window_extent(renderer)
        if box.y0 > 0.5 * fig.bbox.height:
            top = max(top, fig.bbox.height - box.y0 + pad)
        else:
            bottom = max(bottom, box.y1 + pad)
    return top, bottom


def _columns(
    fig: Figure, specs: Sequence[SubplotSpec], rooms: Sequence[_Room], pad: float
) -> tuple[Pixels, Pixels] | None:
    grid = specs[0].get_gridspec()
    before, after = np.full((2, grid.ncols), pad)
    for spec, room in zip(specs, rooms, strict=True):
        first, last = spec.colspan.start, spec.colspan.stop - 1
        before[first] = max(before[first], room.left + pad)
        after[last] = max(after[last], room.right + pad)
    return _shared_out(fig.bbox.width, grid.get_width_ratios(), before, after)


def _rows(
    fig: Figure,
    specs: Sequence[SubplotSpec],
    rooms: Sequence[_Room],
    pad: float,
    top: float,
    bottom: float,
) -> tuple[Pixels, Pixels] | None:
    grid = specs[0].get_gridspec()
    before, after = np.full((2, grid.nrows), pad)
    for spec, room in zip(specs, rooms, strict=True):
        first, last = spec.rowspan.start, spec.rowspan.stop - 1
        before[first] = max(before[first], room.top + pad)
        after[last] = max(after[last], room.bottom + pad)
    before[0] += top
    after[-1] += bottom
    return _shared_out(fig.bbox.height, grid.get_height_ratios(), before, after)


def _shared_out(
    size: float, ratios: npt.ArrayLike, before: Pixels, after: Pixels
) -> tuple[Pixels, Pixels] | None:
    """Where panels of given ratios begin and end along a side; None if nothing is left."""
    left = size - before.sum() - after.sum()
    if left <= 0:
        return None
    shares = np.asarray(ratios, float)
    inner = left * shares / shares.sum()
    ends = np.cumsum(before + inner + after) - after
    return ends - inner, ends
