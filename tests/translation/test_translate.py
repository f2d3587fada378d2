"""Translation of files: bytes, columns, ADC counts, and what can go wrong."""

from __future__ import annotations

import multiprocessing
import os
import signal
from itertools import product

import awkward as ak
import h5py
import lh5
import numpy as np
import pytest
from lgdo import Array, ArrayOfEqualSizedArrays, Table, VectorOfVectors

from cpunet.electronics.drawn_pile_up import SIZES_KEV
from cpunet.errors import CpunetError
from cpunet.processes import outcomes
from cpunet.progress import Stage
from cpunet.pulses.container import Pulses
from cpunet.pulses.preparation import Rejection, prepare
from cpunet.pulses.provenance import provenance
from cpunet.pulses.reading.files import PulseFile, open_pulses
from cpunet.translation.options import Adc
from cpunet.translation.translate import translate
from cpunet.translation.translation import Counts
from cpunet.translation.translator import REN, noise_seed
from synthetic import edges, load_recipe, nearly_full_disk, write_chain, write_table

DT_NS, N = 16.0, 40
NOISE_KEV = 2.0
# the data of a run: 1 in prepared units was 26145.11 ADC at 2614.511 keV
BASELINE = {"name": "baseline", "centre": 14000.0, "low": 0, "high": 1}
DATA = {"cuts": {"amplitude": 26145.11, "noise": 9.0, "windows": [BASELINE]}}
DRAWN = {"rate_khz": 1.0, "decay_us": 50.0, "energies_kev": [100.0, 2000.0], "height": 0.9}
DRAWN |= {"lead_us": 0.0, "dt_ns": DT_NS, "passed": [float(kev < 30) for kev in SIZES_KEV]}
TAILS = {"rate_khz": 1.0, "drawn": DRAWN}
ADC = Adc(length=1400, n_pre=700)
PILED = ("n_piled", "piled_kev", "piled_ns")


def charge(n=N, seed=1):
    """Edges of random width that end at 1."""
    return edges(n, seed, at=80).astype(np.float32)


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    """A readout chain that was not fitted."""
    folder = tmp_path_factory.mktemp("runs") / "run"
    return write_chain(folder, noise_kev=NOISE_KEV, data=DATA)


@pytest.fixture(scope="module")
def busy(tmp_path_factory):
    """A chain of data with pile-up tails."""
    folder = tmp_path_factory.mktemp("runs") / "run"
    return write_chain(folder, noise_kev=NOISE_KEV, data=DATA, fit={"tails": TAILS})


def energies(n=N, seed=1):
    return np.random.default_rng(seed).uniform(500, 2600, n)


def sim_file(path, n=N, seed=1, **others):
    """An LH5 file by the LH5 library, with columns of many kinds."""
    numbers = {"event_number": 7 + 2 * np.arange(n)} | others
    return write_table(path, "geds/sim", charge(n, seed), energies(n, seed), **numbers)


def simulated(n=N):
    """The same pulses in memory."""
    return Pulses.of(charge(n), dt_ns=DT_NS, energy_kev=energies(n))


