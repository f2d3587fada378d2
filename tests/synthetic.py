"""Pulses of known shape, files of them, and listeners, that several test modules share.

Times are in samples, lengths too, if nothing else is said.
"""

from __future__ import annotations

import hashlib
import io
import os
import re
import resource
import signal
import subprocess
import sys
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import lh5
import numpy as np
import numpy.typing as npt
import pytest
import scipy.signal
from lgdo import LGDO, Array, ArrayOfEqualSizedArrays, Table, WaveformTable
from matplotlib.figure import Figure
from scipy.special import ndtr

from cpunet import recipes
from cpunet.cli import main
from cpunet.electronics.baseline_noise import BaselineNoise, record_samples
from cpunet.electronics.drawn_pile_up import TailsLaw, energies_at
from cpunet.electronics.finishing import finish, padding
from cpunet.errors import CpunetError
from cpunet.networks import Stored
from cpunet.networks.generators import ResponseGenerator
from cpunet.pulses.container import FloatArray, Pulses
from cpunet.pulses.loading import InputSet
from cpunet.pulses.preparation import Kind, Prepared, prepare
from cpunet.pulses.reading.files import PulseFile
from cpunet.pulses.writing import Columns, PulseWriter
from cpunet.recipes.schema import PreparationConfig, Recipe
from cpunet.training.adversarial import Game
from cpunet.training.run import Run
from cpunet.validation.methods import pair_squares, scores_of_squares, true_responses
from cpunet.validation.metrics import Metrics, PairedScores
from cpunet.validation.report import Report

Values = npt.NDArray[np.float64]
DT_NS = 16.0
LENGTH, START, STOP = 1200, 500, 725  # of a trace, and of the charge within it
KEV = (2614.511, 2103.511, 1592.511)


def load_recipe(recipe: str, settings: Any = ()) -> Recipe:
    """A recipe for pulses with the period of these."""
    return recipes.load_recipe(recipe, settings).at(DT_NS)


PREPARATION = load_recipe("fast").preparation
PADDING_BEFORE, PADDING_AFTER = padding(DT_NS)
NOISE_SAMPLES = record_samples(DT_NS)
NOISE_BINS = NOISE_SAMPLES // 2 + 1
# of a run that was not trained
FACTS = {"peak": "FEP", "seed": 0, "dt_ns": DT_NS, "seconds": 1.0, "device": "cpu"}
LOSS_NAMES = (
    "identity_data",
    "identity_sim",
    "cycle_forward",
    "cycle_backward",
    "adversarial_ren",
    "adversarial_iren",
    "discriminator_data",
    "discriminator_sim",
)


def of_parts(text: str) -> tuple[str, ...]:
    """Settings of a recipe: lines of a part's name and its settings."""
    lines = [line.split() for line in text.strip().splitlines()]
    return tuple(f"{part}.{setting}" for part, *settings in lines for setting in settings)


# settings of the narrowest networks
SMALL_NETWORK = of_parts("""
generator width=2 dropout=0
discriminator embedding_dim=2 hidden=2
training batch_size=4 statistics_batches=1 discriminator_interval=1
""")


def write_pulses(
    path: str | Path,
    blocks: Pulses | Iterable[Pulses],
    *,
    columns: Columns | None = None,
    **options: Any,
) -> int:
    """Write pulses, at once or in blocks, with columns of all blocks together; their number."""
    extra = {name: (np.asarray(v), units) for name, (v, units) in (columns or {}).items()}
    with PulseWriter(path, **options) as writer:
        for block in [blocks] if isinstance(blocks, Pulses) else blocks:
            rows = slice(writer.n_pulses, writer.n_pulses + len(block))
            writer.append(block, {name: (v[rows], u) for name, (v, u) in extra.items()})
    return writer.n_pulses


def edges(
    n: int,
    seed: int | np.random.Generator,
    widths: tuple[float, float] = (1.5, 5.0),
    at: float = 60,
    length: int = STOP - START,
) -> Values:
    """Charge of logistic edges of random width, shape (n, length)."""
    width = np.random.default_rng(seed).uniform(*widths, (n, 1))
    return np.asarray(1 / (1 + np.exp(-(np.arange(length) - at) / width)))


def gaussian_edge(time: Values, sigma: npt.ArrayLike) -> Values:
    """A Gaussian edge at 0, as after bandwidth poles; exactly 0.5 at time 0."""
    return np.asarray(ndtr(time / sigma))


