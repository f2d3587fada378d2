"""What `info` says of files, detectors and folders, and what `load` opens."""

from __future__ import annotations

import json
from pathlib import Path
from types import SimpleNamespace

import h5py
import numpy as np
import pytest

from cpunet import CpunetError, FileOptions, PulseFile, info, load
from cpunet.electronics.pile_up_tails import PileUpTails
from cpunet.pulses.baselines import Baselines
from cpunet.pulses.container import Pulses
from cpunet.pulses.provenance import left_out, trace_properties
from cpunet.simulation.hit_files import describe_hits
from cpunet.training import chain_description
from synthetic import load_recipe, status_of, write_csv, write_pulses, write_run

RECIPE = load_recipe("fast")
DT = FileOptions(dt_ns=16)
INFO = {"peak": "FEP", "seed": 7, "seconds": 12.5, "device": "cpu", "dt_ns": 16.0}


def test_a_file_of_pulses(tmp_path):
    waveforms = np.tile(np.arange(20.0), (6, 1))
    waveforms[1, 3] = np.nan
    waveforms[2, 4] = np.inf
    waveforms[3] = 7.0
    waveforms[4, 0] = -3.0
    energies = [2614.0, 2615.0, 2103.0, 500.0, np.nan, 100.0]
    path = tmp_path / "pulses.lh5"
    write_pulses(path, Pulses.of(waveforms, dt_ns=16, energy_kev=energies))
    assert dict(info(path).lines) == {
        "file": str(path),
        "format": "LH5, table geds/sim/waveform",
        "traces": "6 of 20 samples, every 16 ns",
        "columns": "energy, event_number",
        "energy": "column energy [keV], 100 … 2615 keV; 1 pulses have none",
        "lines": "2 FEP, 1 SEP",
        "source": "",
        "amplitudes": "",
        "samples": "values -3 … 19; 2 traces not finite; 1 traces constant; "
        "1 traces copies of others",
    }


def test_a_file_is_opened(tmp_path):
    path = tmp_path / "pulses.lh5"
    write_pulses(path, Pulses.of(np.zeros((3, 20)), dt_ns=16))
    assert load(path) == PulseFile(path)
    (tmp_path / "text").write_text("no pulses")
    with pytest.raises(CpunetError, match="text"):
        load(tmp_path / "text")


def test_tails_that_cannot_be_told(tmp_path):
    rng, path = np.random.default_rng(1), tmp_path / "pulses.lh5"
    write_pulses(path, Pulses.of(rng.integers(0, 900, (40, 400)), dt_ns=16))
    told = dict(info(path, quality=True).lines)["pile-up tails"]
    assert told.startswith("not known: only 0 of 40 traces can be prepared")


def test_a_run_folder(tmp_path):
    recipe = load_recipe("paper", ["generator.width=2"])
    tails = {"rate_khz": 0.0}
    fit = {"verdict": "good", "pulls": {"edge": 4.2, "tail": 1.0}, "tails": tails}
    write_run(tmp_path, {}, recipe, INFO | {"fit": fit})
    lines = dict(info(tmp_path).lines)
    assert lines["trained"] == "recipe paper on FEP, seed 7; 12.5 s on cpu"
    assert (lines["fit"], lines["off"]) == ("good", "edge +4.2 σ")
    assert load(tmp_path).summary() == info(tmp_path).lines
    assert lines["pile-up tails"] == "none significant"


def test_every_table_of_a_file(tmp_path, capsys):
    file = tmp_path / "channels.h5"
    with h5py.File(file, "w") as made:
        for channel in (3, 7):
            group = made.create_group(f"ch{channel}/raw")
            group["waveform"] = np.zeros((channel, 50), np.float32)
            group["waveform"].attrs["dt"] = 16.0
    rows = [line.split()[:4] for line in str(info(file, read=DT)).splitlines()]
    assert rows[:3] == [
        ["table", "traces", "samples", "ns"],
        ["ch3/raw", "3", "50", "16"],
        ["ch7/raw", "7", "50", "16"],
    ]
    one = info(file, read=FileOptions(table="ch7/raw", dt_ns=16))
    assert dict(one.lines)["traces"] == "7 of 50 samples, every 16 ns"
    every = info(file, read=FileOptions(table="all", dt_ns=16))
    assert every.ok
    assert str(every).endswith(f"ch7:\n{one}")
    told = f"{status_of('info', file, '--table', 'all')} {capsys.readouterr().out}"
    assert told.startswith("1 ")
    assert "ch7:\nthe sampling period is not in the file; give --dt-ns" in told


