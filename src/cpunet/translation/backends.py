"""Backends of a translator: a network, a readout chain, or its inverse."""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt
import torch
from torch import nn

from cpunet.electronics.drawn_remains import DrawnRemains
from cpunet.electronics.extension import PADDING_BEFORE, extended, with_room
from cpunet.electronics.finishing import finish_with_codes
from cpunet.electronics.second_pulses import SecondPulses
from cpunet.errors import CpunetError
from cpunet.networks.kept_noise import KeptNoise
from cpunet.networks.linear_inverse import LinearInverse
from cpunet.networks.positional_unet import PositionalUNet
from cpunet.networks.response_generator import ResponseGenerator
from cpunet.pulses.container import FloatArray, Pulses
from cpunet.pulses.preparation import Codes, prepare
from cpunet.recipes.schema import PreparationConfig

Energies = npt.NDArray[np.float64]
NO_ENERGY = "electronic noise is scaled by 1/energy; give energy_kev, or noise=False"
NO_OTHERS = (
    "other pulses are drawn with the noise, by energies; leave out remains_kev and second"
)


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
    remains_kev
        Remains of earlier pulses under each pulse, in keV.
    second
        Second pulses within the records.
    """

    energy_kev: Energies | None = None
    noise: bool = True
    generator: torch.Generator | None = None
    remains_kev: Energies | None = None
    second: SecondPulses | None = None

    @property
    def others(self) -> bool:
        """Whether there are other pulses under these."""
        return self.remains_kev is not None or self.second is not None

    def of_rows(self, rows: npt.NDArray[np.integer]) -> Drawn:
        """The same for some of the pulses."""
        return replace(
            self,
            energy_kev=None if self.energy_kev is None else self.energy_kev[rows],
            remains_kev=None if self.remains_kev is None else self.remains_kev[rows],
            second=None if self.second is None else self.second.of_rows(rows),
        )

    def device(self, default: torch.device) -> torch.device:
        """Device of the random generator."""
        return default if self.generator is None else self.generator.device

    def seed(self, default: torch.device) -> int:
        """Seed of the electronic noise, from the random generator."""
        device = self.device(default)
        return int(torch.randint(2**62, (), generator=self.generator, device=device))


class Backend(ABC):
    """Translates a batch of prepared windows."""

    network: nn.Module

    @property
    def device(self) -> torch.device:
        """Device of the computation."""
        weights: torch.Tensor = next(iter(self.network.state_dict().values()))
        return weights.device

    @abstractmethod
    def __call__(self, windows: FloatArray, drawn: Drawn) -> tuple[FloatArray, Codes]:
        """Return translated windows (NaN for rejected rows) and a `Rejection` for each row."""


class NetworkBackend(Backend):
    """A network that maps windows to windows; its noise is the latent noise."""

    def __init__(self, network: PositionalUNet) -> None:
        self.network = network.eval()

    def __call__(self, windows: FloatArray, drawn: Drawn) -> tuple[FloatArray, Codes]:
        """Run the network; its output is a prepared window already."""
        if drawn.others:
            raise CpunetError(
                "a network has what it was shown; other pulses belong to readout chains, so "
                "leave out remains_kev and second"
            )
        batch = torch.from_numpy(windows).to(self.device)
        out = self.network(batch[:, None], generator=drawn.generator, mean=not drawn.noise)
        result: FloatArray = out[:, 0].cpu().numpy()
        return result, np.zeros(len(windows), np.uint8)


class NoisyNetworkBackend(NetworkBackend):
    """A network that maps windows to windows, with baseline noise added to its output.

    Parameters
    ----------
    network
        Network whose output has no electronic noise.
    noise
        Noise of the data's baselines.
    config
        The preparation of the data, which noisy pulses go through again.
    remains
        Distribution of the remains of earlier pulses under the data, if known.
    """

    def __init__(
        self,
        network: PositionalUNet,
        noise: KeptNoise,
        config: PreparationConfig,
        remains: DrawnRemains | None = None,
    ) -> None:
        super().__init__(network)
        self.noise, self.config, self.remains = noise, config, remains

    def __call__(self, windows: FloatArray, drawn: Drawn) -> tuple[FloatArray, Codes]:
        """Run the network, add noise in proportion to 1/energy, and prepare like data.

        Raises
        ------
        CpunetError
            If noise is requested and an energy is unknown.
        """
        energy_kev, second = drawn.energy_kev, drawn.second
        if drawn.noise and energy_kev is None:
            raise CpunetError(NO_ENERGY)
        if not drawn.noise and drawn.others:
            raise CpunetError(NO_OTHERS)
        clean, codes = super().__call__(
            windows, Drawn(noise=drawn.noise, generator=drawn.generator)
        )
        if energy_kev is None or not drawn.noise:
            return clean, codes
        seed = drawn.seed(self.device)
        dt_ns = self.noise.noise_dt_ns
        records = with_room(clean, self.config, dt_ns)
        added = None
        if drawn.others:
            added = _left(self.remains, records, energy_kev, drawn.remains_kev)
        if second is not None and added is not None:
            length = records.shape[1] + second.reach(dt_ns)
            before = PADDING_BEFORE + self.config.samples_before
            shapes = extended(clean[second.partner], self.config, dt_ns, length, before)
            added += second.added(shapes, energy_kev, dt_ns, records.shape[1])
        return finish_with_codes(
            records,
            self.config,
            dt_ns=dt_ns,
            noise=self.noise.noise,
            energy_kev=energy_kev,
            seed=seed,
            added=added,
        )


class ResponseBackend(Backend):
    """A readout chain with electronic noise and the preparation of measured traces."""

    def __init__(self, generator: ResponseGenerator, config: PreparationConfig) -> None:
        self.network = self.chain = generator.eval()
        self.config = config

    def __call__(self, windows: FloatArray, drawn: Drawn) -> tuple[FloatArray, Codes]:
        """Apply the chain, add noise proportional to 1/energy, and prepare like data.

        Raises
        ------
        CpunetError
            If noise is requested and an energy is unknown.
        """
        records = self.network(torch.from_numpy(windows).to(self.device)).cpu().numpy()
        energy_kev, second = drawn.energy_kev, drawn.second
        if drawn.noise and energy_kev is None:
            raise CpunetError(NO_ENERGY)
        seed = drawn.seed(self.device)
        added = None
        if drawn.others:
            if energy_kev is None or not drawn.noise:
                raise CpunetError(NO_OTHERS)
            added = _left(self.chain.remains, records, energy_kev, drawn.remains_kev)
            if second is not None and len(second.row):
                added += self._second(windows, energy_kev, second, records.shape[1])
        return finish_with_codes(
            records,
            self.config,
            dt_ns=float(self.chain.response.dt_ns),
            noise=self.chain.noise if drawn.noise else None,
            energy_kev=energy_kev if drawn.noise else None,
            seed=seed,
            added=added,
        )

    def _second(
        self, windows: FloatArray, energy_kev: Energies, second: SecondPulses, length: int
    ) -> npt.NDArray[np.float64]:
        """Second pulses with shapes of the same batch, at each sample in prepared units."""
        dt_ns = float(self.chain.response.dt_ns)
        # early second pulses need longer records
        chosen = np.pad(
            windows[second.partner], ((0, 0), (0, second.reach(dt_ns))), mode="edge"
        )
        shapes = self.network(torch.from_numpy(chosen).to(self.device)).cpu().numpy()
        config = self.config.model_copy(update={"saturation_run": shapes.shape[1] + 1})
        clean = prepare(Pulses.of(shapes, dt_ns=dt_ns), config, "measured")
        scale = np.full(len(shapes), np.median(clean.scale))
        scale[clean.index] = clean.scale
        return second.added(shapes / scale[:, np.newaxis], energy_kev, dt_ns, length)


class InverseBackend(Backend):
    """A linear inverse, followed by the preparation of simulated pulses."""

    def __init__(self, inverse: LinearInverse, config: PreparationConfig, dt_ns: float) -> None:
        self.network = inverse.eval()
        self.config = config
        self.dt_ns = dt_ns

    def __call__(self, windows: FloatArray, drawn: Drawn) -> tuple[FloatArray, Codes]:
        """Invert the response and suppress the noise; deterministic.

        Raises
        ------
        CpunetError
            If other pulses are to be added.
        """
        if drawn.others:
            raise CpunetError(
                "the inverse gives charge, without other pulses; leave out remains_kev and "
                "second"
            )
        pulses = self.network(torch.from_numpy(windows).to(self.device)).cpu().numpy()
        pulses = np.asarray(pulses, np.float32)
        prepared = prepare(Pulses.of(pulses, dt_ns=self.dt_ns), self.config, "simulated")
        result = np.full_like(windows, np.nan)
        result[prepared.index] = prepared.pulses.waveforms
        return result, prepared.codes


def _left(
    remains: DrawnRemains | None,
    records: FloatArray,
    energy_kev: Energies,
    remains_kev: Energies | None,
) -> npt.NDArray[np.float64]:
    """Remains of earlier pulses at each sample of the records, in prepared units."""
    if remains_kev is None:
        return np.zeros(records.shape)
    if remains is None:
        raise CpunetError(
            "the run does not tell of remains of earlier pulses; leave out remains_kev"
        )
    left = remains_kev * remains.height / energy_kev
    return np.asarray(left[:, np.newaxis] * remains.decay(records.shape[1]))
