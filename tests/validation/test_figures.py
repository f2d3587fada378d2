"""Figures show what they are given, and leave matplotlib's settings alone."""

from __future__ import annotations

import matplotlib as mpl
import numpy as np
import pytest
from matplotlib.figure import Figure
from scipy.special import ndtr

from cpunet.electronics.tails_law import TailsLaw
from cpunet.pulses.parameters import PARAMETERS, align_half_maximum
from cpunet.pulses.shape_parameters import SHAPE_PARAMETERS, data_axis
from cpunet.recipes import load_recipe
from cpunet.training.figures import sides_figure
from cpunet.validation import run_figures
from cpunet.validation.comparisons import compare
from cpunet.validation.pulse_figures import (
    DataPulse,
    nearest,
    single_pulse_figure,
    spectrum_figure,
    tails_figure,
)
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


def test_further_parameters_are_drawn_each():
    rng = np.random.default_rng(0)
    names = ("rise_10_90", "t50", "tail_slope", "current_width", "baseline_rms")
    values = {
        name: {method: rng.normal(100, 5, 300) for method in ("data", "ren")} for name in names
    }
    figure = run_figures.further_histograms(values, 40, "SEP")
    require_drawn(figure)
    (axes,) = figure.axes
    told = [text.get_text() for text in axes.texts]
    assert all(SHAPE_PARAMETERS[name].axis_label in told for name in names)
    gids = [patch.get_gid() for patch in axes.patches]
    assert gids == ["method-data", "method-ren"] * len(names)


def test_all_eight_losses_are_drawn_with_their_moving_average():
    figure = run_figures.loss_curves(log(500))
    require_drawn(figure)
    lines = [line for axes in figure.axes for line in axes.lines]
    assert len(lines) == 2 * len(LOSSES) == 16
    average = figure.axes[1].lines[1].get_xydata()
    assert average.shape == (491, 2)
    assert average[0].tolist() == pytest.approx([90, np.mean(1 / np.arange(1, 11))])


def test_a_loss_of_every_third_iteration_is_drawn():
    records = log(60)
    for record in records:
        if record["iteration"] % 30:
            del record["losses"]["discriminator_data"]
    raw, average = run_figures.loss_curves(records).axes[2].lines[:2]
    np.testing.assert_array_equal(raw.get_xdata(), np.arange(0, 600, 30))
    assert np.isfinite(average.get_ydata()).sum() == 20


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


DT, ALIGN = 16.0, 300
TAU_US = 50.0


def edges(widths, centre=250.0, decay=True):
    time = np.arange(600) - centre
    pulses = ndtr(time / np.asarray(widths)[:, np.newaxis])
    if decay:
        pulses = pulses * np.exp(-np.clip(time, 0, None) * DT * 1e-3 / TAU_US)
    return pulses.astype(np.float32)


def test_the_nearest_pulse_is_that_of_a_plain_loop():
    rng = np.random.default_rng(0)
    windows = edges(rng.uniform(4, 20, 50)) + rng.normal(0, 0.003, (50, 600)).astype("f4")
    target = edges([9.0], centre=270.3)[0]
    wanted = align_half_maximum(target[np.newaxis], 100, 150)[0]
    rms = [
        np.sqrt(np.mean((align_half_maximum(w[np.newaxis], 100, 150)[0] - wanted) ** 2))
        for w in windows
    ]
    row, found = nearest(windows, target)
    assert row == int(np.argmin(rms))
    assert found == pytest.approx(min(rms), rel=1e-4)


def test_pulses_without_a_crossing_are_never_nearest():
    windows = edges([5.0, 6.0, 7.0])
    windows[1] = np.nan
    windows[0] = 0
    assert nearest(windows, edges([5.0])[0])[0] == 2


def test_a_pulse_of_which_little_is_in_the_record_is_not_compared():
    windows = np.concatenate([edges([9.0], centre=595.0), edges([5.0])])
    assert nearest(windows, edges([9.0])[0])[0] == 1


def test_single_pulses_lose_their_decay_below():
    data = edges([4.0, 8.0, 16.0])
    pulses = {"raw": edges([3.0], decay=False)[0], "ren": edges([8.0])[0]}
    beside = DataPulse.beside(pulses, data, DT, ALIGN)
    figure = single_pulse_figure(pulses, beside, DT, ALIGN, "SEP")
    require_drawn(figure)
    assert len(figure.axes) == 6
    title = figure.legends[0].get_title().get_text()
    assert "data pulse 1 is nearest to “REN translation”" in title
    below = figure.axes[2]
    assert "50 µs" in below.get_title()
    for line in below.lines:  # data, raw and REN
        plateau = line.get_ydata()[line.get_xdata() > 2000]
        assert np.nanmax(np.abs(plateau - 1)) < 2e-3
    above = figure.axes[0].lines[2].get_ydata()
    assert np.nanmin(above[700:]) < 0.95
    differences = figure.axes[4].lines[1].get_ydata()
    assert np.nanmax(np.abs(differences)) < 0.01


def test_spectra_hold_all_events_and_name_the_peaks():
    rng = np.random.default_rng(1)
    energies = {
        "data": np.append(rng.normal(2614.5, 2, 500), [np.nan, 100.0]),
        "raw": rng.normal(2614.5, 0.3, 900),
    }
    figure = spectrum_figure(energies, {"FEP": 2614.5, "far": 9000.0})
    require_drawn(figure)
    axes = figure.axes[0]
    for patch, n in zip(axes.patches, (501, 900), strict=True):
        data = patch.get_data()
        assert (data.values * np.diff(data.edges)).sum() == pytest.approx(1)
        assert np.diff(data.edges) == pytest.approx(2)
        assert f"n = {n}" in patch.get_label()
    assert "1 without energy" in axes.patches[0].get_label()
    assert [text.get_text() for text in axes.texts] == ["FEP"]


def test_a_single_outlier_does_not_widen_all_bins():
    kev = np.append(np.random.default_rng(1).normal(2614.5, 2, 500), 1e6)
    data = spectrum_figure({"data": kev}, {"FEP": 2614.5}).axes[0].patches[0].get_data()
    assert np.diff(data.edges) == pytest.approx(2)
    assert (data.values * np.diff(data.edges)).sum() == pytest.approx(1, abs=0.01)


def test_the_counts_of_pulses_are_those_of_the_files():
    some = {"data": edges([20.0] * 15), "raw": edges([10.0] * 5)}
    values = {axis: {side: np.arange(15.0) for side in some} for axis in ("time", "current")}
    figure = sides_figure(some, values, DT, {"data": 9000, "raw": 5})
    told = [text.get_text() for text in figure.legends[0].get_texts()]
    assert [text.partition(", ")[2] for text in told] == ["12 of 9000", "5 of 5"]


def test_the_sizes_that_a_training_keeps_are_drawn_beside_the_law():
    law = TailsLaw(1.0, 55.0, (100.0, 2000.0))
    kev = np.geomspace(2, 2000, 30)
    summary = {"rate_khz": 1.0, "rate_error_khz": 0.1, "decay_us": 55.0, "error_kev": 2.5}
    sizes = {"kev": kev.tolist(), "percent_above": (100 * law.share_above(kev)).tolist()}
    kept = {"traces": 5000, "sizes": sizes, "drawn": {"energies_kev": law.energies_kev}}
    axes = tails_figure(summary | kept).axes[0]
    measured, drawn = (line.get_ydata() for line in axes.lines[:2])
    np.testing.assert_allclose(measured, drawn)
    assert "1.00 ± 0.10 kHz" in axes.get_title()