def test_amplitudes_suggest_a_calibration(tmp_path):
    rng = np.random.default_rng(2)
    lines = np.repeat([2614.5, 583.2, 1592.5, 2103.5, 727.3], [400, 700, 100, 90, 150])
    kev = np.append(rng.uniform(100, 2600, 2000), rng.normal(lines, 1.2))
    traces = np.zeros((len(kev), 40), np.float32)
    traces[:, 20:] = 15 * kev[:, np.newaxis]
    file = tmp_path / "raw.npy"
    np.save(file, traces)
    told = dict(info(file, read=DT).lines)["amplitudes"]
    assert "Th-228" in told
    assert float(told.split()[-1]) == pytest.approx(1 / 15, rel=1e-3)
    noise = rng.uniform(100, 2600, (3000, 1)).astype(np.float32) * np.ones((1, 40), np.float32)
    noise[:, :20] = 0
    np.save(file, noise)
    told = dict(info(file, read=DT).lines)
    assert told["amplitudes"] == "no lines that stand out"


def test_files_of_hits_are_described(tmp_path):
    path = tmp_path / "hits.npz"
    place = {"x_mm": [3.0, 0.0, 1.0], "y_mm": [4.0, 0.0, 1.0], "z_mm": [10.0, 20.0, 30.0]}
    np.savez(path, **place, edep_keV=[2000.0, 614.5, 50.0], offsets=np.array([0, 2, 3]))
    told = dict(describe_hits(path, RECIPE.peaks)[""])
    assert told["hits"] == "3 of 2 events"
    assert told["energy"] == "50 … 2614.5 keV an event"
    assert told["lines"] == "1 FEP"
    csv = write_csv(tmp_path / "hits.csv", ["event", "Edep", "x", "y", "z"], ["1,200,3,4,5"])
    assert "z 10 … 30, r 0 … 5 mm" in str(info(path))
    assert "names no unit" in str(info(csv))
    assert "x 30 … 30" in str(info(csv, units="cm,keV"))


def test_the_properties_are_those_that_were_made():
    rng, n, length, at = np.random.default_rng(4), 60, 1600, 700
    time = np.arange(length)
    shape = np.where(time < at, 0, np.exp(-(time - at) * 16e-3 / 50))
    traces = 1000 + np.linspace(2000, 4000, n)[:, np.newaxis] * shape
    traces = np.round(traces + rng.normal(0, 6, traces.shape))
    traces[:3] = np.minimum(traces[:3], 2000)
    pulses = Pulses.of(traces, dt_ns=16, energy_kev=np.linspace(1000, 2000, n))
    told = dict(trace_properties(pulses, RECIPE.preparation))
    adc, kev = (float(part.split()[0]) for part in told["noise"].split(", ")[:2])
    assert adc == pytest.approx(6, rel=0.1)
    # 1000 keV are 2000 ADC, of which an eighth has decayed at the end of a window
    assert kev == pytest.approx(3, rel=0.04)
    assert float(told["decay"].split()[0]) == pytest.approx(50, rel=0.02)
    assert left_out(pulses, RECIPE).startswith("3 saturated")
    with pytest.raises(CpunetError, match="only 0 of 60 traces hold a pulse"):
        trace_properties(Pulses.of(np.ones((n, 200)), dt_ns=16), RECIPE.preparation)


