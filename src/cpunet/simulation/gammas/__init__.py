"""Built-in Monte Carlo of Tl-208 gammas, for users without Geant4 hits."""
