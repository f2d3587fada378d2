"""All methods of a validation: baseline methods, fitted to the peak of the training, and REN.

Each translates all simulated pulses once, with and without noise.  Of a noise-free pulse only
its difference from the truth is stored, and a few events are translated again for display: to
keep all samples would double the memory.

A virtual test stand gives the truth.  Two pulses are compared with it after both are
shifted to cross half of their maximum at the same time: a time shift left by the electronics or
the alignment is not a difference of shape.
"""

from __future__ import annotations

import logging
from collections import defaultdict
from collections.abc import Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from cpunet.electronics.baseline_methods import BASELINE_METHODS, BaselineMethod
from cpunet.electronics.baseline_noise import BaselineNoise
from cpunet.electronics.finishing import Finished, finish
from cpunet.electronics.measured import noise_of, tails_of
from cpunet.errors import CpunetError
from cpunet.processes import usable_cores
from cpunet.progress import stage
from cpunet.pulses.container import Flags, FloatArray, Pulses, blocks
from cpunet.pulses.loading import InputSet
from cpunet.pulses.parameters import Values, aligned_block, current_amplitude
from cpunet.pulses.peaks import EnergySelection
from cpunet.pulses.preparation import apply_cuts, fit_cuts, prepare
from cpunet.pulses.reading.other_formats import read_arrays
from cpunet.recipes.schema import Recipe
from cpunet.translation.translator import REN
from cpunet.validation.metrics import PairedScores

log = logging.getLogger(__name__)


def true_responses(path: Path, sim: InputSet) -> FloatArray:
    """Noise-free traces of the simulated pulses in use, float32, shape (n, samples).

    Parameters
    ----------
    path
        ``.npz`` file with ``response``, shape (pulses of the simulation file, samples).
    sim
        Simulated pulses in use.

    Raises
    ------
    CpunetError
        If the file is not readable or belongs to other pulses, or no trace is finite.
    """
    arrays = read_arrays(path)
    if "response" not in arrays:
        names = ", ".join(arrays) or "none"
        raise CpunetError(f"{path}: has no array 'response' (it has {names})")
    values = arrays["response"]
    if values.ndim != 2 or values.shape[0] != sim.prepared.n_read:
        raise CpunetError(
            f"{path}: response has shape {values.shape}, but {sim.path} holds "
            f"{sim.prepared.n_read} pulses; give the truth of that file"
        )
    used = np.asarray(values[sim.prepared.index], np.float32)
    if len(used) and not any(np.isfinite(trace).all() for trace in used):
        raise CpunetError(f"{path}: no response is finite; give noise-free traces")
    return used


def pair_squares(
    methods: Mapping[str, FloatArray], truth: FloatArray, edge_samples: int
) -> dict[str, Values]:
    """Squared differences from the true shapes, pulse by pulse, aligned at half maximum.

    Parameters
    ----------
    methods
        Translated pulses by method, shape ``(n, length)``.
    truth
        True shapes of the same events, of the same shape.
    edge_samples
        Half-width of the edge window in samples.

    Returns
    -------
    dict
        Arrays of shape ``(n, 4)`` by method: sum of squares and number of samples, over all
        samples that both records of a pair have, and over the ``2 * edge_samples + 1`` samples
        around the crossing; all 0 where a pulse cannot be aligned.
    """
    half, squares = truth.shape[1], {}
    aligned = aligned_block(truth, half, half)
    edge = slice(max(half - edge_samples, 0), half + edge_samples + 1)
    for method, translated in methods.items():
        difference = aligned_block(translated, half, half) - aligned
        columns = []
        for part in (difference, difference[:, edge]):
            values = np.nan_to_num(part)
            columns += [np.einsum("ij,ij->i", values, values), np.isfinite(part).sum(axis=1)]
        squares[method] = np.stack(columns, axis=1)
    return squares


def scores_of_squares(squares: Values) -> PairedScores:
    r"""Root-mean-square differences from the truth, from the result of `pair_squares`.

    .. math:: \mathrm{RMSE} = \sqrt{\frac{1}{N} \sum_{p, k} (x_{pk} - y_{pk})^2}

    over pulses :math:`p` and samples :math:`k`.

    Examples
    --------
    A time shift is no difference of shape:

    >>> import numpy as np
    >>> time = np.arange(100)
    >>> early, late = np.array([1 / (1 + np.exp((t0 - time) / 3)) for t0 in (40, 50)])
    >>> squares = pair_squares({"ren": late[None]}, early[None], edge_samples=10)
    >>> round(scores_of_squares(squares["ren"]).rmse, 6)
    0.0
    """
    sums = squares.sum(axis=0).reshape(2, 2)
    rmse, edge_rmse = (np.sqrt(total / count) if count else None for total, count in sums)
    unaligned = int((squares[:, 1] == 0).sum())
    return PairedScores(rmse=rmse, edge_rmse=edge_rmse, unaligned=unaligned)


