"""Repeated simulation of the same hits with other physics, as needed for a calibration."""

from __future__ import annotations

from typing import Literal

from cpunet.simulation.clustering import merge_hits
from cpunet.simulation.events import EventPulses, simulate_events
from cpunet.simulation.fields import superposed_fields
from cpunet.simulation.geometry import Detector
from cpunet.simulation.hits import Hits
from cpunet.simulation.settings import SimulationSettings
from cpunet.simulation.superposition import NOT_IN_PARTS, Superposition, solve

# For quick pulses. Merging within 0.2 mm changes the effect of self-repulsion by 15 %.
_QUICK_MERGING_MM, _QUICK_STRIDE = 0.1, 4
# Maximum number of detector shapes (such as lithium thicknesses) whose potentials are kept.
_MAX_SHAPES = 4


class SameHits:
    """Hits of a set of events, for repeated simulation with other physics.

    Another temperature, bias, velocity, cloud or trapping, or another scale or tilt of the
    impurities, needs no new solution of the fields. Another shape of the active germanium,
    such as another ``li_thickness``, needs one (seconds, then cached) and merges the hits
    anew.

    Parameters
    ----------
    hits
        Events in the frame of the crystal, merged or not.
    cluster_mm
        Distance in mm within which hits are merged, see
        `cpunet.simulation.clustering.merge_hits`. 0 for hits that are merged already, such as
        those stored with simulated pulses.

    Examples
    --------
    >>> from cpunet.simulation.geometry_readers import read_detector
    >>> hits = Hits.of([[20, 0, 40], [0, 9, 12]], [2600, 14.5], [0, 2])
    >>> same, settings = SameHits(hits), SimulationSettings()
    >>> cold, warm = (
    ...     same.simulate(read_detector("ppc", [f"temperature_K={t}"]), settings).waveforms
    ...     for t in (85, 95)
    ... )
    >>> bool(warm.sum() < cold.sum())  # warm charges are slower
    True
    """

    def __init__(self, hits: Hits, *, cluster_mm: float = 0.0) -> None:
        self._hits, self._cluster_mm = hits, cluster_mm
        self._shapes: dict[str, tuple[Superposition, Hits, Hits, float]] = {}

    def simulate(
        self,
        detector: Detector,
        settings: SimulationSettings,
        *,
        mode: Literal["exact", "quick", "library"] = "exact",
    ) -> EventPulses:
        """Pulses of the events with the physics of `detector` and `settings`.

        Parameters
        ----------
        detector, settings
            Detector and simulation settings.
        mode
            ``"exact"`` and ``"library"`` as in `simulate_events`. ``"quick"`` merges more hits
            and takes longer steps, for differences between two sets of physics: its errors
            are nearly equal in both. See benchmarks/same_hits.py for accuracy and speed.

        Raises
        ------
        CpunetError
            If the detector is not depleted, or a hit is not finite.
        """
        solution, hits, fewer, repelling = self._of(detector)
        fields = superposed_fields(
            solution,
            bias_V=detector.bias_V,
            impurity_scale=detector.impurity_scale,
            impurity_tilt=detector.impurity_tilt_1e10_per_cm4,
            temperature_K=detector.temperature_K,
            depletion=False,
        )
        if mode == "quick":
            longer = {
                "stride": max(_QUICK_STRIDE, settings.stride),
                "self_repulsion": repelling * settings.self_repulsion,
            }
            return simulate_events(fields, fewer, settings.model_copy(update=longer))
        return simulate_events(fields, hits, settings, mode)

    def _of(self, detector: Detector) -> tuple[Superposition, Hits, Hits, float]:
        """Potentials of a detector, its hits, and its hits merged more coarsely.

        Coarser hits repel themselves more strongly. The last value is the factor that
        compensates for this on average.
        """
        key = detector.fingerprint(exclude=NOT_IN_PARTS)
        if key not in self._shapes:
            distance = self._cluster_mm
            fine = merge_hits(self._hits, detector, distance)
            coarse = merge_hits(fine, detector, max(_QUICK_MERGING_MM, distance))
            if len(self._shapes) == _MAX_SHAPES:
                # keep the first, with which all others are compared
                del self._shapes[list(self._shapes)[1]]
            repelling = (fine.edep_kev**2).sum() / max((coarse.edep_kev**2).sum(), 1e-9)
            self._shapes[key] = solve(detector), fine, coarse, float(repelling)
        return self._shapes[key]
