"""Valid inputs after one random change: read, or refused in one line; never anything else."""

from __future__ import annotations

import importlib.util
import json
import pickle
import shutil
import struct
import sys
from collections.abc import Callable
from pathlib import Path
from types import ModuleType

import h5py
import lh5
import numpy as np
import pytest
import yaml
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from lgdo import Array, ArrayOfEqualSizedArrays, Table, VectorOfVectors, WaveformTable
from lh5.compression import RadwareSigcompress, ULEB128ZigZagDiff
from safetensors.numpy import save_file
from torch import nn

from cpunet.electronics.presets import read_electronics
from cpunet.errors import CpunetError
from cpunet.jobs.simulation.simulation_settings import load_settings
from cpunet.jobs.training.import_published import import_pulses
from cpunet.jobs.validation.compare import read_metrics
from cpunet.pulses.reading import open_pulses
from cpunet.recipes import load_recipe
from cpunet.simulation.geometry_readers import read_detector
from cpunet.simulation.hit_readers import hit_parts, read_hits
from cpunet.simulation.settings import SimulationSettings
from cpunet.training.run_folder import load_network, read_info, read_losses

pytestmark = pytest.mark.probed
FEW, MANY = 4, 2500


def load_mutations() -> ModuleType:
    """The changes that ``benchmarks/fuzz.py`` makes, too."""
    path = Path(__file__).parents[1] / "benchmarks" / "mutations.py"
    spec = importlib.util.spec_from_file_location("mutations", path)
    assert spec
    assert spec.loader
    module = importlib.util.module_from_spec(spec)
    sys.modules["mutations"] = module
    spec.loader.exec_module(module)
    return module


mutations = load_mutations()
N, LENGTH = 6, 48


def waveforms() -> np.ndarray:
    return np.random.default_rng(1).integers(0, 9000, (N, LENGTH)).astype(np.uint16)


def lh5_file(path: Path, values: object) -> None:
    table = WaveformTable(
        t0=np.zeros(N), t0_units="ns", dt=np.full(N, 16.0), dt_units="ns", values=values
    )
    energy = Array(np.full(N, 2614.5), attrs={"units": "keV"})
    lh5.write(Table({"waveform": table, "energy": energy}), "raw", path, group="geds")


def encoded(codec: object) -> Callable[[Path], None]:
    return lambda path: lh5_file(
        path, ArrayOfEqualSizedArrays(nda=waveforms(), attrs={"compression": codec})
    )


def spectrum(path: Path) -> None:
    values = waveforms().astype("<f4")
    head = struct.pack("<i8siiiiii", 24, b"pulses  ", LENGTH, N, 1, 1, 24, values.nbytes)
    path.write_bytes(head + values.tobytes() + head[-4:])


def plain_hdf5(path: Path) -> None:
    with h5py.File(path, "w") as file:
        file["waveform"], file["dt_ns"] = waveforms(), 16.0


def flashcam(path: Path) -> None:
    """One channel, as the tests of its reader write it."""

    def frame(kind: str, *values: float) -> bytes:
        content = struct.pack(f"<{len(values)}{kind}", *values)
        return struct.pack("<i", len(content)) + content

    made = b"\xff\x35\x65\xc4" + b"FlashCamV1".ljust(64, b"\0") + struct.pack("<i", -1)
    made += b"".join(frame("i", v) for v in (1, 0, LENGTH, 1, 1, 16, 0, 0, 1, 0))
    made += frame("i", 0)
    for number, trace in enumerate(waveforms()):
        row = frame("H", 0, 0, *trace.tolist())[4:]
        made += struct.pack("<i", -3) + frame("i", 1) + frame("f", 0.0) + frame("i", *[0] * 10)
        made += frame("i", number, *[0] * 9) + struct.pack("<i", len(row)) + row
        made += frame("i", *[0] * 10)
    path.write_bytes(made)


def remage(path: Path) -> None:
    def vectors(units: str) -> VectorOfVectors:
        return VectorOfVectors([[1.0, 2], [3.0]], attrs={"units": units})

    columns = {f"{axis}loc": vectors("mm") for axis in "xyz"} | {"edep": vectors("keV")}
    lh5.write(Table(columns | {"evtid": Array(np.array([3, 7]))}), "stp/det1", path)


def hits_npz(path: Path) -> None:
    x = np.arange(4.0)
    np.savez(path, x_mm=x, y_mm=x, z_mm=x, edep_keV=x + 1, offsets=np.array([0, 2, 3, 4]))


def g4simple(path: Path) -> None:
    with h5py.File(path, "w") as file:
        for name in ("event", "volID", "Edep", "x", "y", "z"):
            file[f"default_ntuples/g4sntuple/{name}/pages"] = np.ones(4)


def csv(path: Path) -> None:
    lines = ["#class tools::wcsv::ntuple", "#title steps data", "#separator 44"]
    lines += [f"#column double {name}" for name in ("event", "Edep", "x", "y", "z")]
    path.write_text("\n".join([*lines, "1,0.5,1,2,3", "1,0.2,1,2,3", "2,1.5,1,2,3"]))


def majorana(path: Path) -> None:
    with h5py.File(path, "w") as file:
        file["raw_waveform"] = waveforms().astype(float)
        for name in ("detector", "run_number", "id", "tp0"):
            file[name] = np.arange(N)
        file["energy_label"] = np.full(N, 2614.5)


