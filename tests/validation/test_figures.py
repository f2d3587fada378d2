"""Figures show what they are given, and leave matplotlib's settings alone."""

from __future__ import annotations

import matplotlib as mpl
import numpy as np
import pytest
from scipy.special import ndtr

from cpunet.pulses.parameters import PARAMETERS, align_half_maximum
from cpunet.pulses.shape_parameters import SHAPE_PARAMETERS, data_axis
from cpunet.training.figures import loss_curves, sides_figure
from cpunet.validation import figures
from cpunet.validation.comparisons import compare
from cpunet.validation.drawings import nearest
from cpunet.validation.figures import shape_figure
from cpunet.validation.peaks import MeanPulse, around_half
from synthetic import LOSS_NAMES, load_recipe, require_drawn

SCORES = load_recipe("fast").scores.model_copy(update={"bootstraps": 10})


def log(n: int) -> list[dict]:
    losses = [dict.fromkeys(LOSS_NAMES, 1 / (i + 1)) for i in range(n)]
    return [{"iteration": 10 * i, "losses": of} for i, of in enumerate(losses)]


def edges(widths, centre=250.0):
    time = np.arange(600) - centre
    return ndtr(time / np.asarray(widths)[:, np.newaxis]).astype(np.float32)


def test_further_parameters_are_drawn_each():
    rng = np.random.default_rng(0)
    names = ("rise_10_90", "t50", "tail_slope", "rise_90_99", "baseline_rms")
    values = {
        name: {method: rng.normal(100, 5, 300) for method in ("data", "ren")} for name in names
    }
    figure = figures.further_histograms(values, 40, "SEP")
    require_drawn(figure)
    for axes, name in zip(figure.axes, names, strict=False):
        assert axes.get_xlabel() == SHAPE_PARAMETERS[name].axis_label
        assert [p.get_gid() for p in axes.patches] == ["method-data", "method-ren"]


def test_all_losses_are_drawn_with_their_moving_average():
    records = log(500)
    for record in records:
        if record["iteration"] % 30:
            del record["losses"]["discriminator_data"]
    figure = loss_curves(records)
    require_drawn(figure)
    assert [len(axes.lines) for axes in figure.axes] == [len(LOSS_NAMES) / 2] * 4
    average = figure.axes[1].lines[0].get_xydata()
    assert average.shape == (491, 2)
    assert average[0].tolist() == pytest.approx([90, np.mean(1 / np.arange(1, 11))])
    average, raw = figure.axes[3].lines[:2]
    assert average.get_label() == "discriminator data"
    np.testing.assert_array_equal(raw.get_xdata(), np.arange(0, 5000, 30))


def test_histogram_legend_tells_scores_and_counts():
    rng = np.random.default_rng(0)
    values = {
        "data": rng.normal(1400, 100, 500),
        "raw": np.r_[rng.normal(900, 50, 400), np.nan],
        "ren": rng.normal(1410, 100, 400),
    }
    data, *methods = ({"drift_time": v} for v in values.values())
    comparison = compare(data, dict(zip(("raw", "ren"), methods, strict=True)), SCORES, 1)
    axis, name = data_axis(values["data"], SCORES.max_bins), "drift_time"
    figure = figures.parameter_histograms(values, axis, name, "SEP", comparison[name])
    require_drawn(figure)
    texts = [text.get_text() for text in figure.legends[0].get_texts()]
    assert texts[0].startswith("Data (data vs data ")
    assert texts[1].startswith("Simulation (IoU ")
    assert texts[1].endswith("n = 401, 1 undefined, 99 % outside")
    assert "outside" not in texts[0]
    assert figure.axes[1].get_xlabel() == PARAMETERS["drift_time"].axis_label
    assert figure.legends[0].get_title().get_text().startswith("SEP")


def test_differences_of_mean_pulses_are_in_standard_errors():
    data = edges([5.0] * 40) + np.random.default_rng(2).normal(0, 1e-3, (40, 600))
    sets = {"data": data, "raw": 1.3 * data, "ren": 1.01 * data}
    means = {m: MeanPulse.of(align_half_maximum(w, 100, 150)) for m, w in sets.items()}
    figure = shape_figure({"all": means, "again": means}, 16.0, "DEP")
    require_drawn(figure)
    assert [axes.get_title() for axes in figure.axes] == ["all", "again", "", ""]
    raw, ren = (line.get_ydata() for line in figure.axes[3].lines[:2])
    np.testing.assert_allclose(raw, 0, atol=0.1)  # at the height of the data
    error = np.hypot(means["data"].error[-1], means["ren"].error[-1])
    assert ren[-1] == pytest.approx(0.01 * means["data"].mean[-1] / error, rel=1e-3)


def test_global_settings_neither_change_nor_matter():
    before = dict(mpl.rcParams)
    with mpl.rc_context({"font.size": 30.0, "axes.grid": False}):
        figure = loss_curves(log(5))
        assert mpl.rcParams["font.size"] == 30.0
    assert dict(mpl.rcParams) == before
    assert figure.axes[0].xaxis.label.get_size() == 10.0


def shape(width, centre=250.0):
    return align_half_maximum(edges([width], centre), 100, 150)[0]


def test_the_nearest_pulse_is_that_of_a_plain_loop():
    rng = np.random.default_rng(0)
    windows = edges(rng.uniform(4, 20, 50)) + rng.normal(0, 0.003, (50, 600)).astype("f4")
    wanted = shape(9.0, centre=270.3)
    aligned = [align_half_maximum(pulse[np.newaxis], 100, 150)[0] for pulse in windows]
    rms = [np.sqrt(np.mean((pulse - wanted) ** 2)) for pulse in aligned]
    row, found = nearest(around_half(windows, 16.0), wanted)
    assert row == int(np.argmin(rms))
    assert found == pytest.approx(min(rms), rel=1e-4)
    # pulses that cannot be compared are never nearest
    windows = np.concatenate([edges([9.0], centre=595.0), edges([5.0, 6.0, 7.0])])
    windows[1], windows[2] = 0, np.nan  # and of the first, little is in the record
    assert nearest(around_half(windows, 16.0), shape(9.0))[0] == 3


def test_the_counts_of_pulses_are_those_of_the_files():
    some = {"data": edges([20.0] * 15), "raw": edges([10.0] * 5)}
    values = {axis: {side: np.arange(15.0) for side in some} for axis in ("time", "current")}
    figure = sides_figure(some, values, 16.0, {"data": 9000, "raw": 5})
    told = [text.get_text() for text in figure.legends[0].get_texts()]
    assert [text.partition(", ")[2] for text in told] == ["12 of 9000", "5 of 5"]
