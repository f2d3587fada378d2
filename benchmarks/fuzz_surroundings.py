"""Cases with changed surroundings of a command: options, names, caches, unfinished work."""

from __future__ import annotations

import functools
import itertools
import json
import os
import pickle
import shutil
import string
from pathlib import Path
from typing import Any

import h5py
import numpy as np
from fuzz_inputs import STUDY, sides, tiny, tuning
from fuzz_process import Case
from mutations import NASTY, NASTY_TEXTS, mutate, pick
from typer.main import get_command

from cpunet.cli.main import app

Rng = np.random.Generator

# A call of each command that succeeds or ends early, unless a case changes it.
WORDS = {
    "demo": ["demo", "--out", "out", "--events", "20", "--set", "training.batch_size=4"],
    "simulate": ["simulate", "--hits", "hits.npz", "--detector", "detector.yaml"],
    "fields": ["fields", "detector.yaml"],
    "stand": ["stand", "--preset", "legend200", "--detector", "detector.yaml",
    "--events=FEP=2"],
    "check": ["check", *sides(), "--out", "out.png"],
    "train": ["train", *sides(), *tiny()],
    "calibrate": ["calibrate", "--data", "data.lh5", "--sim", "made.lh5", "--plan"],
    "ensemble": ["ensemble", *sides(), *tiny(), "--seeds", "1", "--no-validate", *STUDY],
    "tune": ["tune", *sides(), *tuning()],
    "translate": ["translate", "run", "sim.lh5", "--insist"],
    "validate": ["validate", "run", *sides(), "--no-baselines"],
    "compare": ["compare", "report", "report", "--out", "out.html"],
    "summary": ["summary", "report", "--out", "out.html"],
    "response": ["response", "learned"],
    "figure": ["figure", "run", "losses"],
    "explore": ["explore", "learned", "--detector", "detector.yaml", "--points", "4"],
    "export": ["export", "learned", "--to", "legend-pars"],
    "info": ["info", "sim.lh5"],
    "library make": ["library", "make", "--detector", "detector.yaml", "--grid-mm", "12",
                     "--dt-ns", "16", "--length-ns", "3600"],
    "library translate": ["library", "translate", "learned", "psl.lh5"],
    "library merge": ["library", "merge", "psl.lh5"],
    "library expand": ["library", "expand", "psl.lh5"],
    "library lithium": ["library", "lithium"],
    "import weights": ["import", "weights", "--ren", "published.pt"],
    "import pulses": ["import", "pulses", "pulses.pickle"],
}  # fmt: skip
OUTS = {"simulate": "out.lh5", "fields": "out.png", "calibrate": "out", "explore": "out.html",
        "translate": "out.lh5", "import pulses": "out.lh5"} | {
            f"library {name}": "out.lh5"
            for name in ("make", "translate", "merge", "expand", "lithium")}  # fmt: skip
HEAVY = ("demo", "calibrate", "explore", "validate", "ensemble", "tune", "check")
VALUES = [
    *("nan", "inf", "-inf", "-1", "0", "1", "2", "1e300", "-1e300", "1e400", "1e-320", "x", ""),
    *("99999999999999999999", "2000000000", "1" * 400, "0x10", "1_000", "1,2", ",", "=", "a=b"),
    *(" ", "..", "/", "sim.lh5", "nothing", "FEP", "FEP,SEP", "-5", "5-1", "true", "None", "²"),
    *("--x", "[red]x[/red]", "%s%n", "*", "~", "\n", "\u202e", "\udcff", "x" * 5000, "auto"),
]


def with_out(name: str) -> list[str]:
    """Words of a command with an output."""
    words = WORDS[name]
    if "--out" in words or name == "info":
        return words
    return [*words, "--out", OUTS.get(name, "out")]


