"""Figures show what they are given, and leave matplotlib's settings alone."""

from __future__ import annotations

import matplotlib as mpl
import numpy as np
import pytest
from matplotlib.figure import Figure
from scipy.special import ndtr

from cpunet.pulses.binning import data_axis
from cpunet.pulses.half_maximum import align_half_maximum
from cpunet.pulses.parameters import PARAMETERS
from cpunet.pulses.shape_parameters import SHAPE_PARAMETERS
from cpunet.recipes import load_recipe
from cpunet.validation import run_figures
from cpunet.validation.comparisons import compare
from cpunet.validation.slices import MeanPulse
from synthetic import require_drawn

SCORES = load_recipe("fast").scores.model_copy(update={"bootstraps": 10})
LOSSES = [name for panel in run_figures.LOSS_PANELS.values() for name in panel]


def log(n: int, names: list[str] = LOSSES) -> list[dict]:
    return [
        {"iteration": 10 * i, "losses": dict.fromkeys(names, 1 / (i + 1))} for i in range(n)
    ]


def histogram_figure(values: dict[str, np.ndarray]) -> Figure:
    data = {"drift_time": values["data"]}
    methods = {m: {"drift_time": v} for m, v in values.items() if m != "data"}
    comparison = compare(data, methods, SCORES, seed=1)["drift_time"]
    axis = data_axis(values["data"], SCORES.max_bins)
    return run_figures.parameter_histograms(values, axis, "drift_time", "SEP", comparison)


def pulses(n: int, centre: float = 350.0) -> np.ndarray:
    time = np.arange(800) - centre - np.linspace(0, 5, n)[:, np.newaxis]
    return ndtr(time / 5).astype(np.float32)


def test_further_parameters_have_a_panel_each():
    rng = np.random.default_rng(0)
    names = ("rise_10_90", "t50", "tail_slope", "current_width", "baseline_rms")
    values = {
        name: {method: rng.normal(100, 5, 300) for method in ("data", "ren")} for name in names
    }
    figure = run_figures.further_histograms(values, 40, "SEP")
    require_drawn(figure)
    shown = [axes for axes in figure.axes if axes.axison]
    assert len(shown) == len(names)
    assert shown[0].get_xlabel() == SHAPE_PARAMETERS["rise_10_90"].axis_label
    assert [patch.get_gid() for patch in shown[-1].patches] == ["method-data", "method-ren"]


def test_all_eight_losses_are_drawn_with_their_moving_average():
    figure = run_figures.loss_curves(log(50))
    require_drawn(figure)
    lines = [line for axes in figure.axes for line in axes.lines]
    assert len(lines) == 2 * len(LOSSES) == 16
    average = figure.axes[1].lines[1].get_xydata()
    assert average.shape == (41, 2)
    assert average[0].tolist() == pytest.approx([90, np.mean(1 / np.arange(1, 11))])


def test_a_loss_of_every_third_iteration_is_drawn():
    records = log(60)
    for record in records:
        if record["iteration"] % 30:
            del record["losses"]["discriminator_data"]
    raw, average = run_figures.loss_curves(records).axes[2].lines[:2]
    np.testing.assert_array_equal(raw.get_xdata(), np.arange(0, 600, 30))
    assert np.isfinite(average.get_ydata()).sum() == 11


def test_cycle_figure_draws_all_pulses_in_each_panel():
    sets = pulses(10)
    figure = run_figures.cycle_figure(sets, sets, sets, ("A", "B", "C"), 16.0)
    require_drawn(figure)
    assert [len(axes.lines) for axes in figure.axes] == [10, 10, 10]
    assert [axes.get_title() for axes in figure.axes] == ["A", "B", "C"]
    assert figure.axes[0].lines[0].get_xdata()[-1] == pytest.approx(799 * 0.016)


def test_histogram_legend_tells_scores_and_counts():
    rng = np.random.default_rng(0)
    values = {
        "data": rng.normal(1400, 100, 500),
        "raw": np.r_[rng.normal(900, 50, 400), np.nan],
        "ren": rng.normal(1410, 100, 400),
    }
    figure = histogram_figure(values)
    require_drawn(figure)
    texts = [text.get_text() for text in figure.legends[0].get_texts()]
    assert texts[0].startswith("Data (ceiling ")
    assert texts[1].startswith("Simulation (IoU ")
    assert texts[1].endswith("n = 401, 1 undefined")
    assert figure.axes[0].get_xlabel() == PARAMETERS["drift_time"].axis_label
    assert figure.legends[0].get_title().get_text().startswith("SEP")


def test_a_bar_too_high_for_the_figure_is_labelled():
    rng = np.random.default_rng(0)
    figure = histogram_figure({"data": rng.normal(0, 1, 500), "raw": np.full(400, 99.0)})
    require_drawn(figure)
    assert [text.get_text() for text in figure.axes[0].texts] == ["100 %"]
    assert figure.axes[0].get_ylim()[1] < 0.5


def mean_pulse(windows: np.ndarray) -> MeanPulse:
    return MeanPulse.of(align_half_maximum(windows, 100, 150))


def test_mean_pulse_differences_are_in_percent_of_the_charge():
    data = pulses(40)
    sets = {"data": data, "ren": 1.01 * data}
    means = {method: mean_pulse(windows) for method, windows in sets.items()}
    figure = run_figures.mean_pulses(means, 16.0, "DEP")
    require_drawn(figure)
    difference = figure.axes[1].lines[0].get_ydata()
    assert difference[-1] == pytest.approx(1.0, rel=1e-3)
    assert difference[100] == pytest.approx(0.5, rel=1e-2)


def test_global_settings_neither_change_nor_matter():
    before = dict(mpl.rcParams)
    with mpl.rc_context({"font.size": 30.0, "axes.grid": False}):
        figure = run_figures.loss_curves(log(5))
        assert mpl.rcParams["font.size"] == 30.0
    assert dict(mpl.rcParams) == before
    assert figure.axes[0].xaxis.label.get_size() == 10.0
