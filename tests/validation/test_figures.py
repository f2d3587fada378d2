"""Figures show what they are given, and the superpulses and differences that they show."""

from __future__ import annotations

from types import SimpleNamespace

import matplotlib as mpl
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.special import ndtr

from cpunet.errors import CpunetError
from cpunet.pulses.parameters import PARAMETERS, align_half_maximum
from cpunet.pulses.shape_parameters import SHAPE_PARAMETERS, data_axis
from cpunet.training.figures import loss_curves, sides_figure
from cpunet.validation import figures
from cpunet.validation.comparisons import compare
from cpunet.validation.drawings import nearest
from cpunet.validation.figures import shape_figure
from cpunet.validation.methods import true_responses
from cpunet.validation.peaks import MeanPulse, around_half, sliced
from synthetic import LOSS_NAMES, load_recipe, paired_scores, require_drawn
from synthetic import gaussian_edge as edge

SCORES = load_recipe("fast").scores.model_copy(update={"bootstraps": 10})
DT = 16.0
TIME = np.arange(800.0)


def log(n: int) -> list[dict]:
    losses = [dict.fromkeys(LOSS_NAMES, 1 / (i + 1)) for i in range(n)]
    return [{"iteration": 10 * i, "losses": of} for i, of in enumerate(losses)]


def edges(widths, centre=250.0):
    time = np.arange(600) - centre
    return edge(time, np.asarray(widths)[:, np.newaxis]).astype(np.float32)


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


def pulses(rng, n, width=5.0, noise=0.002):
    """Edges whose drift, a slow first third, has a random length; and their times in ns."""
    drift = rng.uniform(20, 120, n)[:, np.newaxis]
    time = np.arange(300) - 150 - rng.uniform(0, 1, n)[:, np.newaxis]
    slow = 0.3 * np.clip((time + drift) / drift, 0, 1)
    windows = slow + 0.7 * ndtr(time / width) + rng.normal(0, noise, (n, 300))
    return windows.astype(np.float32), drift[:, 0] * DT


def superpulses(slices, **sets):
    """Superpulses of sets of pulses and times, by name."""
    times = {name: of_set[1] for name, of_set in sets.items()}
    return sliced(lambda name: sets[name][0], times, DT, slices)


def test_superpulses_are_those_of_a_plain_loop():
    windows, times = pulses(np.random.default_rng(1), 90)
    times[:2] = np.nan, np.inf
    windows[4] = 0.0
    found, means = superpulses(3, data=(windows, times))
    edges = np.quantile(np.delete(times, [0, 1]), [0, 1 / 3, 2 / 3, 1])
    np.testing.assert_allclose(found, edges)
    edges[-1] += 0.01  # the last edge is included
    for i, pulse in enumerate(means["data"][1:]):
        rows = [r for r in range(90) if edges[i] <= times[r] < edges[i + 1] and r != 4]
        aligned = around_half(windows[rows], DT).astype(float)
        assert pulse.n == len(rows)
        np.testing.assert_allclose(pulse.mean, aligned.mean(axis=0), atol=1e-6)
        expected = aligned.std(axis=0, ddof=1) / np.sqrt(len(rows))
        np.testing.assert_allclose(pulse.error, expected, atol=1e-6)


def test_nothing_in_a_slice_is_no_failure():
    windows, times = pulses(np.random.default_rng(5), 40)
    _, means = superpulses(2, data=(windows, times), raw=(windows, times + 1e6))
    assert all(pulse.n == 0 for pulse in means["raw"][1:])
    columns = {str(i): {m: of[i] for m, of in means.items()} for i in (1, 2)}
    require_drawn(shape_figure(columns, DT, "SEP"))


@given(shift=st.floats(-40, 40), sigma=st.floats(3, 20))
def test_a_shift_is_no_difference(shift, sigma):
    truth = edge(TIME - 350, sigma)[np.newaxis].astype(np.float32)
    moved = edge(TIME - 350 - shift, sigma)[np.newaxis].astype(np.float32)
    scores = paired_scores(moved, truth, 100)
    assert scores.rmse < 3e-5
    assert scores.edge_rmse < 6e-5


def test_windows_of_the_two_scores():
    truth = np.repeat(edge(TIME - 400, 4.0)[np.newaxis], 2, axis=0).astype(np.float32)
    other = truth.copy()
    other[0, 520] -= 0.1  # beyond the edge's window, and not its maximum
    scores = paired_scores(other, truth, 100)
    assert scores.edge_rmse < 1e-6
    assert scores.rmse == pytest.approx(0.1 / np.sqrt(2 * 800), rel=0.01)
    other[0, 490] -= 0.1
    expected = 0.1 / np.sqrt(2 * 201)
    assert paired_scores(other, truth, 100).edge_rmse == pytest.approx(expected, rel=0.01)


def test_pairs_that_cannot_be_aligned_are_counted():
    truth = edge(TIME - np.linspace(330, 370, 5)[:, np.newaxis], 4.0).astype(np.float32)
    broken = truth.copy()
    broken[1] = 0
    broken[3, 5] = np.nan
    assert paired_scores(broken, truth, 100).unaligned == 2
    nothing = paired_scores(broken[[1]], truth[[1]], 100)
    assert nothing.rmse is None
    assert nothing.unaligned == 1


def prepared(index, n_read):
    return SimpleNamespace(prepared=SimpleNamespace(index=index, n_read=n_read), path="sim.lh5")


@pytest.mark.parametrize("dtype", [np.float16, np.float64])
def test_responses_are_those_of_the_pulses_in_use(tmp_path, dtype):
    path, response = tmp_path / "truth.npz", np.arange(40.0).reshape(20, 2).astype(dtype)
    np.savez_compressed(path, other=np.zeros(3), response=response)
    used = np.array([0, 1, 2, 9, 10, 17, 19])
    found = true_responses(path, prepared(used, 20))
    assert found.dtype == np.float32
    np.testing.assert_array_equal(found, response[used])
    np.savez(path, response=np.full((20, 2), np.inf))
    with pytest.raises(CpunetError, match=r"truth.npz: no response is finite"):
        true_responses(path, prepared(np.arange(20), 20))
    path.write_bytes(path.read_bytes()[:200])
    with pytest.raises(CpunetError, match="cannot be read as NumPy file"):
        true_responses(path, prepared(np.arange(20), 20))
