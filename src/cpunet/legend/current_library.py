"""Write, read and merge current libraries, and expand components to templates.

A current library holds what reboost reads: the currents of single sites, in units of the most
frequent A/E.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path
from typing import Any, Self

import h5py
import numpy as np

from cpunet.errors import CpunetError
from cpunet.hdf5_files import opened, text_attribute
from cpunet.legend.currents import LENGTH, PEAK, Floats, Loss, Values
from cpunet.legend.library_files import put_array, put_column
from cpunet.outputs import refuse_existing, written_aside
from cpunet.pulses.writing import FileInTheMaking

TOLD = "cpunet"  # attribute of a library: JSON of how it was made
_COMPONENTS = "components"


@dataclass(frozen=True, eq=False)
class NewLibrary:
    """A current library that is being written: of whole templates, or of components."""

    group: h5py.Group
    basis: Floats | None

    @classmethod
    def begin(
        cls, group: h5py.Group, r_mm: Values, z_mm: Values, dt_ns: float, basis: Floats | None
    ) -> Self:
        """Write axes and components."""
        put_column(group, "r", r_mm, "mm")
        put_column(group, "z", z_mm, "mm")
        put_column(group, "dt", np.array(dt_ns, float), "ns")
        put_column(group, "t0", np.array(-PEAK * dt_ns, float), "ns")
        if basis is not None:
            put_column(group, _COMPONENTS, basis, "")
        return cls(group, basis)

    def arrays(self, angle: str) -> tuple[h5py.Dataset, h5py.Dataset]:
        """Datasets of one azimuth, such as ``"000_deg"``: currents and drift times in ns."""
        shape = (len(self.group["r"]), len(self.group["z"]))
        name, length = f"waveform_{angle}", LENGTH
        if self.basis is not None:
            name, length = f"coefficients_{angle}", len(self.basis)
        values = put_array(self.group, name, (*shape, length), np.float32, "")
        return values, put_array(self.group, f"drift_time_{angle}", shape, np.float32, "ns")

    def stored(self, currents: Floats, loss: Loss) -> Floats:
        """What stands for currents (rows, z, samples): these, or their coefficients."""
        if self.basis is None:
            return currents
        there = ~np.isnan(currents[:, :, 0])
        coefficients = np.full((*there.shape, len(self.basis)), np.nan, np.float32)
        coefficients[there] = currents[there] @ self.basis.T
        loss.add(currents[there], coefficients[there], self.basis)
        return coefficients


def describe(group: h5py.Group) -> None:
    """Add LH5's attribute to a complete library and to every level above it."""
    while group.name != "/":
        group.attrs["datatype"] = f"struct{{{','.join(sorted(group))}}}"
        group = group.parent


@dataclass(frozen=True, eq=False)
class CurrentLibrary:
    """Currents of a detector, in units of its most frequent A/E.

    Attributes
    ----------
    detector
        Name of the detector in the file.
    r_mm, z_mm
        Grid points.
    dt_ns, t0_ns
        Sampling period, and time of the first sample relative to the maximum.
    drift_time_ns
        Drift times by azimuth in degrees, shape (r, z); NaN where there is no template.
    told
        Provenance of the library.
    """

    detector: str
    r_mm: Values
    z_mm: Values
    dt_ns: float
    t0_ns: float
    drift_time_ns: dict[int, Floats]
    told: dict[str, Any]
    _stored: dict[int, Floats]
    _basis: Floats | None

    def template(self, r_mm: float, z_mm: float, angle: int = 0) -> Floats:
        """The current of the grid point nearest to a position, shape (samples,)."""
        i = int(np.abs(self.r_mm - r_mm).argmin())
        j = int(np.abs(self.z_mm - z_mm).argmin())
        return self._whole(self._stored[angle][i, j])

    def currents(self, angle: int = 0) -> Floats:
        """All templates of an azimuth, shape (r, z, samples)."""
        return self._whole(self._stored[angle])

    def _whole(self, stored: Floats) -> Floats:
        return stored if self._basis is None else np.asarray(stored @ self._basis)

    def for_reboost(self, angle: int = 0) -> Any:
        """Library for `reboost.hpge.psd.maximum_current`, 0 where there is no template.

        Raises
        ------
        CpunetError
            If reboost is not installed.
        """
        try:
            utils, units = map(import_module, ("reboost.hpge.utils", "reboost.units"))
        except ImportError as error:
            raise CpunetError(
                "reboost is not installed; `pip install reboost`, or use `currents`"
            ) from error
        currents = np.nan_to_num(self.currents(angle), nan=0.0)
        times = self.t0_ns + self.dt_ns * np.arange(currents.shape[2])
        mm, ns = units.ureg.mm, units.ureg.ns
        return utils.HPGePulseShapeLibrary(currents, mm, mm, ns, self.r_mm, self.z_mm, times)


def read_library(path: Path | str, detector: str | None = None) -> CurrentLibrary:
    """Read a current library, of whole templates or of components.

    Parameters
    ----------
    path
        LH5 file that `cpunet library translate` or `merge_libraries` made.
    detector
        Name of the library; can be left out if the file has only one.

    Raises
    ------
    CpunetError
        If there is no such library in the file.
    """
    path = Path(path)
    with opened(path) as file:
        names = current_libraries(file)
        if detector is None and len(names) == 1:
            detector = names[0]
        if detector not in names:
            held = ", ".join(names) or "none"
            wish = "name the detector" if detector is None else f"no library of {detector}"
            raise CpunetError(f"{path}: {wish}; the file has {held}")
        return _read(file[detector], detector)