def pickled(path: Path) -> None:
    with path.open("wb") as stream:
        for wave in waveforms():
            pickle.dump({"wf": wave.astype(float), "tp0": 3, "energy": 2614.5}, stream)


def text_of(content: object) -> Callable[[Path], None]:
    return lambda path: Path(path).write_text(
        json.dumps(content) if path.suffix == ".json" else yaml.safe_dump(content)
    )


def read_pulses(path: Path) -> None:
    tells = path.suffix in (".lh5", ".h5") or path.name == "pulses.npz"
    open_pulses(path, dt_ns=None if tells else 16).read()


def read_weights(path: Path) -> None:
    load_network(path.parent, "ren", nn.Linear(3, 2))


def convert(path: Path) -> None:
    try:
        import_pulses(path, path.with_name("out.lh5"))
    finally:
        left = {file.name for file in path.parent.iterdir()} - {path.name, "out.lh5"}
        assert not left


INFO = {
    "recipe": "fast",
    "peak": "FEP",
    "seed": 1,
    "dt_ns": 16.0,
    "seconds": 1,
    "device": "cpu",
}
SIDE = {"file": "x", "used": 3, "cuts": {"amplitude": 1.0, "noise": 0.1, "windows": []}}
SCORES = {"peaks": {"FEP": {"parameters": {"drift_time": {"iou": {"ren": 80.0}}}}}}

Make, Read = Callable[[Path], object], Callable[[Path], object]
# name of the file → (how it is written, how it is read)
INPUTS: dict[str, tuple[Make, Read]] = {
    "plain.lh5": (lambda p: lh5_file(p, ArrayOfEqualSizedArrays(nda=waveforms())), read_pulses),
    "ragged.lh5": (
        lambda p: lh5_file(p, VectorOfVectors(waveforms().tolist(), dtype=np.uint16)),
        read_pulses,
    ),
    "varlen.lh5": (encoded(ULEB128ZigZagDiff()), read_pulses),
    "radware.lh5": (encoded(RadwareSigcompress(codec_shift=-32768)), read_pulses),
    "plain.h5": (plain_hdf5, read_pulses),
    "pulses.npz": (lambda p: np.savez(p, waveform=waveforms(), dt_ns=16.0), read_pulses),
    "packed.npz": (
        lambda p: np.savez_compressed(p, waveform=waveforms(), dt=16.0),
        read_pulses,
    ),
    "pulses.npy": (lambda p: np.save(p, waveforms()), read_pulses),
    "pulses.spe": (spectrum, read_pulses),
    "pulses.txt": (lambda p: np.savetxt(p, waveforms(), fmt="%d"), read_pulses),
    "run.fcio": (flashcam, lambda p: open_pulses(p).read()),
    "majorana.h5": (
        majorana,
        lambda p: open_pulses(p, table="raw_waveform", dt_ns=10).read(),
    ),
    "pulses.pickle": (pickled, read_pulses),
    "remage.lh5": (remage, read_hits),
    "steps.lh5": (remage, lambda p: list(hit_parts(p)())),
    "hits.npz": (hits_npz, read_hits),
    "g4simple.h5": (g4simple, read_hits),
    "hits.csv": (csv, read_hits),
    "detector.yaml": (
        text_of(read_detector("ppc").model_dump(mode="json")),
        read_detector,
    ),
    "settings.yaml": (text_of(SimulationSettings().model_dump(mode="json")), load_settings),
    "electronics.yaml": (
        text_of(read_electronics("legend200").model_dump(mode="json")),
        read_electronics,
    ),
    "recipe.yaml": (
        text_of(load_recipe("fast").model_dump(mode="json")),
        lambda p: load_recipe(str(p)),
    ),
    "run.json": (text_of(INFO | {"data": SIDE}), lambda p: read_info(p.parent)),
    "losses.jsonl": (
        lambda p: p.write_text('{"iteration": 1, "rate": 0.1, "losses": {"a": 0.5}}\n' * 3),
        lambda p: read_losses(p.parent),
    ),
    "metrics.json": (text_of(SCORES), read_metrics),
    "weights.safetensors": (
        lambda p: save_file(
            {"ren.weight": np.ones((2, 3), np.float32), "ren.bias": np.ones(2, np.float32)}, p
        ),
        read_weights,
    ),
}


@pytest.fixture
def valid(tmp_path: Path, name: str) -> Path:
    """Folder with a file that can be read."""
    make, read = INPUTS[name]
    make(tmp_path / name)
    read(tmp_path / name)
    return tmp_path


def read_changed(valid: Path, folder: Path, name: str, seed: int) -> None:
    """Change a file, and read it: nothing but an error of one line may come of it."""
    path = folder / name
    shutil.copy(valid / name, path)
    told = mutations.mutate(path, np.random.default_rng(seed))
    try:
        INPUTS[name][1](path)
    except CpunetError as error:
        line = str(error)
        assert "\n" not in line, told
        assert 0 < len(line) < 2000, told


@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize("name", INPUTS)
@settings(max_examples=FEW, suppress_health_check=list(HealthCheck))
@given(seed=st.integers(0, 2**32 - 1))
def test_one_change_is_read_or_refused(valid, tmp_path_factory, name, seed):
    read_changed(valid, tmp_path_factory.mktemp("changed"), name, seed)


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize("name", INPUTS)
def test_thousands_of_changes_are_read_or_refused(valid, tmp_path_factory, name):
    folder = tmp_path_factory.mktemp("changed")
    for seed in range(MANY):
        read_changed(valid, folder, name, seed)
