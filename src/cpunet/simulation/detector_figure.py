"""The fields of a detector in one figure: potentials, drift paths and collection times."""

from __future__ import annotations

from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.colors import LogNorm
from matplotlib.contour import ContourSet
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch
from matplotlib.ticker import MaxNLocator
from scipy.ndimage import distance_transform_edt

from cpunet.plotting import COLOURS, styled
from cpunet.simulation.drift import drift_paths
from cpunet.simulation.fields import FieldMaps
from cpunet.simulation.geometry import (
    DITCH,
    LI_CONTACT,
    POINT_CONTACT,
    Detector,
    FloatArray,
)
from cpunet.simulation.settings import SimulationSettings

# Paths and times tolerate coarse steps, but must not end before the charge is collected.
_SETTINGS = SimulationSettings(step_ns=2.0, dt_ns=16.0, length_ns=6000.0, diffusion=False)
_MAP_POINTS = 70  # grid points of the collection times along the longer side of the crystal
_OUTLINE_POINTS = 900  # along the same side
_BLOCK = 500  # paths per block
_ELECTRON, _HOLE = COLOURS["ren"], COLOURS["raw"]
_REGIONS = ((LI_CONTACT, "Li contact", "0.55"), (POINT_CONTACT, "p⁺ contact", "#009E73"))
_WEIGHTING_LEVELS = (0.01, 0.02, 0.05, 0.1, 0.2, 0.5)
_RAY_RAD = np.deg2rad(55)


@styled
def detector_figure(detector: Detector, fields: FieldMaps) -> Figure:
    """Potential, weighting potential and collection times on the cross-section r, z.

    Collection times are those of holes at the point contact.  They and the paths start in
    the plane y = 0.  A path ends where its carrier is collected or can induce no further
    signal; far from the point contact, electron paths end soon after they start.

    Parameters
    ----------
    detector
        Detector whose outline is drawn.
    fields
        Field maps of the detector.
    """
    ratio = detector.crystal_length / detector.crystal_radius
    figure = Figure(figsize=(10.5, min(max(1.6 + 2.5 * ratio, 3.4), 7.5)))
    panels = figure.subplots(1, 3, sharex=True, sharey=True)
    _potential(figure, panels[0], fields)
    _weighting_potential(figure, panels[1], fields)
    _collection_times(figure, panels[2], detector, fields)
    _paths(panels[0], detector, fields)
    for axes in panels:
        _outline(axes, detector)
        axes.set(xlabel="r [mm]", aspect="equal")
        axes.grid(visible=False)
        axes.set_xlim(0, detector.crystal_radius * 1.02)
        axes.set_ylim(-0.01 * detector.crystal_length, detector.crystal_length * 1.01)
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


def _potential(figure: Figure, axes: Axes, fields: FieldMaps) -> None:
    values = _in_germanium(fields, fields.potential_V)
    top = float(np.nanmax(fields.potential_V))
    levels = np.linspace(0, top, 11)[1:-1]
    bar = f"Potential [V], lines every {top / 10:.0f} V"
    _map(
        figure, axes, fields, values, levels, "Potential", bar, cmap="viridis", vmin=0, vmax=top
    )


def _weighting_potential(figure: Figure, axes: Axes, fields: FieldMaps) -> None:
    low, name = _WEIGHTING_LEVELS[0], "Weighting potential"
    values = np.maximum(_in_germanium(fields, fields.weighting_potential), low / 10)
    how = {"cmap": "cividis", "norm": LogNorm(low / 10, 1)}
    lines = _map(figure, axes, fields, values, _WEIGHTING_LEVELS, name, name, **how)
    axes.clabel(lines, manual=_along_a_ray(fields), fmt="%g", fontsize=7.5)


def _map(
    figure: Figure, axes: Axes, fields: FieldMaps, values: FloatArray, levels: Any, title: str,
    bar: str, **how: Any,
) -> ContourSet:  # fmt: skip
    """Draw values at the nodes in colour, with lines at some levels."""
    places = fields.r_mm, fields.z_mm, values.T
    image = axes.pcolormesh(*places, rasterized=True, **how)
    axes.set_title(title)
    _bar(figure, axes, image, bar)
    return axes.contour(*places, levels, colors="white", linewidths=0.65, alpha=0.9)


def _along_a_ray(fields: FieldMaps) -> list[tuple[float, float]]:
    """Positions of the contour labels on a ray from the contact, so none is cut off."""
    distance = np.arange(0, fields.z_mm[-1], fields.grid_mm)
    r, z = distance * np.cos(_RAY_RAD), distance * np.sin(_RAY_RAD)
    r, z = r[r < fields.r_mm[-1]], z[r < fields.r_mm[-1]]
    rows, columns = (np.rint(x / fields.grid_mm).astype(int) for x in (r, z))
    along = fields.weighting_potential[rows, columns]
    # at the first contact that it meets, the ray leaves the crystal
    end = int(np.argmax((along <= 0) & (r > 0))) or len(along)
    firsts = [int(np.argmax(along[:end] <= level)) for level in _WEIGHTING_LEVELS[:-1]]
    return [(float(r[i]), float(z[i])) for i in firsts if i]


