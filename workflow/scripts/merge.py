"""Pulses of several files into one, block by block, with their energies in keV.

Run by the workflow where a detector has several files, as a training takes one a side.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path

from cpunet.errors import CpunetError
from cpunet.outputs import refuse_inputs
from cpunet.pulses.reading.files import open_pulses
from cpunet.pulses.writing import PulseWriter


def merge(
    out: Path,
    files: Sequence[Path],
    made_table: str,
    *,
    table: str | None = None,
    energies: Sequence[str] = (),
    kev_per_adc: float | None = None,
    dt_ns: float | None = None,
) -> int:
    """Write the pulses of all files into one and return how many they are.

    Parameters
    ----------
    out
        LH5 file to write; an old one is replaced.
    files
        What `cpunet.open_pulses` reads.
    made_table
        Table to write.
    energies
        None, one for all files, or one for each.
    table, kev_per_adc, dt_ns
        As for `cpunet.open_pulses`.

    Raises
    ------
    CpunetError
        If a file cannot be read, or the files' pulses differ in length or sampling.
    """
    refuse_inputs(out, *files, *energies)
    of_files: list[str | None] = list(energies) or [None]
    if len(of_files) == 1:
        of_files *= len(files)
    if len(of_files) != len(files):
        raise CpunetError(f"{out}: {len(of_files)} energies for {len(files)} files")
    units = "ADC" if made_table.endswith("raw") else ""
    with PulseWriter(out, table=made_table, waveform_units=units, force=True) as writer:
        for file, energy in zip(files, of_files, strict=True):
            source = open_pulses(
                file, table=table, energy=energy, kev_per_adc=kev_per_adc, dt_ns=dt_ns
            )
            for block in source.blocks():
                writer.append(block)
    return writer.n_pulses


def main() -> None:
    """Read the command line; bad input ends in one line."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("out", type=Path)
    parser.add_argument("--files", type=Path, nargs="+", required=True)
    parser.add_argument("--made-table", required=True)
    parser.add_argument("--table")
    parser.add_argument("--energy", dest="energies", action="append", default=[])
    parser.add_argument("--kev-per-adc", type=float)
    parser.add_argument("--dt-ns", type=float)
    given = vars(parser.parse_args())
    try:
        n_pulses = merge(**given)
    except CpunetError as error:
        sys.exit(f"error: {error}")
    sys.stderr.write(f"{given['out']}: {n_pulses} pulses of {len(given['files'])} files\n")


if __name__ == "__main__":
    main()
