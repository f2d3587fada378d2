"""Libraries in files: several of them, unusual types, and what cannot be translated."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import partial
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
from torch import nn

from cpunet.errors import CpunetError
from cpunet.legend.translate_library import translate_library
from cpunet.networks.response_generator import ResponseGenerator
from cpunet.recipes import load_recipe
from synthetic import write_run

R, Z = np.arange(3.0), np.arange(4.0)


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A readout chain that was not fitted."""
    recipe = load_recipe("fast")
    model = nn.ModuleDict({"ren": ResponseGenerator(recipe.matching.generator, 16.0)})
    info = {"recipe": "fast", "peak": "FEP", "seed": 0, "dt_ns": 16.0}
    folder = tmp_path_factory.mktemp("runs") / "run"
    folder.mkdir()
    write_run(folder, model, recipe, info | {"seconds": 1.0, "device": "cpu"})
    return folder


def charge(n_samples: int, dt_ns: float) -> np.ndarray[Any, Any]:
    """Edges (r, z, samples) at different times."""
    middle = 400 + 40 * np.arange(len(R) * len(Z)).reshape(len(R), len(Z), 1)
    return 1 / (1 + np.exp(-(dt_ns * np.arange(n_samples) - middle) / 40))


def put(path: Path, group: str, dt_ns: float, arrays: Mapping[str, Any], units: Any) -> None:
    with h5py.File(path, "a") as file:
        library = file.require_group(group)
        for name, values in {"r": R, "z": Z, "dt": dt_ns, **arrays}.items():
            library[name] = values
        library["dt"].attrs["units"] = units


def put_charge(path: Path, group: str, n_samples: int, dt_ns: float, units: Any = "ns") -> None:
    put(path, group, dt_ns, {"waveform_000_deg": charge(n_samples, dt_ns)}, units)


def test_libraries_of_different_lengths_and_periods(run: Path, tmp_path: Path) -> None:
    source = tmp_path / "psl.lh5"
    put_charge(source, "V01", 600, 4.0)
    put_charge(source, "V02", 300, 8.0)
    angles = {"waveform_000_deg": charge(400, 4.0), "waveform_045_deg": charge(500, 4.0)}
    put(source, "V03", 4.0, angles, "ns")
    told = translate_library(run, source, tmp_path / "ren.lh5").numbers
    assert told["translated"] == 4 * len(R) * len(Z)
    assert told["linearity"]["largest"] < 1e-5


def test_a_library_within_another_keeps_its_own_period(run: Path, tmp_path: Path) -> None:
    alone, nested = tmp_path / "alone.lh5", tmp_path / "nested.lh5"
    put_charge(alone, "V01", 600, 4.0)
    put_charge(nested, "V01", 600, 4.0)
    put_charge(nested, "V01/coarse", 300, 8.0)
    found = []
    for source in (alone, nested):
        out = tmp_path / f"ren_{source.name}"
        translate_library(run, source, out)
        with h5py.File(out) as file:
            found.append(file["V01/waveform_000_deg"][()])
    np.testing.assert_allclose(found[1], found[0], atol=1e-6)


@pytest.mark.parametrize("currents", [False, True])
def test_units_in_bytes_and_a_period_in_a_column(
    run: Path, tmp_path: Path, currents: bool
) -> None:
    for group, dt_ns, units in (("a", 4.0, np.bytes_(b"ns")), ("b", np.array([4.0]), "ns")):
        put_charge(tmp_path / f"{group}.lh5", group, 600, dt_ns, units)  # type: ignore[arg-type]
        out = tmp_path / f"ren_{group}.lh5"
        translate_library(
            run, tmp_path / f"{group}.lh5", out, format="currents" if currents else "charge"
        )
        with h5py.File(out) as file:
            assert file[f"{group}/t0"][()] == (-1000 if currents else 0)
            assert file[f"{group}/t0"].attrs["units"] == "ns"


def test_currents_of_whole_numbers_are_not_rounded(run: Path, tmp_path: Path) -> None:
    counts = np.round(1000 * charge(600, 4.0)).astype(np.int32)
    put(tmp_path / "psl.lh5", "V01", 4.0, {"waveform_000_deg": counts}, "ns")
    translate_library(run, tmp_path / "psl.lh5", tmp_path / "ren.lh5", format="currents")
    with h5py.File(tmp_path / "ren.lh5") as file:
        values = file["V01/waveform_000_deg"][()]
    # all charge is in the current
    assert 4.0 * values[1, 1].sum() == pytest.approx(1000, rel=0.05)


@pytest.mark.parametrize(
    "translate", [partial(translate_library, format=name) for name in ("simflow", "currents")]
)
def test_currents_of_negative_charge_are_refused(
    run: Path, tmp_path: Path, translate: Callable[[Path, Path, Path], Any]
) -> None:
    """Their maximum is not that of the signal; the charge itself is translated as it is."""
    source = tmp_path / "psl.lh5"
    put(source, "V01", 1.0, {"waveform_000_deg": -charge(2400, 1.0)}, "ns")
    with h5py.File(source, "a") as file:
        for name in ("r", "z"):
            file[f"V01/{name}"].attrs["units"] = "mm"
    with pytest.raises(CpunetError, match="12 of 12 templates end below half"):
        translate(run, source, tmp_path / "ren.lh5")
    assert translate_library(run, source, tmp_path / "ren.lh5").numbers["translated"] == 12


def test_an_empty_axis_is_told_in_one_line(run: Path, tmp_path: Path) -> None:
    source = tmp_path / "psl.lh5"
    with h5py.File(source, "w") as file:
        file["V01/r"], file["V01/z"], file["V01/dt"] = R, np.empty(0), 4.0
        file["V01/dt"].attrs["units"] = "ns"
        file["V01/waveform_000_deg"] = np.empty((len(R), 0, 600))
    with pytest.raises(CpunetError, match="V01: z is no column of numbers"):
        translate_library(run, source, tmp_path / "ren.lh5")
