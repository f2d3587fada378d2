"""Built-in Monte Carlo of Tl-208 gammas, for users without Geant4 hits."""

from cpunet.simulation.gammas.sample import (
    TL208_KEV,
    GammaStatistics,
    WantedLine,
    simulate_gammas,
    with_resolution,
)

__all__ = ["TL208_KEV", "GammaStatistics", "WantedLine", "simulate_gammas", "with_resolution"]
