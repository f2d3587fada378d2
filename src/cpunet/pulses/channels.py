"""Process the channels of a file on all cores, each with its own output."""

from __future__ import annotations

import logging
import re
from collections.abc import Callable, Mapping
from contextlib import closing
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Generic, TypeVar
from urllib.parse import quote

from cpunet.errors import CpunetError
from cpunet.outputs import MARKER
from cpunet.processes import outcomes, usable_cores
from cpunet.progress import stage
from cpunet.pulses.reading.files import ALL, PulseFile, table_sizes
from cpunet.tables import aligned

log = logging.getLogger(__name__)

CHANNEL = "{channel}"  # in the name of an energy column

R = TypeVar("R")
Pair = tuple[PulseFile, PulseFile]
Pairs = Mapping[str, Pair | CpunetError]  # of each channel, or why it has none


def channel_names(tables: list[str]) -> dict[str, str]:
    """Short name of each table: its path without the parts that all paths share at either end.

    A table at the top of its file is called ``root``.

    Examples
    --------
    >>> channel_names(["ch1/raw", "ch2/raw"])
    {'ch1': 'ch1/raw', 'ch2': 'ch2/raw'}
    >>> channel_names(["hpge/det1/raw", "hpge/det2/raw"])
    {'det1': 'hpge/det1/raw', 'det2': 'hpge/det2/raw'}
    >>> channel_names(["geds/raw"])
    {'geds': 'geds/raw'}
    """
    parts = [table.strip("/").split("/") for table in tables]
    for end in (-1, 0):
        while all(len(part) > 1 for part in parts) and len({part[end] for part in parts}) == 1:
            for part in parts:
                part.pop(end)
    short = [re.sub(r"[^\w.-]+", "_", "/".join(part)) or "root" for part in parts]
    unique = len(set(short)) == len(short)
    names = short if unique else [quote(table or "/", safe="") for table in tables]
    return dict(zip(names, tables, strict=True))


def channels_of(file: PulseFile) -> dict[str, PulseFile]:
    """Each channel of a file whose table is ``"all"``, by its short name.

    In the name of the energy column ``{channel}`` stands for the name of the channel.

    Raises
    ------
    CpunetError
        If the file cannot be read, or its format has no tables.
    """
    tables = [*table_sizes(file.path)]
    if not tables:
        text = f"{file.path}: holds no tables of waveforms of which to take all"
        raise CpunetError(text, f"leave out `data_table` {ALL} or `table` {ALL}")
    energy = file.energy or ""
    places = {replace(file, table=table).place for table in tables}  # rows of one share it
    if ":" in energy and CHANNEL not in energy and len(places) > 1:
        remedy = f"put {CHANNEL} into its path, as in hit.lh5:{CHANNEL}/hit/energy"
        raise CpunetError(f"{energy}: one column for {len(places)} channels", remedy)
    return {
        name: replace(file, table=table, energy=energy.replace(CHANNEL, name) or None)
        for name, table in channel_names(tables).items()
    }


def paired(sim: PulseFile, data: PulseFile) -> dict[str, Pair | CpunetError]:
    """The simulation and the data of each channel of the data.

    A single table of simulated pulses is used for all channels.  If its table is ``"all"`` too,
    channels are matched by name; if ``{channel}`` stands in the name of its file, each channel
    has the file of its name.  A channel without a simulation has an error instead.
    """
    measured = channels_of(data)
    if CHANNEL in str(sim.path):
        paths = {name: Path(str(sim.path).replace(CHANNEL, name)) for name in measured}
        simulated = {name: replace(sim, path=path) for name, path in paths.items()}
    else:
        simulated = channels_of(sim) if sim.table == ALL else dict.fromkeys(measured, sim)
    pairs: dict[str, Pair | CpunetError] = {}
    for name, file in measured.items():
        others = f"{sim.path}: no table of {name}; there are those of {', '.join(simulated)}"
        pairs[name] = (simulated[name], file) if name in simulated else CpunetError(others)
    return pairs


@dataclass(frozen=True)
class Outcome(Generic[R]):
    """Outcome of each channel: a result, or the reason of its failure."""

    done: dict[str, R] = field(default_factory=dict)
    failed: dict[str, str] = field(default_factory=dict)

    @property
    def ok(self) -> bool:
        """Whether no channel failed, and no result is bad."""
        results = self.done.values()
        return not self.failed and all(getattr(result, "ok", True) for result in results)

    def __str__(self) -> str:
        lines = {name: repr(result).strip("<>'") for name, result in self.done.items()}
        lines |= {name: f"failed: {reason}" for name, reason in self.failed.items()}
        return aligned([*lines.items()])


def each_channel(channels: Pairs, out: Path, do: Callable[[str, Pair, Path], R]) -> Outcome[R]:
    """Process each channel, on all cores; a failed channel does not stop the others.

    Parameters
    ----------
    channels
        Result of `paired`.
    out
        Folder of the outputs; each is a folder (or file) named after its channel.
    do
        Function called with the name of a channel, its two files and the path of its output;
        it and its result are pickled.

    Raises
    ------
    CpunetError
        If `out` is the output of one channel.
    """
    if out.is_file() or (out / MARKER).exists():
        remedy = f"choose another `out` for the folders of {len(channels)}"
        raise CpunetError(f"{out}: is the output of one channel", remedy)
    done, failed = dict[str, R](), dict[str, str]()
    make = partial(partial, _one_channel, dict(channels), out, do)  # called in each process
    made = outcomes(make, list(channels), usable_cores())
    with stage("Channels", len(channels)) as bar, closing(made) as results:
        for name, outcome in results:
            bar.update()
            if isinstance(outcome, CpunetError):
                failed[name] = str(outcome)
                log.info(f"{name}: failed: {outcome}")
            else:
                done[name] = outcome
    return Outcome(
        {name: done[name] for name in channels if name in done},
        {name: failed[name] for name in channels if name in failed},
    )


def _one_channel(pairs: Pairs, out: Path, do: Callable[[str, Pair, Path], R], name: str) -> R:
    pair = pairs[name]
    if isinstance(pair, CpunetError):
        raise pair
    log.info(f"{name}:")
    return do(name, pair, out / name)


def own_folder(folder: Path, name: str, file: str) -> Path:
    """`folder` itself if it is the folder of a run, else the folder of the channel inside it.

    Parameters
    ----------
    folder
        Folder of a run, or of runs by channel.
    name
        Short name of the channel.
    file
        File that identifies the folder of a run, such as ``run.json``.
    """
    return folder if (folder / file).is_file() else folder / name
