"""Writes measured traces without the tails that earlier pulses left under them."""

from __future__ import annotations

from pathlib import Path

import numpy as np

import cpunet
from cpunet.electronics.pile_up_tails import PileUpTails
from cpunet.errors import CpunetError
from cpunet.outputs import refuse_existing
from cpunet.pulses.baselines import Baselines
from cpunet.pulses.provenance import MADE_BY, SIDE
from cpunet.pulses.reading.files import Source, pulse_file
from cpunet.pulses.writing import PulseWriter
from cpunet.recipes.schema import PreparationConfig

_BLOCK = 4096  # traces read at a time


def subtract_tails(
    data: Source,
    out: str | Path,
    *,
    preparation: PreparationConfig | None = None,
    force: bool = False,
) -> PileUpTails:
    """Write measured traces less the pile-up tails under them.

    The LH5 file has the columns ``tails_kev`` and ``tails_error_kev``. Traces whose tail
    cannot be determined are unchanged.

    Parameters
    ----------
    data
        Measured traces of one channel.
    out
        File to write.
    preparation
        Settings of the preparation; those of the default recipe if None.
    force
        Whether to replace an existing file.

    Returns
    -------
    PileUpTails
        The tails, measured.

    Raises
    ------
    CpunetError
        If the tails cannot be measured, or the file exists and `force` is off.
    """
    from cpunet.recipes import load_recipe

    file = pulse_file(data)
    refuse_existing(Path(out), *file.files, force=force)
    source = file.open()
    try:
        config = preparation or load_recipe("fast").preparation
        tails = PileUpTails.of(Baselines.of(source.blocks(_BLOCK), config))
    except CpunetError as error:
        raise CpunetError(f"{file.path}: {error}") from error
    attrs = {MADE_BY: f"cpunet subtract_tails {cpunet.__version__}", SIDE: "measured"}
    with PulseWriter(
        Path(out), table="geds/raw", waveform_units="ADC", attrs=attrs, force=force
    ) as writer:
        for block in source.blocks(_BLOCK):
            kev = tails.measure(block)
            error_kev = np.where(np.isfinite(kev), tails.error_kev, np.nan)
            columns = {"tails_kev": (kev, "keV"), "tails_error_kev": (error_kev, "keV")}
            writer.append(tails.subtracted_from(block), columns)
    return tails
