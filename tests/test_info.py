"""What `describe` says of files and run folders."""

from __future__ import annotations

import json
import tracemalloc
from pathlib import Path

import h5py
import lh5
import numpy as np
import pytest

from cpunet.cli.main import main
from cpunet.errors import CpunetError
from cpunet.jobs.inspection.info import describe
from cpunet.pulses.container import Pulses
from cpunet.pulses.writing import write_pulses
from cpunet.recipes import load_recipe
from cpunet.recipes.schema import PeakConfig

LINES = {
    "FEP": PeakConfig(energy_kev=2614.511, half_width_kev=5),
    "SEP": PeakConfig(energy_kev=2103.511, half_width_kev=5),
    "DEP": PeakConfig(energy_kev=1592.511, half_width_kev=5),
}


def test_a_file_of_pulses(tmp_path):
    waveforms = np.tile(np.arange(20.0), (6, 1))
    waveforms[1, 3] = np.nan
    waveforms[2, 4] = np.inf
    waveforms[3] = 7.0
    waveforms[4, 0] = -3.0
    energies = [2614.0, 2615.0, 2103.0, 500.0, np.nan, 100.0]
    path = tmp_path / "pulses.lh5"
    write_pulses(path, Pulses.of(waveforms, dt_ns=16, energy_kev=energies))
    assert describe(path, peaks=LINES) == {
        "kind": "pulses",
        "path": str(path),
        "format": "LH5",
        "table": "geds/sim/waveform",
        "columns": ["energy", "event_number"],
        "n_pulses": 6,
        "length": 20,
        "dt_ns": 16.0,
        "energy": "column energy [keV]",
        "energy_kev": [100.0, 2615.0],
        "n_without_energy": 1,
        "peaks": {"FEP": 2, "SEP": 1, "DEP": 0},
        "samples": [-3.0, 19.0],
        "n_not_finite": 2,
        "n_constant": 1,
    }


def test_nothing_known_is_none(tmp_path):
    np.save(tmp_path / "pulses.npy", np.full((2, 20), np.nan))
    told = describe(tmp_path / "pulses.npy", dt_ns=16)
    assert (told["energy_kev"], told["samples"], told["peaks"]) == (None, None, {})
    assert (told["n_not_finite"], told["n_constant"]) == (2, 0)
    json.dumps(told)


def test_memory_does_not_grow_with_the_file(tmp_path):
    block = Pulses.of(np.zeros((4096, 100)), dt_ns=16)  # 1.6 MB as float32
    write_pulses(tmp_path / "pulses.lh5", (block for _ in range(12)))
    tracemalloc.start()
    try:
        assert describe(tmp_path / "pulses.lh5")["n_pulses"] == 12 * 4096
        assert tracemalloc.get_traced_memory()[1] < 10e6
    finally:
        tracemalloc.stop()


def test_remains_of_a_bench_detector(reference_data: Path, tmp_path: Path):
    path, calibrated = reference_data / "real" / "th228.fcio", 2614.5 / 40265
    preparation = load_recipe("fast").preparation
    flat = tmp_path / "flat.lh5"
    told = describe(path, kev_per_adc=calibrated, preparation=preparation, without_remains=flat)
    assert told["remains"]["rate_khz"] == pytest.approx(1.4, abs=0.3)
    json.dumps(told)
    left = lh5.read("geds/raw/remains_kev", flat).nda
    assert len(left) == 1000
    assert np.nanmean(left > 10) == pytest.approx(0.3, abs=0.03)
    again = describe(flat, preparation=preparation)["remains"]
    assert again["rate_khz"] == 0


def test_remains_that_cannot_be_told(tmp_path):
    rng, path = np.random.default_rng(1), tmp_path / "pulses.lh5"
    write_pulses(path, Pulses.of(rng.integers(0, 900, (40, 400)), dt_ns=16))
    preparation = load_recipe("fast").preparation
    told = describe(path, preparation=preparation)
    assert told["remains"].startswith("not known: only 0 of 40 traces can be prepared")
    with pytest.raises(CpunetError, match="only 0 of 40 traces"):
        describe(path, preparation=preparation, without_remains=tmp_path / "flat.lh5")
    write_pulses(tmp_path / "sim.lh5", Pulses.of(np.tile(np.arange(400), (9, 1)), dt_ns=16))
    with pytest.raises(CpunetError, match="remains are taken off measured traces"):
        describe(tmp_path / "sim.lh5", without_remains=tmp_path / "flat.lh5")


