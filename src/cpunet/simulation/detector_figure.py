"""The fields of a detector in one figure: potentials and drift paths."""

from __future__ import annotations

from typing import Any

import numpy as np
from matplotlib.colors import ListedColormap, LogNorm
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch
from scipy.ndimage import distance_transform_edt

from cpunet.plotting import COLOURS, styled
from cpunet.simulation.fields import FieldMaps
from cpunet.simulation.geometry import Detector, FloatArray
from cpunet.simulation.outline import DITCH, LI_CONTACT, POINT_CONTACT
from cpunet.simulation.settings import SimulationSettings
from cpunet.simulation.simulator import Simulator

# Paths tolerate coarse steps, but must not end before the charge is collected.
_SETTINGS = SimulationSettings(step_ns=2.0, dt_ns=16.0, length_ns=6000.0, diffusion=False)
_OUTLINE_POINTS = 900  # along the longer side of the crystal
_ELECTRON, _HOLE = COLOURS["ren"], COLOURS["raw"]
_REGIONS = ((LI_CONTACT, "Li contact", "0.55"), (POINT_CONTACT, "p⁺ contact", "#009E73"))
_WEIGHTING_LEVELS = (0.01, 0.02, 0.05, 0.1, 0.2, 0.5)


@styled
def detector_figure(detector: Detector, fields: FieldMaps) -> Figure:
    """Potential with drift paths, and weighting potential, on the cross-section r, z.

    Paths start in the plane y = 0. A path ends where its carrier is collected or can induce no
    further signal; far from the point contact, electron paths end soon after they start.

    Parameters
    ----------
    detector
        Detector whose outline is drawn.
    fields
        Field maps of the detector.
    """
    radius, height = detector.crystal_radius, detector.crystal_length
    figure = Figure(figsize=(7.2, min(max(1.6 + 2.5 * height / radius, 3.4), 7.5)))
    panels = figure.subplots(1, 2, sharex=True, sharey=True)
    # values of the germanium extend into the lithium layer and the ditch, so that no gap shows
    # at the edges of what is drawn there
    covered = np.isin(fields.region, (LI_CONTACT, DITCH))
    nearest = distance_transform_edt(covered, return_distances=False, return_indices=True)

    def draw(axes: Any, values: FloatArray, levels: Any, label: str, **colours: Any) -> None:
        grid = fields.r_mm, fields.z_mm, values[tuple(nearest)].T
        image = axes.pcolormesh(*grid, rasterized=True, **colours)
        axes.contour(*grid, levels, colors="white", linewidths=0.65, alpha=0.9)
        place: Any = {"location": "bottom", "shrink": 0.95, "pad": 0.02, "aspect": 25}
        figure.colorbar(image, ax=axes, label=label, **place)

    top, low = float(fields.potential_V.max()), _WEIGHTING_LEVELS[0]
    label, levels = f"Potential [V], lines every {top / 10:.0f} V", np.linspace(0, top, 11)
    draw(panels[0], fields.potential_V, levels[1:-1], label, cmap="viridis", vmin=0, vmax=top)
    values, norm = np.maximum(fields.weighting_potential, low / 10), LogNorm(low / 10, 1)
    label = f"Weighting potential, lines at {low} to {_WEIGHTING_LEVELS[-1]}"
    draw(panels[1], values, _WEIGHTING_LEVELS, label, cmap="cividis", norm=norm)
    r, z = np.meshgrid(radius * np.array([0.35, 0.75]), height * np.array([0.15, 0.5, 0.85]))
    # well away from the surfaces of the active germanium
    near, far = np.maximum(r - 0.05 * radius, 0), r + 0.05 * radius
    inside = detector.active(near, z) & detector.active(far, z)
    r, z = r[inside], z[inside]
    electrons, holes = Simulator(detector, _SETTINGS, fields=fields).paths(r, 0.0, z)
    for carrier, colour in ((electrons, _ELECTRON), (holes, _HOLE)):
        for track in carrier:
            # a light outline keeps the line visible everywhere on the map
            path = np.hypot(track[:, 0], track[:, 1]), track[:, 2]
            panels[0].plot(*path, color="white", linewidth=2.2, alpha=0.75)
            panels[0].plot(*path, color=colour, linewidth=1.2)
    panels[0].plot(r, z, "o", color="white", markeredgecolor="black", markersize=4)
    # contacts and lithium layer filled, the outside and the ditch blank
    step = max(height, radius) / _OUTLINE_POINTS
    at_r = np.arange(0, 1.05 * radius, step)
    at_z = np.arange(-step, 1.05 * height, step)  # the face has an outside
    rr, zz = np.meshgrid(at_r, at_z)
    inside, region = detector.inside(rr, zz), detector.region(rr, zz)
    cover = np.full(rr.shape, np.nan)
    for number, (of, _, _) in enumerate(_REGIONS):
        cover[region == of] = number
    cover[~inside] = len(_REGIONS)
    covers = ListedColormap([*(colour for _, _, colour in _REGIONS), "white"])
    for axes in panels:
        axes.pcolormesh(at_r, at_z, cover, cmap=covers, zorder=2.2, rasterized=True)
        axes.contour(
            at_r, at_z, inside.astype(float), [0.5], colors="black", linewidths=1.0, zorder=2.3
        )
        axes.grid(visible=False)
        axes.set(xlim=(0, radius * 1.02), ylim=(-0.01 * height, height * 1.01))
        axes.set(xlabel="r [mm]", aspect="equal")
    panels[0].set_ylabel("z [mm]")
    handles = [
        *(Patch(color=colour, label=name) for _, name, colour in _REGIONS),
        Line2D([], [], color=_ELECTRON, label="electron path"),
        Line2D([], [], color=_HOLE, label="hole path"),
    ]
    title = (
        f"{detector.name}: {detector.bias_V:g} V, depleted from {fields.depletion_V:.0f} V, "
        f"{fields.capacitance_pF:.2f} pF, {detector.temperature_K:g} K"
    )
    figure.legend(handles=handles, loc="outside upper center", ncols=len(handles), title=title)
    return figure
