"""An ensemble of trainings as one translator: mean, spread, or a random member per pulse."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Self

import numpy as np
import numpy.typing as npt
import torch
from torch import nn

from cpunet.electronics.drawn_remains import DrawnRemains
from cpunet.errors import CpunetError
from cpunet.pulses.container import FloatArray
from cpunet.pulses.half_maximum import Splines, last_below_half
from cpunet.pulses.preparation import Codes
from cpunet.training.ensemble_folder import finished_members
from cpunet.translation.backends import Backend, Drawn
from cpunet.translation.translator import BATCH, REN

Values = npt.NDArray[np.float64]


class EnsembleREN(REN):
    """RENs that differ in their seed.

    It translates like a single `REN` but draws a random member for each pulse, so that a
    translated dataset contains the spread of the seeds.  ``noise=False`` switches off the
    electronic noise but not this draw.  `mean_and_spread` is deterministic.

    Parameters
    ----------
    members
        Two or more RENs with the same preparation and sampling period.

    Raises
    ------
    CpunetError
        If there are fewer than two, or their preparations or sampling periods differ.
    """

    def __init__(self, members: Sequence[REN]) -> None:
        if len(members) < 2:
            raise CpunetError(f"an ensemble has two members or more, not {len(members)}")
        first = members[0]
        for number, ren in enumerate(members):
            same = ren.recipe.preparation == first.recipe.preparation
            if not (same and np.isclose(ren.dt_ns, first.dt_ns)):
                raise CpunetError(
                    f"member {number} of the ensemble has another preparation or sampling "
                    "period than the first; take seeds of one training"
                )
        super().__init__(_Draw([ren.backend for ren in members]), first.recipe, first.dt_ns)
        self.members = tuple(members)

    @classmethod
    def load(cls, ensemble: str | Path, device: str = "cpu") -> Self:
        """Load all finished seeds from a folder of `cpunet ensemble`.

        Raises
        ------
        CpunetError
            If fewer than two seeds are finished, or a run cannot be loaded.
        """
        runs = finished_members(Path(ensemble))
        if len(runs) < 2:
            raise CpunetError(f"{ensemble}: one finished seed only; continue with --resume")
        return cls([REN.load(run, device) for run in runs])

    @property
    def needs_energies(self) -> bool:
        """Whether the noise depends on the energies."""
        return self.members[0].needs_energies

    @property
    def remains(self) -> DrawnRemains | None:
        """Remains of earlier pulses as learned; seeds of a training measure the same data."""
        return self.members[0].remains

    def mean_and_spread(self, windows: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Mean and standard deviation of the members' noise-free translations.

        The preparation aligns a translation at a whole sample, so two members of nearly the
        same response can differ by one sample, which is not a difference of shape.  Each
        translation is therefore shifted, with its cubic spline, to the mean time at which
        the members reach half of their maximum.  There the spread is 0 except for different
        slopes.  The spread does not contain different delays, which a training cannot infer.

        Parameters
        ----------
        windows
            Prepared simulated pulses, shape (n, samples).

        Returns
        -------
        mean, spread
            Mean and standard deviation over the members (ddof = 1), float32, shape
            (n, samples); rows of NaN where a member has no translation.
        """
        mean, spread = np.empty_like(windows), np.empty_like(windows)
        for first in range(0, len(windows), BATCH):
            rows = slice(first, first + BATCH)
            each = [ren.apply(windows[rows], noise=False) for ren in self.members]
            moved = _at_their_mean_time(np.stack(each).astype(float))
            mean[rows], spread[rows] = moved.mean(axis=0), moved.std(axis=0, ddof=1)
        return mean, spread


class _Draw(Backend):
    """A random one of several backends for each pulse."""

    def __init__(self, backends: Sequence[Backend]) -> None:
        self.backends = backends
        self.network = nn.ModuleList(backend.network for backend in backends)

    def __call__(self, windows: FloatArray, drawn: Drawn) -> tuple[FloatArray, Codes]:
        """Assign pulses to random backends and translate them."""
        chosen = torch.randint(
            len(self.backends),
            (len(windows),),
            generator=drawn.generator,
            device=drawn.device(self.device),
        )
        result, codes = np.empty_like(windows), np.zeros(len(windows), np.uint8)
        for number, backend in enumerate(self.backends):
            rows = np.flatnonzero(chosen.cpu().numpy() == number)
            if rows.size:
                result[rows], codes[rows] = backend(windows[rows], drawn.of_rows(rows))
        return result, codes


def _at_their_mean_time(translations: Values) -> Values:
    """Shift translations, shape (members, n, samples), to their mean time of half maximum.

    The ends are padded with the end values.  Rows are NaN where the pulse of any member does
    not cross half maximum.
    """
    members, n, samples = translations.shape
    flat = translations.reshape(-1, samples)
    usable, before = last_below_half(flat)
    usable = np.tile(usable.reshape(members, n).all(axis=0), members)
    moved = np.full_like(flat, np.nan)
    if usable.any():
        whole = flat[usable]
        splines = Splines(whole)
        times = splines.crossing(before[usable], 0.5 * whole.max(axis=1)).reshape(members, -1)
        found = splines.shifted((times - times.mean(axis=0)).ravel(), 0, samples)
        inside = np.isfinite(found)
        rising = inside.cumsum(axis=1) == 0  # before the record
        ends = np.where(rising, whole[:, :1], whole[:, -1:])
        moved[usable] = np.where(inside, found, ends)
    return moved.reshape(translations.shape)