@functools.cache
def options() -> dict[str, list[str]]:
    """Options of each command that take a value, read from the command line's definition."""
    found = {}
    tree: Any = get_command(app)
    for name in WORDS:
        node = tree
        for word in name.split():
            node = node.commands[word]
        found[name] = [
            option.opts[0]
            for option in node.params
            if option.opts[0].startswith("--") and not option.is_flag
        ]
    return found


def any_option(_folder: Path, rng: Rng) -> Case:
    """Some value for some option of some command."""
    light = [name for name in WORDS if name not in HEAVY]
    names = [*WORDS, *light, *light, *light]
    name = pick(rng, names)
    option, value = pick(rng, options()[name]), pick(rng, VALUES)
    words = with_out(name)
    if option == "--out":  # the last one counts
        value = value or "."
    return Case([*words, f"{option}={value}"], f"{name} {option}={value[:40]!r}")


def set_anything(_folder: Path, rng: Rng) -> Case:
    """Some ``--set`` for some command that takes it."""
    name = pick(rng, [name for name, known in options().items() if "--set" in known])
    keys = {
        "detector": ["crystal_length", "crystal_radius", "bias_V", "vacuum_gap", "grid_mm",
                     "li_thickness", "impurity_z0_1e10_per_cm3", "temperature_K", "name"],
        "settings": ["dt_ns", "length_ns", "cloud_fwhm_mm", "step_ns", "library_grid_mm", "x"],
        "recipe": ["training.batch_size", "training.iterations", "training.components",
                   "discriminator.embedding_rows", "generator.width", "peaks", "cuts", "chain",
                   "preparation", "preparation.samples_after", "training.losses.cycle_weight",
                   "matching.generator", "scores.bootstraps", "search", "training", "noise.x"],
    }  # fmt: skip
    kind = "recipe" if name in ("train", "ensemble", "tune", "check", "demo") else "detector"
    key = pick(rng, [*keys[kind], *keys["settings" if kind == "detector" else "recipe"]])
    more = ["2000000000", "100000", "1e9", "1e20", "{a: 1}", "[1, 2]", "1" * 400, "null"]
    value = pick(rng, [*NASTY_TEXTS, *more, *map(str, NASTY)]).replace("\0", "")
    words = [*with_out(name), "--set", f"{key}={value}"]
    return Case(words, f"{name} --set {key}={value[:40]}")


