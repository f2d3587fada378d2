"""Panels leave room for all labels, as matplotlib's own layout does."""

from __future__ import annotations

import io

import numpy as np
import pytest
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from cpunet.analysis.layout import MeasuredLayout


def labelled(engine) -> Figure:
    """Four panels of unlike sizes with all kinds of labels, placed by an engine."""
    figure = Figure(figsize=(6, 4), layout=engine)
    grid = figure.subplots(2, 2, sharex=True, height_ratios=(3, 2))
    for axes in grid.flat:
        axes.plot([0, 1e6], [0, 1e-5], label="line")
    grid[0, 0].set(title="Title\nof two lines", ylabel="Label\nof two lines")
    grid[1, 1].set(xlabel="Label")
    figure.legend(loc="outside upper left")
    figure.supxlabel("Below all")
    figure.savefig(io.BytesIO(), dpi=80)
    return figure


def test_places_are_nearly_those_of_constrained_layout():
    own, known = labelled(MeasuredLayout()), labelled("constrained")
    for axes, expected in zip(own.axes, known.axes, strict=True):
        found, wanted = (one.get_position().extents for one in (axes, expected))
        np.testing.assert_allclose(found, wanted, atol=0.03)


def test_no_label_is_cut_or_overlaps_another_panel():
    figure = labelled(MeasuredLayout())
    renderer = FigureCanvasAgg(figure).get_renderer()
    boxes = [axes.get_tightbbox(renderer) for axes in figure.axes]
    for i, box in enumerate(boxes):
        assert box.x0 >= 0
        assert box.x1 <= figure.bbox.width
        assert box.y1 <= figure.bbox.height - figure.legends[0].get_window_extent().height
        assert box.y0 >= figure.texts[0].get_window_extent().y1
        assert not any(box.overlaps(other) for other in boxes[i + 1 :])


@pytest.mark.parametrize("kind", ["colour bar", "no room", "round"])
def test_other_figures_are_left_to_matplotlib(kind, recwarn):
    placed = []
    for engine in (MeasuredLayout(), "constrained"):
        figure = Figure(figsize=(0.3, 0.3) if kind == "no room" else (4, 3), layout=engine)
        axes = figure.subplots()
        drawn = axes.imshow(np.eye(3), aspect="equal" if kind == "round" else "auto")
        if kind == "colour bar":
            figure.colorbar(drawn, ax=axes)
        axes.set_ylabel("Label\nof\nmany\nlines")
        figure.savefig(io.BytesIO(), dpi=80)
        placed.append([one.get_position().extents for one in figure.axes])
    np.testing.assert_array_equal(*placed)
    assert bool(recwarn.list) == (kind == "no room")