def test_a_simulation_tells_how_it_was_made(tmp_path: Path):
    made = {
        "detector": {"name": "ppc", "bias_V": 2500.0, "temperature_K": 90.0},
        "settings": {"cloud_fwhm_mm": 0.1},
        "hits": {"file": "/a/hits.npz", "origin_mm": [0.0, 0.0, 0.0], "flip_z": False},
        "events": 3,
        "events_without_signal": 0,
        "seed": 1,
    }
    attrs = {"made_by": "cpunet simulate 0.1.0", "simulation": json.dumps(made)}
    path = tmp_path / "sim.lh5"
    write_pulses(path, Pulses.of(np.tile(np.arange(300.0), (3, 1)), dt_ns=16), attrs=attrs)
    told = dict(info(path).lines)
    assert told["made by"].startswith("cpunet simulate")
    assert told["detector"].startswith("ppc, 2500 V, 90 K, charge clouds of 0.1")
    assert told["hits"] == "hits.npz, origin [0.0, 0.0, 0.0] mm"


def test_traces_that_are_no_numbers(tmp_path):
    np.save(tmp_path / "pulses.npy", np.full((30, 400), np.nan))
    told = dict(info(tmp_path / "pulses.npy", read=DT).lines)
    assert told["samples"] == "values –; 30 traces not finite"
    with pytest.raises(CpunetError, match="is no detector; leave out `settings` and `out`"):
        info(tmp_path / "pulses.npy", read=DT, out=tmp_path / "e.png")


def test_the_noise_of_a_run_is_that_of_its_response(monkeypatch, tmp_path):
    """In keV of a full charge, not of the level that prepared tails have."""
    run = tmp_path / "run"
    run.mkdir()
    fit = {"noise": {"rms": 1.6, "baselines": 9}}
    write_run(run, {}, RECIPE, INFO | {"fit": fit})
    assert dict(info(run).lines)["noise"] == "of 9 baselines"
    numbers = [{"noise_rms_kev": kev} for kev in (1.95, 0.05)]
    told = SimpleNamespace(values=numbers[0], errors=numbers[1])
    monkeypatch.setattr(chain_description, "describe_chain", lambda _: told)
    assert dict(info(run).lines)["noise"] == "1.950 ± 0.050 keV (RMS), of 9 baselines"


@pytest.mark.usefixtures("own_cache")
def test_numbers_of_a_detector():
    told = dict(info("ppc", settings={"grid_mm": 0.5}).lines)
    # at 0.5 mm the contact is coarse; at 0.1 mm it is 2.10 pF and 1854 V
    assert 1.8 < float(told["capacitance"].split()[0]) < 2.4
    assert 1700 < float(told["depletion voltage"].split()[0]) < 2000
    assert told["bias"] == "2500 V"
    low, high = (float(told[f"{k} field"].split()[0]) for k in ("lowest", "highest"))
    assert 0 < low < 300 < 1000 < high


def test_measured_traces_are_described(reference_data: Path):
    """A bench detector, whose properties are seen by eye."""
    told = dict(info(reference_data / "real" / "th228.fcio", quality=True).lines)
    assert float(told["decay"].removesuffix(" µs")) == pytest.approx(78.9, rel=0.03)
    adc, _, words = told["noise"].partition(" ADC ")
    assert float(adc) == pytest.approx(15, abs=2)
    assert words == "(RMS of a baseline, median)"  # without energies not in keV
    assert told["left out"].startswith("2 saturated")
    assert told["left out"].endswith(" of 1000 traces")


@pytest.mark.thorough
def test_tails_of_a_bench_detector(reference_data: Path):
    path, calibrated = reference_data / "real" / "th228.fcio", 2614.5 / 40265
    file = PulseFile(path, kev_per_adc=calibrated)
    tails = PileUpTails.of(Baselines.of(file.open().blocks(4096), RECIPE.preparation))
    assert tails.decay_us == pytest.approx(85, rel=0.04)
    assert tails.describe().rate_khz == pytest.approx(1.4, abs=0.3)
    for share in tails.describe().percent_above.values():  # of a thousand traces
        assert share["measured"] == pytest.approx(share["law"], abs=3)
    assert np.nanmean(tails.kev > 10) == pytest.approx(0.3, abs=0.03)