def must_be_refused(_folder: Path, rng: Rng) -> Case:
    """Values that make no sense, although they are numbers or names."""
    chances = [
        ("simulate", "--events", "100000000000000000000"), ("simulate", "--origin", "1e9,0,0"),
        ("simulate", "--resolution", "1e308,1"), ("simulate", "--length-ns", "1e12"),
        ("simulate", "--set", "bias_V=1e9"), ("simulate", "--set", "vacuum_gap=.inf"),
        ("simulate", "--set", "crystal_length=.inf"), ("simulate", "--set", "grid_mm=1e-6"),
        ("simulate", "--cloud-fwhm-mm", "inf"), ("simulate", "--set", "crystal_length=1e9"),
        ("stand", "--events", "100000000000000000000"), ("stand", "--rate-khz", "1e300"),
        ("stand", "--hum", "50=1e300"), ("stand", "--hum", "x"), ("stand", "--shift", "x"),
        ("train", "--peak", "-1"), ("train", "--peak", "FEP,SEPP"), ("train", "--peak", "9e5-"),
        ("train", "--set", "discriminator.embedding_rows=2000000000"),
        ("train", "--set", "generator.width=100000"), ("train", "--recipe", "nothing"),
        ("train", "--set", "training.batch_size=1000000000"), ("train", "--threads", "100000"),
        ("train", "--set", "training.iterations=100000000000000000000"),
        ("tune", "--trials", "0"), ("tune", "--trials", "99999999999"), ("tune", "--jobs", "0"),
        ("ensemble", "--seeds", "0"), ("ensemble", "--seeds", "99999999999"),
        ("ensemble", "--seeds", "x"), ("ensemble", "--jobs", "-1"),
        ("translate", "--realisations", "1000000"), ("translate", "--length", "99999999999"),
        ("translate", "--adc-per-kev", "nan"), ("translate", "--remains", "-1"),
        ("translate", "--n-pre", "-1"), ("translate", "--baseline", "inf"),
        ("validate", "--ae-range", "x"), ("validate", "--ae-range", "3-1"),
        ("validate", "--truth", "sim.lh5"), ("validate", "--truth", "pulses.npy"),
        ("explore", "--points", "0"), ("explore", "--points", "99999999999"),
        ("library make", "--grid-mm", "1e-9"), ("library make", "--angles", "99999999"),
        ("library make", "--length-ns", "1e12"), ("library lithium", "--thickness-mm", "1e9"),
        ("library translate", "--rings", "99999999999"), ("import weights", "--dt-ns", "nan"),
        ("import weights", "--ren", "pulses.pickle"), ("import pulses", "--dt-ns", "inf"),
        ("calibrate", "--prior", "temperature=nan"), ("calibrate", "--free", "colour"),
        ("calibrate", "--fix", "x"), ("export", "--format", "x"), ("figure", "--format", "exe"),
        ("response", "--stand", "nothing"), ("response", "--electronics", "sim.lh5"),
        ("demo", "--preset", "nothing"), ("demo", "--events", "100000000000000000000"),
        ("check", "--recipe", "detector.yaml"), ("fields", "--crystal", "sim.lh5"),
        ("info", "--without-remains", "/nowhere/at/all.lh5"), ("summary", "--out", "report"),
    ]  # fmt: skip
    name, option, value = pick(rng, chances)
    words = [*with_out(name), f"{option}={value}"]
    return Case(words, f"{name} {option}={value}", must_fail=True)


def names(folder: Path, rng: Rng) -> Case:
    """Files with odd names, which must be read or written, or refused in one line."""
    odd = [
        b"caf\xe9",
        b"\xff\xfe",
        b"a b",
        b"-x",
        b"[red]x",
        b"%s",
        b"a\nb",
        b"x:y",
        b"'\"",
        b"$x",
    ]
    odd += ["μ→𝛾".encode(), b"\xe2\x80\xae", b"*", b"x" * 250, b"{0}", b"\\", b"<b>&", b".x"]
    name = os.fsdecode(pick(rng, odd))
    words = {
        "info": ["info", f"./{name}.lh5"],
        "translate": ["translate", "run", f"./{name}.lh5", "--insist", "--out", "out.lh5"],
        "train": [
            "train",
            "--sim",
            f"./{name}.lh5",
            "--data",
            "data.lh5",
            "--out=out",
            *tiny(),
        ],
        "response": ["response", f"./{name}"],
        "compare": ["compare", f"./{name}", "report", "--out", "out.html"],
        "summary": ["summary", f"./{name}", "report", "--out", "out.html"],
        "out": ["translate", "run", "sim.lh5", "--insist", "--out", f"./{name}.lh5"],
        "out2": ["compare", "report", "report", "--out", f"./{name}.html"],
        "out3": ["train", *sides(), "--out", f"./{name}", *tiny()],
    }
    kind = pick(rng, sorted(words))
    base = {"response": "learned", "compare": "report", "summary": "report"}.get(kind)
    if base:
        shutil.copytree(folder / base, folder / name)
    elif not kind.startswith("out"):
        (folder / f"{name}.lh5").write_bytes((folder / "sim.lh5").read_bytes())
    return Case(words[kind], f"{kind} of {name[:20]!r}", fresh=bool(rng.random() < 0.2))