@dataclass(eq=False)
class FittedBaselineMethods:
    """The fitted baseline methods, and the noise that is added to them and to the truth.

    Parameters
    ----------
    methods
        Fitted baseline methods by name.
    noise
        Noise drawn from the baselines of the data, with pile-up tails if the data
        have any; None if there are no baselines.
    missing
        Reasons why methods or the noise are missing, by name.
    """

    methods: dict[str, BaselineMethod] = field(default_factory=dict)
    noise: BaselineNoise | None = None
    missing: dict[str, str] = field(default_factory=dict)


def fit_baseline_methods(
    ren: REN, sim: InputSet, data: InputSet, fit_on: EnergySelection, *, fitted: bool
) -> FittedBaselineMethods:
    """Fit every baseline method to unpaired pulses.

    Parameters
    ----------
    ren
        REN, whose recipe and pile-up tails the methods share.
    sim, data
        All prepared pulses of both sides.
    fit_on
        Energies on which the methods are fitted: those of the training.
    fitted
        Whether to fit the methods; the noise is measured in any case, for the truth.

    Returns
    -------
    FittedBaselineMethods
        Methods that cannot be fitted are listed as missing, with the reason.
    """
    result, tails = FittedBaselineMethods(), ren.tails
    if tails is not None and tails.rate_khz <= 0:
        tails = None
    measured_tails = None if tails is None else tails_of(data)[0]
    try:
        result.noise = replace(noise_of(data, measured_tails), tails=tails)
    except CpunetError as error:
        result.missing["noise"] = str(error)
    pulses = [side.prepared.pulses for side in (sim, data)]
    fit_sim, fit_data = (of.waveforms[fit_on.select(of.energy_kev)] for of in pulses)
    kinds = BASELINE_METHODS if fitted else {}
    how = (fit_sim, fit_data, sim.dt_ns, ren.recipe.preparation.samples_before)
    pool = ThreadPoolExecutor(usable_cores())
    with stage("Fitting baseline methods", len(kinds)) as bar, pool:
        fits = {name: pool.submit(kind, *how) for name, kind in kinds.items()}
        for name, fit in fits.items():
            try:
                result.methods[name] = fit.result()
            except CpunetError as error:
                result.missing[name] = str(error)
            bar.update(1)
    for name, reason in result.missing.items():
        log.info(f"{name} is left out: {reason}")
    return result


@dataclass(frozen=True, eq=False)
class Translations:
    """Pulses of all methods: measured, simulated, and translated row by row.

    Parameters
    ----------
    windows
        Windows with noise by method: ``data``, ``raw``, baseline methods, ``ren`` and
        ``truth``; of translations only ``ren`` if the noise of the data is unknown.  Rows that
        cannot be prepared, or do not pass cuts as those of the data, are NaN.
    whole, energy_kev, amplitudes
        Mask of the prepared rows, energies and current amplitudes, by method.
    comparable
        Mask of the simulated pulses that every method can prepare without noise.
    squares
        Squared differences of the noise-free pulses from the truth by method, see
        `pair_squares`; empty if the truth is unknown.
    truth
        Windows of the noise-free truth, if given.
    """

    ren: REN
    baselines: FittedBaselineMethods
    windows: dict[str, FloatArray]
    whole: dict[str, Flags]
    energy_kev: dict[str, Values]
    amplitudes: dict[str, Values]
    comparable: Flags
    squares: dict[str, Values]
    truth: FloatArray | None

    def without_noise(self, row: int) -> dict[str, FloatArray]:
        """Noise-free window of a pulse by method, with the truth if given."""
        raw, config = self.windows["raw"][[row]], self.ren.recipe.preparation
        windows, kev = {"raw": raw}, self.energy_kev["raw"][[row]]
        for name, method in self.baselines.methods.items():
            windows[name] = finish(method.translate(raw), config, dt_ns=self.ren.dt_ns).windows
        windows["ren"] = self.ren.apply(raw, energy_kev=kev, noise=False)
        return windows if self.truth is None else windows | {"truth": self.truth[[row]]}


