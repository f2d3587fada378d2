"""Detect discriminators that have won or lost, from which a generator learns nothing."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from cpunet.training.loop import Record

LAST = 0.25  # last fraction of the updates, over which accuracies are averaged
MIN_N = 20  # minimum number of updates
WON, LOST = 0.95, 0.52


def judges_noted(records: Sequence[Record]) -> list[str]:
    """One line for each discriminator that has won or lost in the last part of a training.

    Parameters
    ----------
    records
        Records of the whole training, with the accuracies of discriminators where updated.
    """
    told = [a for record in records if isinstance(a := record.get("accuracy"), dict)]
    last = told[-max(1, round(LAST * len(told))) :]
    if len(last) < MIN_N:
        return []
    lines = []
    for side in last[0]:
        mean = float(np.mean([accuracy[side] for accuracy in last]))
        if mean > WON:
            lines.append(
                f"the judge of {side} has won: it is right {100 * mean:.0f} % of the time, so "
                "translations are still easily distinguished; train longer or lower "
                "training.rate_discriminators"
            )
        elif mean < LOST:
            lines.append(
                f"the judge of {side} has lost: it is right {100 * mean:.0f} % of the time, so "
                "it finds nothing to teach; see the scores whether there is nothing left"
            )
    return lines
