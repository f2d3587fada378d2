"""Small valid inputs of every kind, which are then broken."""

from __future__ import annotations

import json
import math
import os
import pickle
import signal
import struct
import time
from itertools import pairwise
from pathlib import Path

import numpy as np
import yaml
from fuzz_process import Case, call, run

TINY = [
    "generator.width=2", "discriminator.embedding_rows=20", "discriminator.embedding_dim=2",
    "discriminator.hidden=2", "discriminator.samples_per_step=80", "training.iterations=2",
    "training.decay_start=1", "training.batch_size=4", "training.statistics_batches=1",
    "training.log_interval=1", "scores.bootstraps=5", "chain=null", "training.noise=none",
    "training.losses.baseline_len=200", "training.losses.tail_len=400",
]  # fmt: skip
PEAKS = (2614.511, 2103.511, 1592.511)
STUDY = ["--jobs", "1", "--threads", "1"]


def edges(n: int, rng: np.random.Generator) -> np.ndarray:
    """Charge pulses of 225 samples that end at 1."""
    width = rng.uniform(1.0, 4.0, (n, 1))
    return 1 / (1 + np.exp(-(np.arange(225) - rng.uniform(40, 70, (n, 1))) / width))


def traces(n: int, rng: np.random.Generator, kev: np.ndarray) -> np.ndarray:
    """ADC counts of 1200 samples with a decay, a baseline and noise."""
    record = np.zeros((n, 1200))
    record[:, 500:725] = edges(n, rng)
    record[:, 725:] = 1
    record *= np.exp(-np.clip(np.arange(1200) - 560, 0, None) * 16 / 55_000)
    adc = 8000 + 15 * kev[:, None] * record + rng.normal(0, 15, record.shape)
    return np.clip(np.rint(adc), 0, 65535).astype(np.uint16)


def make_base(base: Path) -> None:
    """Make every kind of valid input in a folder."""
    import h5py
    import lh5
    from lgdo import Array, ArrayOfEqualSizedArrays, Table, VectorOfVectors, WaveformTable
    from lh5.compression import RadwareSigcompress, ULEB128ZigZagDiff

    rng = np.random.default_rng(0)
    kev = np.tile(PEAKS, 28) + rng.normal(0, 0.5, 84)

    def table(values: object, n: int, energies: np.ndarray) -> Table:
        wave = WaveformTable(
            t0=np.zeros(n), t0_units="ns", dt=np.full(n, 16.0), dt_units="ns", values=values
        )
        energy = Array(energies, attrs={"units": "keV"})
        return Table({"waveform": wave, "energy": energy, "event_number": Array(np.arange(n))})

    def write(name: str, path: str, values: object, n: int, energies: np.ndarray) -> None:
        group, _, inner = path.rpartition("/")
        lh5.write(table(values, n, energies), inner, base / name, group=group)

    sim, data = edges(84, rng).astype(np.float32), traces(84, rng, kev)
    write("sim.lh5", "geds/sim", ArrayOfEqualSizedArrays(nda=sim), 84, kev)
    write("data.lh5", "geds/raw", ArrayOfEqualSizedArrays(nda=data), 84, kev)
    for name, codec in (
        ("varlen", ULEB128ZigZagDiff()),
        ("radware", RadwareSigcompress(codec_shift=-32768)),
    ):
        values = ArrayOfEqualSizedArrays(nda=data[:8], attrs={"compression": codec})
        write(f"{name}.lh5", "geds/raw", values, 8, kev[:8])
    ragged = VectorOfVectors(data[:8].tolist(), dtype=np.uint16)
    write("ragged.lh5", "geds/raw", ragged, 8, kev[:8])
    with h5py.File(base / "plain.h5", "w") as file:
        file["waveform"], file["dt_ns"], file["energy_kev"] = sim[:8], 16.0, kev[:8]
    np.savez(base / "pulses.npz", waveform=sim[:8], dt_ns=16.0, energy_kev=kev[:8])
    np.savez_compressed(base / "packed.npz", waveform=sim[:8], dt_ns=16.0)
    np.save(base / "pulses.npy", sim[:8])
    head = struct.pack("<i8siiiiii", 24, b"pulses  ", 225, 8, 1, 1, 24, 8 * 225 * 4)
    (base / "pulses.spe").write_bytes(head + sim[:8].tobytes() + head[-4:])
    np.savetxt(base / "pulses.txt", sim[:4], fmt="%.4f")
    (base / "run.fcio").write_bytes(flashcam(data[:5, :64]))
    np.savez(base / "truth.npz", response=traces(84, rng, kev).astype(np.float32))
    with (base / "pulses.pickle").open("wb") as stream:
        for i in range(6):
            pickle.dump([{"wf": sim[i], "tp0": 40, "energy": kev[i], "event": i}], stream)
    make_hits(base)
    make_settings(base)
    call(["train", "--sim", "sim.lh5", "--data", "data.lh5", "--out", "run", *tiny()], base)
    call(["validate", "run", *sides(), "--no-baselines", "--out", "report"], base)
    make_response(base)
    words = ["--detector", "detector.yaml", "--grid-mm", "12", "--dt-ns", "16", "--length-ns"]
    call(["library", "make", *words, "3600", "--out", "psl.lh5"], base)
    words = ["--hits", "hits.npz", "--detector", "detector.yaml", "--out", "made.lh5"]
    call(["simulate", *words], base)
    make_studies(base)
    make_published(base)
    make_code(base)