def phased_edges(n: int, rng: np.random.Generator, at: float, length: int) -> Values:
    """Logistic edges of random width at any phase of the clock."""
    width = rng.uniform(1.0, 6.0, (n, 1))
    late = (np.arange(length) - at - rng.uniform(0, 1, (n, 1))) / width
    return np.asarray(1 / (1 + np.exp(-np.clip(late, -50, 50))))


def decay(at: float, tau: float, length: int) -> Values:
    """1 before `at`, and an exponential decay from there on."""
    return np.exp(-np.clip(np.arange(length) - at, 0, None) / tau)


def after_pole(pulses: Values, tau: float, kept: int) -> Values:
    """The pulses behind a low pass whose response to an impulse has `kept` samples."""
    kernel = np.exp(-np.arange(kept) / tau)
    smooth = np.apply_along_axis(np.convolve, 1, pulses, kernel / kernel.sum())
    return np.asarray(smooth[:, : pulses.shape[1]])


def two_sites(
    rng: np.random.Generator,
    n: int,
    site: Callable[[], Values],
    single: float = 0.5,
    least: float = 0.1,
) -> Values:
    """Charge of two sites in random shares, or in part of the pulses of a single one."""
    alone = rng.random((n, 1)) < single if single else False
    share = np.where(alone, 1.0, rng.uniform(least, 1 - least, (n, 1)))
    return np.asarray(share * site() + (1 - share) * site())


def drifting(since: Values, drift: Values, steep: Values | float, slow: float = 0.3) -> Values:
    """Charge of a site: the `slow` share during its drift, the rest at its steep end."""
    end = np.clip((since - drift) / steep + 1, 0, 1)
    return np.asarray(slow * np.clip(since / drift, 0, 1) ** 2 + (1 - slow) * end)


def sampled(fine: Values, steps: int) -> Values:
    """Means over the sampling period."""
    return np.asarray(fine.reshape(*fine.shape[:-1], -1, steps).mean(axis=-1))


def after_pole_and_decay(
    fine: Values, step_ns: float, pole_ns: float, decay_ns: float, *, middle: bool = False
) -> Values:
    """Finely sampled pulses behind a pole and a decay, by recursion.

    Values are those at the ends of the steps, or in the middle, halfway back to those before.
    """
    rise, fall = np.exp(-step_ns / np.array([pole_ns, decay_ns]))
    taken = [(1 - rise) / 2] * 2 if middle else [1 - rise]
    smooth = scipy.signal.lfilter(taken, [1, -rise], fine)
    return np.asarray(scipy.signal.lfilter([1, -1], [1, -fall], smooth))


def in_traces(charge: Values, steps: int = 1) -> Values:
    """Charge within a trace: nothing before it, and all of it after."""
    traces = np.ones((len(charge), LENGTH * steps))
    traces[:, : START * steps] = 0
    traces[:, START * steps : STOP * steps] = charge
    return traces


def decaying_traces(charge: Values, rng: np.random.Generator, noise_adc: float) -> Values:
    """Traces in ADC counts on a baseline, with a decay of 55 µs and white noise."""
    traces = in_traces(charge) * decay(560, 55_000 / DT_NS, LENGTH)
    return 8000 + 20_000 * traces + rng.normal(0, noise_adc, traces.shape)


def small_sides() -> tuple[npt.NDArray[np.float32], npt.NDArray[np.float32]]:
    """Eleven simulated and nine measured pulses of 64 samples."""
    rng, time = np.random.default_rng(1), np.arange(64)
    width = rng.uniform(1, 4, (20, 1))
    pulses = 1 / (1 + np.exp(-(time - 32 + 3 * width) / width))
    data = pulses[11:] * decay(32, 150, 64) + rng.normal(0, 0.003, (9, 64))
    return pulses[:11].astype(np.float32), data.astype(np.float32)


def prepared_of(
    raw: npt.ArrayLike, kind: Kind = "measured", dt_ns: float = DT_NS, **changes: Any
) -> Prepared:
    """Pulses prepared as recipes do, or with changes of that."""
    config = PREPARATION.model_copy(update=changes)
    return prepare(Pulses.of(raw, dt_ns=dt_ns), config, kind)


def prepared_truth(path: Path, sim: InputSet, config: PreparationConfig) -> FloatArray:
    """The noise-free response of each simulated pulse in use, prepared like data."""
    return finish(true_responses(path, sim), config, dt_ns=sim.dt_ns).windows


class Files(NamedTuple):
    """Files of both sides."""

    sim: PulseFile
    data: PulseFile