def variables(folder: Path, rng: Rng) -> Case:
    """An odd environment variable in a new interpreter; it must not matter."""
    words = pick(rng, [["info", "sim.lh5"], with_out("compare"), with_out("simulate")])
    numbers = ["abc", "0", "-1", "", "99999999", "1,2", "1.5", " 1", "²"]
    chances: list[dict[str, str]] = [
        *({name: pick(rng, numbers)} for name in ("OMP_NUM_THREADS", "NUMBA_NUM_THREADS",
          "MKL_NUM_THREADS", "OPENBLAS_NUM_THREADS", "OMP_THREAD_LIMIT")),
        {"PYTHONIOENCODING": "ascii", "LC_ALL": "C"}, {"LC_ALL": "nowhere.XX"},
        {"HOME": "/dev/null"},
        {"PYTHONUTF8": "0", "LC_ALL": "POSIX", "LANG": ""}, {"TMPDIR": "/nowhere"},
        {"CPUNET_CACHE": pick(rng, ["/dev/null", "sim.lh5", "", "/proc/x", "x" * 300])},
        {"COLUMNS": pick(rng, ["0", "x", "-5", "1", "99999999"])}, {"TERM": "x"}, {"TZ": "x/y"},
        {"NUMBA_CACHE_DIR": pick(rng, ["/dev/null", "sim.lh5", "/proc/x", "/tmp", ""])},
        {"MPLBACKEND": "x"}, {"MPLCONFIGDIR": "/dev/null"}, {"XDG_CACHE_HOME": "/dev/null"},
        {"HDF5_USE_FILE_LOCKING": "x"}, {"HDF5_PLUGIN_PATH": "/nowhere"}, {"NO_COLOR": ""},
    ]  # fmt: skip
    changed = pick(rng, chances)
    told = f"{words[0]} in {changed}"
    return Case(words, told, must_succeed=True, environment=changed, fresh=True)


def streams(_folder: Path, rng: Rng) -> Case:
    """A standard stream that is closed or full."""
    names = [name for name in WORDS if name not in HEAVY]
    name, closed = (
        pick(rng, names),
        pick(rng, ["full", "closed", "errors full", "errors closed"]),
    )
    words = WORDS[name] if name in ("fields", "response") else with_out(name)
    return Case(
        words, f"{name}: output {closed}", closed=closed, fresh=bool(rng.random() < 0.1)
    )


def caches(folder: Path, rng: Rng) -> Case:
    """A damaged file in the cache of fields or of compiled code; it must be made again."""
    base = Path(os.environ["CPUNET_CACHE"])
    places = {"CPUNET_CACHE": base, "NUMBA_CACHE_DIR": base.parent / "code"}
    variable = pick(rng, sorted(places))
    target = folder.parent / "cache"
    shutil.copytree(places[variable], target)
    files = sorted(path for path in target.rglob("*") if path.is_file())
    path = pick(rng, files)
    told = f"{variable}/{path.name[-24:]}: {mutate(path, rng)}"
    words = with_out("simulate") if variable == "CPUNET_CACHE" else ["info", "sim.lh5"]
    words = pick(rng, [words, with_out("simulate")])
    fresh = variable == "NUMBA_CACHE_DIR"
    return Case(
        words, told, must_succeed=True, environment={variable: str(target)}, fresh=fresh
    )


def unfinished(folder: Path, rng: Rng) -> Case:
    """A training, an ensemble or a search that is resumed from changed files."""
    kind = pick(rng, ["stopped", "stopped", "ens", "tuned"])
    place = folder / ("stopped.unfinished" if kind == "stopped" else kind)
    files = [
        path for path in sorted(place.rglob("*")) if path.is_file() and path.stat().st_size
    ]
    path = pick(rng, files)
    told = f"{path.relative_to(folder)}: {mutate(path, rng)}"
    words = {
        "stopped": ["train", *sides(), "--out", "stopped", *tiny(), "--set",
                    "training.iterations=30", "--resume"],
        "ens": [*WORDS["ensemble"], "--out", "ens", "--resume"],
        "tuned": [*WORDS["tune"], "--out", "tuned", "--resume"],
    }[kind]  # fmt: skip
    return Case(words, told)


