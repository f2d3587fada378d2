"""Backends of a translator: a network, a readout chain, or its inverse."""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
import numpy.typing as npt

from cpunet.electronics.baseline_noise import BaselineNoise
from cpunet.electronics.drawn_pile_up import DrawnTails, InTracePileUp
from cpunet.electronics.finishing import extended, finish, padding, with_room
from cpunet.networks import require_torch
from cpunet.networks.by_height import ByHeight
from cpunet.networks.generators import KeptNoise, LinearInverse, Residual, ResponseGenerator
from cpunet.pulses.container import FloatArray, Pulses
from cpunet.pulses.preparation import Codes, Prepared, prepare
from cpunet.recipes.schema import PreparationConfig, PunetConfig
from cpunet.training.run import Run

if TYPE_CHECKING:
    from cpunet.training.adversarial import Generator

Energies = npt.NDArray[np.float64]
Floats = npt.NDArray[np.floating]
Inverse = LinearInverse | Residual  # arrays of windows → pulses
NOISE = "noise"  # stored with the weights of a CycleGAN, for its translations


@dataclass(frozen=True, eq=False)
class Batch:
    """Prepared windows, and what is added to them.

    Parameters
    ----------
    windows
        Float32, shape (n, samples).
    energy_kev
        Energy of each pulse; electronic noise is scaled by its inverse.
    noise
        Whether to add noise.
    generator
        Random generator of the noise.
    tails_kev
        Pile-up tails under each pulse, in keV.
    piled
        Piled-up pulses within the records.
    trace
        Samples of a raw trace before the alignment of a pulse without noise, and all; None for
        windows.  A network knows its windows alone: beyond them traces are the baseline, and
        the decay fitted to their end, both without noise.
    """

    windows: FloatArray
    energy_kev: Energies | None = None
    noise: bool = True
    generator: np.random.Generator = field(default_factory=np.random.default_rng)
    tails_kev: Energies | None = None
    piled: InTracePileUp | None = None
    trace: tuple[int, int] | None = None

    def of_rows(self, rows: npt.NDArray[np.integer]) -> Batch:
        """The same for some of the pulses."""
        piled = None if self.piled is None else self.piled.of_rows(rows)
        return replace(
            self,
            windows=self.windows[rows],
            energy_kev=None if self.energy_kev is None else self.energy_kev[rows],
            tails_kev=None if self.tails_kev is None else self.tails_kev[rows],
            piled=piled if piled is not None and len(piled.row) else None,
        )


class Translated(NamedTuple):
    """A translated batch.

    Parameters
    ----------
    windows
        Float32, shape (n, samples); NaN for rejected rows.
    codes
        A `Rejection` for each row.
    begin
        First sample of each, in samples after the first one of what was translated.
    """

    windows: FloatArray
    codes: Codes
    begin: npt.NDArray[np.int64]


@dataclass(eq=False)
class Backend(ABC):
    """Translates a batch of prepared windows.

    Parameters
    ----------
    network
        What the run stores.
    config, dt_ns
        Preparation of the pulses that it gives, and their sampling period in ns.
    noise
        Noise that is added in proportion to 1/energy, if any.
    tails
        Distribution of the pile-up tails under the data, if it was measured.
    by_height
        What the electronics do by the height of a pulse, if anything.
    """

    network: Generator | ResponseGenerator | Inverse
    config: PreparationConfig
    dt_ns: float
    noise: BaselineNoise | None = None
    tails: DrawnTails | None = None
    by_height: ByHeight | None = None

    @abstractmethod
    def translate(self, batch: Batch) -> Translated:
        """Translate a batch of windows."""

    def finished(
        self, records: FloatArray, batch: Batch, shapes: Floats | None = None
    ) -> Translated:
        """Records with noise in proportion to 1/energy and other pulses, prepared like data.

        `shapes` are records of the piled-up pulses, see `InTracePileUp.added`.
        """
        energy_kev, added = batch.energy_kev, None
        if energy_kev is not None and batch.tails_kev is not None and self.tails is not None:
            left = batch.tails_kev * self.tails.height / energy_kev
            added = left[:, np.newaxis] * self.tails.decay(records.shape[1])
        if energy_kev is not None and batch.piled is not None and shapes is not None:
            piled = batch.piled.added(shapes, energy_kev, self.dt_ns, records.shape[1])
            added = piled if added is None else added + piled
        done = finish(
            records,
            self.config,
            dt_ns=self.dt_ns,
            noise=self.noise if batch.noise else None,
            energy_kev=energy_kev,
            seed=batch.generator,
            added=added,
            by_height=self.by_height,
        )
        return Translated(done.windows, done.codes, done.begin - padding(self.dt_ns)[0])