def many_columns(n=N):
    hits = ak.Array([[float(i)] * (i % 4) for i in range(n)])
    return {
        "edep": VectorOfVectors(hits, attrs={"units": "keV"}),
        "names": Array(np.array([b"a", b"bcd"] * (n // 2))),
        "drift_time": Array(np.arange(n) * 1.5, attrs={"units": "ns"}),
        "flag": Array(np.arange(n) % 3 == 0),
        "position": ArrayOfEqualSizedArrays(nda=np.arange(3.0 * n).reshape(n, 3)),
        "vertex": Table({"x": Array(np.arange(n)), "hits": VectorOfVectors(hits)}),
        "rejection": Array(np.full(n, 9)),
    }


def plain(column, rows=slice(None)):
    """A column of LH5 as nested lists."""
    if isinstance(column, Table):
        return {name: plain(inner, rows) for name, inner in column.items()}
    if isinstance(column, VectorOfVectors):
        return ak.to_list(column.view_as("ak")[rows])
    return column.nda[rows].tolist()


def values(path, table="geds/ren"):
    return lh5.read(f"{table}/waveform/values", path).nda


def names(folder):
    return sorted(path.name for path in folder.iterdir())


def require_deposit(half_ns):
    """The half rise of a translated pulse is that of the charge, delayed by two poles."""
    half = (charge() < 0.5).sum(axis=1) * DT_NS
    assert np.isfinite(half_ns).all()
    assert (np.abs(half_ns - half - 60) < 80).all(), half_ns - half


def test_all_other_columns_are_kept(run, tmp_path):
    source = sim_file(tmp_path / "sim.lh5", **many_columns())
    translate(run, source, tmp_path / "out.lh5")
    assert names(tmp_path) == ["out.lh5", "sim.lh5"]
    before, after = lh5.read("geds/sim", source), lh5.read("geds/ren", tmp_path / "out.lh5")
    assert set(after) == set(before) | {"rejection_source"}
    assert plain(after.rejection_source) == [9] * N
    assert plain(after.rejection) == [0] * N
    waveform = after.waveform
    assert (waveform.values.nda.shape, waveform.values.nda.dtype) == ((N, 800), np.float32)
    assert np.isfinite(waveform.values.nda).all()
    assert (waveform.dt.attrs["units"], set(waveform.dt.nda)) == ("ns", {DT_NS})
    require_deposit(waveform.t0.nda + 400 * DT_NS)  # sample 400 is where the pulse is aligned
    for name in set(before) - {"waveform", "rejection"}:
        assert plain(after[name]) == plain(before[name]), name
        assert after[name].attrs.get("units") == before[name].attrs.get("units")


def test_columns_of_other_formats_and_those_that_cannot_be_copied(run, tmp_path, caplog):
    with h5py.File(tmp_path / "sim.hdf5", "w") as file:
        file["waveform"], file["dt_ns"] = charge(), DT_NS
        file["energy_kev"], file["depth"] = np.full(N, 1000.0), np.arange(N)
        file["text"] = np.array(["a", "bc"] * (N // 2), dtype=object)
        file["short"] = np.arange(3)
        file["pair"] = np.ones(N, complex)
    out = tmp_path / "out.lh5"
    translate(run, tmp_path / "sim.hdf5", out)
    table = lh5.read("geds/ren", out)
    assert plain(table.depth) == list(range(N))
    assert plain(table.text) == [b"a", b"bc"] * (N // 2)
    told = " ".join(caplog.messages)
    assert "column short is left out: 3 rows for 40 pulses" in told
    assert "column pair is left out: of type complex128" in told
    assert {"short", "pair"}.isdisjoint(table)


def test_channels_have_noise_of_their_own(run, tmp_path):
    source = sim_file(tmp_path / "sim.lh5")
    with h5py.File(source, "a") as file:
        for channel in ("ch1", "ch2"):
            file.copy("geds/sim", f"{channel}/sim")
        del file["geds"]
    outcome = translate(run, PulseFile(source, "all"), tmp_path / "out")
    assert {n: of.counts.translated for n, of in outcome.done.items()} == {"ch1": N, "ch2": N}
    first, second = (values(tmp_path / "out" / f"ch{i}.lh5")[:, :300] for i in (1, 2))
    together = (first * second).mean() / (first.std() * second.std())
    assert together == pytest.approx(0, abs=0.05)


def test_all_that_pulses_can_be_gives_the_same(run, tmp_path):
    """A path, a file, pulses and arrays; in memory, streamed, and saved later."""
    path = sim_file(tmp_path / "sim.lh5", **many_columns())
    pulses = open_pulses(path).read()
    kept = translate(run, path, seed=4)
    assert kept.waveforms.shape == (len(kept), 800) == (N, 800)
    translate(run, PulseFile(path), tmp_path / "streamed.lh5", seed=4)
    translate(run, pulses, tmp_path / "given.lh5", seed=4)
    kept.save(tmp_path / "saved.lh5")
    for name in ("streamed", "given", "saved"):
        np.testing.assert_array_equal(values(tmp_path / f"{name}.lh5"), kept.waveforms)
    assert "noise True, seed 4" in provenance(open_pulses(tmp_path / "given.lh5"))["options"]
    resumed = translate(run, pulses, tmp_path / "given.lh5", seed=4, resume=True)
    assert resumed.counts.skipped
    with pytest.raises(CpunetError, match="holds these pulses already"):
        resumed.save(tmp_path / "again.lh5")
    with pytest.raises(CpunetError, match=r"saved.lh5: exists already"):
        kept.save(tmp_path / "saved.lh5")
    with pytest.raises(CpunetError, match="was made with another source"):
        translate(run, pulses[1:], tmp_path / "given.lh5", seed=4, resume=True)
    array = translate(run, pulses.waveforms, noise=False)
    assert array.pulses.dt_ns == DT_NS
    expected = translate(run, pulses, noise=False).waveforms
    np.testing.assert_array_equal(array.waveforms, expected)
    table = kept.to_dataframe()
    assert len(table) == N
    assert {"energy_kev", "rejection", "current_amplitude"} <= set(table)
    for nothing in ([], pulses[:0]):
        with pytest.raises(CpunetError, match="no pulses"):
            translate(run, nothing)
    with pytest.raises(CpunetError, match="several files or tables do not stay in memory"):
        translate(run, [path, path])


def test_seeds_differ_by_file_and_block():
    each = product((0, 1), (None, "a.lh5", "b.lh5"), (0, 1))
    assert len({noise_seed(*of_block) for of_block in each}) == 12
    assert noise_seed(5, None, 0) == 5
    assert noise_seed(5, "s\udcff.lh5", 0) != 5  # a name that is not UTF-8


@pytest.fixture(scope="module")
def many(tmp_path_factory):
    folder = tmp_path_factory.mktemp("many")
    return [PulseFile(sim_file(folder / f"sim_{i}.lh5", seed=i)) for i in range(3)]


@pytest.fixture(scope="module")
def sequential(run, many, tmp_path_factory):
    out = tmp_path_factory.mktemp("sequential") / "out"
    translate(run, many, out)
    return out


def require_same(folder, expected):
    assert names(folder) == names(expected)
    for path in expected.iterdir():
        assert (folder / path.name).read_bytes() == path.read_bytes()


@pytest.mark.parametrize("jobs", [1, pytest.param(2, marks=pytest.mark.slow)])
def test_processes_change_nothing_and_a_bad_file_does_not_keep_the_others(
    run, many, sequential, tmp_path, caplog, jobs
):
    bad, out = tmp_path / "bad.lh5", tmp_path / "out"
    bad.write_bytes(many[0].path.read_bytes()[:3000])
    sources = [PulseFile(bad), *many]
    with pytest.raises(CpunetError, match=r"1 of 4 files failed, .*bad.lh5.* 3 are in"):
        translate(run, sources, out, jobs=jobs)
    assert sum("bad.lh5" in note for note in caplog.messages) == 1
    require_same(out, sequential)
    assert multiprocessing.active_children() == []


def test_resume_skips_what_is_finished_and_refuses_what_was_made_otherwise(
    run, network, many, sequential, tmp_path
):
    out = tmp_path / "out"
    translate(run, many[:2], out)
    before = [(out / f"sim_{i}.lh5").stat().st_mtime_ns for i in (0, 1)]
    with pytest.raises(CpunetError, match="exists already"):
        translate(run, many, out)
    told = translate(run, many, out, resume=True).counts
    assert (told.skipped, told.translated) == (2, 3 * N)
    assert [(out / f"sim_{i}.lh5").stat().st_mtime_ns for i in (0, 1)] == before
    require_same(out, sequential)
    other = PulseFile(sim_file(tmp_path / "sim_0.lh5", seed=9))
    foreign = tmp_path / "foreign"
    foreign.mkdir()
    (foreign / "sim_0.lh5").write_bytes(b"x")
    for of, sources, out, options, said in (
        (network, many, sequential, {}, "another run"),
        (run, many, sequential, {"seed": 1}, r"other options \(seed\)"),
        (run, many, sequential, {"noise": False}, r"other options \(noise\)"),
        (run, [other], sequential, {}, "another source"),
        (run, many[:1], foreign, {}, "no translation that is finished"),
    ):
        with pytest.raises(CpunetError, match=said):
            translate(of, sources, f"{out}/", **options, resume=True)


@pytest.mark.parametrize("adc", [Adc(), ADC])
def test_traces_in_adc_counts(run, tmp_path, adc):
    source, out = sim_file(tmp_path / "sim.lh5"), tmp_path / "out.lh5"
    told = translate(run, source, out, adc=True, scale=adc).counts
    assert (told.translated, told.saturated) == (N, 0)
    length, n_pre = adc.length or 800, adc.n_pre or 400
    table = lh5.read("geds/ren", out)
    traces = table.waveform.values.nda
    assert (traces.dtype, traces.shape) == (np.uint16, (N, length))
    assert table.waveform.values.attrs["sample_units"] == "ADC"
    require_deposit(table.waveform.t0.nda + n_pre * DT_NS)
    # the stored data: baseline 14000, and 10 ADC per keV and prepared unit
    energy = table.energy.nda
    assert traces[:, :200].mean() == pytest.approx(14_000, abs=2)
    white = traces[:, :200].std(axis=1).mean()
    assert white == pytest.approx(10 * NOISE_KEV, rel=0.05)
    end = traces[:, n_pre + 395 : n_pre + 400].mean(axis=1) - 14_000
    np.testing.assert_allclose(end / energy, 8.0, atol=5 * 20 / np.sqrt(5) / energy.min())
    # prepared again they are what translation gives without ADC
    config = load_recipe("fast").preparation
    clean = translate(run, source, adc=True, scale=adc, noise=False)
    back = prepare(clean.pulses, config, "measured")
    assert set(np.abs(back.align_sample - n_pre)) <= {0, 1}
    windows = REN.load(run).translate(charge(), noise=False)
    same = back.align_sample == n_pre
    assert same.sum() > N / 3
    wanted = windows[back.index[same]]
    np.testing.assert_allclose(back.pulses.waveforms[same], wanted, atol=1.2 / 5000)


def test_noise_runs_all_along_a_chains_record_and_is_filled_in_for_a_network(
    run, network, caplog
):
    traces = translate(run, simulated(), adc=True, scale=ADC).waveforms.astype(float)
    for part in (slice(0, 250), slice(1150, 1400)):
        steps = np.diff(traces[:, part], axis=1).std(axis=1) / np.sqrt(2)
        assert steps.mean() == pytest.approx(10 * NOISE_KEV, rel=0.05)
    given = Adc(adc_per_kev=8.0, baseline=14_000, length=1000, n_pre=500)
    of_network = translate(network, simulated(), adc=True, scale=given, noise=False)
    assert len(of_network) == N
    assert any("beyond them stand baseline and decay" in note for note in caplog.messages)
    assert (of_network.waveforms[:, :100] == 14_000).all()


def test_saturated_and_lost_pulses_are_counted(run):
    waveforms, kev = charge(6), np.array([1000.0, 6500.0, np.nan, 1000.0, 6500.0, 1000.0])
    waveforms[3] = 0.5
    pulses = Pulses.of(waveforms, dt_ns=DT_NS, energy_kev=kev)
    done = translate(run, pulses, adc=True, scale=ADC)
    assert done.counts == Counts(6, 4, {"constant": 1, "energy_unknown": 1}, saturated=2)
    assert (done.waveforms[[2, 3]] == 0).all()
    assert done.waveforms.max(axis=1)[[1, 4]].tolist() == [65535, 65535]
    codes = [Rejection(code).label for code in done.codes]
    assert codes == ["accepted", "accepted", "energy_unknown", "constant"] + 2 * ["accepted"]


@pytest.mark.parametrize(
    ("counts", "bits", "ends", "kind"),
    [
        ((120, 16_383), None, (0, 16_383), "u2"),
        ((120, 13_000), None, (0, 16_383), "u2"),
        ((-200, 7000), None, (-8192, 8191), "i2"),
        ((0, 70_000), None, (0, 131_071), "u4"),
        ((120, 16_383), 12, (0, 4095), "u2"),
        (None, None, (0, 65_535), "u2"),
    ],
)
def test_counts_are_clipped_where_the_digitisers_end(tmp_path, counts, bits, ends, kind):
    data = DATA | {"counts": counts}
    run = write_chain(tmp_path / "run", noise_kev=NOISE_KEV, data=data)
    kev = np.array([0.3, 0.5, 1.2, 1.3, 1.4, 1.5]) * ends[1] / 4
    pulses = Pulses.of(charge(6), dt_ns=DT_NS, energy_kev=kev)
    scale = Adc(adc_per_kev=4.0, baseline=100.0, bits=bits)
    options = {"adc": True, "scale": scale, "noise": False}
    told = translate(run, pulses, tmp_path / "out.lh5", **options).counts
    assert told.saturated == 4
    traces = values(tmp_path / "out.lh5")
    assert (traces.dtype, traces.max()) == (np.dtype(kind), ends[1])
    # the gain is the height of a fast pulse
    np.testing.assert_allclose((traces.max(axis=1)[:2] - 100.0) / kev[:2], 4.0, rtol=0.01)


@pytest.mark.parametrize("height", [0.0, np.nan])
def test_a_run_that_makes_no_pulse_has_no_gain(run, monkeypatch, height):
    monkeypatch.setattr(REN, "apply", lambda _, pulses, **how: np.full_like(pulses, height))
    with pytest.raises(CpunetError, match="cannot translate a fast pulse; train again"):
        translate(run, simulated(), adc=True, scale=Adc(adc_per_kev=4.0), noise=False)


def truth(done, *names):
    """What was drawn for each pulse."""
    return [done.in_memory.truth[name][0] for name in names]


def test_learned_tails_are_those_behind_the_cuts(busy, tmp_path):
    done = translate(busy, simulated(40 * N), tails="learned")
    (left,) = truth(done, "tails_kev")
    assert len(left) == 40 * N
    assert left.max() < 40
    assert (left > 5).mean() == pytest.approx(0.13, abs=0.04)
    # behind a baseline that falls tails lie lower, and are scaled up to the same level
    higher = done.waveforms[:, 430:460].mean(axis=1)
    assert np.corrcoef(left / done.pulses.energy_kev, higher)[0, 1] > 0.4
    translate(busy, simulated(40 * N), tmp_path / "out.lh5", tails="1")
    assert lh5.read("geds/ren/tails_kev", tmp_path / "out.lh5").nda.max() > 100


def test_tails_lift_the_baselines_of_raw_traces(busy):
    how = {"adc": True, "scale": ADC, "seed": 3}
    none, lifted = (translate(busy, simulated(), tails=tails, **how) for tails in ("none", "3"))
    (left,) = truth(lifted, "tails_kev")
    assert (left > 20).sum() > 5
    # 9 ADC per keV of height 0.9
    wanted = left * 0.9 * 26145.11 / 2614.511
    begin = (lifted.waveforms - none.waveforms)[:, :300].mean(axis=1)
    assert begin == pytest.approx(wanted * np.exp(-2.4 / 50), abs=25)


def test_piled_up_pulses_are_within_raw_traces_and_told(busy):
    sim, how = simulated(5 * N), {"adc": True, "scale": ADC, "seed": 3}
    none, some = (translate(busy, sim, pile_up_khz=rate, **how) for rate in (0, 20))
    assert not none.in_memory.truth
    count, kev, after_ns = truth(some, *PILED)
    assert 0 < (count > 0).sum() < 5 * N
    assert np.array_equal(np.isnan(kev), count == 0)
    added = some.waveforms - none.waveforms
    # away from the pulse, the trace rises by the piled-up pulse's energy where it is said
    single = (count == 1) & (np.abs(after_ns) > 1500) & (np.abs(after_ns) < 7000)
    assert single.sum() >= 3
    for row in np.flatnonzero(single):
        at = ADC.n_pre + int(after_ns[row] / DT_NS)
        assert added[row, at - 100 : at - 60].mean() == pytest.approx(0, abs=15)
        wanted = kev[row] * 0.9 * 26145.11 / 2614.511
        assert added[row, at + 40 : at + 50].mean() == pytest.approx(wanted, rel=0.1, abs=40)


def test_piled_up_pulses_are_within_windows(busy, tmp_path):
    out = tmp_path / "some.lh5"
    translate(busy, simulated(10 * N), out, pile_up_khz=20, seed=3)
    table = lh5.read("geds/ren", out)
    count, kev, after_ns = (table[name].nda for name in PILED)
    assert len(count) == 10 * N
    # 20 kHz for a record of 1,400 samples of 16 ns
    assert count.mean() == pytest.approx(0.448, abs=0.1)
    # baselines are flat but behind a piled-up pulse, or on its edge
    windows = values(out)
    tilt = np.abs(windows[:, :50].mean(axis=1) - windows[:, 100:150].mean(axis=1))
    assert tilt[count == 0].max() < 0.03
    inside = (count == 1) & (after_ns > -4500) & (after_ns < -2000) & (kev > 200)
    assert inside.sum() >= 3
    heights = windows[inside].max(axis=1)
    # those within the tail are rejected, as they are in data
    assert (heights[np.isfinite(heights)] > 0.05).all()
    assert np.isfinite(heights).any()


@pytest.mark.parametrize(
    ("options", "said"),
    [
        ({"pile_up_khz": -1.0}, "expected a rate in kHz, 0 or more"),
        ({"pile_up_khz": 1e6}, "give a lower rate"),
        ({"pile_up_khz": 1.0, "noise": False}, "or translate with noise"),
        ({"pile_up_khz": 1.0, "inverse": True}, "leave out `pile_up_khz`"),
        ({"out_table": ""}, "`out_table` is empty"),
        ({"inverse": True, "adc": True}, "leave out `adc`"),
        ({"adc": True, "scale": Adc(bits=40)}, "`bits` is 40; expected 1 to 24"),
        ({"adc": True, "scale": Adc(adc_per_kev=0)}, "expected a number above 0"),
        ({"adc": True, "scale": Adc(baseline=-1)}, "expected a number that is not negative"),
        ({"adc": True, "scale": Adc(length=100, n_pre=100)}, "not within a trace"),
        ({"jobs": 0}, "`jobs` is 0; expected 1 or more"),
        ({"seed": -1}, "`seed` is -1; expected a whole number from 0"),
        ({"tails": "many"}, "`tails` is many; expected learned, none, or a rate in kHz"),
        ({"tails": "learned", "noise": False}, "or translate with noise"),
        ({"tails": "learned", "inverse": True}, "leave out `tails`"),
    ],
)
def test_options_that_cannot_be(busy, tmp_path, options, said):
    with pytest.raises(CpunetError, match=said):
        translate(busy, simulated(), tmp_path / "out.lh5", **options)


def test_runs_that_tell_of_no_tails(run, network):
    for folder in (run, network):
        with pytest.raises(CpunetError, match="the run tells nothing of pile-up tails"):
            translate(folder, simulated(), tails="1")
        with pytest.raises(CpunetError, match=r"tells nothing of .* other pulses"):
            translate(folder, simulated(), pile_up_khz=1)


def test_a_file_that_changes_meanwhile_gives_no_output(run, tmp_path, monkeypatch):
    source = sim_file(tmp_path / "sim.lh5")

    monkeypatch.setattr(Stage, "update", lambda *_: os.utime(source, ns=(0, 0)))
    with pytest.raises(CpunetError, match=r"sim.lh5: changed while it was read"):
        translate(run, source, tmp_path / "out.lh5")
    assert names(tmp_path) == ["sim.lh5"]


def test_a_full_disk_leaves_one_line_and_nothing_else(run, tmp_path):
    source, out = sim_file(tmp_path / "sim.lh5", n=400), tmp_path / "out" / "out.lh5"
    listing = r"out.lh5: cannot be written \(File too large\); make room"
    for size in (source.stat().st_size // 2, source.stat().st_size + 100_000):
        with nearly_full_disk(size), pytest.raises(CpunetError, match=listing):
            translate(run, source, out)
        assert names(out.parent) == []


def killed():
    """Work that the system ends, as for lack of memory."""
    return lambda _task: os.kill(os.getpid(), signal.SIGKILL)


@pytest.mark.thorough
def test_a_process_that_is_killed_is_told():
    with pytest.raises(CpunetError, match="a process was ended, perhaps for lack of memory"):
        list(outcomes(killed, ["a", "b"], 2))
    assert multiprocessing.active_children() == []


def test_names(run, many, sequential, tmp_path):
    folder = many[0].path.parent
    translate(run, str(folder / "sim_*.lh5"), tmp_path / "all")
    require_same(tmp_path / "all", sequential)
    strange = sim_file(tmp_path / "a[1].lh5")  # a file may be named like a pattern
    assert len(translate(run, strange, noise=False)) == N
    with pytest.raises(CpunetError, match=r"other.lh5: no such file; check the name"):
        translate(run, folder / "other.lh5")
    with pytest.raises(CpunetError, match=r"x\*.lh5: no such files; check the name"):
        translate(run, folder / "x*.lh5")
    with pytest.raises(CpunetError, match="is a file, but several outputs need a folder"):
        translate(run, many, many[0].path)
    twice = [many[0], many[0]]
    with pytest.raises(CpunetError, match=r"occur twice among the files, as sim_0.lh5"):
        translate(run, twice, tmp_path / "out")
    shared = [PulseFile(one.path, energy="hit.lh5:a/b") for one in many]
    with pytest.raises(CpunetError, match="belongs to one file"):
        translate(run, shared, tmp_path / "out")
    # the other input is a link to a file that has the name of the output
    sim_file(tmp_path / "sim_0.lh5")
    (tmp_path / "links").mkdir()
    (tmp_path / "links" / "sim_1.lh5").symlink_to(tmp_path / "sim_0.lh5")
    linked = [many[0], tmp_path / "links" / "sim_1.lh5"]
    with pytest.raises(CpunetError, match=r"sim_0\.lh5: is the input; choose another"):
        translate(run, linked, tmp_path, force=True)
