"""No file that is read executes code."""

from __future__ import annotations

import os
import pickle
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from cpunet.errors import CpunetError
from cpunet.pulses.reading import open_pulses
from cpunet.recipes import load_recipe
from cpunet.simulation.geometry_readers import read_detector
from cpunet.simulation.hit_files import read_hits
from cpunet.training.published import import_weights


class Hostile:
    """Makes a folder when it is unpickled."""

    def __init__(self, path: Path) -> None:
        self.path = path

    def __reduce__(self) -> tuple[Any, ...]:
        return os.mkdir, (str(self.path),)


def arrays(path: Path, hostile: Hostile) -> None:
    values = np.array([[hostile]], dtype=object)
    np.savez(path, waveform=values, x_mm=values, offsets=values, allow_pickle=True)


def yaml_tag(path: Path, hostile: Hostile) -> None:
    path.write_text(f"name: !!python/object/apply:os.mkdir ['{hostile.path}']")


# file → (how it is written, how it is read)
FILES: dict[str, tuple[Callable[[Path, Hostile], object], Callable[[Path], object]]] = {
    "pulses.npz": (arrays, open_pulses),
    "hits.npz": (arrays, read_hits),
    "pulses.npy": (lambda p, h: np.save(p, np.array([[h]], object)), open_pulses),
    "pulses.pickle": (
        lambda p, h: p.write_bytes(pickle.dumps({"wf": np.array([h], object)})),
        open_pulses,
    ),
    "weights.pt": (
        lambda p, h: torch.save({"inc": h}, p),
        lambda p: import_weights(p.parent / "run", ren=p),
    ),
    "recipe.yaml": (yaml_tag, lambda p: load_recipe(str(p))),
    "detector.yaml": (yaml_tag, read_detector),
}


@pytest.mark.parametrize("name", FILES)
def test_no_file_executes_code(tmp_path: Path, name: str) -> None:
    write, read = FILES[name]
    made = tmp_path / "made"
    write(tmp_path / name, Hostile(made))
    with pytest.raises(CpunetError, match=r"^[^\n]+$"):
        read(tmp_path / name)
    assert not made.exists()