def write_files(folder: Path, kev: npt.ArrayLike) -> Files:
    """Simulated and measured pulses of these energies; the latter in another order."""
    energies = np.asarray(kev, float)
    rng = np.random.default_rng(5)
    sim = edges(len(energies), rng, (1.5, 4))
    for name, pulses in (("sim", sim), ("data", decaying_traces(sim[::-1], rng, 10))):
        whole = Pulses.of(pulses, dt_ns=DT_NS, energy_kev=energies)
        write_pulses(folder / f"{name}.lh5", whole)
    return Files(PulseFile(folder / "sim.lh5"), PulseFile(folder / "data.lh5"))


def write_line(
    path: Path, seed: int, pole: float | None, dt_ns: float = DT_NS, n: int = 240
) -> PulseFile:
    """Pulses of 2614.5 keV; behind a pole (samples) and a decay, with noise, if measured."""
    rng = np.random.default_rng(seed)
    pulses = phased_edges(n, rng, 450, 1100)
    if pole is not None:
        decayed = after_pole(pulses, pole, 90) * decay(450, 4000, 1100)
        pulses = np.round(1000 + 26000 * decayed + rng.normal(0, 20, decayed.shape))
    kev = np.full(n, 2614.5)
    write_pulses(path, Pulses.of(pulses, dt_ns=dt_ns, energy_kev=kev), table="geds/raw")
    return PulseFile(path)


def write_sides(folder: Path, sim_kev: Values, dead: int | None = None) -> None:
    """Files of both sides, all measured pulses of one energy; a simulated one may be empty."""
    rng, n = np.random.default_rng(1), len(sim_kev)
    sim = phased_edges(n, rng, 550, 1200)
    if dead is not None:
        sim[dead] = 0
    write_pulses(folder / "sim.lh5", Pulses.of(sim, dt_ns=DT_NS, energy_kev=sim_kev))
    decayed = phased_edges(n, rng, 550, 1200) * decay(550, 4000, 1200)
    raw = np.round(1000 + 10 * KEV[0] * decayed + rng.normal(0, 20, decayed.shape))
    pulses = Pulses.of(raw, dt_ns=DT_NS, energy_kev=np.full(n, KEV[0]))
    write_pulses(folder / "raw.lh5", pulses, table="geds/raw", waveform_units="ADC")


@contextmanager
def nearly_full_disk(size: int) -> Iterator[None]:
    """No file may grow beyond `size` bytes: writing fails as on a full disk."""
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, before[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)


def digests(run: Path) -> list[str]:
    """What must not depend on how often, or on how many processes, a training was begun."""
    files = (run / name for name in ("weights.safetensors", "losses.jsonl"))
    return [hashlib.sha256(file.read_bytes()).hexdigest() for file in files]


def one_line(call: Callable[[], object], *parts: str) -> None:
    """That a call is refused in one line, with these parts."""
    with pytest.raises(CpunetError) as error:
        call()
    for part in parts:
        assert part in str(error.value)


def require_drawn(figure: Figure) -> None:
    """That a figure can be drawn, and is not empty."""
    stream = io.BytesIO()
    figure.savefig(stream, format="png", dpi=40)
    assert stream.tell() > 1000


@pytest.fixture
def same_random_numbers() -> Iterator[None]:
    """Torch draws the same in each test, whatever ran before."""
    import torch

    with torch.random.fork_rng():
        torch.manual_seed(0)
        yield


def white_noise(rms_kev: float) -> BaselineNoise:
    """Noise without a colour."""
    density = np.full(NOISE_BINS, rms_kev**2)
    return BaselineNoise(density, NOISE_SAMPLES, DT_NS, 100)


def paired_scores(translated: FloatArray, truth: FloatArray, edge_samples: int) -> PairedScores:
    """Differences from the truth as a validation computes them."""
    return scores_of_squares(pair_squares({"ren": translated}, truth, edge_samples)["ren"])


def write_run(
    folder: Path, parts: Mapping[str, Any], recipe: Recipe, info: dict[str, Any]
) -> None:
    """Write a run of networks as they are; `info` may be the content of a ``run.json``."""
    facts = {key: value for key, value in info.items() if key not in ("recipe", "format")}
    Run.of(parts, recipe, **facts).write(folder)


def write_chain(
    folder: Path,
    *settings: str,
    noise_kev: float = 0.0,
    change: Callable[[ResponseGenerator], object] = lambda _chain: None,
    inverse: Callable[[ResponseGenerator], Stored] | None = None,
    **facts: Any,
) -> Path:
    """Write a run of a readout chain that was not fitted, with white noise, as changed."""
    recipe = load_recipe("fast", settings)
    dt_ns = facts.get("dt_ns", DT_NS)
    chain = ResponseGenerator(recipe.matching.generator, dt_ns)
    if noise_kev:
        chain.set_noise(white_noise(noise_kev))
    change(chain)
    networks = {"ren": chain} | ({} if inverse is None else {"iren": inverse(chain)})
    folder.mkdir(exist_ok=True)
    write_run(folder, networks, recipe, FACTS | facts)
    return folder


