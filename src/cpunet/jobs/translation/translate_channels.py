"""Translate each table of a file with the run of its channel."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from cpunet.jobs.translation.translate import translate_file
from cpunet.jobs.translation.translate_options import TranslateOptions
from cpunet.pulses.channels import Outcome, Pair, channels_of, one_by_one, own_folder
from cpunet.pulses.reading.files import PulseFile
from cpunet.training.run import INFO

DEFAULTS = TranslateOptions()


def translate_channels(
    runs: Path,
    source: PulseFile,
    out: Path,
    options: TranslateOptions = DEFAULTS,
    **how: Any,
) -> Outcome[dict[str, Any]]:
    """Translate each table of a file with ``RUNS/CHANNEL`` into ``OUT/CHANNEL.lh5``.

    A single table, such as a simulation that serves all channels, is translated with each run.

    The noise depends on the seed and the name of the channel, so that of channels differs.

    Parameters
    ----------
    runs
        Folder of runs by channel, or one run for all channels.
    source
        File whose table is ``"all"``.
    out
        Folder of the LH5 files.
    options, how
        See `cpunet.jobs.translation.translate.translate_file`.

    Returns
    -------
    Outcome
        Counts of each file, and the reasons why channels have none.

    Raises
    ------
    CpunetError
        If the file cannot be read.
    """

    def translate(name: str, pair: Pair, place: Path) -> dict[str, Any]:
        run = own_folder(runs, name, INFO)
        target = place.with_name(f"{name}.lh5")
        return translate_file(run, pair[0], target, options, noise_key=name, **how)

    channels: dict[str, Pair] = {n: (file, file) for n, file in channels_of(source).items()}
    if len(channels) == 1 and not any(own_folder(runs, n, INFO).is_dir() for n in channels):
        (single,) = channels.values()
        trained = sorted(info.parent.name for info in runs.glob(f"*/{INFO}"))
        channels = dict.fromkeys(trained, single) or channels
    return one_by_one(channels, out, translate)
