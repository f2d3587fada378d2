"""Thousands of broken inputs for every command, and what becomes of each.

Run with ``python benchmarks/fuzz.py --cases 2000 --seed 1``.  Small valid inputs are made once
(kept in ``--base``); each case changes one of them, an option or a variable of the environment
by ``mutations.py``, and calls one command in a process of its own, forked from one that has
imported everything.  Counted are: tracebacks (also what the command line calls a bug), crashes
by a signal, wrong statuses, more or less than one line of error, outputs or half-written files
left by a failure, inputs that changed, successes although the change cannot make sense, more
than 2 GB, and more than 30 s.  ``--only 17`` does one case again, and shows what it says.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import os
import pickle
import resource
import shutil
import signal
import struct
import sys
import tempfile
import time
import traceback
from collections import Counter
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, field
from itertools import pairwise
from pathlib import Path

import numpy as np
import yaml
from mutations import NASTY, NASTY_TEXTS, mutate, pick

from cpunet.cli.main import main as cpunet_main

MAX_KB, MAX_S = 2_000_000, 30
TINY = [
    "generator.width=2", "discriminator.embedding_rows=20", "discriminator.embedding_dim=2",
    "discriminator.hidden=2", "discriminator.samples_per_step=80", "training.iterations=2",
    "training.decay_start=1", "training.batch_size=4", "training.statistics_batches=1",
    "training.log_interval=1", "scores.bootstraps=5", "chain=null", "training.noise=none",
    "training.losses.baseline_len=200", "training.losses.tail_len=400",
]  # fmt: skip
PEAKS = (2614.511, 2103.511, 1592.511)


@dataclass
class Case:
    """One call: words, with what was changed, and whether it must not succeed."""

    words: list[str]
    told: str
    must_fail: bool = False
    environment: dict[str, str] = field(default_factory=dict)
    closed: str = ""  # a standard stream: "closed" or "full"


# --- valid inputs -----------------------------------------------------------------------------


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
    kev = np.tile(PEAKS, 14) + rng.normal(0, 0.5, 42)

    def table(values: object, n: int, energies: np.ndarray) -> Table:
        wave = WaveformTable(
            t0=np.zeros(n), t0_units="ns", dt=np.full(n, 16.0), dt_units="ns", values=values
        )
        energy = Array(energies, attrs={"units": "keV"})
        return Table({"waveform": wave, "energy": energy, "event_number": Array(np.arange(n))})

    def write(name: str, path: str, values: object, n: int, energies: np.ndarray) -> None:
        group, _, inner = path.rpartition("/")
        lh5.write(table(values, n, energies), inner, base / name, group=group)

    sim, data = edges(42, rng).astype(np.float32), traces(42, rng, kev)
    write("sim.lh5", "geds/sim", ArrayOfEqualSizedArrays(nda=sim), 42, kev)
    write("data.lh5", "geds/raw", ArrayOfEqualSizedArrays(nda=data), 42, kev)
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
    np.savez(base / "truth.npz", response=traces(42, rng, kev).astype(np.float32))
    with (base / "pulses.pickle").open("wb") as stream:
        for i in range(6):
            pickle.dump([{"wf": sim[i], "tp0": 40, "energy": kev[i], "event": i}], stream)
    make_hits(base)
    make_settings(base)
    call(["train", "--sim", "sim.lh5", "--data", "data.lh5", "--out", "run", *tiny()], base)
    call(["validate", "run", *sides(), "--no-rivals", "--out", "report"], base)
    make_response(base)
    words = ["--detector", "detector.yaml", "--grid-mm", "12", "--dt-ns", "16", "--length-ns"]
    call(["library", "make", *words, "3600", "--out", "psl.lh5"], base)
    words = ["--hits", "hits.npz", "--detector", "detector.yaml", "--out", "made.lh5"]
    call(["simulate", *words], base)


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
    """Settings of every kind; a small detector, whose fields take a moment."""
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
    """A run that has a response, as it is before its fit."""
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


def sides() -> list[str]:
    """Options that name both inputs."""
    return ["--sim", "sim.lh5", "--data", "data.lh5"]


# --- cases ------------------------------------------------------------------------------------

SIMULATE = ["simulate", "--hits", "hits.npz", "--detector", "detector.yaml"]
SIMULATE += ["--out", "out.lh5"]
TRAIN = ["train", *sides(), "--out", "out", *tiny()]
PULSES = [
    "sim.lh5", "data.lh5", "varlen.lh5", "radware.lh5", "ragged.lh5", "plain.h5", "pulses.npz",
    "packed.npz", "pulses.npy", "pulses.spe", "pulses.txt", "run.fcio", "made.lh5",
]  # fmt: skip
HITS = ["hits.npz", "remage.lh5", "g4simple.h5", "hits.csv", "made.lh5"]
RUN = ["run.json", "recipe.yaml", "weights.safetensors", "losses.jsonl"]


def with_file(name: str, words: list[str]) -> Callable[[Path, np.random.Generator], Case]:
    """Cases that change a file of the base."""

    def make(folder: Path, rng: np.random.Generator) -> Case:
        return Case(words, f"{name}: {mutate(folder / name, rng)}")

    return make


def kinds() -> list[tuple[float, Callable[[Path, np.random.Generator], Case]]]:
    """Kinds of cases, and how often they come."""
    made: list[tuple[float, Callable[[Path, np.random.Generator], Case]]] = []
    for name in PULSES:
        dt = ["--dt-ns", "16"] if Path(name).suffix in (".npy", ".spe", ".txt") else []
        made.append((3, with_file(name, ["info", name, *dt])))
        translate = ["translate", "run", name, *dt, "--insist", "--out", "out.lh5"]
        made.append((1, with_file(name, translate)))
    for name in HITS:
        words = ["simulate", "--detector", "detector.yaml", "--out", "out.lh5", "--hits", name]
        made.append((4, with_file(name, words)))
    for name in RUN:
        made.append((2, with_file(f"run/{name}", ["info", "run"])))
        words = ["translate", "run", "sim.lh5", "--insist", "--out", "out.lh5"]
        made.append((3, with_file(f"run/{name}", words)))
        if name != "losses.jsonl":
            made.append((3, with_file(f"learned/{name}", ["response", "learned"])))
        words = ["export", "run", "--format", "torchscript", "--out", "out.pt"]
        made.append((0.5, with_file(f"run/{name}", words)))
    for words in (
        ["compare", "report", "report/metrics.json"],
        ["summary", "report", "--out", "out.html"],
    ):
        made.append((4, with_file("report/metrics.json", words)))
    made.append((3, with_file("settings.yaml", [*SIMULATE, "--settings", "settings.yaml"])))
    made.append((3, with_file("detector.yaml", SIMULATE)))
    made.append((2, with_file("detector.yaml", ["fields", "detector.yaml"])))
    made.append((2, with_file("detector.config", ["fields", "detector.config"])))
    words = ["fields", "diode.json", "--set", "temperature_K=85", "--set", "grid_mm=0.5"]
    made.append((3, with_file("diode.json", words)))
    words = ["stand", "--preset", "electronics.yaml", "--detector", "detector.yaml"]
    words += ["--events", "FEP=2", "--out", "out"]
    made.append((2, with_file("electronics.yaml", words)))
    shifted = [*words, "--kind", "shifted", "--shift", "shift.yaml"]
    shifted[shifted.index("electronics.yaml")] = "legend200"
    made.append((1, with_file("shift.yaml", shifted)))
    words = ["train", *sides(), "--out", "out", "--recipe", "recipe.yaml"]
    made.append((3, with_file("recipe.yaml", words)))
    for name in ("sim.lh5", "data.lh5"):
        made.append((1, with_file(name, TRAIN)))
    words = ["validate", "run", *sides(), "--no-rivals", "--truth", "truth.npz", "--out", "out"]
    made.append((1.5, with_file("truth.npz", words)))
    words = ["library", "translate", "learned", "psl.lh5", "--out", "out.lh5"]
    made.append((3, with_file("psl.lh5", words)))
    words = ["import", "pulses", "pulses.pickle", "--out", "out.lh5"]
    made.append((3, with_file("pulses.pickle", words)))
    made += [(4, set_word), (6, option), (3, place), (3, environment), (3, resumed)]
    return made


def set_word(_folder: Path, rng: np.random.Generator) -> Case:
    """A value given by ``--set``."""
    keys = {
        "detector": ["crystal_length", "bias_V", "grid_mm", "li_thickness", "temperature_K"],
        "settings": ["dt_ns", "length_ns", "cloud_fwhm_mm", "step_ns", "library_grid_mm"],
        "recipe": ["training.batch_size", "preparation.samples_after", "generator.width",
                   "training.rate_generators", "peaks", "training.losses.cycle_weight"],
    }  # fmt: skip
    kind = pick(rng, list(keys))
    trap = pick(rng, [*NASTY_TEXTS, *(str(value) for value in NASTY)]).replace("\0", "")
    word = f"{pick(rng, keys[kind])}={trap}"
    words = [*TRAIN, "--set", word] if kind == "recipe" else [*SIMULATE, "--set", word]
    return Case(words, f"--set {word[:60]}")


def option(_folder: Path, rng: np.random.Generator) -> Case:
    """An option with a value out of range, or of another kind."""
    numbers = [
        "nan",
        "inf",
        "-inf",
        "-1",
        "0",
        "1e300",
        "1e400",
        "x",
        "",
        "99999999999999999999",
    ]
    translate = ["translate", "run", "sim.lh5", "--insist", "--out", "out.lh5"]
    chances: list[tuple[list[str], str, list[str]]] = [
        (SIMULATE, "--origin", ["1e300,0,0", "nan,0,0", "1,2", "a,b,c", ""]),
        (SIMULATE, "--resolution", ["1e308,0", "nan,1", "-1,0", "1", "inf,inf", "1,1,1"]),
        (SIMULATE, "--cluster-mm", ["nan", "inf", "-1", "1e300", "x"]),
        (SIMULATE, "--window-kev", ["nan", "inf", "-1", "0", "1e300"]),
        (SIMULATE, "--seed", ["-1", "x", "1e3", "99999999999999999999"]),
        (SIMULATE, "--dt-ns", numbers),
        (SIMULATE, "--length-ns", numbers),
        (SIMULATE, "--temperature", numbers),
        (SIMULATE, "--cloud-fwhm-mm", ["nan", "inf", "-1", "1e300", "x", ""]),
        (SIMULATE, "--diffusion-constant", [*numbers, "true"]),
        (SIMULATE, "--hits-detector", ["x", "²", "--x"]),
        (SIMULATE, "--peak", ["x", "5-1", "-1", "FEP,x", "1e400-", "nan-3"]),
        (SIMULATE, "--set", ["", "=", "x", "x=1", "bias_V", "bias_V=1e9", "=3"]),
        (SIMULATE, "--settings", ["nothing.yaml", ".", "sim.lh5", "/dev/zero"]),
        (SIMULATE, "--crystal", ["nothing.yaml", "sim.lh5"]),
        (TRAIN, "--threads", ["0", "-1", "100000", "x", "1e3"]),
        (TRAIN, "--seed", ["-1", "4294967296", "x"]),
        (TRAIN, "--peak", ["", "x", "-1", "FEP,x", "5-1", "1e400-", "7000-8000", "FEP,"]),
        (TRAIN, "--device", ["", "x", "cuda:99", "gpu"]),
        (TRAIN, "--init", ["nothing", "sim.lh5", "report"]),
        (TRAIN, "--sim-table", ["x", "geds", "/x/"]),
        (TRAIN, "--kev-per-adc", numbers),
        (TRAIN, "--data-energy", ["x", "sim.lh5:x", "nothing.lh5:x", ":", "geds/raw"]),
        (translate, "--realisations", ["0", "-1", "1000000", "x"]),
        (translate, "--table", ["x", "geds", "..", "geds/sim/waveform/values"]),
        (translate, "--out-table", ["", "/", "a/b/c/d/e"]),
        (translate, "--append-column", ["", "a/b", "waveform", "."]),
        (translate, "--energy", ["x", "sim.lh5:", "nothing:x"]),
        (translate, "--jobs", ["0", "-1", "99999"]),
        (["info", "pulses.npy"], "--dt-ns", numbers),
        (["info", "sim.lh5"], "--energy", ["x", ":", "sim.lh5:geds/sim"]),
        (["info", "sim.lh5"], "--table", ["x", "geds/sim/dt"]),
        (["compare", "report", "report"], "--method", ["", "x", "ceiling"]),
    ]
    words, name, values = pick(rng, chances)
    value = pick(rng, values)
    fine = {
        ("--table", "geds/sim/waveform/values"),
        ("--peak", "1e400-"),
        ("--out-table", "a/b/c/d/e"),
        ("--hits-detector", "x"),
    }
    must = (name, value) not in fine and not (name == "--length-ns" and value == "")
    return Case([*words, f"{name}={value}"], f"{words[0]} {name}={value}", must_fail=must)


def place(folder: Path, rng: np.random.Generator) -> Case:
    """A name or a place where nothing can be read or written."""
    os.mkfifo(folder / "pipe")
    (folder / "empty").mkdir()
    (folder / "link").symlink_to("nowhere/else")
    (folder / "loop").symlink_to("loop")
    (folder / "void.lh5").touch()
    (folder / "full.lh5").symlink_to("/dev/full")
    names = ["pipe", "empty", "link", "loop", "void.lh5", "x" * 300, "a/" * 3000, "/dev/null"]
    names += [
        "/dev/full",
        "/dev/zero",
        "",
        ".",
        "..",
        "/",
        "nothing",
        "sim.lh5/x",
        "\n",
        "a\nb",
    ]
    name = pick(rng, names)
    if rng.random() < 0.5:
        command = pick(
            rng,
            [
                ["info", name],
                ["translate", "run", name, "--insist", "--out", "out.lh5"],
                ["translate", name, "sim.lh5", "--out", "out.lh5"],
                ["simulate", "--hits", name, "--detector", "detector.yaml", "--out", "out.lh5"],
                ["simulate", "--hits", "hits.npz", "--detector", name, "--out", "out.lh5"],
                ["response", name],
                ["compare", name, "report"],
                ["import", "pulses", name, "--out", "out.lh5"],
                ["library", "translate", "learned", name, "--out", "out.lh5"],
                ["fields", name],
                ["train", "--sim", name, "--data", "data.lh5", "--out", "out", *tiny()],
                ["figure", "run", name],
                ["figure", name, "losses"],
            ],
        )
        return Case(command, f"{command[0]} reads {name[:30]!r}", must_fail=True)
    command = pick(
        rng,
        [
            ["translate", "run", "sim.lh5", "--insist", "--out", name],
            ["simulate", "--hits", "hits.npz", "--detector", "detector.yaml", "--out", name],
            ["response", "learned", "--out", name],
            ["compare", "report", "report", "--out", name],
            ["summary", "report", "--out", name],
            [*TRAIN, f"--out={name}"],
            ["import", "pulses", "pulses.pickle", "--out", name],
        ],
    )
    fine = name in ("nothing", "\n", "a\nb", "link") or name.startswith("a/")
    return Case(command, f"{command[0]} writes {name[:30]!r}", must_fail=not fine)


def environment(_folder: Path, rng: np.random.Generator) -> Case:
    """A variable or a stream that is not as it should be; the command itself is fine."""
    words = pick(rng, [["info", "sim.lh5"], SIMULATE, ["compare", "report", "report"]])
    chances = [
        ({"OMP_NUM_THREADS": pick(rng, ["abc", "0", "-1", "", "99999999"])}, ""),
        ({"NUMBA_NUM_THREADS": pick(rng, ["abc", "0", "-1", "99999999"])}, ""),
        ({"PYTHONIOENCODING": "ascii", "LC_ALL": "C"}, ""),
        ({"CPUNET_CACHE": "/dev/null"}, ""),
        ({"CPUNET_CACHE": "sim.lh5"}, ""),
        ({"COLUMNS": pick(rng, ["0", "x", "-5", "1"])}, ""),
        ({}, pick(rng, ["closed", "full"])),
    ]
    changed, closed = pick(rng, chances)
    told = f"{words[0]} in {changed} {closed}"
    return Case(words, told, environment=changed, closed=closed)


def resumed(folder: Path, rng: np.random.Generator) -> Case:
    """A record of an earlier translation that does not say what it should."""
    import h5py

    words = ["translate", "run", "sim.lh5", "sim.lh5", "--insist", "--out", "many/"]
    shutil.copy(folder / "sim.lh5", folder / "sim2.lh5")
    words[3] = "sim2.lh5"
    call(words, folder)
    path = folder / "many" / "sim.lh5"
    with h5py.File(path, "r+") as file:
        name = next((key for key in file.attrs if "cpunet" in key or "record" in key), None)
        if name is None:
            return Case([*words, "--resume"], "no record")
        from mutations import change_tree

        tree, told = change_tree(json.loads(file.attrs[name]), rng)
        file.attrs[name] = json.dumps(tree)
    return Case([*words, "--resume"], f"record: {told}")


# --- what becomes of a case -------------------------------------------------------------------


def call(words: list[str], folder: Path) -> None:
    """Call a command that must succeed, in a process of its own."""
    outcome = run(Case(words, ""), folder, folder)
    if outcome["status"] != 0:
        raise SystemExit(f"{' '.join(words)}: {outcome['err']}")


def run(case: Case, folder: Path, logs: Path) -> dict[str, object]:
    """Run a case in a fork; return status, signal, output, time and memory."""
    out, err = logs / ".stdout", logs / ".stderr"
    begun = time.monotonic()
    pid = os.fork()
    if pid == 0:
        status = 99
        try:
            os.chdir(folder)
            os.setsid()
            os.environ.update(case.environment)
            stdout = os.open(out, os.O_WRONLY | os.O_CREAT | os.O_TRUNC)
            if case.closed == "full":
                stdout = os.open("/dev/full", os.O_WRONLY)
            stderr = os.open(err, os.O_WRONLY | os.O_CREAT | os.O_TRUNC)
            os.dup2(stdout, 1)
            os.dup2(stderr, 2)
            encoding = case.environment.get("PYTHONIOENCODING", "utf-8")
            sys.stdout = os.fdopen(1, "w", encoding=encoding)
            sys.stderr = os.fdopen(2, "w", encoding=encoding, errors="backslashreplace")
            if case.closed == "closed":
                os.close(1)
                sys.stdout = None  # as Python has it then
            sys.argv = ["cpunet", *case.words]
            resource.setrlimit(resource.RLIMIT_AS, (12 << 30, 12 << 30))
            cpunet_main()
        except SystemExit as ended:
            status = ended.code if isinstance(ended.code, int) else 98
        except BaseException:
            traceback.print_exc()
            status = 97
        finally:
            for stream in (sys.stdout, sys.stderr):
                with suppress(OSError, AttributeError, ValueError):
                    stream.flush()
            os._exit(status)
    late = False
    while True:
        done, code, usage = os.wait4(pid, os.WNOHANG)
        if done:
            break
        if time.monotonic() - begun > MAX_S:
            late = True
            os.killpg(pid, signal.SIGKILL)
            _, code, usage = os.wait4(pid, 0)
            break
        time.sleep(0.005)
    return {
        "status": os.waitstatus_to_exitcode(code),
        "out": out.read_text("utf-8", "replace") if out.exists() else "",
        "err": err.read_text("utf-8", "replace") if err.exists() else "",
        "seconds": time.monotonic() - begun,
        "kb": usage.ru_maxrss,
        "late": late,
    }


def listing(folder: Path) -> dict[str, str]:
    """Digests of all files below a folder."""
    found = {}
    for path in sorted(folder.rglob("*")):
        if path.is_symlink() or not path.is_file():
            found[str(path.relative_to(folder))] = "link" if path.is_symlink() else "other"
        else:
            digest = hashlib.sha256(path.read_bytes()).hexdigest()
            found[str(path.relative_to(folder))] = digest
    return found


def judged(case: Case, outcome: dict, before: dict, after: dict) -> list[str]:
    """What is wrong with an outcome; nothing, most of the time."""
    faults = []
    status, err = outcome["status"], outcome["err"]
    errors = sum(line.startswith("error: ") for line in err.splitlines())
    if outcome["late"]:
        faults.append("over 30 s")
    elif status < 0:
        faults.append("crash")
    elif "Traceback" in err or status in (70, 97, 98, 99):
        faults.append("traceback")
    elif status not in (0, 2, 141):
        faults.append("wrong status")
    elif status and not 1 <= errors <= (3 if "files failed" in err else 1):
        faults.append("not one line")
    if outcome["kb"] > MAX_KB:
        faults.append("over 2 GB")
    if status == 0 and case.must_fail:
        faults.append("wrong success")
    if status and case.environment and not case.closed:
        faults.append("wrong failure")
    changed = [name for name in before if after.get(name) != before[name]]
    if changed:
        faults.append(f"input changed ({changed[0]})")
    if status and (left := sorted(after.keys() - before.keys())):
        faults.append(f"leftover ({left[0]})")
    return faults


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--cases", type=int, default=200)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--first", type=int, default=0)
    parser.add_argument("--only", type=int)
    parser.add_argument(
        "--base", type=Path, default=Path(tempfile.gettempdir()) / "cpunet-fuzz"
    )
    given = parser.parse_args()
    import torch

    import cpunet.jobs.translation.translate
    import cpunet.jobs.validation.validate  # noqa: F401

    torch.set_num_threads(1)
    os.environ["CPUNET_CACHE"] = str(given.base / "cache")
    if not (given.base / "valid").is_dir():
        making = given.base / "making"
        shutil.rmtree(making, ignore_errors=True)
        making.mkdir(parents=True)
        make_base(making)
        for name in (".stdout", ".stderr"):
            (making / name).unlink()
        making.replace(given.base / "valid")
    chances = kinds()
    weights = np.array([weight for weight, _ in chances])
    counts: Counter[str] = Counter()
    commands: Counter[str] = Counter()
    begun = time.monotonic()
    numbers = (
        [given.only]
        if given.only is not None
        else range(given.first, given.first + given.cases)
    )
    for number in numbers:
        rng = np.random.default_rng([given.seed, number])
        with tempfile.TemporaryDirectory(dir=given.base) as name:
            folder, logs = Path(name) / "in", Path(name)
            shutil.copytree(given.base / "valid", folder, symlinks=True)
            kind = chances[int(rng.choice(len(chances), p=weights / weights.sum()))][1]
            case = kind(folder, rng)
            for left in (".stdout", ".stderr"):
                (folder / left).unlink(missing_ok=True)
            before = listing(folder)
            outcome = run(case, folder, logs)
            faults = judged(case, outcome, before, listing(folder))
        counts["success" if outcome["status"] == 0 else "error"] += 1
        commands[case.words[0]] += 1
        for fault in faults:
            counts[fault.partition(" (")[0]] += 1
        if faults or given.only is not None:
            line = (outcome["err"].splitlines() or [""])[-1]
            print(f"{number}: {', '.join(faults)}: {case.told}\n    {line[:300]}", flush=True)
        if given.only is not None:
            print(" ".join(case.words), outcome, sep="\n")
    print(dict(commands.most_common()))
    print(f"{len(numbers)} cases in {time.monotonic() - begun:.0f} s: {dict(counts)}")


if __name__ == "__main__":
    main()
