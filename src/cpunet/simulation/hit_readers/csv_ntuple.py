"""CSV ntuples as Geant4's analysis manager writes them, one step per line."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from cpunet.errors import CpunetError
from cpunet.simulation.hit_readers.columns import (
    ReadColumn,
    detectors_there,
    of_detector,
    steps_of,
)
from cpunet.simulation.hit_readers.steps import Steps, Units

_G4SIMPLE_TITLE = "steps data"


def read_csv(path: Path, detector: str | None, units: Units) -> Steps:
    """Read the steps of a CSV ntuple.

    A column name may end with a unit, in brackets or after ``_in_``. Without it, files of
    g4simple (recognised by their title) are in MeV and mm. For all other files the unit must
    be given. Times are in ns, Geant4's unit, unless their name tells another.
    """
    title, columns = _columns(path)
    if title == _G4SIMPLE_TITLE:
        units = Units(units.length or "mm", units.energy or "MeV")
    return of_detector(path, steps_of(path, columns, units), columns, detector)


def csv_detectors(path: Path) -> list[str]:
    """Detectors with deposits, by their number or name; empty if no column tells them."""
    return detectors_there(_columns(path)[1])


def _columns(path: Path) -> tuple[str, Mapping[str, ReadColumn]]:
    """Title of the file, and its columns."""
    title, names = _header(path)
    with path.open(encoding="utf-8", errors="replace") as lines:
        body = [line.strip() for line in lines if line.strip() and not line.startswith("#")]
    if not body:
        raise CpunetError(f"{path}: holds no steps; simulate again")
    if (n := body[0].count(",") + 1) != len(names):
        raise CpunetError(f"{path}: {n} values a line for {len(names)} columns; export again")
    cells: npt.NDArray[Any]
    try:
        cells = np.loadtxt(body, delimiter=",", ndmin=2)
    except ValueError:  # names of volumes and processes among the numbers
        rows = [line.split(",") for line in body]
        if any(len(row) != len(names) for row in rows):
            raise CpunetError(
                f"{path}: a line is not {len(names)} values; is it cut off?"
            ) from None
        cells = np.array(rows)

    def reader(at: int) -> ReadColumn:
        return lambda: (_numbers(cells[:, at]), "")

    return title, {name: reader(at) for at, name in enumerate(names)}


def _header(path: Path) -> tuple[str, list[str]]:
    title, columns = "", []
    with path.open(encoding="utf-8", errors="replace") as lines:
        for line in lines:
            if not line.startswith("#"):
                break
            key, _, value = line[1:].strip().partition(" ")
            if key == "title":
                title = value
            elif key == "column":
                columns.append(value.partition(" ")[2])
            elif key == "separator" and value != "44":
                raise CpunetError(f"{path}: columns are not separated by commas; export again")
    return title, columns


def _numbers(values: npt.NDArray[Any]) -> npt.NDArray[Any]:
    """Values as numbers, unless one is text."""
    try:
        return values.astype(float)
    except ValueError:
        return values
