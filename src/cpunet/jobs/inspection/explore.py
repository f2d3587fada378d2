"""Make a page that shows the pulses of every position in a crystal."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from cpunet.analysis.explorer import Exploration, explorer_page
from cpunet.analysis.nearest import nearest_pulses
from cpunet.analysis.paired import align_half_maximum
from cpunet.errors import CpunetError
from cpunet.files import written_aside
from cpunet.jobs.common.devices import resolve_device
from cpunet.jobs.common.inputs import InputFile, load_measured
from cpunet.jobs.common.monitor import Monitor
from cpunet.jobs.inspection.chain_description import require_alike
from cpunet.jobs.inspection.places import Places, place_pulses, settings_at
from cpunet.outputs import refuse_existing
from cpunet.pulses.container import FloatArray
from cpunet.pulses.peaks import parse_selection
from cpunet.pulses.preparation import Rejection
from cpunet.simulation.geometry import Detector
from cpunet.simulation.settings import SimulationSettings
from cpunet.training.run_folder import read_info
from cpunet.translation.backends import Drawn
from cpunet.translation.translator import REN

QUIET = Monitor()
POINTS = 400  # approximate number of grid points in the crystal
MIN_N, MOST = 20, 600  # more points would exceed a page of 5 MB
NEIGHBOURS = 3  # measured pulses shown for each grid point


def explore_runs(
    runs: Sequence[Path],
    detector: Detector,
    out: Path,
    *,
    data: InputFile | None = None,
    points: int = POINTS,
    settings: SimulationSettings | None = None,
    device: str = "auto",
    force: bool = False,
    monitor: Monitor = QUIET,
) -> dict[str, Any]:
    """Write a page that shows the pulses of any selected position in the crystal.

    For each grid point, the page shows the simulated pulse of a single deposit there, its
    noise-free translation (for several runs the mean, and a band from the lowest to the
    highest), and, with `data`, the nearest measured pulses of the training's energies.

    Parameters
    ----------
    runs
        Folders of training runs with the same preparation, such as several seeds.
    detector
        Geometry, impurities, bias and temperature of the detector.
    out
        HTML file to write; it appears when it is complete.
    data
        Measured pulses, prepared and cut as in the training.
    points
        Approximate number of grid points, `MIN_N` to `MOST`.
    settings
        Settings of the simulation; ``dt_ns`` must be that of the runs, which is the default.
    device, force, monitor
        See `cpunet.jobs.training.train.train_run`.

    Returns
    -------
    dict
        ``places``, the number of grid points; ``shown``, those with pulses; ``left_out``,
        the others by reason; ``measured``, ``unaligned`` and ``drawn``, the numbers of data
        pulses read, of those without a complete edge, and of those on the page; ``bytes``,
        the size of the page.

    Raises
    ------
    CpunetError
        If the page exists, runs, settings or data are inconsistent, the detector is not
        depleted, or no grid point has a pulse.
    """
    refuse_existing(out, *runs, *([] if data is None else data.files), force=force)
    if not MIN_N <= points <= MOST:
        raise CpunetError(f"--points {points}: give from {MIN_N} to {MOST} places")
    translators = _load(runs, resolve_device(device))
    peak = _peak(runs) if data is not None else ""
    ren = translators[0]
    settings = settings_at(ren.dt_ns, settings)
    if data is not None:
        _require_sampling(data, runs[0], ren.dt_ns)
    places = place_pulses(detector, ren.recipe, settings, points, monitor)
    places, translated = _translated(places, translators, runs, monitor)
    shown = Exploration(
        detector=detector,
        recipe=ren.recipe,
        runs=tuple(Path(run).name for run in runs),
        dt_ns=ren.dt_ns,
        step_mm=places.step_mm,
        r_mm=places.r_mm,
        z_mm=places.z_mm,
        missing=places.missing,
        ideal=places.windows,
        translated=translated,
        **_neighbours(data, peak, ren, translated, monitor),
    )
    told = _told(shown)
    page = explorer_page(replace(shown, notes=_notes(told, data, peak)))
    with written_aside(out) as aside:
        aside.write_text(page, encoding="utf-8")
    return told | {"bytes": len(page.encode())}


def _translated(
    places: Places, translators: Sequence[REN], runs: Sequence[Path], monitor: Monitor
) -> tuple[Places, FloatArray]:
    """Translate by every run; grid points where any run fails become missing."""
    missing = np.array(places.missing, object)
    kept = np.flatnonzero(missing == "")
    results = []
    with monitor.stage("Translating", len(translators) * len(kept)) as advance:
        for run, ren in zip(runs, translators, strict=True):
            windows, codes = ren.apply_with_codes(places.windows, Drawn(noise=False), advance)
            results.append(windows)
            for i in np.flatnonzero((codes != Rejection.ACCEPTED) & (missing[kept] == "")):
                why = Rejection(codes[i]).label.replace("_", " ")
                missing[kept[i]] = f"not translated by {Path(run).name}: {why}"
    done = missing[kept] == ""
    if not done.any():
        counts = ", ".join(f"{n} {why}" for why, n in Counter(missing.tolist()).items())
        raise CpunetError(
            f"none of {len(missing)} places has a pulse ({counts}); check the detector and "
            "the settings of the simulation"
        )
    whole = Places(
        places.r_mm, places.z_mm, places.step_mm, tuple(missing), places.windows[done]
    )
    return whole, np.stack(results)[:, done]


def _neighbours(
    data: InputFile | None, peak: str, ren: REN, translated: FloatArray, monitor: Monitor
) -> dict[str, Any]:
    """Measured pulses and the nearest ones, as fields of an `Exploration`."""
    if data is None:
        return {}
    selection = parse_selection(peak, ren.recipe.peaks)
    measured = load_measured(data, ren.recipe, selection, monitor).prepared.pulses
    half = ren.recipe.scores.edge_samples
    with monitor.stage("Nearest measured pulses"):
        edges = np.mean([align_half_maximum(run, half, half) for run in translated], axis=0)
        nearest = nearest_pulses(edges, measured.waveforms, NEIGHBOURS)
    if not nearest.index.size:
        raise CpunetError(
            f"{data.path}: none of {len(measured)} pulses has a whole edge; shorten "
            "scores.edge_samples in the recipe"
        )
    return {"measured": measured, "nearest": nearest}


def _load(runs: Sequence[Path], device: str) -> list[REN]:
    """Translators of the runs, which must have the same preparation and sampling."""
    if not runs:
        raise CpunetError("no run was given; name the folder of at least one")
    translators = [REN.load(run, device) for run in runs]
    alike = [(r, t.dt_ns, t.recipe.preparation) for r, t in zip(runs, translators, strict=True)]
    require_alike(alike, "explore")
    return translators


def _peak(runs: Sequence[Path]) -> str:
    peaks = [str(read_info(run)["peak"]) for run in runs]
    for run, peak in zip(runs, peaks, strict=True):
        if peak != peaks[0]:
            raise CpunetError(
                f"{run}: trained on {peak}, {runs[0]} on {peaks[0]}, so that no measured "
                "pulses go with both; explore them one by one or leave out --data"
            )
    return peaks[0]


def _require_sampling(data: InputFile, run: Path, dt_ns: float) -> None:
    period = data.open().dt_ns
    if not np.isclose(period, dt_ns):
        raise CpunetError(
            f"{data.path}: sampled every {period:g} ns, {run} was trained on {dt_ns:g} ns; "
            "resample the pulses"
        )


def _told(shown: Exploration) -> dict[str, Any]:
    left_out = Counter(why for why in shown.missing if why)
    told: dict[str, Any] = {
        "places": len(shown.missing),
        "shown": len(shown.ideal),
        "left_out": dict(left_out),
    }
    if shown.measured is not None and shown.nearest is not None:
        told["measured"] = len(shown.measured)
        told["unaligned"] = shown.nearest.unaligned
        told["drawn"] = len(np.unique(shown.nearest.index))
    return told


def _notes(told: dict[str, Any], data: InputFile | None, peak: str) -> tuple[str, ...]:
    """Notes of the page on grid points and pulses that are left out."""
    reasons = "; ".join(f"{n} {why}" for why, n in told["left_out"].items())
    notes = [
        f"{told['shown']} of {told['places']} places have a pulse"
        + (f"; grey are {reasons}." if reasons else ".")
    ]
    if data is not None:
        notes.append(
            f"{data.path.name}, {peak}: {told['measured']} measured pulses were searched, "
            f"{told['unaligned']} of them left out for lack of a whole edge; "
            f"{told['drawn']} are the nearest of some place."
        )
    return tuple(notes)
