"""A file of pulses in, the translated file out, row by row."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from cpunet.errors import CpunetError
from cpunet.files import refuse_existing
from cpunet.jobs.inputs import InputFile
from cpunet.jobs.monitor import Monitor
from cpunet.jobs.train import resolve_device
from cpunet.pulses.preparation import Rejection
from cpunet.pulses.writing import PulseWriter
from cpunet.translation.translator import IREN, REN, Translator

QUIET = Monitor()
BLOCK_SIZE = 4096


def translate_file(
    run: Path,
    source: InputFile,
    out: Path,
    *,
    inverse: bool = False,
    noise: bool = True,
    seed: int = 0,
    table: str | None = None,
    device: str = "auto",
    force: bool = False,
    monitor: Monitor = QUIET,
) -> dict[str, Any]:
    """Translate all pulses of a file, block by block, keeping their rows.

    Pulses that cannot be prepared stay as rows of NaN; the column ``rejection`` says
    why (0: translated), and the counts are returned.

    Parameters
    ----------
    run
        Folder of a training run.
    source
        Simulated pulses, or measured ones for `inverse`.
    out
        LH5 file to write.
    inverse
        Apply IREN (data → simulation-like) instead of REN.
    noise, seed
        Add noise, drawn with this seed, or none.
    table
        Where in the LH5 file to put the pulses; ``geds/ren`` or ``geds/iren`` if None.
    device, force, monitor
        As for `cpunet.jobs.train.train_run`.

    Returns
    -------
    dict
        ``read``, ``translated`` and ``rejections`` (counts by reason).
    """
    refuse_existing(out, force=force)
    kind: type[Translator] = IREN if inverse else REN
    translator = kind.load(run, resolve_device(device))
    pulses = source.open()
    if not np.isclose(pulses.dt_ns, translator.dt_ns):
        raise CpunetError(
            f"{source.path}: sampled every {pulses.dt_ns:g} ns, the run was trained on "
            f"{translator.dt_ns:g} ns; resample the pulses"
        )
    generator = translator.seeded(seed)
    counts = np.zeros(256, np.int64)
    writer = PulseWriter(
        out,
        table=table or f"geds/{kind.part}",
        t0_ns=-translator.recipe.preparation.samples_before * translator.dt_ns,
        attrs={"translated_by": f"cpunet {kind.part}", "run": str(run)},
        force=force,
    )
    with monitor.stage("Translating", pulses.n_pulses) as advance, writer:
        for block in pulses.blocks(BLOCK_SIZE):
            done = translator.translate_pulses(block, noise=noise, generator=generator)
            writer.append(done.pulses, columns={"rejection": (done.codes, "")})
            counts += np.bincount(done.codes, minlength=len(counts))
            advance(len(block))
        if not counts[Rejection.ACCEPTED]:
            reasons = ", ".join(f"{n} {reason}" for reason, n in _by_reason(counts).items())
            raise CpunetError(
                f"{source.path}: none of {counts.sum()} pulses can be translated "
                f"({reasons}); are these {translator.takes} pulses?"
            )
    return {
        "read": int(counts.sum()),
        "translated": int(counts[Rejection.ACCEPTED]),
        "rejections": _by_reason(counts),
    }


def _by_reason(counts: np.ndarray[Any, np.dtype[np.int64]]) -> dict[str, int]:
    return {Rejection(int(c)).label: int(counts[c]) for c in np.flatnonzero(counts) if c}
