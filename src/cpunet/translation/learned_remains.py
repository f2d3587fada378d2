"""Pile-up tails as learned by a run, or at a given rate."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from cpunet.electronics.drawn_tails import DrawnTails
from cpunet.electronics.in_trace_pile_up import DrawnPileUp
from cpunet.errors import CpunetError
from cpunet.translation.options import LEARNED, NONE

if TYPE_CHECKING:
    from cpunet.translation.translator import Translator


def wanted_tails(
    translator: Translator, wanted: str | float, *, raw: bool = False
) -> DrawnTails | None:
    """Pile-up tails to add to translations.

    Parameters
    ----------
    translator
        Trained run.
    wanted
        ``"learned"`` for the tails of the data, ``"none"``, or a rate in kHz.
    raw
        Whether the tails are for raw traces, which have not passed any cuts.

    Raises
    ------
    CpunetError
        If `wanted` is invalid, or the run lacks the necessary information.
    """
    if wanted == NONE:
        return None
    rate = None if wanted == LEARNED else _rate(wanted)
    known = translator.tails
    if known is None:
        raise CpunetError(
            f"`tails` {wanted}: the run tells nothing of pile-up tails (a "
            "network, trained before they were told, or without raw traces); train a readout "
            "chain on raw traces, or leave it out"
        )
    if rate is not None:
        known = known.uncut(rate)
    elif raw:
        known = known.uncut()
    return known if known.law.rate_khz > 0 else None


def wanted_pile_up(translator: Translator, rate_khz: float) -> DrawnPileUp | None:
    """Piled-up pulses to add to translations, with the energies learned by a run.

    Parameters
    ----------
    translator
        Trained run.
    rate_khz
        Rate in kHz; 0 for none.

    Raises
    ------
    CpunetError
        If the rate is negative or not finite, or the run has no energies.
    """
    if not (np.isfinite(rate_khz) and rate_khz >= 0):
        raise CpunetError(f"`pile_up_khz` {rate_khz:g}: expected a rate in kHz, 0 or more")
    if rate_khz == 0:
        return None
    known = translator.tails
    if known is None:
        raise CpunetError(
            f"`pile_up_khz` {rate_khz:g}: the run does not tell the energies of other pulses "
            "(a network, trained before they were told, or without raw traces); train a "
            "readout chain on raw traces, or leave it out"
        )
    return DrawnPileUp(rate_khz, known.law.energies_kev, translator.dt_ns)


def _rate(wanted: str | float) -> float:
    try:
        rate = float(wanted)
    except ValueError:
        rate = np.nan
    if not (np.isfinite(rate) and rate >= 0):
        raise CpunetError(f"`tails` {wanted}: expected learned, none, or a rate in kHz")
    return rate
