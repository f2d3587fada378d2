"""How often critics are right on pulses that they have not seen, and when their game is over.

A critic that is right by chance on unseen pulses knows its own by heart, and has nothing to
teach; a critic that is nearly always right teaches nothing either, for its slope is flat.
"""

from __future__ import annotations

import logging
from collections.abc import Sequence

import numpy as np

log = logging.getLogger(__name__)

JUDGED, RECENT = 5, 20  # iterations between values, and values that are averaged
WON = 0.97
EARLY, HALF = 0.25, 0.5  # part of a training before which none is at chance, and none has won


class Judge:
    """Accuracies of critics on unseen pulses, and verdicts.

    Parameters
    ----------
    sides
        Names of the critics.
    unseen
        Number of pulses of a side that are held out.
    """

    def __init__(self, sides: Sequence[str], unseen: int) -> None:
        self.unseen, self.error = unseen, 0.5 * max(unseen, 1) ** -0.5
        self.values: dict[str, list[float]] = {side: [] for side in sides}
        self.over: dict[str, str] = {}
        """Critics whose game is over, and how it ended: ``"won"`` or ``"chance"``."""

    def add(self, side: str, accuracy: float, done: float) -> None:
        """Note an accuracy, when a part of the training is done."""
        values = self.values[side] = [*self.values[side], accuracy][-RECENT:]
        if len(values) < RECENT or side in self.over:
            return
        if (mean := float(np.mean(values))) > WON and done > HALF:
            self.over[side] = "won"
            log.warning(
                f"the critic of {side} has won: it is right on {100 * mean:.0f} % of pulses "
                "that it has not seen; its game ends here, and the average before counts"
            )
        elif mean < 0.5 + self.error and done > EARLY:
            self.over[side] = "chance"
            log.info(
                f"the critic of {side} is right on {100 * mean:.0f} % of pulses that it has "
                "not seen, as by guessing; its game ends here"
            )

    @property
    def ended(self) -> bool:
        """Whether nothing is left to be played for."""
        return self.over.get("data") == "won" or len(self.over) == len(self.values)

    def good(self, side: str) -> bool:
        """Whether a critic has not won lately."""
        return bool(self.values[side]) and float(np.mean(self.values[side])) <= WON

    def state_dict(self) -> dict[str, dict[str, list[float]] | dict[str, str]]:
        """All that changes."""
        return {"values": dict(self.values), "over": dict(self.over)}

    def load_state_dict(self, state: dict[str, dict[str, object]]) -> None:
        """Continue from a state."""
        vars(self).update({name: dict(state[name]) for name in ("values", "over")})
