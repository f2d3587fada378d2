"""Kinds of broken inputs, options, places and environments."""

from __future__ import annotations

import json
import os
import shutil
from collections.abc import Callable
from pathlib import Path

import numpy as np
from fuzz_inputs import sides, tiny
from fuzz_process import Case, call
from mutations import NASTY, NASTY_TEXTS, change_tree, mutate, pick

Kind = Callable[[Path, np.random.Generator], Case]

# --------------------------------------------------------------------------------------------

SIMULATE = ["simulate", "--hits", "hits.npz", "--detector", "detector.yaml"]
SIMULATE += ["--out", "out.lh5"]
TRAIN = ["train", *sides(), "--out", "out", *tiny()]
PULSES = [
    "sim.lh5", "data.lh5", "varlen.lh5", "radware.lh5", "ragged.lh5", "plain.h5", "pulses.npz",
    "packed.npz", "pulses.npy", "pulses.spe", "pulses.txt", "run.fcio", "made.lh5",
]  # fmt: skip
HITS = ["hits.npz", "remage.lh5", "g4simple.h5", "hits.csv", "made.lh5"]
RUN = ["run.json", "recipe.yaml", "weights.safetensors", "losses.jsonl"]


def with_file(name: str, words: list[str]) -> Kind:
    """Kind of case that changes one valid file."""

    def make(folder: Path, rng: np.random.Generator) -> Case:
        return Case(words, f"{name}: {mutate(folder / name, rng)}")

    return make


def kinds() -> list[tuple[float, Kind]]:
    """Kinds of cases with their weights."""
    made: list[tuple[float, Kind]] = []
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
    words = [
        "validate",
        "run",
        *sides(),
        "--no-baselines",
        "--truth",
        "truth.npz",
        "--out",
        "out",
    ]
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
    """An option with a value that is out of range or of the wrong type."""
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
        (TRAIN, "--sim-table", ["x", "geds/raw", "/x/"]),
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
        (["compare", "report", "report"], "--method", ["", "x"]),
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
        here = command[0] == "compare" and name == "."  # a folder with a report in it
        return Case(command, f"{command[0]} reads {name[:30]!r}", must_fail=not here)
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
    """An invalid environment variable or stream; the command itself is valid."""
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
    """A changed record of an earlier translation."""
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
        tree, told = change_tree(json.loads(file.attrs[name]), rng)
        file.attrs[name] = json.dumps(tree)
    return Case([*words, "--resume"], f"record: {told}")
