"""Functions of single pulses against their definitions, and which pulses are compared."""

from __future__ import annotations

import numpy as np
import pytest

from cpunet.errors import CpunetError
from cpunet.pulses.container import FloatArray, Pulses
from cpunet.pulses.parameters import current_amplitude
from cpunet.pulses.preparation import prepare
from cpunet.training.moments import BLOCK, MIN_PULSES, Moments, stretch_name
from synthetic import load_recipe, two_sites
from unpaired import at_half_maximum

RECIPE = load_recipe("fast")
CONFIG, PREPARATION = RECIPE.matching.training, RECIPE.preparation
DT_NS, DECAY_US = 16.0, 54.6
BEFORE, AFTER = 200, 400  # samples added to a window to make it a record
LAST = BEFORE + PREPARATION.samples_before + 100
N = 500


def prepared(n: int = N, seed: int = 0, noise: float = 8e-4, width: float = 4) -> FloatArray:
    """Windows of two-site pulses with logistic edges, a decay and white noise."""
    rng = np.random.default_rng(seed)
    time = np.arange(1200)[np.newaxis]

    def site() -> np.ndarray:
        return 1 / (1 + np.exp(-(time - rng.uniform(500, 540, (n, 1))) / width))

    record = two_sites(rng, n, site, single=0, least=0)
    record *= np.exp(-np.maximum(time - 520, 0) * DT_NS * 1e-3 / DECAY_US)
    raw = Pulses.of(record + rng.normal(0, noise, record.shape), dt_ns=DT_NS)
    windows = prepare(raw, PREPARATION, "measured")
    assert len(windows) == n
    return windows.pulses.waveforms


def as_records(windows: FloatArray) -> FloatArray:
    """The windows with room around them, as a response puts out."""
    return np.pad(windows, ((0, 0), (BEFORE, AFTER)), mode="edge")


def functions_of(
    moments: Moments, records: FloatArray, clip: float | None = None
) -> np.ndarray:
    readings, _ = moments.read(records.copy(), LAST)
    return moments.functions(readings, clip)


@pytest.fixture(scope="module")
def windows() -> FloatArray:
    return prepared()


@pytest.fixture(scope="module")
def moments(windows: FloatArray) -> Moments:
    return Moments.of_data(windows, CONFIG, PREPARATION)


def column(moments: Moments, name: str) -> int:
    return moments.names.index(name)


def test_the_datas_own_windows_in_records_have_the_datas_own_values(moments, windows) -> None:
    again = functions_of(moments, as_records(windows))
    assert moments.values.shape == (N, len(moments.names))
    assert again.dtype == moments.values.dtype == np.float64
    slope = [column(moments, name) for name in ("tail slope", "tail slope squared")]
    shape = [i for i in range(len(moments.names)) if i not in slope]
    np.testing.assert_allclose(again[:, shape], moments.values[:, shape], atol=0.02)
    # 99.9 % of a noisy maximum may be found a few samples beside
    difference = np.abs(again - moments.values)[:, slope]
    assert np.quantile(difference, 0.9) < 1e-2
    assert difference.mean() < 0.05


def test_stretches_are_deviations_in_robust_standard_deviations(moments, windows) -> None:
    aligned = at_half_maximum(windows, moments.level, 401, CONFIG, PREPARATION.tail_level)
    first, stop = CONFIG.segments[6:8]
    means = aligned[:, CONFIG.before + first : CONFIG.before + stop].mean(axis=1)
    centre = np.median(means)
    sigma = 1.4826 * np.median(np.abs(means - centre))
    wanted = np.clip((means - centre) / sigma, -CONFIG.clip, CONFIG.clip)
    found = moments.values[:, column(moments, stretch_name(*CONFIG.segments_ns[6:8]))]
    np.testing.assert_allclose(found, wanted, atol=0.02)