def truths(folder: Path, rng: Rng) -> Case:
    """Truth files of the wrong shape, type or format."""
    whole = np.load(folder / "truth.npz")["response"]
    arrays = {
        "short": whole[:-1], "long": np.vstack([whole, whole]), "flat": whole[0],
        "cube": whole[None],
        "one sample": whole[:, :1], "text": np.full(whole.shape, "x"), "empty": whole[:0],
        "complex": whole * 1j, "objects": np.array([{}] * len(whole)), "NaN": whole * np.nan,
        "infinite": np.full(whole.shape, np.inf), "scalar": np.float64(1), "bool": whole > 0,
    }  # fmt: skip
    kind = pick(rng, [*arrays, "npy", "another name", "folder", "a run"])
    if kind in arrays:
        np.savez(folder / "truth.npz", allow_pickle=True, response=arrays[kind])
    elif kind == "npy":
        np.save(folder / "t.npy", whole)
        (folder / "t.npy").replace(folder / "truth.npz")
    elif kind == "another name":
        np.savez(folder / "truth.npz", truth=whole)
    else:
        (folder / "truth.npz").unlink()
        shutil.copytree(folder / "run", folder / "truth.npz")
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
    return Case(words, f"truth: {kind}", must_fail=True)


def wrong_hits(folder: Path, rng: Rng) -> Case:
    """Impossible hits in a readable file."""
    arrays = dict(np.load(folder / "hits.npz"))
    column = pick(rng, ["x_mm", "y_mm", "z_mm", "edep_keV"])
    value = pick(rng, [np.nan, np.inf, -np.inf, 1e300, -1e300])
    offsets = [[0, 2, 3, 9], [0, 3, 2, 4], [1, 2, 4], [0, 2, np.nan, 4], [0.5, 2, 4], [-1, 4]]
    offsets += [[0, 2, 3, 2**62], [], [[0, 4]], ["0", "4"], [0, 1]]
    if rng.random() < 0.5:
        arrays[column] = arrays[column].copy()
        arrays[column][int(rng.integers(4))] = value
        told = f"{column}: {value}"
    else:
        arrays["offsets"] = np.array(told := pick(rng, offsets))
        told = f"offsets: {told}"
    np.savez(folder / "hits.npz", **arrays)
    return Case(with_out("simulate"), told, must_fail=True)


def wide_files(folder: Path, rng: Rng) -> Case:
    """Sparse files that claim to be far larger than they are."""
    shape = pick(
        rng, [(4, 10**7), (10**8, 64), (10**9, 2), (1, 2**31), (10**6, 10**6), (10**12, 8)]
    )
    with h5py.File(folder / "wide.h5", "w") as file:
        chunks = (min(shape[0], 1000), min(shape[1], 1000))
        file.create_dataset("waveform", shape, pick(rng, ["u2", "f4", "f8"]), chunks=chunks)
        file["dt_ns"] = 16.0
        rows = min(shape[0], 10**8)
        energy = file.create_dataset("energy_kev", (rows,), "f4", chunks=(min(rows, 1000),))
        energy[:3] = 2614.5
    words = [
        ["info", "wide.h5"],
        ["translate", "run", "wide.h5", "--insist", "--out", "out.lh5"],
    ]
    words += [["train", "--sim", "wide.h5", "--data", "data.lh5", "--out", "out", *tiny()]]
    words += [["check", "--sim", "sim.lh5", "--data", "wide.h5"]]
    # any result is accepted, if it takes little time and memory
    return Case(pick(rng, words), f"a sparse file of {shape}")


