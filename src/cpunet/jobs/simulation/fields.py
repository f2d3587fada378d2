"""Describe the fields of a detector in numbers and a picture."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np

from cpunet.errors import CpunetError
from cpunet.jobs.simulation.simulate import ImpurityFrom, solved
from cpunet.outputs import PICTURE_FORMATS, refuse_existing, written_aside
from cpunet.progress import stage
from cpunet.simulation.fields import FieldMaps
from cpunet.simulation.geometry import LI_CONTACT, Detector, FloatArray
from cpunet.simulation.grid import CONTACT_EDGE, DITCH_EDGE

_DPI = 200


def describe_fields(
    detector: Detector,
    picture: Path | None = None,
    *,
    impurity_from: ImpurityFrom = "file",
    paths: bool = True,
    force: bool = False,
) -> dict[str, str]:
    """Solve for the fields (or take them from the cache), and draw them if requested.

    Parameters
    ----------
    detector
        Geometry, impurities and bias.
    picture
        File to write, ``.png``, ``.pdf`` or ``.svg``; None for none.
    impurity_from
        ``"depletion"`` scales the impurities so that the detector depletes at its
        ``measured_depletion_V``.
    paths
        Whether to draw drift paths.
    force
        Whether to replace an existing picture.

    Returns
    -------
    dict
        Text by name, with units: capacitance, depletion voltage (and the measured one, if
        known), the scale of the impurities if it is not 1, bias, and the lowest and highest
        field in the bulk.

    Raises
    ------
    CpunetError
        If the detector is not depleted, or the picture exists, cannot be written or has an
        unknown format.
    """
    if picture is not None:
        if picture.suffix.lower() not in PICTURE_FORMATS:
            raise CpunetError(f"{picture}: pictures are made as {', '.join(PICTURE_FORMATS)}")
        refuse_existing(picture, force=force)
    detector, fields = solved(detector, impurity_from)
    told = _told(detector, fields)
    if picture is not None:
        # matplotlib and the compiled drift are needed only for the picture
        from cpunet.validation.detector_figure import detector_figure

        with stage("Picture"):
            figure = detector_figure(detector, fields, paths=paths)
            with written_aside(picture) as aside:
                figure.savefig(aside, format=picture.suffix[1:].lower(), dpi=_DPI)
        told["picture"] = str(picture)
    return told


def _told(detector: Detector, fields: FieldMaps) -> dict[str, str]:
    strength = np.hypot(fields.e_r_V_per_cm, fields.e_z_V_per_cm)
    # next to contacts and the ditch the field is only a one-sided difference
    bulk = fields.point_type > LI_CONTACT
    bulk &= fields.point_type < DITCH_EDGE
    bulk &= fields.point_type != CONTACT_EDGE
    bulk &= detector.active(fields.r_mm[:, None], fields.z_mm[None, :])
    measured, scale = detector.measured_depletion_V, detector.impurity_scale
    return {
        "detector": detector.name,
        "capacitance": f"{fields.capacitance_pF:.3f} pF",
        "depletion voltage": f"{fields.depletion_V:.0f} V",
        **({"measured depletion": f"{measured:g} V"} if measured else {}),
        **({"impurity_scale": f"{scale:.6g}"} if scale != 1 else {}),
        "bias": f"{detector.bias_V:g} V",
        "lowest field": _at(fields, np.where(bulk, strength, np.inf), np.argmin),
        "highest field": _at(fields, np.where(bulk, strength, -np.inf), np.argmax),
    }


def _at(
    fields: FieldMaps, strength: FloatArray, extreme: Callable[[FloatArray], np.intp]
) -> str:
    i, j = np.unravel_index(extreme(strength), strength.shape)
    place = f"r {fields.r_mm[i]:.1f}, z {fields.z_mm[j]:.1f} mm"
    return f"{strength[i, j]:.0f} V/cm at {place}"