def make_code(base: Path) -> None:
    """Compiled code in a folder of its own, which a case may damage."""
    words = ["simulate", "--hits", "hits.npz", "--detector", "detector.yaml", "--out", "x.lh5"]
    folder = Path(os.environ["CPUNET_CACHE"]).parent / "code"
    case = Case(words, "", environment={"NUMBA_CACHE_DIR": str(folder)}, fresh=True)
    if run(case, base, base).status != 0 or not any(folder.rglob("*.nbi")):
        raise SystemExit("code: cannot be compiled into a folder")
    (base / "x.lh5").unlink()


def make_studies(base: Path) -> None:
    """An ensemble, a search and an unfinished training, all of which can be resumed."""
    words = ["ensemble", *sides(), *tiny(), "--seeds", "1", "--no-validate", "--out", "ens"]
    call([*words, *STUDY], base)
    call(["tune", *sides(), *tuning(), "--out", "tuned"], base)
    words = ["train", *sides(), "--out", "stopped", *tiny(), "--set", "training.iterations=30"]
    pid = os.fork()
    if pid == 0:
        run(Case(words, ""), base, base)
        os._exit(0)
    unfinished = base / "stopped.unfinished"
    losses = unfinished / "losses.jsonl"
    while not losses.exists() or not losses.stat().st_size:
        time.sleep(0.01)
        if os.waitpid(pid, os.WNOHANG)[0]:
            raise SystemExit("stopped: the training ended before it could be stopped")
    for child in Path(f"/proc/{pid}/task/{pid}/children").read_text().split():
        os.kill(int(child), signal.SIGTERM)
    os.waitpid(pid, 0)
    if not (unfinished / "checkpoint.safetensors").exists():
        raise SystemExit("stopped: no checkpoint")