def _collection_times(
    figure: Figure, axes: Axes, detector: Detector, fields: FieldMaps
) -> None:
    step = max(detector.crystal_length, detector.crystal_radius) / _MAP_POINTS
    r = np.arange(step / 2, detector.crystal_radius + step / 2, step)
    z = np.arange(step / 2, detector.crystal_length + step / 2, step)
    rr, zz = np.meshgrid(r, z, indexing="ij")
    blocks = [
        _hole_times(fields, rr.ravel()[i : i + _BLOCK], zz.ravel()[i : i + _BLOCK])
        for i in range(0, rr.size, _BLOCK)
    ]
    times = np.concatenate(blocks).reshape(rr.shape)
    top = float(np.nanmax(times))
    times = _filled(times)
    image = axes.pcolormesh(r, z, times.T, cmap="YlOrRd", vmin=0, vmax=top, rasterized=True)
    levels = MaxNLocator(12, steps=[1, 2, 5, 10]).tick_values(0, top)[1:-1]
    lines = axes.contour(r, z, times.T, levels, colors="black", linewidths=0.7)
    axes.clabel(lines, levels=levels[1::2], fmt="%g", fontsize=7.5)
    axes.set_title("Hole collection time")
    _bar(figure, axes, image, f"To the p⁺ contact [ns], lines every {levels[0]:g} ns")


def _hole_times(fields: FieldMaps, r: FloatArray, z: FloatArray) -> FloatArray:
    """Drift time in ns from each point to the point contact; NaN if it is not reached."""
    height = drift_paths(fields, r, np.zeros_like(r), z, _SETTINGS).holes[:, :, 2]
    steps = np.isfinite(height).sum(axis=1)
    arrived = (steps > 0) & (steps < height.shape[1])
    return np.asarray(np.where(arrived, (steps - 1) * _SETTINGS.step_ns, np.nan))


def _paths(axes: Axes, detector: Detector, fields: FieldMaps) -> None:
    r, z = np.meshgrid(
        np.array([0.35, 0.75]) * detector.crystal_radius,
        np.array([0.15, 0.5, 0.85]) * detector.crystal_length,
    )
    # well away from the surfaces of the active germanium
    margin = 0.05 * detector.crystal_radius
    inside = detector.active(r + margin, z) & detector.active(np.maximum(r - margin, 0), z)
    r, z = r[inside], z[inside]
    tracks = drift_paths(fields, r, np.zeros_like(r), z, _SETTINGS)
    for carrier, colour in ((tracks.electrons, _ELECTRON), (tracks.holes, _HOLE)):
        for track in carrier:
            # a light outline keeps the line visible everywhere on the map
            radius, height = np.hypot(track[:, 0], track[:, 1]), track[:, 2]
            axes.plot(radius, height, color="white", linewidth=2.2, alpha=0.75)
            axes.plot(radius, height, color=colour, linewidth=1.2)
    axes.plot(r, z, "o", color="white", markeredgecolor="black", markersize=4)


def _outline(axes: Axes, detector: Detector) -> None:
    """Fill contacts and lithium layer, blank the outside and the ditch, draw the outline."""
    step = max(detector.crystal_length, detector.crystal_radius) / _OUTLINE_POINTS
    r = np.arange(0, 1.05 * detector.crystal_radius, step)
    z = np.arange(0, 1.05 * detector.crystal_length, step)
    rr, zz = np.meshgrid(r, z)
    inside, region = detector.inside(rr, zz), detector.region(rr, zz)
    covers = [(~inside, "white")]
    covers += [(inside & (region == n), c) for n, _, c in _REGIONS]
    for where, colour in covers:
        # slightly too wide, so that no gap shows between two patches
        axes.contourf(r, z, where.astype(float), [0.3, 1.5], colors=[colour], zorder=2.2)
    axes.contour(r, z, inside.astype(float), [0.5], colors="black", linewidths=1.0, zorder=2.3)
    # contours do not run along the edge of the axes
    bottom = np.where(inside[0], 0.0, np.nan)
    axes.plot(r, bottom, color="black", linewidth=1.0, zorder=2.3)


def _in_germanium(fields: FieldMaps, values: FloatArray) -> FloatArray:
    """The map with the germanium's values extended into the lithium layer and the ditch."""
    return _filled(np.where(np.isin(fields.point_type, (LI_CONTACT, DITCH)), np.nan, values))


def _filled(values: FloatArray) -> FloatArray:
    """Fill missing values with the nearest ones, which avoids gaps at the covered edges."""
    nearest = distance_transform_edt(
        np.isnan(values), return_distances=False, return_indices=True
    )
    return np.asarray(values[tuple(nearest)])


def _bar(figure: Figure, axes: Axes, image: ScalarMappable, text: str) -> None:
    bar = figure.colorbar(image, ax=axes, location="bottom", shrink=0.95, pad=0.02, aspect=25)
    bar.set_label(text)
