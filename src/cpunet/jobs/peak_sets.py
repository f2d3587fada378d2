"""The pulses of one peak by method, as a validation compares them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from cpunet.jobs.inputs import InputSet
from cpunet.jobs.rivals import RivalWindows
from cpunet.pulses.container import FloatArray, Pulses
from cpunet.pulses.peaks import parse_selection
from cpunet.recipes.schema import Recipe

FEWEST = 10  # pulses, below which a distribution says nothing


@dataclass(frozen=True, eq=False)
class PeakSets:
    """The pulses of one peak: raw simulation, its translation, measured.

    ``clean`` holds noise-free windows by method, for the comparison with ``truth``;
    ``others`` the windows of the rivals and of the truth, with noise and without.
    """

    name: str
    raw: Pulses
    ren: Pulses
    data: Pulses
    clean: Mapping[str, FloatArray]
    truth: FloatArray | None
    others: Mapping[str, FloatArray]

    def by_method(self) -> dict[str, Pulses]:
        """Pulses by method, from the simplest to the known answer, the data's first."""
        others = {
            name: Pulses.of(windows, dt_ns=self.raw.dt_ns)
            for name, windows in self.others.items()
            if len(windows) >= FEWEST
        }
        rivals = {name: p for name, p in others.items() if not name.startswith("truth")}
        truth = {name: p for name, p in others.items() if name.startswith("truth")}
        return {"data": self.data, "raw": self.raw} | rivals | {"ren": self.ren} | truth

    def not_prepared(self) -> dict[str, int]:
        """How many translated pulses cannot be prepared as data are, by method."""
        left = {"ren": self.ren.waveforms, **self.others}
        counts = {method: len(self.raw) - len(windows) for method, windows in left.items()}
        return {method: count for method, count in counts.items() if count}

    def missing(self) -> str | None:
        """Say what keeps the peak from being scored, if anything does."""
        sides = (("simulated", self.raw), ("measured", self.data))
        few = [
            f"{len(pulses) or 'no'} {side}" for side, pulses in sides if len(pulses) < FEWEST
        ]
        return f"{' and '.join(few)} pulses (at least {FEWEST} are needed)" if few else None


def peak_sets(
    name: str,
    recipe: Recipe,
    sim_set: InputSet,
    data_set: InputSet,
    noisy: FloatArray,
    clean: FloatArray,
    rivals: RivalWindows,
) -> PeakSets:
    """Choose the pulses of one peak, or of a range of energies, from both sets.

    Parameters
    ----------
    name
        A peak of the recipe, or a range in keV.
    recipe
        The run's settings.
    sim_set, data_set
        Prepared pulses.
    noisy, clean
        The translation of the simulated ones with and without noise, row by row.
    rivals
        What other methods make of them.
    """
    selection = parse_selection(name, recipe.peaks)
    sim, data = sim_set.prepared.pulses, data_set.prepared.pulses
    chosen = selection.select(sim.energy_kev)
    raw = sim[chosen]
    return PeakSets(
        name=name,
        raw=raw,
        ren=Pulses.of(_whole(noisy[chosen]), dt_ns=raw.dt_ns),
        data=data[selection.select(data.energy_kev)],
        clean={"raw": raw.waveforms}
        | {name: windows[chosen] for name, windows in rivals.clean.items() if name != "truth"}
        | {"ren": clean[chosen]},
        truth=rivals.clean["truth"][chosen] if "truth" in rivals.clean else None,
        others={name: _whole(w[chosen]) for name, w in rivals.methods().items()},
    )


def _whole(windows: FloatArray) -> FloatArray:
    """Leave out the rows that could not be prepared."""
    return windows[np.isfinite(windows).all(axis=1)]