def test_a_run_folder(tmp_path):
    content = {"recipe": {"name": "paper"}, "seed": 7, "seconds": 12.5, "device": "cpu"}
    (tmp_path / "run.json").write_text(json.dumps(content))
    assert describe(tmp_path) == {"kind": "run", "path": str(tmp_path), **content}


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (None, "a folder without run.json; give the folder of a run, or a file"),
        ("{", r"run.json: cannot be read \([^\n]*\); the run is damaged"),
        ("[1]", r"run.json: holds no run"),
    ],
)
def test_folders_that_are_no_runs(tmp_path, text, message):
    if text is not None:
        (tmp_path / "run.json").write_text(text)
    with pytest.raises(CpunetError, match=message):
        describe(tmp_path)


def test_reference_pulses(reference_data: Path):
    told = describe(reference_data / "closure" / "data.lh5", peaks=LINES)
    assert (told["n_pulses"], told["length"], told["dt_ns"]) == (3343, 1200, 16)
    assert min(told["peaks"].values()) > 500
    assert (told["n_not_finite"], told["n_constant"]) == (0, 0)


def test_every_table_of_a_file(tmp_path, capsys, monkeypatch):
    file = tmp_path / "channels.h5"
    with h5py.File(file, "w") as made:
        for channel in (3, 7):
            group = made.create_group(f"ch{channel}/raw")
            group["waveform"] = np.zeros((channel, 50), np.float32)
            group["waveform"].attrs["dt"] = 16.0
    told = describe(file, dt_ns=16)
    assert told["kind"] == "tables"
    found = {name: (one["n_pulses"], one["length"]) for name, one in told["tables"].items()}
    assert found == {"ch3/raw": (3, 50), "ch7/raw": (7, 50)}
    assert describe(file, dt_ns=16, table="ch7/raw")["n_pulses"] == 7
    monkeypatch.setattr("sys.argv", ["cpunet", "info", str(file), "--dt", "16"])
    with pytest.raises(SystemExit):
        main()
    printed = capsys.readouterr().out
    assert "ch3/raw" in printed
    assert "--table NAME" in printed


def test_amplitudes_suggest_a_calibration(tmp_path):
    rng = np.random.default_rng(2)
    lines = np.repeat([2614.5, 583.2, 1592.5, 2103.5, 727.3], [400, 700, 100, 90, 150])
    kev = np.append(rng.uniform(100, 2600, 2000), rng.normal(lines, 1.2))
    traces = np.zeros((len(kev), 40), np.float32)
    traces[:, 20:] = 15 * kev[:, np.newaxis]
    file = tmp_path / "raw.npy"
    np.save(file, traces)
    told = describe(file, dt_ns=16)
    assert "Th-228" in told["amplitudes"]
    assert float(told["amplitudes"].split()[-1]) == pytest.approx(1 / 15, rel=1e-3)
    noise = rng.uniform(100, 2600, (3000, 1)).astype(np.float32) * np.ones((1, 40), np.float32)
    noise[:, :20] = 0
    np.save(file, noise)
    assert describe(file, dt_ns=16)["amplitudes"] == "no lines that stand out"


def test_the_measured_spectrum_suggests_its_calibration(reference_data):
    told = describe(reference_data / "real" / "th228.fcio")
    assert "Th-228" in told["amplitudes"]
    # as found from its lines by hand
    assert float(told["amplitudes"].split()[-1]) == pytest.approx(0.06493, rel=0.01)


def test_files_of_hits_are_described(tmp_path, capsys, monkeypatch):
    path = tmp_path / "hits.npz"
    place = {"x_mm": [3.0, 0.0, 1.0], "y_mm": [4.0, 0.0, 1.0], "z_mm": [10.0, 20.0, 30.0]}
    np.savez(path, **place, edep_keV=[2000.0, 614.5, 50.0], offsets=np.array([0, 2, 3]))
    told = describe(path, peaks=load_recipe("fast").peaks)["detectors"][""]
    assert (told["events"], told["hits"]) == (2, 3)
    assert told["energy_kev"] == [50.0, 2614.5]
    assert told["r_mm"] == [0.0, 5.0]
    assert told["peaks"] == {"FEP": 1, "SEP": 0, "DEP": 0}
    csv = tmp_path / "hits.csv"
    names = "".join(f"#column double {name}\n" for name in ("event", "Edep", "x", "y", "z"))
    csv.write_text(
        f"#class tools::wcsv::ntuple\n#title hits\n#separator 44\n{names}1,2,3,4,5\n"
    )
    for file, said in ((path, "z_mm        10 … 30"), (csv, "names no unit")):
        monkeypatch.setattr("sys.argv", ["cpunet", "info", str(file)])
        with pytest.raises(SystemExit):
            main()
        assert said in capsys.readouterr().out
