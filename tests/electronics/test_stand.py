"""Stands follow from their seed, and pulses of a library are those drifted one by one."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import numpy.typing as npt
import pytest

from cpunet import load
from cpunet.electronics.chain import read_electronics
from cpunet.electronics.stand import make_stand
from cpunet.errors import CpunetError
from cpunet.pulses.loading import load_pulses
from cpunet.pulses.peaks import parse_selection
from cpunet.pulses.reading.files import PulseFile
from cpunet.simulation.geometry_readers import read_detector
from cpunet.simulation.settings import Shift, SimulationSettings
from cpunet.simulation.simulate import StoredSimulation
from cpunet.simulation.simulator import Simulator
from synthetic import load_recipe, prepared_truth

SMALL_CRYSTAL = "crystal_length=14 crystal_radius=10 bottom_taper_length=2 bias_V=600"
DETECTOR = read_detector("ppc", ["name=small", *SMALL_CRYSTAL.split(), "grid_mm=0.25"])
EVENTS = {"FEP": 10, "1000-2000": 30}
SMALL = {"electronics": "ornl", "detector": DETECTOR, "events": EVENTS}
FILES = (".cpunet.json", "data.lh5", "data_labels.npz", "sim.lh5", "stand.json", "truth.npz")

pytestmark = pytest.mark.usefixtures("own_cache")


def made(
    out: Path, seed: int = 0, shift: tuple[str, ...] = (), dt_ns: float = 16
) -> dict[str, npt.NDArray[Any]]:
    """Everything in the files of a stand but where and when it was made."""
    period = {"dt_ns": dt_ns}
    stand = make_stand(out, **SMALL, shift=shift, seed=seed, settings=period)
    assert str(load(out)) == str(stand)
    assert load(out).electronics == read_electronics("ornl", period)
    assert tuple(sorted(path.name for path in out.iterdir())) == FILES
    content: dict[str, npt.NDArray[Any]] = {}
    for name in ("sim.lh5", "data.lh5"):
        with h5py.File(out / name) as file:
            paths: list[str] = []
            file.visit(paths.append)
            sets = {f"{name}/{path}": file[path] for path in paths}
            content |= {k: v[()] for k, v in sets.items() if isinstance(v, h5py.Dataset)}
    for name in ("truth.npz", "data_labels.npz"):
        with np.load(out / name) as arrays:
            content |= {f"{name}/{key}": arrays[key] for key in arrays.files}
    return content


def test_the_same_seed_gives_the_same_stand_and_another_another(tmp_path: Path) -> None:
    shift = ("default",)
    first, again = made(tmp_path / "a", 5, shift), made(tmp_path / "b", 5, shift)
    assert first.keys() == again.keys()
    for name, values in first.items():
        np.testing.assert_array_equal(values, again[name], err_msg=name)
    told = [(tmp_path / name / "stand.json").read_text() for name in "ab"]
    assert told[0] == told[1]
    other = made(tmp_path / "c", 6, shift)
    for name in ("truth.npz/response", "sim.lh5/geds/sim/energy", "data.lh5/geds/raw/energy"):
        assert not np.array_equal(first[name], other[name])
    # both sides are events of their own; the lines are at the same energies on both
    sim, data = first["sim.lh5/geds/sim/energy"], first["data.lh5/geds/raw/energy"]
    nearest = np.abs(sim[:, None] - data).min(axis=1)[(sim > 1000) & (sim < 2000)]
    assert np.median(nearest) > 2


def test_the_folder_is_read_and_prepared(tmp_path: Path) -> None:
    made = tmp_path / "stand"
    coarse = {"electronics": "ornl", "settings": {"grid_mm": 0.5}}
    make_stand(made, **coarse, events="FEP=40,DEP=20", shift=("default",))
    recipe = load_recipe("fast")
    chosen = parse_selection("FEP,DEP", recipe.peaks)
    sim = load_pulses(PulseFile(made / "sim.lh5"), "simulated", recipe, chosen)
    data = load_pulses(PulseFile(made / "data.lh5"), "measured", recipe, chosen)
    assert len(sim.prepared) > 20
    assert len(data.prepared) > 10
    truth = prepared_truth(made / "truth.npz", sim, recipe.preparation)
    assert np.isfinite(truth).all()
    # the mean edge of the truth is that of the data, within what the detector's shift makes
    measured = data.prepared.pulses.waveforms.mean(axis=0)
    assert np.abs(truth.mean(axis=0) - measured).max() < 0.1
    made_by = json.loads((made / "stand.json").read_text())
    assert made_by["data"]["detector"]["temperature_K"] == 92
    flags = np.load(made / "data_labels.npz")
    assert len(flags["label"]) == made_by["counts"]["n_data"]
    assert set(flags["label"]) <= {0, 2, 3}
    left = flags["tails_kev"] > 1
    assert (left == (flags["flag"] & 1 > 0)).mean() > 0.99
    assert 0.1 < left.mean() < 0.6
    assert set(flags) == {"label", "flag", "tails_kev", "n_piled", "piled_kev", "piled_ns"}


def test_a_stand_of_any_period_is_the_same_stand(tmp_path: Path) -> None:
    """Means over 80 ns, a multiple of all periods, do not depend on the period."""

    def means(waveforms: npt.NDArray[Any]) -> npt.NDArray[Any]:
        return waveforms.reshape(len(waveforms), -1, round(80 / dt_ns)).mean(axis=2)

    expected: list[npt.NDArray[Any]] = []
    for dt_ns in (16, 10, 8, 4):
        arrays = made(tmp_path / str(dt_ns), dt_ns=dt_ns)
        for table, lasts_ns in (("sim.lh5/geds/sim", 3600), ("data.lh5/geds/raw", 22_400)):
            assert (arrays[f"{table}/waveform/dt"] == dt_ns).all()
            assert arrays[f"{table}/waveform/values"].shape[1] == lasts_ns / dt_ns
        assert arrays["truth.npz/n_pre"] == 8000 / dt_ns
        these = [
            means(arrays["truth.npz/response"]),
            means(arrays["sim.lh5/geds/sim/waveform/values"]),
            arrays["sim.lh5/geds/sim/energy"],
        ]
        expected = expected or these
        for values, same in zip(these, expected, strict=True):
            np.testing.assert_allclose(values, same, atol=1e-4)


@pytest.mark.parametrize("preset", ["legend200", "mjd"])
def test_pulses_made_again_are_those_stored(tmp_path: Path, preset: str) -> None:
    values = {"self_repulsion": 0.3, "hole_velocity_low_factor": 0.95}
    settings = SimulationSettings(**values)
    electronics = read_electronics(preset)
    small = SMALL | {"electronics": electronics, "settings": values}
    make_stand(tmp_path / "a", **small)
    stored = StoredSimulation.read(tmp_path / "a" / "sim.lh5")
    assert stored.detector == DETECTOR
    assert stored.settings == settings.model_copy(update={"dt_ns": electronics.dt_ns})
    again = Simulator(stored.detector, stored.settings).events(stored.hits).pulses()
    with h5py.File(tmp_path / "a" / "sim.lh5") as file:
        np.testing.assert_array_equal(again.event_number, file["geds/sim/event_number"][()])
        np.testing.assert_allclose(again.energy_kev, file["geds/sim/energy"][()], atol=1e-6)
        values = file["geds/sim/waveform/values"][()]
    # the record ends with whole samples of either period
    kept = values.shape[1] - 1
    np.testing.assert_allclose(again.waveforms[:, :kept], values[:, :kept], atol=1e-6)
    # a file that cannot be made again says why
    damages: dict[str, Callable[[Any], Any]] = {
        "give an output of cpunet": lambda file: file["geds/sim"].attrs.pop("simulation"),
        "give an output of cpunet simulate or": lambda file: file.pop("geds/hits"),
        "other ev": lambda file: file["geds/sim/event_number"].write_direct(
            again.event_number * 0
        ),
        "cannot be used by": lambda file: file["geds/sim"].attrs.update(simulation="{}"),
        "cannot be used by this": lambda file: file["geds/sim"].attrs.update(simulation="{"),
    }
    for said, damage in damages.items():
        path = shutil.copy(tmp_path / "a" / "sim.lh5", tmp_path / "damaged.lh5")
        with h5py.File(path, "r+") as file:
            damage(file)
        with pytest.raises(CpunetError, match=said):
            StoredSimulation.read(path)


def test_any_shift_is_that_of_the_data(tmp_path: Path) -> None:
    shift = Shift(bias_V=20, hole_trapping_per_us=0.5, electron_trapping_per_us=0.5)
    out = tmp_path / "a"
    small = SMALL | {"events": "FEP=20"}
    make_stand(out, **small, shift=shift.model_dump(exclude_unset=True))
    told = json.loads((out / "stand.json").read_text())
    assert Shift.model_validate(told["shift"]) == shift
    assert told["data"]["detector"]["bias_V"] == DETECTOR.bias_V + 20
    assert told["data"]["settings"]["hole_trapping_per_us"] == 0.5
    assert told["sim"]["settings"]["hole_trapping_per_us"] == 0
    assert told["data"]["settings"]["cloud_fwhm_mm"] == 0.1
    # energies are calibrated: their median is the line's, though some of the charge is lost
    with h5py.File(out / "data.lh5") as file:
        energy = file["geds/raw/energy"][()]
    label = np.load(out / "data_labels.npz")["label"]
    assert np.median(energy[label == 2]) == pytest.approx(2614.5, rel=3e-3)
    assert np.ptp(energy[label == 2]) > 10


def test_what_a_stand_cannot_be(tmp_path: Path) -> None:
    for settings, said in (
        ({"dt_ns": 0.05}, "dt_ns: Input should be greater than or equal to 1"),
        ({"dt_ns": 12.5}, "dt_ns must be a multiple of step_ns, 1 ns; add step_ns=0.5$"),
        ({"dt_ns": 3.001}, "multiple of step_ns, 1 ns; choose another$"),
        ({"step_ns": 8}, "step_ns: a stand needs steps of at most 4 ns; lower it$"),
        ({"bias": 3}, "bias: no such setting"),
    ):
        with pytest.raises(CpunetError, match=said):
            make_stand(tmp_path / "a", **SMALL, settings=settings)
    with pytest.raises(CpunetError, match="`events` FEP=0: give at least 1 event"):
        make_stand(tmp_path / "a", events="FEP=0")
    assert list(tmp_path.iterdir()) == []
