"""Import published weights as a run, and published lists of pulses as an LH5 file."""

from __future__ import annotations

import hashlib
from collections import Counter
from collections.abc import Iterator, Mapping
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
from torch import nn

from cpunet.errors import CpunetError
from cpunet.outputs import refuse_existing
from cpunet.progress import stage
from cpunet.pulses.container import Pulses
from cpunet.pulses.loading import SideInfo
from cpunet.pulses.peaks import parse_selection
from cpunet.pulses.reading.pickles import PickledPulse, TruncatedError, as_pulse, entries
from cpunet.pulses.writing import PulseWriter
from cpunet.recipes import load_recipe
from cpunet.recipes.schema import Recipe
from cpunet.training.run import Run, versions
from cpunet.translation.published import read_discriminator, read_generator

BLOCK = 1024
TABLE = "geds/raw"
# Entries on the training for a report; its pulses were not published.
UNKNOWN = SideInfo(file="not published with the weights", used="an unknown number of")


def import_weights(
    out: Path,
    *,
    ren: Path | None = None,
    iren: Path | None = None,
    discriminator_data: Path | None = None,
    discriminator_sim: Path | None = None,
    dt_ns: float = 16.0,
    peak: str = "FEP",
    force: bool = False,
) -> Run:
    """Make a run folder for `REN.load` and `IREN.load` from published state dicts.

    Parameters
    ----------
    out
        Folder to create.
    ren, iren
        Generators: ``fep_REN.pt`` (simulation to data), ``fep_IREN.pt``; at least one.
    discriminator_data, discriminator_sim
        ``fep_netD_A.pth`` and ``fep_netD_B.pth``, only stored.
    dt_ns
        Sampling period in ns of the pulses of the training.
    peak
        Energies of the training.
    force
        Whether to replace an existing run folder.

    Returns
    -------
    Run
        The run, with the files in ``imported``.

    Raises
    ------
    CpunetError
        If no generator is given, `peak` cannot be understood, a file is not a plain state
        dict or has another architecture, the two generators differ in width, or `out` cannot
        be written.
    """
    given = {
        "ren": ren,
        "iren": iren,
        "discriminator_data": discriminator_data,
        "discriminator_sim": discriminator_sim,
    }
    refuse_existing(out, *given.values(), force=force)
    files = {part: path for part, path in given.items() if path is not None}
    if ren is None and iren is None:
        raise CpunetError("no generator given; name fep_REN.pt, fep_IREN.pt or both")
    if not (np.isfinite(dt_ns) and dt_ns > 0):
        raise CpunetError(f"the sampling period is {dt_ns} ns; expected more than 0")
    networks, recipe = _read_networks(files)
    parse_selection(peak, recipe.peaks)
    run = Run.of(
        nn.ModuleDict(networks),
        recipe,
        peak=peak,
        seed=None,
        dt_ns=dt_ns,
        seconds=0.0,
        device="elsewhere",
        sim=UNKNOWN,
        data=UNKNOWN,
        imported={
            part: {"file": str(path), "sha256": hashlib.sha256(path.read_bytes()).hexdigest()}
            for part, path in files.items()
        },
        imported_at=datetime.now(UTC).isoformat(timespec="seconds"),
        versions=versions(),
    )
    run.save(out, force)
    return run.model_copy(update={"folder": out})


