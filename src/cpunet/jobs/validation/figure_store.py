"""Store the numbers behind figures in a file, to redraw figures without scoring again."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from cpunet.errors import CpunetError
from cpunet.jobs.common.inputs import InputFile
from cpunet.jobs.translation.translation_record import run_print, source_print
from cpunet.jobs.validation.drawings import KINDS, Drawing
from cpunet.jobs.validation.evaluation import ValidateOptions
from cpunet.pulses.reading.arrays import read_arrays

STORE = "figures.npz"
_INDEX = "index"
_ARRAY = "array"  # in the index: placeholder for an array of the file

Made = dict[str, Any]


def made_of(run: Path, sim: InputFile, data: InputFile, how: ValidateOptions) -> Made:
    """Inputs of the figures, for `write_drawings`."""
    return {
        "run": run_print(run),
        "sim": source_print(sim),
        "data": source_print(data),
        "truth": None if how.truth is None else source_print(InputFile(how.truth)),
        "rivals": how.baselines,
        "seed": how.seed,
        "most": how.most,
        "ae_range_kev": None if how.ae_range_kev is None else list(how.ae_range_kev),
    }


def write_drawings(file: Path, drawings: Mapping[str, Drawing], made: Made) -> None:
    """Store figures by name, with their inputs."""
    arrays: dict[str, npt.NDArray[Any]] = {}
    content = {
        name: {"kind": drawing.kind, "values": _told(drawing.values, arrays)}
        for name, drawing in drawings.items()
    }
    text = json.dumps({"made": made, "figures": content})
    with file.open("wb") as stream:
        np.savez_compressed(stream, allow_pickle=False, **{_INDEX: np.array(text)}, **arrays)


def read_drawings(file: Path) -> tuple[dict[str, Drawing], Made]:
    """Read stored figures by name, and their inputs.

    Raises
    ------
    CpunetError
        If the file cannot be read.
    """
    try:
        arrays = read_arrays(file)
        index = json.loads(str(arrays[_INDEX]))
        drawings = {
            name: Drawing(one["kind"], _found(one["values"], arrays))
            for name, one in index["figures"].items()
        }
        made = index["made"]
        if unknown := {one.kind for one in drawings.values()} - KINDS:
            raise ValueError(f"no figures of kind {min(unknown)}")
        if not isinstance(made, dict):
            raise ValueError("the inputs of the figures are missing")
    except (CpunetError, ValueError, LookupError, TypeError, AttributeError) as error:
        raise CpunetError(
            f"{file}: cannot be read ({error}); remove it, and score the run again"
        ) from error
    return drawings, made


def _told(value: Any, arrays: dict[str, npt.NDArray[Any]]) -> Any:
    """JSON-ready form of a value; its arrays are moved to `arrays`."""
    if isinstance(value, Mapping):
        return {str(key): _told(part, arrays) for key, part in value.items()}
    if isinstance(value, list | tuple):
        return [_told(part, arrays) for part in value]
    if isinstance(value, np.ndarray):
        name = f"{_ARRAY}{len(arrays)}"
        arrays[name] = value
        return {_ARRAY: name}
    return value.item() if isinstance(value, np.generic) else value


def _found(value: Any, arrays: Mapping[str, Any]) -> Any:
    if isinstance(value, dict):
        if set(value) == {_ARRAY}:
            return arrays[value[_ARRAY]]
        return {key: _found(part, arrays) for key, part in value.items()}
    return [_found(part, arrays) for part in value] if isinstance(value, list) else value
