"""Frozen references: what the program computes, to the last bit.

``python tests/frozen.py`` runs demo, stands, translations, a calibration, a library and some
steps of a network, and compares digests of all arrays and scores with ``frozen.json``. It
guards a change that should change no result. If one must, it stores the new digests, with the
reason, by ``python tests/frozen.py --freeze "reason" PART ...``.

The last bits depend on processor and libraries: on another machine than the one that froze
them, freeze the commit before the change first, and do not commit that.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import os
import platform
import subprocess
import sys
import tempfile
from collections.abc import Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor
from importlib.metadata import version
from pathlib import Path
from typing import Any

import h5py
import numpy as np
from safetensors.numpy import load_file

FROZEN = Path(__file__).with_suffix(".json")
DATA = Path(
    os.environ.get("CPUNET_REFERENCE_DATA", Path(__file__).parents[2] / "shared" / "data")
)
STAND = "--sim {0}/sim.lh5 --data {0}/data.lh5"
FEW = "--events FEP=2000,SEP=500,DEP=500"
TRUTH = "--truth {0}/truth.npz"


def train_and_validate(stand: str, name: str) -> list[str]:
    """Commands that train on a stand and score the run."""
    sides, truth = STAND.format(stand), TRUTH.format(stand)
    return [
        f"train {sides} --out {name}",
        f"validate {name} {sides} {truth} --out {name}-report",
    ]


# Commands of each part, and what they leave; parts of one lane need those before them.
LANES: list[dict[str, list[str]]] = [
    {"demo": ["demo --out demo"]},
    {
        "matched": [
            f"stand --preset legend200 {FEW} --seed 3 --out stand",
            *train_and_validate("stand", "matched"),
        ],
        "translate": [
            "translate matched stand/sim.lh5 --seed 1 --out windows.lh5",
            "translate matched stand/sim.lh5 --seed 1 --adc --adc-per-kev 3.5"
            " --baseline 9000 --pile-up-khz 5 --out adc.lh5",
            "translate matched stand/data.lh5 --inverse --out inverse.lh5",
        ],
        "library": [
            "library make --detector ppc --grid-mm 6 --out library.lh5",
            "library translate matched library.lh5 --detector ppc --out behind.lh5",
        ],
        "network": [
            f"train --recipe published {STAND.format('stand')} --out network"
            " --set training.noise=baselines"
            " --set generator.width=4 --set training.iterations=20"
            " --set training.decay_start=10 --set training.log_interval=1"
            " --set training.statistics_batches=2"
        ],
    },
    {
        "shifted": [
            f"stand --preset ornl --shift default {FEW} --seed 4 --out shifted-stand",
            *train_and_validate("shifted-stand", "shifted"),
        ],
        "calibrate": [
            f"calibrate {STAND.format('shifted-stand')} --events 800"
            " --free temperature,impurity --out calibrated"
        ],
    },
    {"closure": train_and_validate("{DATA}/closure", "closure")},
]


def digest(array: Any) -> str:
    """Of type, shape and bytes of an array."""
    array = np.asarray(array)
    if array.dtype.kind in "OSU":
        array = array.astype(str)
    content = repr((array.dtype.str, array.shape)).encode() + array.tobytes()
    return hashlib.sha256(content).hexdigest()[:12]


def results(path: Path) -> Iterator[tuple[str, Any]]:
    """What a command has left in a file or a folder: names, with digests or scores."""
    if path.is_dir():
        for file in sorted(path.iterdir()):
            yield from ((f"{path.name}/{name}", value) for name, value in results(file))
    elif path.suffix == ".lh5":
        with h5py.File(path) as file:
            sets: dict[str, Any] = {}
            file.visititems(lambda name, item: sets.update({name: item}))
            for name, item in sets.items():
                if hasattr(item, "shape"):
                    yield f"{path.name}:{name}", digest(item[()])
    elif path.suffix == ".safetensors":
        tensors = {name: digest(tensor) for name, tensor in load_file(path).items()}
        yield path.name, digest(json.dumps(tensors, sort_keys=True))
    elif path.name == "truth.npz":
        with np.load(path, allow_pickle=False) as arrays:
            yield from ((f"{path.name}:{name}", digest(arrays[name])) for name in arrays)
    elif path.name == "metrics.json":
        metrics = json.loads(path.read_text())
        for key in metrics.keys() - {"training", "compared"}:  # hold seconds, and the day
            yield f"{path.name}:{key}", digest(json.dumps(metrics[key], sort_keys=True))
        for peak, scores in metrics["peaks"].items():
            for name, comparison in scores["parameters"].items():
                yield f"{path.name}:{peak} {name} IoU", comparison["iou"].get("ren")
    elif path.name == "losses.jsonl":
        lines = [json.loads(line) for line in path.read_text().splitlines()]
        for line in lines[-1:]:
            losses = {key: value for key, value in line.items() if "second" not in key}
            yield f"{path.name}:last", losses
    elif path.name == "calibration.json":
        content = json.loads(path.read_text())
        yield f"{path.name}:parameters", content["parameters"]
        yield f"{path.name}:pulls", digest(json.dumps(content["pulls_after"]))


def run_lane(lane: Mapping[str, list[str]], folder: Path) -> dict[str, dict[str, Any]]:
    """Run the commands of some parts in a folder; results by part."""
    threads = dict.fromkeys(("OMP_NUM_THREADS", "NUMBA_NUM_THREADS"), "1")
    found = {}
    for part, commands in lane.items():
        if any("{DATA}" in command for command in commands) and not DATA.is_dir():
            print(f"{part}: left out, no reference data (CPUNET_REFERENCE_DATA)")
            continue
        before = set(folder.iterdir())
        for command in commands:
            words = command.replace("{DATA}", str(DATA)).split()
            how = {"cwd": folder, "env": os.environ | threads, "text": True, "check": True}
            words = [sys.executable, "-m", "cpunet", *words]
            subprocess.run(words, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, **how)
        made = sorted(set(folder.iterdir()) - before)
        found[part] = dict(item for path in made for item in results(path))
    return found


def machine() -> dict[str, str]:
    """What the last bits depend on."""
    lines = Path("/proc/cpuinfo").read_text().splitlines()
    cpu = next((line for line in lines if "model name" in line), "")
    found = {"processor": cpu.partition(":")[2].strip() or platform.processor()}
    return found | {name: version(name) for name in ("numpy", "scipy", "numba", "torch")}


def main() -> int:
    """Compare or freeze; the exit status says whether all are equal."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("parts", nargs="*", help="all by default, with those that they need")
    parser.add_argument("--freeze", metavar="REASON", help="store the results of these parts")
    arguments = parser.parse_args()
    lanes = [lane for lane in LANES if not arguments.parts or lane.keys() & arguments.parts]
    with tempfile.TemporaryDirectory() as name, ThreadPoolExecutor(2) as pool:
        folders = [Path(name) / str(i) for i in range(len(lanes))]
        for folder in folders:
            folder.mkdir()
        try:
            done = list(pool.map(run_lane, lanes, folders))
        except subprocess.CalledProcessError as error:
            print(f"{' '.join(error.cmd[3:])}: {error.stderr.splitlines()[-1:]}")
            return 2
    found = {part: values for lane in done for part, values in lane.items()}
    if arguments.parts:
        found = {part: found[part] for part in arguments.parts}
    stored = json.loads(FROZEN.read_text()) if FROZEN.exists() else {"parts": {}, "reasons": []}
    if arguments.freeze:
        stored["machine"] = machine()
        stored["parts"] |= {
            part: dict(sorted(values.items())) for part, values in found.items()
        }
        stored["reasons"].append(f"{', '.join(found)}: {arguments.freeze}")
        FROZEN.write_text(json.dumps(stored, indent=1) + "\n")
        return 0
    if stored["machine"] != machine():
        print(f"frozen with {stored['machine']}, not {machine()}: last bits may differ")
    return report(stored["parts"], found)


def report(stored: Mapping[str, Any], found: Mapping[str, Any]) -> int:
    """Print what differs; 1 if anything does."""
    different = 0
    for part, values in found.items():
        then = stored.get(part, {})
        for name in sorted(then.keys() | values.keys()):
            before, now = (json.dumps(side.get(name)) for side in (then, values))
            if before != now:
                different += 1
                print(f"{part}: {name}: {before} -> {now}")
        print(f"{part}: {len(values)} results")
    return int(different > 0)


if __name__ == "__main__":
    sys.exit(main())