def _read_networks(files: Mapping[str, Path]) -> tuple[dict[str, nn.Module], Recipe]:
    """Networks by their part of a run, and the recipe of the paper with their dimensions."""
    networks: dict[str, nn.Module] = {}
    widths, overrides = set(), []
    length = load_recipe("paper").preparation.length
    for part, path in files.items():
        if part in ("ren", "iren"):
            network = read_generator(path, length)
            networks[part] = network
            widths.add(network.latent_mean.out_channels // 8)
        else:
            networks[part], config = read_discriminator(path)
            overrides = [
                f"discriminator.{name}={getattr(config, name)}"
                for name in ("embedding_rows", "embedding_dim", "hidden")
            ]
    if len(widths) > 1:
        raise CpunetError(
            f"{files['ren']} and {files['iren']}: generators of widths {sorted(widths)}; give "
            "a pair"
        )
    return networks, load_recipe("paper", [f"generator.width={widths.pop()}", *overrides])


def import_pulses(
    source: Path,
    out: Path,
    *,
    dt_ns: float = 16.0,
    table: str = TABLE,
    units: str = "ADC",
    force: bool = False,
) -> dict[str, Any]:
    """Convert a pickled list of pulses to LH5 without executing code of the pickle.

    Pulses are dictionaries ``{wf, tp0, energy[, event]}``, pickled one after the other in
    one file (streamed) or in lists (one list in memory at a time).

    Parameters
    ----------
    source
        File of pickles.
    out
        LH5 file to write: ``waveform``, ``energy`` (keV), ``event_number``, ``tp0``.
    dt_ns
        Sampling period in ns, which the pickles do not contain.
    table, units
        Table of the LH5 file for the pulses, and the units of their samples.
    force
        Whether to replace an existing file.

    Returns
    -------
    dict
        ``read`` (entries), ``written``, ``rejections`` (counts by reason) and ``truncated``
        (the file ends within an entry, or is damaged there).

    Raises
    ------
    CpunetError
        If the pickle needs more than arrays and plain containers, or contains no pulse.
    """
    refuse_existing(out, source, force=force)
    counts: Counter[str] = Counter()
    ended: list[str] = []
    length = 0
    writer = PulseWriter(
        out,
        table=table,
        waveform_units=units,
        attrs={"imported_from": source.name},
        force=force,
    )
    with writer, stage("Pulses") as bar:
        for block in _blocks(_entries(source, ended), counts):
            length = length or len(block[0].samples)
            same = [pulse for pulse in block if len(pulse.samples) == length]
            counts["other_length"] += len(block) - len(same)
            if same:
                writer.append(*_columns(same, dt_ns))
            counts["written"] += len(same)
            bar.update(len(block))
        if not counts["written"]:
            why = f"; it ends early ({ended[0]})" if ended else ""
            raise CpunetError(
                f"{source}: no pulse among {counts['read']} entries{why}; expected "
                "dictionaries with wf, tp0 and energy"
            )
    return {
        "read": counts["read"],
        "written": counts["written"],
        "rejections": {k: n for k, n in counts.items() if k not in ("read", "written") and n},
        "truncated": bool(ended),
    }


def _entries(source: Path, ended: list[str]) -> Iterator[Any]:
    """Single entries and those of lists; if the file is truncated, `ended` has the reason."""
    try:
        yield from entries(source)
    except TruncatedError as error:
        ended.append(" ".join(str(error).split()))


def _blocks(found: Iterator[Any], counts: Counter[str]) -> Iterator[list[PickledPulse]]:
    """Blocks of pulses; entries that are not pulses are counted by reason."""
    block: list[PickledPulse] = []
    for entry in found:
        number = counts["read"]
        counts["read"] += 1
        pulse, reason = as_pulse(entry, number)
        if pulse is None:
            counts[reason] += 1
            continue
        block.append(pulse)
        if len(block) == BLOCK:
            yield block
            block = []
    if block:
        yield block


def _columns(
    block: list[PickledPulse], dt_ns: float
) -> tuple[Pulses, dict[str, tuple[npt.ArrayLike, str]]]:
    pulses = Pulses.of(
        np.stack([pulse.samples for pulse in block]),
        dt_ns=dt_ns,
        energy_kev=np.array([pulse.numbers["energy"] for pulse in block]),
        event_number=np.array([pulse.event for pulse in block]),
    )
    return pulses, {"tp0": (np.array([pulse.numbers["tp0"] for pulse in block]), "")}
