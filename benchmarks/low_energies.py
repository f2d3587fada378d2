"""Windows and current amplitudes of translated pulses at low energies, on a stand.

Run with ``python benchmarks/low_energies.py STAND RUN``; the run is trained on the full-energy
peak of the stand, which has pulses at 100 to 1000 keV (``--events FEP=2000,100-1000=10000``).
Per range of energy: pulses translated; windows whose first 320 ns lie below −5 % of the charge,
as those that begin inside a pulse do; 95 % quantile of the current amplitude with noise over
that without, of translations and of the true response with the same noise.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np
import numpy.typing as npt

from cpunet.pulses.loading import load_pulses
from cpunet.pulses.parameters import Values, current_amplitude
from cpunet.pulses.peaks import parse_selection
from cpunet.pulses.reading.files import PulseFile
from cpunet.training.run import Run
from cpunet.translation.translator import REN
from cpunet.validation.methods import fit_baseline_methods, translate_all, true_responses

RANGES = ((100, 200), (200, 400), (400, 700), (700, 1000))
BEGIN_NS, BELOW, SEED = 320.0, -0.05, 1


def main() -> None:
    arguments = argparse.ArgumentParser(description=__doc__)
    arguments.add_argument("stand", type=Path)
    arguments.add_argument("run", type=Path)
    given = arguments.parse_args()
    run = Run.load(given.run)
    ren, recipe, selection = REN.of(run), run.recipe, parse_selection("100-1000", {})
    sim = load_pulses(PulseFile(given.stand / "sim.lh5"), "simulated", recipe, selection)
    data = load_pulses(PulseFile(given.stand / "data.lh5"), "measured", recipe, selection)
    noise = fit_baseline_methods(ren, sim, data, selection, fitted=False)
    known = true_responses(given.stand / "truth.npz", sim)
    noisy = translate_all(ren, noise, sim, data, known, SEED)
    clean = current_amplitude(ren.apply(sim.prepared.pulses.waveforms, noise=False), ren.dt_ns)
    assert noisy.truth is not None
    true = current_amplitude(noisy.truth, ren.dt_ns)
    begin = round(BEGIN_NS / ren.dt_ns)
    level = recipe.preparation.tail_level
    print(f"{'keV':<12}{'translated':>12}{'bad windows':>13}{'A ratio':>10}{'of truth':>10}")

    def high(name: str, without: Values, rows: npt.NDArray[np.bool_]) -> float:
        return float(np.nanquantile((noisy.amplitudes[name] / without)[rows], 0.95))

    for low, top in RANGES:
        rows = (sim.prepared.pulses.energy_kev >= low) & (sim.prepared.pulses.energy_kev < top)
        windows = noisy.windows["ren"][rows]
        whole = np.isfinite(windows).all(axis=1)
        bad = (windows[whole, :begin].mean(axis=1) < BELOW * level).mean()
        ratios = high("ren", clean, rows), high("truth", true, rows)
        print(
            f"{f'{low}-{top}':<12}{100 * whole.mean():>10.1f} %{100 * bad:>11.2f} %"
            f"{ratios[0]:>10.3f}{ratios[1]:>10.3f}"
        )


if __name__ == "__main__":
    main()
