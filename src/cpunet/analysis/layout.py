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
from matplotlib.layout_engine import ConstrainedLayoutEngine
from matplotlib.transforms import Bbox


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
        w_pad, h_pad = fig.dpi * pads["w_pad"], fig.dpi * pads["h_pad"]
        renderer = RendererAgg(*fig.bbox.size, fig.dpi)  # type: ignore[no-untyped-call]
        rooms = [_room(axes, renderer) for axes in panels]
        grid, width, height = specs[0].get_gridspec(), fig.bbox.width, fig.bbox.height
        x = _ends(
            width,
            grid.get_width_ratios(),
            [spec.colspan for spec in specs],
            [(room.left, room.right) for room in rooms],
            w_pad,
        )
        y = _ends(
            height,
            grid.get_height_ratios(),
            [spec.rowspan for spec in specs],
            [(room.top, room.bottom) for room in rooms],
            h_pad,
            _beyond_panels(fig, renderer, h_pad),
        )
        if x is None or y is None:
            super().execute(fig)  # which warns that there is no room
            return
        for axes, (left, right), (high, low) in zip(panels, x, y, strict=True):
            place = Bbox.from_extents(left, height - low, right, height - high)
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


def _ends(
    size: float,
    ratios: npt.ArrayLike,
    spans: Sequence[range],
    rooms: Sequence[tuple[float, float]],
    pad: float,
    beyond: tuple[float, float] = (0.0, 0.0),
) -> list[tuple[float, float]] | None:
    """Where each panel begins and ends along one side of the figure; None if nothing is left.

    The side has `size` pixels and columns or rows of relative `ratios`; each panel spans some
    of them, and its labels take `rooms` before and after it.  Pixels `beyond` are taken at
    either end of the side.
    """
    shares = np.asarray(ratios, float)
    before, after = np.full((2, len(shares)), pad)
    for span, room in zip(spans, rooms, strict=True):
        before[span.start] = max(before[span.start], room[0] + pad)
        after[span.stop - 1] = max(after[span.stop - 1], room[1] + pad)
    before[0] += beyond[0]
    after[-1] += beyond[1]
    left = size - before.sum() - after.sum()
    if left <= 0:
        return None
    inner = left * shares / shares.sum()
    ends = np.cumsum(before + inner + after) - after
    begins = ends - inner
    return [(begins[span.start], ends[span.stop - 1]) for span in spans]
