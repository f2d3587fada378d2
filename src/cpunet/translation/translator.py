"""REN and IREN: a trained run applied to pulses.

``REN`` makes simulated pulses look measured; ``IREN`` goes the other way.  Pulses
are prepared first (aligned and normalised as in the training; a prepared pulse is
left as it is), so raw simulated pulses of any length can be given.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar, Self, TypeVar

import numpy as np
import numpy.typing as npt
import torch

from cpunet.errors import CpunetError
from cpunet.networks.positional_unet import PositionalUNet
from cpunet.pulses.container import FloatArray, Pulses
from cpunet.pulses.preparation import Codes, Kind, Rejection, prepare
from cpunet.recipes.schema import Recipe
from cpunet.training.run_folder import load_network, read_info, read_recipe

Waveforms = TypeVar("Waveforms", npt.NDArray[np.floating], torch.Tensor)

BATCH = 256  # pulses at a time: bounds the memory, hardly touches the speed


@dataclass(frozen=True, eq=False)
class Translated:
    """Translated pulses, row by row those that were given.

    Parameters
    ----------
    pulses
        Windows of shape (n, samples); rows of NaN for pulses that were rejected.
    codes
        A `Rejection` for each row.
    """

    pulses: Pulses
    codes: Codes

    @property
    def valid(self) -> npt.NDArray[np.bool_]:
        """Which rows were translated."""
        return np.asarray(self.codes == Rejection.ACCEPTED)


class Translator:
    """A trained generator with the preparation that it was trained on.

    Use `REN.load` or `IREN.load`.
    """

    part: ClassVar[str]
    takes: ClassVar[Kind]

    def __init__(self, network: PositionalUNet, recipe: Recipe, dt_ns: float) -> None:
        self.network = network.eval()
        self.recipe = recipe
        self.dt_ns = dt_ns

    @classmethod
    def load(cls, run: str | Path, device: str = "cpu") -> Self:
        """Load from the folder of a training run.

        Raises
        ------
        CpunetError
            If the folder is no finished run, or its weights do not fit its recipe.
        """
        run = Path(run)
        info, recipe = read_info(run), read_recipe(run)
        network = PositionalUNet(recipe.generator, recipe.preparation.length)
        load_network(run, cls.part, network, device)
        return cls(network, recipe, float(info["dt_ns"]))

    def translate(
        self, waveforms: Waveforms, *, noise: bool = True, seed: int | None = None
    ) -> Waveforms:
        """Translate waveforms, given as a NumPy array or a torch tensor.

        Parameters
        ----------
        waveforms
            Shape (n, samples), or (samples,) for a single pulse, sampled as in the
            training.
        noise
            Draw the latent noise; off, its mean is taken, the same every time.
        seed
            Of the latent noise; None for a fresh draw.

        Returns
        -------
        array or tensor
            Float32, as what was given, shape (n, window) or (window,).

        Raises
        ------
        CpunetError
            If a pulse cannot be prepared: names the first and the reason.
            `translate_pulses` gives rows of NaN instead.
        """
        if isinstance(waveforms, torch.Tensor):
            result = self._translate_array(waveforms.detach().cpu().numpy(), noise, seed)
            return torch.from_numpy(result).to(waveforms.device)
        return self._translate_array(np.asarray(waveforms), noise, seed)

    def translate_pulses(
        self,
        pulses: Pulses,
        *,
        noise: bool = True,
        generator: torch.Generator | None = None,
        progress: Callable[[int], None] | None = None,
    ) -> Translated:
        """Translate a set, keeping its rows: those rejected become NaN and have a code.

        Parameters
        ----------
        pulses
            Raw or prepared pulses of the side that this translator takes.
        noise
            Draw the latent noise, or take its mean.
        generator
            Source of the noise.
        progress
            Called with the number of pulses done since the last call.

        Raises
        ------
        CpunetError
            If the sampling period is not that of the training.
        """
        if not np.isclose(pulses.dt_ns, self.dt_ns):
            raise CpunetError(
                f"pulses sampled every {pulses.dt_ns:g} ns, the run was trained on "
                f"{self.dt_ns:g} ns; resample them"
            )
        prepared = prepare(pulses, self.recipe.preparation, self.takes)
        length = self.recipe.preparation.length
        waveforms = np.full((len(pulses), length), np.nan, np.float32)
        waveforms[prepared.index] = self.apply(
            prepared.pulses.waveforms, noise=noise, generator=generator, progress=progress
        )
        return Translated(pulses.with_waveforms(waveforms), prepared.codes)

    def apply(
        self,
        windows: FloatArray,
        *,
        noise: bool = True,
        generator: torch.Generator | None = None,
        progress: Callable[[int], None] | None = None,
    ) -> FloatArray:
        """Run the network on prepared windows, shape (n, window), in batches."""
        device = next(self.network.parameters()).device
        result = np.empty_like(windows)
        with torch.inference_mode():
            for first in range(0, len(windows), BATCH):
                batch = torch.from_numpy(windows[first : first + BATCH]).to(device)
                out = self.network(batch[:, None], generator=generator, mean=not noise)
                result[first : first + BATCH] = out[:, 0].cpu().numpy()
                if progress is not None:
                    progress(len(batch))
        return result

    def seeded(self, seed: int | None) -> torch.Generator:
        """Return a source of latent noise; fresh if the seed is None."""
        generator = torch.Generator(device=next(self.network.parameters()).device)
        if seed is None:
            generator.seed()
        else:
            generator.manual_seed(seed)
        return generator

    def _translate_array(
        self, waveforms: npt.NDArray[np.floating], noise: bool, seed: int | None
    ) -> FloatArray:
        single = waveforms.ndim == 1
        pulses = Pulses.of(np.atleast_2d(waveforms), dt_ns=self.dt_ns)
        done = self.translate_pulses(pulses, noise=noise, generator=self.seeded(seed))
        if not done.valid.all():
            first = int(np.flatnonzero(~done.valid)[0])
            raise CpunetError(
                f"pulse {first}: {Rejection(done.codes[first]).label.replace('_', ' ')}; "
                "remove it, or use translate_pulses"
            )
        return done.pulses.waveforms[0] if single else done.pulses.waveforms


class REN(Translator):
    """Response Emulation Network: simulated pulses → measured-like pulses."""

    part = "ren"
    takes = "simulated"


class IREN(Translator):
    """Inverse Response Emulation Network: measured pulses → simulation-like pulses."""

    part = "iren"
    takes = "measured"