class NetworkBackend(Backend):
    """A network that maps windows to windows, with latent noise or that of the baselines."""

    network: Generator

    def translate(self, batch: Batch) -> Translated:
        """Run the network; add noise in proportion to 1/energy, and prepare like data."""
        import torch

        device, (n, length) = next(self.network.parameters()).device, batch.windows.shape
        generator = torch.Generator(device).manual_seed(int(batch.generator.integers(2**62)))
        with torch.inference_mode():
            given = torch.from_numpy(batch.windows).to(device)
            if self.network.linear is None:
                mean = not batch.noise
                out = self.network.unet(given[:, None], generator=generator, mean=mean)[:, 0]
            else:
                out = self.network(given)
        clean: FloatArray = out.cpu().numpy()
        records = shapes = None
        if length < clean.shape[1]:
            records, first = clean, padding(self.dt_ns)[0]
            clean = records[:, first : first + length]
        elif self.noise is not None and batch.noise:
            records = with_room(clean, self.config, self.dt_ns)
        if (piled := batch.piled) is not None:
            others, reach = clean[piled.partner], piled.reach(self.dt_ns)
            shapes = with_room(others, self.config, self.dt_ns, reach)
        done = Translated(clean, np.zeros(n, np.uint8), np.zeros(n, np.int64))
        if records is not None:
            done = self.finished(records, batch, shapes)
        if batch.trace is None:
            return done
        n_pre, length = batch.trace
        traces = extended(done.windows, self.config, self.dt_ns, length, n_pre)
        return Translated(traces, done.codes, done.begin - n_pre + self.config.samples_before)


class ResponseBackend(Backend):
    """A readout chain with electronic noise and the preparation of measured traces."""

    network: ResponseGenerator

    def translate(self, batch: Batch) -> Translated:
        """Apply the chain, add noise proportional to 1/energy, and prepare like data."""
        windows, energies, piled = batch.windows, batch.energy_kev, batch.piled
        # early piled-up pulses need longer records
        reach = 0 if piled is None else piled.reach(self.dt_ns)
        if batch.trace is None:
            shapes: Floats | None = None
            if piled is not None:
                others = np.pad(windows[piled.partner], ((0, 0), (0, reach)), mode="edge")
                records, clean = self._clean(others)
                scale = np.full(len(records), np.median(clean.scale))
                scale[clean.index] = clean.scale
                shapes = records / scale[:, np.newaxis]
            return self.finished(self.network(windows), batch, shapes)

        n_pre, length = batch.trace
        assert energies is not None  # those of the pulses
        levels, clean, first = self._levels(windows, n_pre, length)
        noise = np.zeros_like(levels)
        if batch.noise and self.noise is not None:
            noise += self.noise.draw(energies, length, batch.generator)
        if piled is not None:
            others = self._levels(windows[piled.partner], n_pre, length + reach)[0]
            levels += piled.added(np.nan_to_num(others), energies, self.dt_ns, length)
        if self.by_height is None:
            levels += noise
        else:
            charge = np.ones((len(windows), 1), np.float32)
            charge[clean.index] = clean.scale[:, np.newaxis]
            levels = self.by_height(levels * charge, energies, noise * charge) / charge
        begin = np.zeros(len(windows), np.int64)
        begin[clean.index] = clean.align_sample - first
        return Translated(levels, clean.codes, begin)

    def _levels(
        self, windows: FloatArray, n_pre: int, length: int
    ) -> tuple[FloatArray, Prepared, int]:
        """Noise-free traces, aligned at sample `n_pre`, how, and where the windows begin."""
        before = max(0, n_pre - self.config.samples_before)
        after = max(0, length - n_pre - self.config.samples_after)
        # before the window no charge has moved, after it all charge has been collected
        records, clean = self._clean(np.pad(windows, ((0, 0), (before, after)), mode="edge"))
        source = clean.align_sample[:, np.newaxis] - n_pre + np.arange(length)
        source = source.clip(0, records.shape[1] - 1)
        level = np.take_along_axis(records[clean.index], source, axis=1)
        levels = np.full((len(windows), length), np.nan, np.float32)
        baseline, scale = clean.baseline[:, np.newaxis], clean.scale[:, np.newaxis]
        levels[clean.index] = (level - baseline) / scale
        return levels, clean, n_pre + before + padding(self.dt_ns)[0]

    def _clean(self, windows: FloatArray) -> tuple[FloatArray, Prepared]:
        """Records without noise, and the same prepared; flat tops do not count as saturated."""
        records = self.network(windows)
        config = self.config.model_copy(update={"saturation_run": records.shape[1] + 1})
        return records, prepare(Pulses.of(records, dt_ns=self.dt_ns), config, "measured")