def pickles(folder: Path, rng: Rng) -> Case:
    """Pickles that blow up, call something, or hold no pulses."""
    shared: Any = [0.0] * 10
    for _ in range(40):
        shared = [shared] * 10
    loop: list[Any] = []
    loop.append(loop)
    pulse = {"wf": np.zeros(225, np.float32), "tp0": 40, "energy": 1.0, "event": 1}
    made: dict[str, bytes] = {
        "shared": pickle.dumps([{"wf": shared, "tp0": 40, "energy": 1.0, "event": 1}]),
        "loop": pickle.dumps(loop), "call": b"cos\nsystem\n(S'touch owned'\ntR.",
        "path": pickle.dumps(Path("x")), "number": pickle.dumps(10**400),
        "none": pickle.dumps(None),
        "long": b"\x80\x04\x8b\xff\xff\xff\x7f" + b"1" * 100,
        "frame": b"\x80\x04\x95" + b"\xff" * 8,
        "deep": b"(" * 100_000, "memo": b"\x80\x04]\x94" + b"h\x00a" * 1000 + b".",
        "text": pickle.dumps([pulse | {"wf": "x" * 100}]),
        "nan": pickle.dumps([pulse | {"tp0": "x"}]),
    }  # fmt: skip
    kind = pick(rng, sorted(made))
    command, name = pick(
        rng, [("import pulses", "pulses.pickle"), ("import weights", "published.pt")]
    )
    (folder / name).write_bytes(made[kind])
    return Case(with_out(command), f"{command}: {kind}", must_fail=kind not in ("memo",))


def scores(folder: Path, rng: Rng) -> Case:
    """Scores with one unusual value instead of a number."""
    path = folder / "report" / "metrics.json"
    text = path.read_text("utf-8")
    spans = [i for i, sign in enumerate(text) if sign in string.digits]
    at = int(pick(rng, spans))
    end = next(i for i in itertools.count(at) if text[i] not in "0123456789.e+-")
    value = pick(
        rng, ["1" * 400, "1e400", "-1e308", "NaN", "Infinity", "1" * 5000, "null", "[]"]
    )
    path.write_text(text[:at] + value + text[end:], encoding="utf-8")
    words = pick(
        rng, [with_out("compare"), with_out("summary"), ["figure", "report", "spectrum"]]
    )
    return Case([*words, "--out", "out"] if words[0] == "figure" else words,
                f"{words[0]}: {json.dumps(text[max(at - 30, 0):at])} {value[:10]}")  # fmt: skip


def other_files(folder: Path, rng: Rng) -> Case:
    """A mutated file for commands that the other kinds leave out."""
    chances = [
        ("check", "sim.lh5"), ("check", "data.lh5"), ("calibrate", "made.lh5"),
        ("calibrate", "data.lh5"), ("explore", "detector.yaml"), ("explore",
        "learned/run.json"),
        ("explore", "learned/weights.safetensors"), ("export", "learned/run.json"),
        ("export", "learned/weights.safetensors"), ("export", "learned/recipe.yaml"),
        ("library merge", "psl.lh5"), ("library expand", "psl.lh5"), ("validate",
        "run/run.json"),
        ("library translate", "learned/run.json"), ("import weights", "published.pt"),
        ("import weights", "published.pt"), ("figure", "run/losses.jsonl"), ("stand",
        "detector.yaml"),
        ("summary", "report/.cpunet.json"), ("response", "learned/run.json"),
    ]  # fmt: skip
    name, path = pick(rng, chances)
    return Case(with_out(name), f"{name}: {path}: {mutate(folder / path, rng)}")


def figures(_folder: Path, rng: Rng) -> Case:
    """Names of figures that do not exist."""
    name = pick(rng, ["", " ", "x", "../x", "/", "losses/", "*", "[", "FEP " * 2000, "\0"[:0]])
    return Case(
        ["figure", "report", name, "--out", "out"], f"figure {name[:20]!r}", must_fail=True
    )


KINDS = [
    (8, any_option), (4, set_anything), (5, must_be_refused), (3, names), (1, variables),
    (2, streams), (1.5, caches), (2.5, unfinished), (1, truths), (2, wrong_hits), (2,
    wide_files),
    (1, pickles), (1.5, scores), (4, other_files), (0.5, figures),
]  # fmt: skip
