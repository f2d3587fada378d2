"""Mistakes that people make: each ends in one line with a remedy, and leaves nothing behind.

Those whose remedies are followed are in `test_remedies`.
"""

from __future__ import annotations

import errno
import os
import re
import shlex
import shutil
import signal
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import h5py
import numpy as np
import pytest
import yaml

from cpunet.outputs import folder_written_aside
from cpunet.training.run import RUN
from synthetic import rows_of, status_of, write_chain

# Commands that are right, unless a mistake gives an option another value.
NEEDED = {
    "train": {"--recipe": "fast", "--sim": "sim.lh5", "--data": "data.lh5", "--out": "out"},
    "simulate": {"--detector": "ppc.yaml", "--hits": "hits.npz", "--out": "out"},
}
WRITE = "translate run sim.lh5 --no-noise --out out.lh5"
Patch = Callable[[pytest.MonkeyPatch], None]


class Mistake(NamedTuple):
    """Words of a command, the line that it ends in, and what is wrong with the machine."""

    words: str
    line: str
    patch: Patch | None = None
    status: int = 2


def failing(what: str, error: BaseException) -> Patch:
    """Let a function of the package raise an error."""

    def fail(*_given: object, **_options: object) -> None:
        raise error

    return lambda patch: patch.setattr(what, fail)


def signalled(number: int) -> Patch:
    """Let a signal arrive as the output is moved into its place."""
    arrive = lambda *_given, **_options: signal.raise_signal(number)  # noqa: E731
    return lambda patch: patch.setattr("pathlib.Path.replace", arrive)


DESCRIBE = "cpunet.inspection.pulse_file"
NAMES = ("INT", "TERM", "HUP", "QUIT", "USR1", "USR2", "XCPU")  # some of batch systems
SIGNALS = [getattr(signal, f"SIG{name}") for name in NAMES]
FULL = OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
# Words of a command, and the line that it ends in.
PLAIN = r"""
info 'none[b]:key:[/b].lh5' | none\[b\]:key:\[/b\].lh5: no such file; check the name
info metres.yaml | metres.yaml: .*
info sim.lh5 --tabel x | .*--tabel.*; see .*--help
train --data negative.lh5 | negative.lh5: .*; check the calibration .*-2102
train --data none-at-all.lh5 | none-at-all.lh5: .*; .*
train --sim data.lh5 --data sim.lh5 | sim.lh5: .* measured .* simulated.*swapped.*--insist.*
train --sim translated.lh5 | translated.lh5: .*translated.*; .*
train --data constant.lh5 | constant.lh5: .*constant.*; .*
train --data saturated.lh5 | saturated.lh5: .*saturated.*; .*
train --data few.lh5 | 24 simulated and 2 measured pulses; 200 of each .* needed: select more.*
simulate --seed=-1 | --seed: -1 is not from 0 to 4294967295
simulate --hits noenergy.npz | noenergy.npz: .*
stand --preset ornl --detector V9 --out o | V9: neither a file nor one of .*ppc.*
translate run folder --out out | folder: is a folder; give a file of pulses
translate sim.lh5 sim.lh5 --out out | sim.lh5: no finished run .*; make it with .*
translate report sim.lh5 --out out | report: no finished run .*; make it with .*
translate halfrun sim.lh5 --out out | halfrun.*; .*
translate run sim.lh5 --out text.lh5/o | text.lh5/o: cannot be written \(.*\); .*another place
"""
MISTAKES = {row: Mistake(*row.split(" | ")) for row in rows_of(PLAIN)} | {
    f"stopped by {n.name}": Mistake(WRITE, r"interrupted; .*", signalled(n), 128 + n)
    for n in SIGNALS
}
FAULTS = {
    "no disk": failing("pathlib.Path.replace", FULL),
    "no room": failing(DESCRIBE, FULL),
    "no GPU": lambda patch: patch.setattr("torch.cuda.is_available", lambda: False),
    "memory": failing(DESCRIBE, MemoryError("Unable to allocate 6 GiB")),
    "GPU memory": failing(DESCRIBE, RuntimeError("CUDA out of memory. Tried\nto allocate")),
    "unexpected": failing(DESCRIBE, KeyError("dt")),
}
# the same, behind what is wrong with the machine
FAULTY = r"""
no disk | WRITE | out.lh5: cannot be written \(No space left on device\); make room there, or .*
no room | info sim.lh5 | sim.lh5: No space left on device; make room, or choose another place
no GPU | train --recipe paper --device cuda | no GPU; use --device cpu or install .*
memory | info sim.lh5
    | sim.lh5: out of memory \(Unable to allocate 6 GiB\); take fewer pulses, or .*
GPU memory | info sim.lh5
    | sim.lh5: out of memory \(CUDA out of memory.*\); take fewer pulses, or .*
unexpected | info sim.lh5
    | sim.lh5: unexpected KeyError \('dt'\); please report it to .* --debug prints
"""
for row in rows_of(FAULTY.replace("WRITE", WRITE)):
    fault, words, line = row.split(" | ")
    MISTAKES[fault] = Mistake(words, line, FAULTS[fault], 1 if fault == "unexpected" else 2)