class InverseBackend(Backend):
    """An inverse, followed by the preparation of simulated pulses."""

    network: Inverse

    def translate(self, batch: Batch) -> Translated:
        """Invert the response and suppress the noise; deterministic."""
        windows = batch.windows
        pulses = np.asarray(self.network(windows), np.float32)
        prepared = prepare(Pulses.of(pulses, dt_ns=self.dt_ns), self.config, "simulated")
        result, begin = np.full_like(windows, np.nan), np.zeros(len(windows), np.int64)
        result[prepared.index] = prepared.pulses.waveforms
        begin[prepared.index] = prepared.align_sample - self.config.samples_before
        return Translated(result, prepared.codes, begin)


def backend_of(run: Run, part: str, device: str) -> Backend:
    """The backend of a part of a run, ``"ren"`` or ``"iren"``.

    Raises
    ------
    CpunetError
        If the weights of the run do not match its recipe.
    """
    recipe, forward, dt_ns = run.recipe, part == "ren", run.dt_ns
    generator, config = recipe.generator, recipe.preparation
    if isinstance(generator, PunetConfig):
        require_torch()
        from cpunet.training.network_runs import applied, fill_generator, generators

        parts = generators(recipe)
        if generator.linear == "learned":  # the inverse is that of the response
            fill_generator(run, "ren", parts["ren"], device)
        network = fill_generator(run, part, parts[part], device).eval()
        if not forward and generator.linear == "learned":
            return InverseBackend(applied(network), config, dt_ns)
        if not forward or recipe.cyclegan.training.noise == "none":
            return NetworkBackend(network, config, config.sampled_ns)
        noise = run.fill(NOISE, KeptNoise(dt_ns)).noise
        return NetworkBackend(network, config, config.sampled_ns, noise, run.tails)
    residual, name = None, f"{part}_residual"  # what a network adds to the pulses
    if any(key.startswith(f"{name}.") for key in run.weights):
        require_torch()
        from cpunet.training import adversarial, network_runs

        added = adversarial.Residual(recipe.cyclegan.generator, dt_ns)
        residual = network_runs.applied(run.fill(name, added, device))
    if not forward:
        inverse = run.fill(part, LinearInverse(config.length, recipe.matching.training))
        inverse.residual = residual
        return InverseBackend(inverse, config, dt_ns)
    chain = run.fill(part, ResponseGenerator(generator, dt_ns))
    chain.residual = residual
    by_height = chain.response.by_height
    return ResponseBackend(chain, config, dt_ns, chain.noise, run.tails, by_height)
