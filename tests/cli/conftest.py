"""A small stand with a known answer, written independently of the package, and a run on it."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest

from synthetic import (
    after_pole_and_decay,
    in_traces,
    of_parts,
    status_of,
    waveform_table,
    write_table,
)

DT_NS = 16.0
PEAKS_KEV = {"DEP": 1592.511, "SEP": 2103.511, "FEP": 2614.511}
PER_PEAK = 24

# The narrowest networks and the shortest training there are.
TINY = of_parts("""
generator width=2
discriminator embedding_rows=20 embedding_dim=2 hidden=2 samples_per_step=80
training iterations=4 decay_start=2 batch_size=4 discriminator_interval=1 statistics_batches=2
training log_interval=3
scores bootstraps=20
""")
TINY_OPTIONS = ["--recipe", "published", *(word for value in TINY for word in ("--set", value))]

Waveforms = npt.NDArray[Any]


def charge(n: int, rng: np.random.Generator, length: int = 225) -> npt.NDArray[np.float64]:
    """Charge signals of one to three deposits: slow rise, logistic edge, then exactly 1."""
    time = np.arange(length)
    total = np.zeros((n, length))
    for _ in range(3):
        fraction = rng.uniform(0, 1, (n, 1))
        arrival = rng.uniform(30, 70, (n, 1))
        width = rng.uniform(1.0, 2.5, (n, 1))
        total += fraction / (1 + np.exp(-(time - arrival) / width))
    total -= total[:, :1]
    return total / total[:, -1:]


def respond(pulses: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
    """A record with the charge behind electronics: a bandwidth of 60 ns, a decay of 55 µs."""
    return after_pole_and_decay(in_traces(pulses), DT_NS, 60, 55_000)


def digitised(response: npt.NDArray[np.float64], kev: Waveforms, seed: int) -> Waveforms:
    """ADC counts: gain, baseline and noise of a flash ADC."""
    rng = np.random.default_rng(seed)
    adc = 8000 + 15 * kev[:, None] * response + rng.normal(0, 15, response.shape)
    return np.round(adc).astype(np.uint16)


def energies(rng: np.random.Generator) -> npt.NDArray[np.float64]:
    """Every peak in turn, and each fifth event on the continuum."""
    peaks = np.tile(list(PEAKS_KEV.values()), PER_PEAK) + rng.normal(0, 0.7, 3 * PER_PEAK)
    return np.insert(peaks, np.arange(0, len(peaks), 4), 1000.0)


def write(
    path: Path,
    table: str,
    waveforms: Waveforms,
    kev: npt.ArrayLike,
    *,
    units: str = "ADC",
    dt_ns: float = DT_NS,
) -> Path:
    """An LH5 table as LEGEND's software writes it, not by this package's writer."""
    path.unlink(missing_ok=True)
    traces = waveform_table(waveforms, dt_ns, samples=units)
    numbers = 1000 + 3 * np.arange(len(waveforms))
    return write_table(path, table, traces, np.asarray(kev, float), event_number=numbers)


@pytest.fixture(scope="session")
def tiny() -> list[str]:
    """Options that make a training take a second."""
    return TINY_OPTIONS


@pytest.fixture(scope="session")
def stand(tmp_path_factory: pytest.TempPathFactory) -> SimpleNamespace:
    """Files of the stand, what is in them, and how they are made."""
    folder = tmp_path_factory.mktemp("stand")
    rng = np.random.default_rng(20)
    sim_kev, data_kev = energies(rng), energies(rng)
    pulses, other = charge(len(sim_kev), rng), charge(len(data_kev), rng)
    traces, pulses32 = digitised(respond(other), data_kev, seed=21), pulses.astype(np.float32)
    sim = write(folder / "sim.lh5", "geds/sim", pulses32, sim_kev, units="")
    data = write(folder / "data.lh5", "geds/raw", traces, data_kev)
    np.savez(folder / "truth.npz", response=respond(pulses).astype(np.float32))
    return SimpleNamespace(
        folder=folder,
        sim=sim,
        data=data,
        truth=folder / "truth.npz",
        inputs=["--sim", str(sim), "--data", str(data)],
        sim_waveforms=pulses32,
        sim_kev=sim_kev,
        data_waveforms=traces,
        data_kev=data_kev,
        charge=charge,
        respond=respond,
        digitised=digitised,
        write=write,
    )


@pytest.fixture
def command(capsys: pytest.CaptureFixture[str]) -> Callable[..., SimpleNamespace]:
    """Run the command line in this process; its status and what it printed."""

    def call(*words: object) -> SimpleNamespace:
        capsys.readouterr()
        status, printed = status_of(*words), capsys.readouterr()
        return SimpleNamespace(code=status, out=printed.out, err=printed.err)

    return call


@pytest.fixture(scope="session")
def trained(stand: SimpleNamespace, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run folder made by the command line; do not change it."""
    out = tmp_path_factory.mktemp("trained") / "run"
    assert status_of("train", *stand.inputs, "--out", out, "--seed", 3, *TINY_OPTIONS) == 0
    return out


@pytest.fixture
def run(trained: Path, tmp_path: Path) -> Path:
    """A copy of the run folder that may be changed."""
    return Path(shutil.copytree(trained, tmp_path / "run"))