def make_published(base: Path, m: int = 2) -> None:
    """Weights of a narrow network, in the format of the authors of CPU-Net."""
    import torch

    state: dict[str, torch.Tensor] = {}
    blocks = {"inc": (1, m), "up4.conv": (2 * m, m // 2)}
    blocks |= {f"up{i}.conv": (c * m, o * m) for i, c, o in ((1, 16, 4), (2, 8, 2), (3, 4, 1))}
    for i, (c, o) in enumerate(((1, 2), (2, 4), (4, 8), (8, 8)), 1):
        blocks[f"down{i}.maxpool_conv.1"] = (c * m, o * m)
    for name, (c, o) in blocks.items():
        middle = c // 2 if name.startswith("up") else o
        for first, (i, j, kernel) in ((0, (c, middle, 11)), (3, (middle, o, 7))):
            state[f"{name}.double_conv.{first}.weight"] = 0.1 * torch.ones(j, i, kernel)
            for key in ("weight", "running_var", "bias", "running_mean"):
                fill = torch.ones if key in ("weight", "running_var") else torch.zeros
                state[f"{name}.double_conv.{first + 1}.{key}"] = fill(j)
            state[f"{name}.double_conv.{first + 1}.num_batches_tracked"] = torch.tensor(7)
    for name, c, o in (("fc_mean", 8 * m, 8 * m), ("fc_var", 8 * m, 8 * m)):
        state[f"{name}.weight"], state[f"{name}.bias"] = torch.ones(o, c, 1), torch.zeros(o)
    state["outc.conv.0.weight"], state["outc.conv.0.bias"] = torch.ones(1, 1, 1), torch.zeros(1)
    for i, d in enumerate((m, 2 * m, 4 * m, 8 * m, 8 * m, 4 * m, 2 * m, m, m // 2), 1):
        steps = torch.arange(0, d, 2).float() * (-math.log(10_000) / d)
        phase = torch.exp(steps)[:, None] * torch.arange(10_000).float()
        both = torch.stack([phase.sin(), phase.cos()], 1).reshape(-1, 10_000)
        state[f"pe{i}.pe"] = both[None, :d]
    torch.save(state, base / "published.pt")


def flashcam(samples: np.ndarray) -> bytes:
    """A FlashCam file of one channel."""

    def frame(kind: str, *values: object) -> bytes:
        content = struct.pack(f"<{len(values)}{kind}", *values)
        return struct.pack("<i", len(content)) + content

    n = samples.shape[1]
    made = b"\xff\x35\x65\xc4" + b"FlashCamV1".ljust(64, b"\0") + struct.pack("<i", -1)
    made += b"".join(frame("i", v) for v in (1, 0, n, 1, 1, 16, 0, 0, 1, 0)) + frame("i", 0)
    for i, trace in enumerate(samples):
        row = frame("H", 0, 0, *trace.tolist())[4:]
        made += struct.pack("<i", -3) + frame("i", 1) + frame("f", 0.0) + frame("i", *[0] * 10)
        made += frame("i", i, *[0] * 9) + struct.pack("<i", len(row)) + row
        made += frame("i", *[0] * 10)
    return made


def make_hits(base: Path) -> None:
    """Hits of every format, within the detector of `make_settings`."""
    import h5py
    import lh5
    from lgdo import Array, Table, VectorOfVectors

    x, z, e = np.array([5.0, 6, 0, 9]), np.array([12.0, 13, 15, 9]), np.full(4, 700.0)
    offsets = np.array([0, 2, 3, 4])
    np.savez(base / "hits.npz", x_mm=x, y_mm=0 * x, z_mm=z, edep_keV=e, offsets=offsets)
    parts = [slice(*pair) for pair in pairwise(offsets)]

    def vectors(values: np.ndarray, units: str) -> VectorOfVectors:
        return VectorOfVectors([values[p].tolist() for p in parts], attrs={"units": units})

    columns = {"xloc": vectors(x, "mm"), "yloc": vectors(0 * x, "mm"), "zloc": vectors(z, "mm")}
    columns |= {"edep": vectors(e, "keV"), "evtid": Array(np.array([3, 5, 9]))}
    lh5.write(Table(columns), "stp/det1", base / "remage.lh5")
    with h5py.File(base / "g4simple.h5", "w") as file:
        for name, values in {
            "event": [1, 1, 2, 3], "volID": [1] * 4, "Edep": e / 1e3, "x": x, "y": 0 * x, "z": z
        }.items():  # fmt: skip
            file[f"default_ntuples/g4sntuple/{name}/pages"] = values
    names = ("event", "Edep", "x", "y", "z")
    lines = ["#class tools::wcsv::ntuple", "#title steps data", "#separator 44"]
    lines += [f"#column double {name}" for name in names]
    lines += [f"{i},{a / 1e3},{b},0,{c}" for i, a, b, c in zip(offsets, e, x, z, strict=True)]
    (base / "hits.csv").write_text("\n".join(lines) + "\n")


def make_settings(base: Path) -> None:
    """Settings of every kind; the detector is small, so its fields are solved quickly."""
    from cpunet.electronics.presets import read_electronics
    from cpunet.recipes import load_recipe
    from cpunet.simulation.settings import SimulationSettings

    detector = {
        "crystal_length": 20.0, "crystal_radius": 20.0, "point_contact_length": 1.6,
        "point_contact_radius": 2.0, "li_thickness": 1.0, "impurity_z0_1e10_per_cm3": -0.8,
        "bias_V": 2500, "temperature_K": 85, "grid_mm": 0.5,
    }  # fmt: skip
    contents = {
        "detector": detector,
        "settings": SimulationSettings().model_dump(mode="json"),
        "electronics": read_electronics("legend200").model_dump(mode="json"),
        "recipe": load_recipe("small", TINY).model_dump(mode="json"),
        "shift": {"temperature_K": 1.0, "bias_V": 20},
    }
    for name, content in contents.items():
        (base / f"{name}.yaml").write_text(yaml.safe_dump(content))
    config = "xtal_length 20\nxtal_radius 20\npc_length 1.6\npc_radius 2\nLi_thickness 1\n"
    config += "impurity_z0 -0.8\nxtal_HV 2500\nxtal_temp 85\nxtal_grid 0.5\n"
    (base / "detector.config").write_text(config)
    diode = {
        "name": "V00000A", "type": "bege",
        "geometry": {
            "height_in_mm": 20, "radius_in_mm": 20,
            "pp_contact": {"radius_in_mm": 2, "depth_in_mm": 1.6},
        },
        "production": {"impcc": {"array": {
            "value_in_1e9e/cm3": [8, 8.5], "dist_from_contact_in_mm": [0, 20]}}},
        "characterization": {"manufacturer": {
            "recommended_voltage_in_V": 2500, "dl_thickness_in_mm": 1}},
    }  # fmt: skip
    (base / "diode.json").write_text(json.dumps(diode))


def make_response(base: Path) -> None:
    """A run with a readout response that was not fitted."""
    from torch import nn

    from cpunet.networks.response_generator import ResponseGenerator
    from cpunet.recipes import load_recipe
    from cpunet.training.run_folder import write_run

    recipe = load_recipe("fast")
    info = {"recipe": "fast", "dt_ns": 16.0, "peak": "FEP", "seconds": 0, "seed": 0}
    info |= {"device": "cpu", "fit": {"errors": {"log_decay_us.1": 0.1}, "covariance": [[1.0]]}}
    (base / "learned").mkdir()
    generator = ResponseGenerator(recipe.matching.generator, 16.0)
    write_run(base / "learned", nn.ModuleDict({"ren": generator}), recipe, info)


def tiny() -> list[str]:
    """Options of the shortest training."""
    return ["--recipe", "small", *(word for value in TINY for word in ("--set", value))]


def tuning() -> list[str]:
    """Options of the shortest search."""
    return [*tiny(), "--peak", "1000-", "--trials", "1", *STUDY]


def sides() -> list[str]:
    """Options that name both inputs."""
    return ["--sim", "sim.lh5", "--data", "data.lh5"]