def fill(folder: Path, stand) -> None:
    """Make the files that the commands are given."""
    for name in ("run", "halfrun"):
        with folder_written_aside(folder / name, RUN) as aside:
            write_chain(aside)
    (folder / "halfrun" / "weights.safetensors").unlink()
    shutil.copy(stand.sim, folder / "sim.lh5")
    shutil.copy(stand.data, folder / "data.lh5")
    waves, kev = stand.data_waveforms, stand.data_kev
    for name, energies in {"negative": -kev, "none-at-all": kev}.items():
        stand.write(folder / f"{name}.lh5", "geds/raw", waves, energies)
    few = np.where(np.arange(len(kev)) < 9, kev, 1000)
    scaled = 8000 + (waves - 8000.0) * (few / kev)[:, np.newaxis]
    stand.write(folder / "few.lh5", "geds/raw", np.round(scaled).astype(np.uint16), few)
    bad = {"constant": 0 * waves + 8000, "saturated": waves.clip(0, 20_000)}
    for name, pulses in bad.items():
        stand.write(folder / f"{name}.lh5", "geds/raw", pulses, kev)
    with h5py.File(folder / "none-at-all.lh5", "r+") as file:
        del file["geds/raw/energy"]
        file["geds/raw"].attrs["datatype"] = "table{waveform,event_number}"
    (folder / "text.lh5").write_text("1 2 3\n" * 50)
    (folder / "folder").mkdir()
    (folder / "report").mkdir()
    (folder / "report" / "metrics.json").write_text('{"peaks": {}}')
    crystal = {
        "crystal_length": 20.0, "crystal_radius": 20.0, "point_contact_length": 1.6,
        "point_contact_radius": 2.0, "li_thickness": 1.0, "impurity_z0_1e10_per_cm3": -0.8,
        "bias_V": 2500, "temperature_K": 85, "grid_mm": 0.5,
    }  # fmt: skip
    (folder / "ppc.yaml").write_text(yaml.safe_dump(crystal))
    lengths = {key: crystal[key] / 1000 for key in crystal if key.startswith("crystal_")}
    (folder / "metres.yaml").write_text(yaml.safe_dump(crystal | lengths))
    x = np.array([5.0, 6.0, 9.0])
    hits = {"x_mm": x, "y_mm": 0 * x, "z_mm": x, "offsets": np.array([0, 1, 2, 3])}
    np.savez(folder / "hits.npz", **hits, edep_keV=0 * x + 900)
    np.savez(folder / "noenergy.npz", **hits)


@pytest.fixture(scope="module")
def filled(stand, tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("mistakes")
    fill(folder, stand)
    words = ["translate", folder / "run", folder / "sim.lh5", "--no-noise"]
    assert status_of(*words, "--out", folder / "translated.lh5") == 0
    return folder


@pytest.fixture
def home(filled: Path, own_cache: None, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.chdir(filled)
    return filled


def listing(folder: Path) -> dict[str, int]:
    return {str(path): path.stat().st_mtime_ns for path in folder.rglob("*")}


@pytest.mark.parametrize("name", MISTAKES)
def test_a_mistake_ends_in_one_line_and_leaves_nothing(command, home, monkeypatch, name):
    mistake = MISTAKES[name]
    before = listing(home)
    with monkeypatch.context() as patched:
        if mistake.patch is not None:
            mistake.patch(patched)
        words = shlex.split(mistake.words)
        needed = NEEDED.get(words[0], {}).items()
        words += [word for key, value in needed if key not in words for word in (key, value)]
        outcome = command(*words)
    lines = outcome.err.splitlines()
    assert outcome.code == mistake.status, outcome.err
    assert [line for line in lines if line.startswith("error: ")] == lines[-1:]
    assert re.fullmatch(f"error: {mistake.line}", lines[-1]), lines[-1]
    assert "Traceback" not in outcome.err
    assert outcome.out == ""
    assert listing(home) == before


@pytest.mark.parametrize("words", ["--debug info sim.lh5", "info sim.lh5 --debug"])
def test_debug_shows_where_wherever_it_stands(command, home, monkeypatch, words):
    failing(DESCRIBE, KeyError("dt"))(monkeypatch)
    outcome = command(*words.split())
    assert outcome.code == 1
    assert "Traceback" in outcome.err
    assert outcome.err.splitlines()[-1].startswith("error: sim.lh5: unexpected KeyError")