def translate_all(
    ren: REN,
    baselines: FittedBaselineMethods,
    sim: InputSet,
    data: InputSet,
    responses: FloatArray | None,
    seed: int,
) -> Translations:
    """Translate the simulated pulses by every method, with noise and without.

    Parameters
    ----------
    ren, baselines
        REN and baseline methods.
    sim, data
        Prepared pulses of both sides.
    responses
        True noise-free records of the simulated pulses, if given.
    seed
        Seed of the noise, common to all methods.
    """
    pulses, recipe, noise = sim.prepared.pulses, ren.recipe, baselines.noise
    given = {} if responses is None else {"truth": responses}
    others = [*baselines.methods, *given]
    # all methods get the same noise
    generator = np.random.default_rng(seed)
    rngs = {name: np.random.default_rng(seed) for name in others}

    def finished(name: str, rows: slice, rng: np.random.Generator) -> Finished:
        method, raw = baselines.methods.get(name), pulses.waveforms[rows]
        records = given[name][rows] if method is None else method.translate(raw)
        kev, config = pulses.energy_kev[rows], recipe.preparation
        return finish(records, config, dt_ns=ren.dt_ns, noise=noise, energy_kev=kev, seed=rng)

    noisy, squares = (defaultdict[str, list[Any]](list) for _ in range(2))
    comparable: list[Flags] = []
    truth: list[FloatArray] = []
    with stage("Translating", len(pulses)) as bar, ThreadPoolExecutor(usable_cores()) as pool:
        for rows in blocks(len(pulses)):
            block = pulses[rows]
            done = {n: pool.submit(finished, n, rows, rng) for n, rng in rngs.items()}
            clean = {"raw": block.waveforms}
            for name, translated in done.items():
                clean[name] = translated.result().clean
                if noise is not None:
                    noisy[name].append(translated.result().windows)
            clean["ren"] = ren.apply(block.waveforms, energy_kev=block.energy_kev, noise=False)
            noisy["ren"].append(like_data(ren, block, generator))
            finite = [np.isfinite(windows).all(axis=1) for windows in clean.values()]
            comparable.append(np.all(finite, axis=0))
            if responses is not None:
                truth.append(clean.pop("truth"))
                edge = recipe.scores.samples(recipe.scores.edge_ns)
                for name, of_block in pair_squares(clean, truth[-1], edge).items():
                    squares[name].append(of_block)
            bar.update(len(block))
    measured = data.prepared.pulses
    every = {"data": measured.waveforms, "raw": pulses.waveforms}
    for name in (*baselines.methods, "ren", "truth"):  # from the simplest to the truth
        if name in noisy:
            every[name] = np.concatenate(noisy.pop(name))
            if noise is not None:
                every[name][~passing_cuts(pulses.with_waveforms(every[name]), recipe)] = np.nan
    whole = {m: np.asarray(np.isfinite(w).all(axis=1)) for m, w in every.items()}
    kev = {m: measured.energy_kev if m == "data" else pulses.energy_kev for m in every}
    amplitudes = {method: current_amplitude(w, ren.dt_ns) for method, w in every.items()}
    of_pairs = {method: np.concatenate(of_method) for method, of_method in squares.items()}
    of_all, shapes = np.concatenate(comparable), np.concatenate(truth) if truth else None
    return Translations(ren, baselines, every, whole, kev, amplitudes, of_all, of_pairs, shapes)


def passing_cuts(translated: Pulses, recipe: Recipe) -> Flags:
    """Which translated pulses with noise pass cuts that are derived as those of the data.

    Pulses that are collected late look like piled-up ones.
    """
    ready = prepare(translated, recipe.preparation, "measured")
    ready = replace(ready, scale=ready.pulses.energy_kev)
    passed = np.asarray(np.isfinite(translated.waveforms).all(axis=1))
    passed[ready.index] = False
    if len(ready):
        passed[apply_cuts(ready, fit_cuts(ready, recipe.cuts)).index] = True
    return passed


def like_data(ren: REN, pulses: Pulses, generator: np.random.Generator) -> FloatArray:
    """Translated windows with noise and pile-up tails as those of the data."""
    tails = ren.tails if ren.tails is not None and ren.tails.rate_khz > 0 else None
    kev = None if tails is None else tails.draw_kev(len(pulses), generator)
    return ren.apply(
        pulses.waveforms, energy_kev=pulses.energy_kev, generator=generator, tails_kev=kev
    )
