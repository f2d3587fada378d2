"""Remains of earlier pulses in the measured file of a training or a validation."""

from __future__ import annotations

import logging
from collections.abc import Iterator
from itertools import islice
from typing import Any, NamedTuple

import numpy as np

from cpunet.electronics.drawn_remains import DrawnRemains, passing
from cpunet.electronics.extension import PADDING_BEFORE
from cpunet.electronics.remains import Remains
from cpunet.errors import CpunetError
from cpunet.pulses.container import Pulses
from cpunet.pulses.loading import InputSet
from cpunet.pulses.reading.files import PulseFile
from cpunet.recipes.schema import PreparationConfig

log = logging.getLogger(__name__)

BLOCK = 4096  # traces per block
LARGEST_KEV, SIZES = 2600.0, 40  # sizes at which the distribution is stored
MAX_BLOCKS = 16  # blocks searched for traces that passed the cuts


class FoundRemains(NamedTuple):
    """Remains of a measured file.

    Parameters
    ----------
    measured
        Remains in its traces; None if they cannot be estimated.
    drawn
        Distribution to draw from; None if the existence of remains is not certain.
    told
        Entry of ``run.json``: what was measured, even if the existence of remains is not
        certain; None if they were not looked for.
    """

    measured: Remains | None
    drawn: DrawnRemains | None
    told: dict[str, Any] | None


def find_remains(
    data_file: PulseFile, data: InputSet, config: PreparationConfig
) -> FoundRemains:
    """Measure the remains in a file for a training, and note what was found.

    Parameters
    ----------
    data_file, data
        Measured file, and its pulses that passed the cuts.
    config
        Preparation of the pulses.
    """
    found, reason = measured_remains(data_file, config)
    if found is None:
        log.info(f"remains of earlier pulses are not looked for: {reason}")
        return FoundRemains(None, None, {"missing": reason})
    drawn = drawn_like(found, data_file, data, config)
    told = found.describe() | {"sizes": _sizes(found), "drawn": drawn.describe()}
    if found.law is None:
        return FoundRemains(found, None, told)
    tenth = told["percent_above"]["10_kev"]["law"]
    alone = "" if found.coupled else " (by slopes alone: levels do not follow the tilts)"
    log.info(
        f"remains of earlier pulses: {found.law.rate_khz:.2f} ± {found.fit.rate_error_khz:.2f} "
        f"kHz{alone}, {tenth:.0f} % of the traces on more than 10 keV; translations are given "
        "them"
    )
    return FoundRemains(found, drawn, told)


def measured_remains(
    data_file: PulseFile, config: PreparationConfig
) -> tuple[Remains | None, str | None]:
    """Measure the remains in the traces of a file.

    Returns
    -------
    tuple
        Remains and None, or None and the reason why they cannot be estimated.
    """
    try:
        return Remains.of_traces(data_file.open().blocks(BLOCK), config), None
    except CpunetError as error:
        return None, str(error)


def drawn_like(
    remains: Remains, data_file: PulseFile, data: InputSet, config: PreparationConfig
) -> DrawnRemains:
    """Distribution of remains like that of the data after their quality cuts.

    Parameters
    ----------
    remains
        Remains measured in the file.
    data_file, data
        Measured file, and its pulses that passed the cuts.
    config
        Preparation of the pulses.
    """
    windows = data.prepared.pulses.waveforms
    begins = (
        float(np.median(data.prepared.align_sample)) - config.samples_before - PADDING_BEFORE
    )
    passed = None
    if data.cuts is not None and remains.law is not None:
        passed = passing(remains, _rows(data_file, data), config, data.cuts)
    return DrawnRemains(
        law=remains.fit.law,
        height=float(np.median(windows.max(axis=1))),
        lead_us=begins * data.dt_ns * 1e-3,
        dt_ns=data.dt_ns,
        passed=passed,
        decay_error_us=remains.decay_error_us,
    )


def _rows(data_file: PulseFile, data: InputSet) -> Iterator[Pulses]:
    """Raw traces of the pulses in use, block by block."""
    first, index = 0, data.prepared.index
    for block in islice(data_file.open().blocks(BLOCK), MAX_BLOCKS):
        yield block[index[(index >= first) & (index < first + len(block))] - first]
        first += len(block)


def _sizes(remains: Remains) -> dict[str, list[float]]:
    """Percentages of the traces above sizes in keV, for a figure."""
    kev = np.geomspace(max(remains.error_kev, 0.01), LARGEST_KEV, SIZES)
    told = np.sort(remains.kev[np.isfinite(remains.kev)])
    above = 1 - np.searchsorted(told, kev, side="right") / max(len(told), 1)
    return {"kev": kev.round(4).tolist(), "percent_above": (100 * above).round(3).tolist()}