def test_principal_components_are_uncorrelated_with_unit_variance() -> None:
    wide = CONFIG.model_copy(update={"clip": 1e6})
    moments = Moments.of_data(prepared(), wide, PREPARATION)
    first = column(moments, "component 1")
    # in units of the robust width, which is not theirs: correlations only
    found = np.corrcoef(moments.values[:, first : first + 6].T)
    np.testing.assert_allclose(found, np.eye(6), atol=0.02)
    squares = column(moments, "component 1 squared")
    np.testing.assert_allclose(moments.values[:, squares], moments.values[:, first] ** 2)


def test_the_density_of_the_current_amplitude_is_that_of_its_definition(
    moments, windows
) -> None:
    aligned = at_half_maximum(windows, moments.level, 401, CONFIG, PREPARATION.tail_level)
    amplitude = np.log(current_amplitude(aligned, 16.0))
    edges = np.quantile(amplitude, np.linspace(0.02, 0.995, CONFIG.amplitude_bins + 1))
    centres = 0.5 * (edges[1:] + edges[:-1])
    widths = np.maximum(np.diff(edges), CONFIG.amplitude_width)
    wanted = np.exp(-0.5 * ((amplitude[:, None] - centres) / widths) ** 2)
    first = column(moments, "current amplitude, bin 1")
    np.testing.assert_allclose(moments.values[:, first:], wanted, atol=2e-3)


def test_the_slope_of_the_tails_is_that_of_their_decay(moments) -> None:
    assert moments.slope == pytest.approx(-DT_NS * 1e-3 / DECAY_US, rel=0.01)


def test_outliers_are_clipped(moments, windows) -> None:
    records = as_records(windows[:3])
    records[0, LAST:] *= np.linspace(1, 0.3, records.shape[1] - LAST)
    records[1, BEFORE + 300 : BEFORE + 380] += 0.3
    linear = column(moments, "tail slope") + 1
    clipped = functions_of(moments, records)
    assert np.abs(clipped[:, :linear]).max() == CONFIG.clip
    assert np.abs(clipped).max() <= CONFIG.clip**2
    wider = functions_of(moments, records, clip=64.0)
    assert CONFIG.clip < np.abs(wider[:, :linear]).max() <= 64
    np.testing.assert_array_equal(
        wider[:, :linear].clip(-CONFIG.clip, CONFIG.clip), clipped[:, :linear]
    )


def test_pulses_that_are_not_whole_or_not_alone_are_left_out(moments, windows) -> None:
    spoilt = windows.copy()
    spoilt[3, 500] = np.nan
    spoilt[7, 240:300] += 0.5  # another pulse before this one
    found = Moments.of_data(spoilt, CONFIG, PREPARATION)
    assert len(found.values) == N - 2
    assert np.isfinite(found.values).all()
    assert found.level == pytest.approx(moments.level, rel=1e-3)
    good = np.delete(np.arange(N), [3, 7])
    stretches = len(CONFIG.segments) - 1  # the signs of components are anyone's choice
    np.testing.assert_allclose(
        found.values[:, :stretches], moments.values[good, :stretches], atol=0.1
    )


@pytest.mark.parametrize("first", ["steep", "slow"])
def test_the_order_of_the_data_does_not_leave_pulses_out(first: str) -> None:
    """Pulses are read in blocks, and most of one block can be much steeper than the rest."""
    steep, slow = prepared(BLOCK - 200, width=3), prepared(900, seed=1, width=30)
    ordered = np.concatenate([steep, slow] if first == "steep" else [slow, steep])
    assert Moments.of_data(ordered, CONFIG, PREPARATION).left_out == 0


@pytest.mark.parametrize("n", [1, 50, MIN_PULSES - 1])
def test_too_few_pulses_are_refused(windows, n: int) -> None:
    with pytest.raises(
        CpunetError, match=rf"^{n} measured pulses can be used; {MIN_PULSES} or more"
    ):
        Moments.of_data(windows[:n], CONFIG, PREPARATION)
