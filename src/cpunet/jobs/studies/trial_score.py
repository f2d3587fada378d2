"""Held-out pulses of the training's energies, and the score of a training on them."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import AbstractContextManager
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Self

import numpy as np
import torch
from torch import nn

from cpunet.analysis.distances import null_distances, wasserstein
from cpunet.analysis.resampling import resampled_twice
from cpunet.errors import CpunetError
from cpunet.jobs.common.inputs import InputFile, InputSet
from cpunet.jobs.common.monitor import Monitor
from cpunet.jobs.training.chain_and_inverse import Sides, match
from cpunet.jobs.training.network_start import NetworkStart, network_start
from cpunet.pulses.container import Pulses
from cpunet.pulses.parameters import Values, pulse_parameters
from cpunet.recipes.schema import Recipe
from cpunet.recipes.training_settings import MatchingConfig
from cpunet.training.chain_step import ChainStep
from cpunet.training.cyclegan import CycleGan
from cpunet.training.loop import CheckpointHooks, State, train
from cpunet.training.run_folder import write_run
from cpunet.training.sampling import EpochSampler
from cpunet.training.statistics import refresh_batch_statistics
from cpunet.translation.learned_remains import LEARNED, wanted_remains
from cpunet.translation.output_form import drawn_kev
from cpunet.translation.translator import REN

SHARE = 0.3  # share of the pulses of each side that is held out
MIN_N = 20  # minimum per side for a distribution
MAX_LOST = 0.01  # share of lost translations: losing bad ones would improve the score
REPORTS = 8  # intermediate scores of a CycleGAN

Report = Callable[[int, float], None]  # iterations done, score


@dataclass(frozen=True, eq=False)
class HeldOut:
    """Prepared pulses of both sides, split into pulses to fit and held-out ones.

    Parameters
    ----------
    fit
        Pulses for the training.
    sim, data
        Held-out pulses.
    values, nulls
        Parameters of the held-out data, and the null distance of each.
    """

    fit: Sides
    sim: Pulses
    data: Pulses
    values: dict[str, Values]
    nulls: dict[str, float]
    seed: int

    @classmethod
    def of(
        cls, sim: InputSet, data: InputSet, data_file: InputFile, recipe: Recipe, seed: int
    ) -> Self:
        """Split both sides at random.

        Raises
        ------
        CpunetError
            If too few pulses would be held out.
        """
        rng = np.random.default_rng(seed)
        parts = []
        for side in (sim, data):
            pulses = side.prepared.pulses
            rows, n = rng.permutation(len(pulses)), int(SHARE * len(pulses))
            if n < MIN_N:
                raise CpunetError(
                    f"{side.path}: {len(pulses)} pulses, of which {n} would be held out, "
                    f"and {MIN_N} are needed; select more energies (--peak) or give more"
                )
            parts.append((pulses[np.sort(rows[n:])], pulses[np.sort(rows[:n])]))
        (fit_sim, held_sim), (fit_data, held_data) = parts
        values = pulse_parameters(held_data, recipe.preparation, recipe.scores)
        n_sim, n_data = len(held_sim), len(held_data)
        draws = resampled_twice(n_data, n_sim, n_data, recipe.scores.bootstraps, seed)
        nulls = {name: null_distances(v, draws).wasserstein for name, v in values.items()}
        fit = Sides(fit_sim, fit_data, data_file, data)
        return cls(fit, held_sim, held_data, values, nulls, seed)

    def score(self, ren: REN) -> float:
        r"""Distance of translated held-out pulses from data; 1 for two samples of the data.

        .. math:: \frac{1}{n} \sum_{p=1}^{n} \frac{W_1(p)}{\langle W_1(p) \rangle_0}

        over the pulse-shape parameters :math:`p`, with the mean of the null in the
        denominator.

        Raises
        ------
        CpunetError
            If pulses cannot be translated.
        """
        generator = ren.seeded(self.seed)
        remains = wanted_remains(ren, LEARNED) if ren.remains is not None else None
        windows = ren.apply(
            self.sim.waveforms,
            energy_kev=self.sim.energy_kev,
            generator=generator,
            remains_kev=drawn_kev(remains, len(self.sim), generator),
        )
        whole = np.isfinite(windows).all(axis=1)
        if (lost := 1 - whole.mean()) > MAX_LOST:
            raise CpunetError(f"{100 * lost:.0f} % of the held-out pulses have no translation")
        pulses = Pulses.of(windows[whole], dt_ns=self.sim.dt_ns)
        values = pulse_parameters(pulses, ren.recipe.preparation, ren.recipe.scores)
        ratios = [wasserstein(self.values[k], values[k]) / self.nulls[k] for k in values]
        score = float(np.mean(ratios))
        if not np.isfinite(score):
            raise CpunetError("a parameter of the held-out pulses has no value")
        return score

    def train(self, recipe: Recipe, seed: int, device: str, report: Report) -> REN:
        """Train on the pulses that are not held out.

        Parameters
        ----------
        recipe, seed, device
            See `cpunet.jobs.training.train.train_run`.
        report
            Function called with intermediate scores of a CycleGAN; its exceptions end the
            training.

        Raises
        ------
        CpunetError
            If the training fails.
        """
        model: nn.Module
        if isinstance(recipe.training, MatchingConfig):
            model, _, recipe = match(self.fit, recipe, seed, lambda *_step: None, Monitor())
        else:
            begun = network_start(self.fit, recipe, seed, None, Monitor())
            recipe = begun.recipe
            model = train(
                self.fit.sim.waveforms,
                self.fit.data.waveforms,
                recipe,
                seed=seed,
                device=device,
                surroundings=begun.surroundings,
                hooks=CheckpointHooks(self._watch(begun, device, report)),
            )
        return self._loaded(model, recipe, seed, device)

    def _loaded(self, model: nn.Module, recipe: Recipe, seed: int, device: str) -> REN:
        info = {"dt_ns": self.sim.dt_ns, "peak": "", "recipe": recipe.name}
        with TemporaryDirectory(prefix="cpunet-tune-") as folder:
            told = {"seconds": 0, "device": device, "seed": seed}
            write_run(Path(folder), model, recipe, info | told)
            return REN.load(folder, device)

    def _watch(
        self, begun: NetworkStart, device: str, report: Report
    ) -> Callable[[State], None]:
        """Callback that scores the generator at regular stages of its training."""
        config = begun.recipe.cyclegan.training
        told = 0

        def watch(state: State) -> None:
            nonlocal told
            part = state["iteration"] * REPORTS // config.iterations
            if part in (told, REPORTS):  # the final state is scored separately
                return
            told = part
            with _random_state_kept(device):
                report(state["iteration"], self.score(self._averaged(state, begun, device)))

        return watch

    def _averaged(self, state: State, begun: NetworkStart, device: str) -> REN:
        recipe, prefix = begun.recipe, "module."
        config = recipe.cyclegan.training
        model = CycleGan(recipe, begun.surroundings).to(device)
        model.load_state_dict(state["model"])
        averages = state["averages"][0].items()
        model.ren.load_state_dict(
            {k.removeprefix(prefix): v for k, v in averages if k.startswith(prefix)}
        )
        pulses = torch.from_numpy(self.fit.sim.waveforms)[:, None].to(device)
        sampler = EpochSampler(pulses, config.batch_size, seed=self.seed)
        chain = begun.surroundings.chain
        run = None
        if chain is not None:
            run = ChainStep(*chain, model.ren, model.iren, recipe).records
        refresh_batch_statistics(model.ren, sampler, config.statistics_batches, run)
        return self._loaded(model, recipe, self.seed, device)


def _random_state_kept(device: str) -> AbstractContextManager[None]:
    """Context manager that restores the random state, so that scores do not affect training."""
    cuda = [torch.device(device)] if device.startswith("cuda") else []
    return torch.random.fork_rng(devices=cuda)
