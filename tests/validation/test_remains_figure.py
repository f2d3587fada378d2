"""The picture of tails, on a stand."""

from __future__ import annotations

import numpy as np
import pytest

from cpunet.electronics.chain import read_electronics
from cpunet.electronics.pile_up_tails import PileUpTails
from cpunet.electronics.readout import read_out
from cpunet.electronics.tails_law import TailsLaw
from cpunet.pulses.baselines import Baselines
from cpunet.pulses.container import Pulses
from cpunet.recipes import load_recipe
from cpunet.validation.remains_figure import Slopes, remains_figure, sizes_figure


@pytest.mark.thorough
def test_slopes_without_tails_are_those_of_empty_baselines():
    rng = np.random.default_rng(1)
    ramps = np.clip(np.arange(300) / rng.uniform(40, 120, (1500, 1)), 0, 1)
    steps = Pulses.of(ramps, dt_ns=4, energy_kev=np.full(1500, 2614.5))
    traces = read_out(steps, read_electronics("ornl", {"earlier_pulses.rate_kHz": 2}), seed=2)
    raw = Pulses.of(traces.waveforms, dt_ns=16, energy_kev=traces.energy_kev)
    tails = PileUpTails.of(Baselines.of([raw], load_recipe("fast").preparation))
    slopes = Slopes.of(raw, tails)
    after, noise = slopes.spreads
    assert after == pytest.approx(noise, rel=0.5)
    assert slopes.before.std() > 10 * after
    sizes, _, shown = remains_figure(raw, tails).axes
    measured, law = (line.get_ydata() for line in sizes.lines)
    middle = slice(20, 40)
    np.testing.assert_allclose(measured[middle], law[middle], rtol=0.3)
    assert "keV" in shown.get_ylabel()


def test_the_sizes_that_a_training_keeps_are_drawn_beside_the_law():
    law = TailsLaw(1.0, 55.0, (100.0, 2000.0))
    kev = np.geomspace(2, 2000, 30)
    told = {"rate_khz": 1.0, "rate_error_khz": 0.1, "decay_us": 55.0, "error_kev": 2.5}
    sizes = {"kev": kev.tolist(), "percent_above": (100 * law.share_above(kev)).tolist()}
    axes = sizes_figure(told | {"traces": 5000}, sizes, law.energies_kev).axes[0]
    measured, drawn = (line.get_ydata() for line in axes.lines[:2])
    np.testing.assert_allclose(measured, drawn)
    assert "1.00 ± 0.10 kHz" in axes.get_title()