def waveform_table(
    values: Any, dt: npt.ArrayLike = DT_NS, units: str = "ns", samples: str | None = None
) -> WaveformTable:
    """Waveforms of LH5, sampled with one period or with that of each."""
    if isinstance(values, np.ndarray):
        attrs = {} if samples is None else {"units": samples}
        values = ArrayOfEqualSizedArrays(nda=values, attrs=attrs)
    period = np.broadcast_to(dt, len(values)).astype(float)
    start = np.zeros(len(values))
    return WaveformTable(t0=start, t0_units="ns", dt=period, dt_units=units, values=values)


def write_table(
    path: str | Path, table: str, waveform: Any = None, kev: Any = None, **columns: Any
) -> Path:
    """Write a table of LH5 by its own library; plain arrays are traces, or have no units."""
    given = {"waveform": waveform, "energy": kev} | columns
    made = {key: values for key, values in given.items() if values is not None}
    if isinstance(waveform, np.ndarray):
        made["waveform"] = waveform_table(waveform)
    for name, values in made.items():
        if not isinstance(values, LGDO):
            attrs = {"units": "keV"} if name == "energy" else {}
            made[name] = Array(np.asarray(values), attrs=attrs)
    *groups, name = table.split("/")
    lh5.write(Table(col_dict=made), name, str(path), group="/".join(groups) or "/")
    return Path(path)


def write_csv(path: Path, columns: list[str], rows: list[str], title: str = "hits") -> Path:
    """Write hits as Geant4's analysis writes them as text."""
    head = f"#class tools::wcsv::ntuple\n#title {title}\n#separator 44\n"
    head += "".join(f"#column double {name}\n" for name in columns)
    path.write_text(head + "\n".join(rows))
    return path


def rows_of(table: str) -> list[str]:
    """Rows of a table in a text; a row goes on in lines that begin with spaces."""
    return re.sub(r"\n +", " ", table).strip().splitlines()


def status_of(*words: object) -> Any:
    """Run the command line in this process; its status."""
    arguments, sys.argv = sys.argv, ["cpunet", *map(str, words)]
    try:
        with pytest.raises(SystemExit) as stop:
            main()
    finally:
        sys.argv = arguments
    return stop.value.code


PROGRAM = """
{before}
import runpy, sys
for words in sys.argv[1:]:
    sys.argv[1:] = words.split()
    try:
        runpy.run_module("cpunet", run_name="__main__")
    except SystemExit as end:
        if end.code:
            raise
{after}
"""


def in_a_process(
    *commands: str, before: str = "", after: str = "", **environment: str
) -> subprocess.CompletedProcess[str]:
    """Run commands in a process of their own, one after the other, between other lines."""
    program = PROGRAM.format(before=before, after=after)
    words = [sys.executable, "-W", "error", "-c", program, *commands]
    how = {"capture_output": True, "errors": "surrogateescape", "env": os.environ | environment}
    return subprocess.run(words, text=True, check=False, **how)


@contextmanager
def interrupted_in(iteration: int) -> Iterator[None]:
    """Ctrl-C in an iteration of a training of networks."""
    step = Game.step

    def interrupted(self: Game) -> dict[str, float]:
        if self.iteration + 1 == iteration:
            signal.raise_signal(signal.SIGINT)
        return step(self)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(Game, "step", interrupted)
        yield


def leave_undrawn(patch: pytest.MonkeyPatch) -> None:
    """Leave the figures of reports empty."""

    write = Report.write

    def write_undrawn(report: Report, folder: Path) -> None:
        write(replace(report, drawn=dict.fromkeys(report.drawn or (), Figure)), folder)

    patch.setattr(Report, "write", write_undrawn)


def write_report(
    folder: Path,
    metrics: dict[str, Any],
    figures: dict[str, Any] | None = None,
    notes: Sequence[str] = (),
) -> None:
    """Write a report of these metrics and figures into a folder."""
    drawn = {name: partial(lambda one: one, one) for name, one in (figures or {}).items()}
    Report(Metrics(**{"peaks": {}} | metrics), {}, None, drawn, notes).write(folder)


def mean_kev(law: TailsLaw) -> float:
    """Mean tail, rate times decay time times mean energy (Campbell's theorem)."""
    energies = energies_at((np.arange(1000) + 0.5) / 1000, law.energies_kev)
    return float(law.rate_khz * 1e-3 * law.decay_us * energies.mean())
