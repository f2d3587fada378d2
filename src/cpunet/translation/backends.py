"""Backends of a translator: a network, a readout chain, or its inverse."""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
import numpy.typing as npt

from cpunet.electronics.baseline_noise import BaselineNoise
from cpunet.electronics.drawn_pile_up import DrawnTails, InTracePileUp
from cpunet.electronics.finishing import finish, padding, with_room
from cpunet.networks import require_torch
from cpunet.networks.by_height import ByHeight
from cpunet.networks.generators import (
    KeptNoise,
    LinearInverse,
    Residual,
    ResponseGenerator,
)
from cpunet.pulses.container import FloatArray, Pulses
from cpunet.pulses.preparation import Codes, Prepared, prepare
from cpunet.recipes.schema import PreparationConfig, PunetConfig
from cpunet.training.run import Run

if TYPE_CHECKING:
    from cpunet.training.adversarial import Generator

Energies = npt.NDArray[np.float64]
Inverse = LinearInverse | Residual  # arrays of windows → pulses
NOISE = "noise"  # stored with the weights of a CycleGAN, for its translations


@dataclass(frozen=True, eq=False)
class Drawn:
    """What is added to a batch of pulses, and what must be known of them.

    Parameters
    ----------
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
    """

    energy_kev: Energies | None = None
    noise: bool = True
    generator: np.random.Generator = field(default_factory=np.random.default_rng)
    tails_kev: Energies | None = None
    piled: InTracePileUp | None = None

    @property
    def others(self) -> bool:
        """Whether there are other pulses under these."""
        return self.tails_kev is not None or self.piled is not None

    def of_rows(self, rows: npt.NDArray[np.integer]) -> Drawn:
        """The same for some of the pulses."""
        return replace(
            self,
            energy_kev=None if self.energy_kev is None else self.energy_kev[rows],
            tails_kev=None if self.tails_kev is None else self.tails_kev[rows],
            piled=None if self.piled is None else self.piled.of_rows(rows),
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
    charge
        Of a window of height 1; of a readout chain only.
    """

    windows: FloatArray
    codes: Codes
    begin: npt.NDArray[np.int64]
    charge: FloatArray | None = None


class Backend(ABC):
    """Translates a batch of prepared windows.

    Attributes
    ----------
    network
        What the run stores.
    config : PreparationConfig
        Preparation of the pulses that it gives.
    dt_ns : float
        Their sampling period in ns.
    needs_energies : bool
        Whether the noise depends on the energies.
    chain : ResponseGenerator or None
        Readout chain, which gives traces of any length (`levels`).
    noise : BaselineNoise or None
        Noise that is added to the output of the network.
    tails : DrawnTails or None
        Distribution of the pile-up tails under the data, if known.
    by_height : ByHeight or None
        What the electronics do by the height of a pulse, if anything.
    """

    network: Generator | ResponseGenerator | Inverse
    config: PreparationConfig
    dt_ns: float
    needs_energies: bool = False
    chain: ResponseGenerator | None = None
    noise: BaselineNoise | None = None
    tails: DrawnTails | None = None
    by_height: ByHeight | None = None

    @abstractmethod
    def __call__(self, windows: FloatArray, drawn: Drawn) -> Translated:
        """Translate a batch of windows."""

    def levels(self, windows: FloatArray, n_pre: int, length: int) -> Translated:
        """Noise-free traces of any length, aligned at sample `n_pre`; of a chain only."""
        raise NotImplementedError

    def finished(self, windows: FloatArray, records: FloatArray, drawn: Drawn) -> Translated:
        """Records with noise in proportion to 1/energy and other pulses, prepared like data.

        `windows` are those of which `shapes` makes the other pulses.
        """
        energy_kev, piled, added = drawn.energy_kev, drawn.piled, None
        if drawn.others and energy_kev is not None:
            added = np.zeros(records.shape)
            if drawn.tails_kev is not None and self.tails is not None:
                left = drawn.tails_kev * self.tails.height / energy_kev
                added += left[:, np.newaxis] * self.tails.decay(records.shape[1])
            if piled is not None and len(piled.row):
                # with shapes of the same batch; early ones need longer records
                shapes = self.shapes(windows[piled.partner], piled.reach(self.dt_ns))
                added += piled.added(shapes, energy_kev, self.dt_ns, records.shape[1])
        done = finish(
            records,
            self.config,
            dt_ns=self.dt_ns,
            noise=self.noise if drawn.noise else None,
            energy_kev=energy_kev,
            seed=drawn.generator,
            added=added,
            by_height=self.by_height,
        )
        return Translated(done.windows, done.codes, done.begin - padding(self.dt_ns)[0])

    def shapes(self, windows: FloatArray, reach: int) -> npt.NDArray[np.floating]:
        """Records in prepared units, longer by `reach`, for piled-up pulses."""
        raise NotImplementedError


class NetworkBackend(Backend):
    """A network that maps windows to windows.

    Parameters
    ----------
    network
        Network; its noise is the latent noise unless `kept` is given.
    config
        The preparation of the data, which noisy pulses go through again.
    kept
        Noise of the data's baselines, which is added to the output of the network.
    tails
        Distribution of the pile-up tails under the data, if known.
    """

    network: Generator

    def __init__(
        self,
        network: Generator,
        config: PreparationConfig,
        kept: KeptNoise | None = None,
        tails: DrawnTails | None = None,
    ) -> None:
        self.network, self.config, self.dt_ns = network.eval(), config, config.sampled_ns
        if kept is not None:
            self.noise, self.tails, self.needs_energies = kept.noise, tails, True

    def __call__(self, windows: FloatArray, drawn: Drawn) -> Translated:
        """Run the network; add noise in proportion to 1/energy, and prepare like data."""
        import torch

        device = next(self.network.parameters()).device
        generator = torch.Generator(device).manual_seed(int(drawn.generator.integers(2**62)))
        with torch.inference_mode():
            batch = torch.from_numpy(windows).to(device)
            if self.network.linear is None:
                out = self.network.unet(
                    batch[:, None], generator=generator, mean=not drawn.noise
                )[:, 0]
            else:
                out = self.network(batch)
        clean: FloatArray = out.cpu().numpy()
        if (n := windows.shape[1]) < clean.shape[1]:  # records
            first = padding(self.dt_ns)[0]
            return self.finished(clean[:, first : first + n], clean, drawn)
        if self.noise is None or not drawn.noise:
            n = len(windows)
            return Translated(clean, np.zeros(n, np.uint8), np.zeros(n, np.int64))
        return self.finished(clean, with_room(clean, self.config, self.dt_ns), drawn)

    def shapes(self, windows: FloatArray, reach: int) -> npt.NDArray[np.floating]:
        return with_room(windows, self.config, self.dt_ns, reach)


class ResponseBackend(Backend):
    """A readout chain with electronic noise and the preparation of measured traces."""

    needs_energies = True
    network: ResponseGenerator
    chain: ResponseGenerator

    def __init__(self, generator: ResponseGenerator, config: PreparationConfig) -> None:
        self.network = self.chain = generator
        self.noise, self.tails = generator.noise, generator.tails
        self.config, self.dt_ns = config, float(generator.response.dt_ns)
        self.by_height = generator.response.by_height

    def __call__(self, windows: FloatArray, drawn: Drawn) -> Translated:
        """Apply the chain, add noise proportional to 1/energy, and prepare like data."""
        return self.finished(windows, self.network(windows), drawn)

    def levels(self, windows: FloatArray, n_pre: int, length: int) -> Translated:
        """Noise-free traces of prepared simulated windows, aligned at sample `n_pre`."""
        before = max(0, n_pre - self.config.samples_before)
        after = max(0, length - n_pre - self.config.samples_after)
        # before the window no charge has moved, after it all charge has been collected
        long = np.pad(windows, ((0, 0), (before, after)), mode="edge")
        records, clean = self._clean(long)
        source = clean.align_sample[:, np.newaxis] - n_pre + np.arange(length)
        source = source.clip(0, records.shape[1] - 1)
        level = np.take_along_axis(records[clean.index], source, axis=1)
        levels = np.full((len(windows), length), np.nan, np.float32)
        height = clean.scale[:, np.newaxis]
        levels[clean.index] = (level - clean.baseline[:, np.newaxis]) / height
        begin = np.zeros(len(windows), np.int64)
        begin[clean.index] = clean.align_sample - n_pre - before - padding(self.dt_ns)[0]
        charge = np.ones(len(windows), np.float32)
        charge[clean.index] = clean.scale
        return Translated(levels, clean.codes, begin, charge)

    def _clean(self, windows: FloatArray) -> tuple[FloatArray, Prepared]:
        """Records without noise, and the same prepared; flat tops do not count as saturated."""
        records = self.network(windows)
        config = self.config.model_copy(update={"saturation_run": records.shape[1] + 1})
        pulses = Pulses.of(records, dt_ns=self.dt_ns)
        return records, prepare(pulses, config, "measured")

    def shapes(self, windows: FloatArray, reach: int) -> npt.NDArray[np.floating]:
        records, clean = self._clean(np.pad(windows, ((0, 0), (0, reach)), mode="edge"))
        scale = np.full(len(records), np.median(clean.scale))
        scale[clean.index] = clean.scale
        return records / scale[:, np.newaxis]


class InverseBackend(Backend):
    """An inverse, followed by the preparation of simulated pulses."""

    network: Inverse

    def __init__(self, inverse: Inverse, config: PreparationConfig, dt_ns: float) -> None:
        self.network = inverse
        self.config = config
        self.dt_ns = dt_ns

    def __call__(self, windows: FloatArray, drawn: Drawn) -> Translated:
        """Invert the response and suppress the noise; deterministic."""
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
    recipe, forward = run.recipe, part == "ren"
    generator, preparation = recipe.generator, recipe.preparation
    if isinstance(generator, PunetConfig):
        require_torch()
        from cpunet.training.network_runs import applied, fill_generator, generators

        made = generators(recipe)
        if generator.linear == "learned":  # the inverse is that of the response
            fill_generator(run, "ren", made["ren"], device)
        network = fill_generator(run, part, made[part], device)
        if not forward and generator.linear == "learned":
            return InverseBackend(applied(network), preparation, run.dt_ns)
        if not forward or recipe.cyclegan.training.noise == "none":
            return NetworkBackend(network, preparation)
        kept = run.fill(NOISE, KeptNoise(run.dt_ns))
        return NetworkBackend(network, preparation, kept, run.tails)
    if forward:
        response = run.fill(part, ResponseGenerator(generator, run.dt_ns))
        response.tails, response.residual = run.tails, _residual(run, part, device)
        return ResponseBackend(response, preparation)
    inverse = run.fill(part, LinearInverse(preparation.length, recipe.matching.training))
    inverse.residual = _residual(run, part, device)
    return InverseBackend(inverse, preparation, run.dt_ns)


def _residual(run: Run, part: str, device: str) -> Residual | None:
    """What a network adds to the pulses of a part, if there is one."""
    name = f"{part}_residual"
    if not any(key.startswith(f"{name}.") for key in run.weights):
        return None
    require_torch()
    from cpunet.training import adversarial, network_runs

    network = adversarial.Residual(run.recipe.cyclegan.generator, run.dt_ns)
    return network_runs.applied(run.fill(name, network, device))