def _read(group: h5py.Group, detector: str) -> CurrentLibrary:
    basis = group.get(_COMPONENTS)
    prefix = "waveform_" if basis is None else "coefficients_"
    arrays = {int(n.split("_")[1]): n for n in group if n.startswith(prefix)}
    return CurrentLibrary(
        detector,
        np.asarray(group["r"][()], np.float64),
        np.asarray(group["z"][()], np.float64),
        group["dt"][()].item(),
        group["t0"][()].item(),
        {angle: group[n.replace(prefix, "drift_time_")][()] for angle, n in arrays.items()},
        json.loads(text_attribute(group, TOLD) or "{}"),
        {angle: group[name][()] for angle, name in arrays.items()},
        None if basis is None else basis[()],
    )


def current_libraries(file: h5py.File) -> list[str]:
    """Paths of groups that are current libraries."""
    found: list[str] = []

    def visit(name: str, item: h5py.Group | h5py.Dataset) -> None:
        names = [*item] if isinstance(item, h5py.Group) else []
        stored = [n for n in names if n.startswith(("waveform_", "coefficients_"))]
        drift_times = {f"drift_time_{n.split('_', 1)[1]}" for n in stored}
        if stored and {"r", "z", "dt", "t0"} | drift_times <= set(names):
            found.append(name)

    file.visititems(visit)
    return sorted(found)


def merge_libraries(
    sources: Sequence[str | Path], out: str | Path, *, force: bool = False
) -> list[str]:
    """Copy current libraries of several detectors into one file, as in production.

    Parameters
    ----------
    sources
        Files of whole templates or of components, each of one detector or more.
    out
        File to write.
    force
        Whether to replace an existing file.

    Returns
    -------
    list of str
        Names of the detectors.

    Raises
    ------
    CpunetError
        If a file contains no current library, two libraries belong to one detector, or their
        time axes differ.
    """
    paths, out = [*map(Path, sources)], Path(out)
    refuse_existing(out, *paths, force=force)
    first: dict[str, tuple[Path, str]] = {}
    with written_aside(out) as aside, FileInTheMaking(aside, out) as made:
        for path in paths:
            with opened(path) as file:
                names = current_libraries(file)
                if not names:
                    raise CpunetError(
                        f"{path}: no current library; make it with `cpunet library translate`"
                    )
                for name in names:
                    axis = _time_axis(file[name])
                    if name in first:
                        raise CpunetError(
                            f"{path}: a second library of {name}, which {first[name][0]} has "
                            "already; give one of each detector"
                        )
                    first[name] = (path, axis)
                    other, (known_path, known) = next(iter(first.items()))
                    if axis != known:
                        raise CpunetError(
                            f"{path}: {name} has {axis}, {other} of {known_path} {known}; "
                            "translate both with one version"
                        )
                    _copy(file[name], made.h5)
    return sorted(first)


def _copy(group: h5py.Group, made: h5py.File) -> None:
    """Copy a library to the same place in another file."""
    copy = made.create_group(group.name)
    copy.attrs.update(group.attrs)
    for name in group:
        group.copy(name, copy)
    describe(copy.parent)


def _time_axis(group: h5py.Group) -> str:
    """Number of samples, period and first time, as text."""
    waveforms = (name for name in group if name.startswith("waveform_"))
    array = _COMPONENTS if _COMPONENTS in group else next(waveforms)
    dt_ns, t0_ns = (group[name][()].item() for name in ("dt", "t0"))
    return f"{group[array].shape[-1]} samples of {dt_ns:g} ns from {t0_ns:g} ns"


def expand_library(source: str | Path, out: str | Path, *, force: bool = False) -> list[str]:
    """Expand components to whole templates, so that reboost can read the file.

    Libraries of whole templates are copied.

    Returns
    -------
    list of str
        Names of all libraries.

    Raises
    ------
    CpunetError
        If the file contains no library of components.
    """
    source, out = Path(source), Path(out)
    refuse_existing(out, source, force=force)
    with opened(source) as file:
        names = current_libraries(file)
        if not any(_COMPONENTS in file[name] for name in names):
            raise CpunetError(
                f"{source}: no library of components; make one with `low_rank`, or use the "
                "file as it is"
            )
        with written_aside(out) as aside, FileInTheMaking(aside, out) as made:
            for name in names:
                if _COMPONENTS not in file[name]:
                    _copy(file[name], made.h5)
                    continue
                library, group = _read(file[name], name), made.h5.create_group(name)
                axes = library.r_mm, library.z_mm, library.dt_ns
                whole = NewLibrary.begin(group, *axes, None)
                for angle, drift_times in library.drift_time_ns.items():
                    values, times = whole.arrays(f"{angle:03d}_deg")
                    values[...], times[...] = library.currents(angle), drift_times
                group.attrs[TOLD] = json.dumps(library.told)
                describe(group)
    return names
