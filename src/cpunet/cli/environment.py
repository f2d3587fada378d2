"""Variables of the environment: how OpenMP's threads wait, and what would end a library."""

from __future__ import annotations

import os

# Turns of the loop in which a thread of OpenMP waits before it sleeps: about 0.1 ms, longer
# than most gaps between two operations and far shorter than others hold a core.
SPIN_COUNT = "3000"


def sound_environment() -> None:
    """Mend variables that libraries read when they are loaded, and which may be nonsense here.

    Pictures are written to files, whatever backend a notebook shows its own with; a terminal
    that says it is no column wide shows text as any other.
    """
    os.environ["MPLBACKEND"] = "agg"
    for name in ("COLUMNS", "LINES", "NUMBA_NUM_THREADS"):
        if not os.environ.get(name, "1").isdecimal() or os.environ.get(name) == "0":
            del os.environ[name]


def share_the_machine() -> None:
    """Keep OpenMP's threads from spinning for long, before torch loads OpenMP.

    By default threads wait for each other in busy loops. If other programs run as well, the
    thread that the others wait for often has no core, because a waiting one occupies it:
    trainings then take several times as much of the machine. Short loops bridge the gaps
    between two operations; a thread that waits longer sleeps. If the user has set OpenMP's own
    variables, nothing is changed.
    """
    if not os.environ.keys() & {"OMP_WAIT_POLICY", "GOMP_SPINCOUNT"}:
        os.environ["GOMP_SPINCOUNT"] = SPIN_COUNT
