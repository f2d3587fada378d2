"""Preparation against a plain NumPy reading of its definition; prepared sets of sources."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import h5py
import numpy as np
import numpy.typing as npt
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from cpunet.pulses import loading
from cpunet.pulses.container import Pulses
from cpunet.pulses.peaks import parse_selection
from cpunet.pulses.preparation import Kind, Prepared, Rejection, prepare
from cpunet.pulses.provenance import describe_pulses
from cpunet.pulses.reading.files import PulseFile
from synthetic import PREPARATION as CONFIG
from synthetic import load_recipe, one_line

DT_NS = 16.0
Array = npt.NDArray[np.float64]


def measured(
    *, n=1, length=1200, start=560.0, amplitude=2e4, rise=25.0, tau_us=60.0, noise=8.0, seed=0
) -> Array:
    """Traces of a smooth charge pulse behind a resistive-feedback preamplifier."""
    rng = np.random.default_rng(seed)
    t = np.maximum(np.arange(length) - start, 0)
    pulse = (1 - np.exp(-((t / rise) ** 2))) * np.exp(-t * DT_NS / (1e3 * tau_us))
    return np.asarray(np.rint(14_000 + amplitude * pulse + rng.normal(0, noise, (n, length))))


def simulated(*, n: int = 1, length: int = 225, seed: int = 0) -> Array:
    """Monotone charge pulses that start anywhere and end flat."""
    rng = np.random.default_rng(seed)
    t = np.arange(length)
    drift = rng.uniform(10, 100, (n, 1))
    x = np.clip((t - rng.uniform(0, 20, (n, 1))) / drift, 0, 1)
    return np.asarray(x**2 * (3 - 2 * x))


def prepared_of(raw: npt.ArrayLike, kind: str = "measured", **changes: object) -> Prepared:
    config = CONFIG.model_copy(update=changes)
    return prepare(Pulses.of(raw, dt_ns=DT_NS), config, kind)  # type: ignore[arg-type]


def by_definition(trace: Array) -> tuple[Array, int]:
    """The definition for measured pulses, read literally, for one float64 trace."""
    base = trace[:200].mean()
    for _ in range(3):
        top = int(trace.argmax())
        below = np.flatnonzero(trace[:top] < base + 0.999 * (trace[top] - base))
        align = int(below[-1]) + 1
        window = trace[align - 400 : align + 400]
        base = window[:200].mean()
    window = window - base
    return window * 0.80 / window[-5:].mean(), align


class TestMeasured:
    def test_follows_the_definition(self) -> None:
        raw = measured(n=50)
        prepared = prepared_of(raw, align_at=0.999)
        windows, aligns = zip(*map(by_definition, raw), strict=True)
        np.testing.assert_array_equal(prepared.align_sample, aligns)
        np.testing.assert_allclose(prepared.pulses.waveforms, windows, atol=1e-6)

    def test_noise_tail_and_chi_square_are_those_put_in(self) -> None:
        prepared = prepared_of(measured(n=400, noise=10.0, tau_us=54.6))
        rms = prepared.baseline_rms * prepared.scale
        assert np.mean(rms) == pytest.approx(10.0, rel=0.02)
        assert np.mean(-1e3 / prepared.tail_slope) == pytest.approx(54.6, rel=0.002)
        # Expectation n/(n-2) from the estimated noise; the error of the mean is 0.006.
        assert np.mean(prepared.chi2) == pytest.approx(1.01, abs=0.03)
        assert abs(np.mean(prepared.baseline_slope)) < 0.05

    def test_preparing_again_changes_nothing(self) -> None:
        """No alignment is the nearest to its own crossing: 451.54 from 451, 451.49 from 452.

        Other pulses are in test_preparation_alignment.py.
        """
        once = prepared_of(measured(n=4, amplitude=500, start=410, rise=48.875, seed=536))
        twice = prepared_of(once.pulses.waveforms)
        assert twice.rejections == {}
        np.testing.assert_array_equal(twice.align_sample, 400)
        np.testing.assert_allclose(twice.pulses.waveforms, once.pulses.waveforms, atol=3e-7)
        np.testing.assert_allclose(twice.tail_slope, once.tail_slope, atol=1e-3)

    def test_early_pulse_is_padded_with_zero(self) -> None:
        prepared = prepared_of(measured(start=260.0, length=800))
        padding, window = 400 - int(prepared.align_sample[0]), prepared.pulses.waveforms[0]
        assert 0 < padding < 200
        assert np.all(window[:padding] == 0)
        assert np.all(window[padding : padding + 5] != 0)
        assert abs(window[padding:200].mean()) < 1e-6

    def test_what_is_not_a_pulse_is_counted_by_reason(self) -> None:
        good = measured()[0]
        noise = np.random.default_rng(1).normal(14_000, 10, 1200).round()

        def spoiled(where: int | slice, value: float) -> Array:
            trace = good.copy()
            trace[where] = value
            return trace

        traces = [good, spoiled(30, np.nan), spoiled(700, np.inf), np.full(1200, 5.0), noise]
        traces += [30_000 - good, spoiled(slice(650, None), 13_000), spoiled(900, 10_000)]
        prepared = prepared_of(np.array(traces))
        labels = [Rejection(c).label for c in prepared.codes]
        reasons = ["accepted", "nan", "nan", "constant"] + 3 * ["no_amplitude"]
        assert labels == [*reasons, "tail_not_positive"]
        assert sum(prepared.rejections.values()) + len(prepared) == prepared.n_read == 8

    @settings(max_examples=60, deadline=None)
    @given(length=st.integers(1, 900), seed=st.integers(0, 2**32 - 1), kind=st.booleans())
    def test_any_trace_is_accepted_or_counted(self, length: int, seed: int, kind: bool) -> None:
        rng = np.random.default_rng(seed)
        odds = {0.0: 0.4, 1.0: 0.2, -5.0: 0.2, 7.0: 0.199, np.nan: 0.001}
        raw = rng.choice([*odds], p=[*odds.values()], size=(5, length))
        raw[1] = np.sort(raw[1])
        raw[2] = 1e30 * rng.normal(size=length)
        prepared = prepared_of(raw, "simulated" if kind else "measured")
        assert len(prepared) + sum(prepared.rejections.values()) == prepared.n_read == 5
        assert np.isfinite(prepared.pulses.waveforms).all()
        assert np.isfinite(prepared.scale).all()


class TestSaturation:
    @pytest.mark.parametrize("ceiling", [30_000.0, 65_520.0, 65_535.0])
    @pytest.mark.parametrize("noise", [0.0, 0.3, 3.0, 30.0])
    def test_clipped_traces_are_found(self, ceiling: float, noise: float) -> None:
        raw = measured(n=20, amplitude=1.1 * (ceiling - 14_000), noise=noise)
        prepared = prepared_of(np.minimum(raw, ceiling))
        assert prepared.rejections == {"saturated": 20}

    @pytest.mark.parametrize("noise", [0.0, 0.3, 1.0, 3.0, 10.0])
    @pytest.mark.parametrize("amplitude", [200.0, 1000.0, 5000.0, 40_000.0])
    def test_coarse_steps_and_slow_decays_are_not(self, noise: float, amplitude: float) -> None:
        raw = measured(n=200, amplitude=amplitude, noise=noise, tau_us=550.0, length=1000)
        assert "saturated" not in prepared_of(raw).rejections


class TestSimulated:
    def test_scaled_to_one_aligned_and_padded(self) -> None:
        raw = 3 + 2 * simulated(n=20)
        prepared = prepared_of(raw, "simulated", align_at=0.999)
        windows = prepared.pulses.waveforms
        assert np.all(windows.min(1) == 0)
        np.testing.assert_allclose(windows.max(1), 1, rtol=1e-6)
        assert np.all(windows[:, 400] >= np.float32(0.999))
        assert np.all(windows[:, 399] < np.float32(0.999))
        for window, align, trace in zip(windows, prepared.align_sample, raw, strict=True):
            assert np.all(window[: 400 - align] == 0)
            inside = (trace - trace.min()) / np.ptp(trace)
            record = window[400 - align : 625 - align][: 400 + align]
            np.testing.assert_allclose(record, inside, atol=1e-6)
            assert np.all(window[625 - align :] == window[-1])

    def test_charge_of_the_first_sample_is_no_baseline(self) -> None:
        """A pulse that moves from the first sample on has moved by then; an offset has not."""
        drift = np.clip((np.arange(225) + 0.5) / 20, 0, 1)[np.newaxis]
        prepared = prepared_of(drift, "simulated")
        start, window = 400 - prepared.align_sample[0], prepared.pulses.waveforms[0]
        assert prepared.baseline[0] == 0.0
        np.testing.assert_allclose(window[start : start + 225], drift[0], atol=1e-7)
        assert not window[:start].any()
        offset = prepared_of(3 + 2 * drift, "simulated")
        assert offset.baseline[0] == pytest.approx(3 + 2 * drift[0, 0])


class TestSets:
    def test_rejecting_counts_and_choosing_does_not(self) -> None:
        prepared = prepared_of(np.concatenate([np.full((1, 1200), np.nan), measured(n=4)]))
        reasons = np.array([0, Rejection.CHI2, 0, Rejection.CHI2], np.uint8)
        cut = prepared.rejected(reasons)
        assert cut.rejections == {"nan": 1, "chi2": 2}
        assert cut.index.tolist() == [1, 3]
        assert len(cut) + sum(cut.rejections.values()) == cut.n_read
        assert prepared.rejections == {"nan": 1}
        chosen = prepared[np.array([2, 0])]
        assert chosen.index.tolist() == [3, 1]
        assert chosen.rejections == {"nan": 1}


def test_real_traces(reference_data) -> None:  # type: ignore[no-untyped-def]
    with h5py.File(reference_data / "real" / "hpge_real_waveforms.h5") as file:
        for group in file.values():
            prepared = prepared_of(group["waveform"][:])
            empty = group["is_baseline_only"][:].astype(bool)
            assert not empty[prepared.index].any()
        bench = file["th228_fcio"]
        codes = prepared_of(bench["waveform"][:]).codes
        saturated = bench["saturated"][:].astype(bool)
        np.testing.assert_array_equal(codes == Rejection.SATURATED, saturated)
        good = bench["clean"][:].astype(bool) & (bench["energy_keV"][:] > 300)
    assert (codes[good] == Rejection.ACCEPTED).mean() > 0.98


SIZES = {"before_ns": 320, "after_ns": 320, "baseline_ns": 160, "tail_ns": 32}
SIZES |= {"decay_fit_ns": 160, "padding_before_ns": 80}
SHORT = CONFIG.model_copy(update=SIZES)


def file_of(energies: npt.ArrayLike, broken: list[int] | None = None) -> PulseFile:
    energy_kev = np.asarray(energies, float)
    t = np.maximum(np.arange(60) - 27, 0)
    raw = np.nan_to_num(energy_kev, nan=500.0)[:, None] * np.minimum(t / 5, 1)
    raw *= np.exp(-t / 300)
    raw *= 1 + 1e-6 * np.arange(len(raw))[:, None]  # else they are copies
    raw[broken or []] = np.nan
    pulses = Pulses.of(raw, dt_ns=16, energy_kev=energy_kev)
    return PulseFile(Path("run7.lh5"), pulses=pulses, insist=True)


@pytest.fixture(autouse=True)
def small_blocks(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(loading, "BLOCK_SIZE", 4)


NEAR_1000 = parse_selection("900-1100", {})
FAST = load_recipe("fast")
WIDE = FAST.cuts.model_copy(update=dict.fromkeys(type(FAST.cuts).model_fields, 1e9))
RECIPE = FAST.model_copy(update={"preparation": SHORT, "cuts": WIDE})


def load(file: PulseFile, side: Kind = "measured", max_pulses: int | None = None) -> Prepared:
    return loading.load_pulses(file, side, RECIPE, NEAR_1000, max_pulses=max_pulses).prepared


def test_every_pulse_is_kept_or_counted() -> None:
    energies = [1000, 1001, 50, np.nan, 1002, 1003, 2000, 999, 998, np.nan]
    prepared = load(file_of(energies, [4]))
    assert prepared.pulses.energy_kev.tolist() == [1000, 1001, 1003, 999, 998]
    assert prepared.index.tolist() == [0, 1, 5, 7, 8]
    assert prepared.rejections == {"nan": 1, "energy_unknown": 2, "energy_outside_selection": 2}
    assert prepared.n_read == 10


@pytest.mark.parametrize("kind", ["measured", "simulated"])
@pytest.mark.parametrize("same_events", [True, False])
def test_rows_written_twice_count_once(kind, same_events) -> None:
    once = file_of([1000, 1001, 1002, 1003, 1004, 50])[:]
    again = once if same_events else replace(once, event_number=once.event_number + 6)
    twice = Pulses.concatenate([once, again])
    file = PulseFile(Path("run7.lh5"), pulses=twice, insist=True)
    prepared = load(file, kind)
    copies = 5 if same_events or kind == "measured" else 0
    assert prepared.rejections.get("copies", 0) == copies
    assert prepared.index.tolist() == [0, 1, 2, 3, 4, 6, 7, 8, 9, 10][: 10 - copies]
    source = file.open()
    lines = dict(describe_pulses(source, source.blocks(), {}))
    assert "6 traces copies of others" in lines["samples"]


@settings(max_examples=50, deadline=None)
@given(st.lists(st.sampled_from([1000.0, 50.0, np.nan]), min_size=1), st.integers(1, 20))
def test_counts_add_up(energies: list[float], max_pulses: int) -> None:
    file = file_of([*energies, 1000.0])
    prepared = load(file, max_pulses=max_pulses)
    assert len(prepared) + sum(prepared.rejections.values()) == prepared.n_read
    assert prepared.n_read == len(energies) + 1
    assert len(prepared) == min(max_pulses, energies.count(1000.0) + 1)
    assert (file.energy_kev[prepared.index] == 1000).all()


def test_of_too_many_a_sample_of_the_whole_file_is_kept() -> None:
    file = file_of([1000.0, 50.0] * 500)
    first, second = (load(file, max_pulses=60) for _ in range(2))
    assert (len(first), first.n_read) == (60, 1000)
    assert first.rejections == {"energy_outside_selection": 500, "not_drawn": 440}
    assert (first.index == second.index).all()
    assert (np.diff(first.index) > 0).all()
    # rows 0, 2 ... 998, each as likely: their mean is 499 with a scatter of 289 / sqrt(60)
    assert abs(first.index.mean() - 499) < 3 * 289 / 60**0.5
    assert (first.codes[first.index] == 0).all()
    whole = load(file)
    same = np.isin(whole.index, first.index)
    assert (whole.pulses.waveforms[same] == first.pulses.waveforms).all()


@pytest.mark.parametrize(
    ("energies", "broken", "words"),
    [
        ([], [], ["run7.lh5", "no pulses"]),
        ([50.0] * 9, [], ["9 energy_outside_selection", "calibration"]),
        ([1000.0] * 5 + [50.0], [*range(5)], ["5 nan, 1 energy_outside", "write them again"]),
        ([np.nan] * 3, [], ["3 energy_unknown", "calibrated energies"]),
    ],
)
def test_nothing_left_is_one_line_with_counts_and_remedy(energies, broken, words) -> None:
    one_line(lambda: load(file_of(energies, broken)), *words)
