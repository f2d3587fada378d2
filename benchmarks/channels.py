"""Time of an array: train and validate all channels of a file.

Usage: ``python benchmarks/channels.py [--channels 20]``; it needs a minute for the stand.
"""

from __future__ import annotations

import argparse
import tempfile
import time
from pathlib import Path

import h5py

import cpunet
from cpunet.processes import usable_cores
from cpunet.pulses.reading.files import ReadOptions


def array_of(data: Path, channels: int, out: Path) -> Path:
    """A file with this number of channels, each with the traces of the stand."""
    with h5py.File(data) as source, h5py.File(out, "w") as file:
        for number in range(channels):
            source.copy("geds/raw", file.create_group(f"ch{number:02}"), "raw")
    return out


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--channels", type=int, default=20)
    channels = parser.parse_args().channels
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        stand = cpunet.make_stand(folder / "stand", events="FEP=1000,SEP=500,DEP=500")
        sim, read = stand.sim.path, ReadOptions(data_table="all")
        raw = array_of(stand.data.path, channels, folder / "raw.lh5")
        start = time.perf_counter()
        runs = cpunet.train(sim, raw, folder / "runs", read=read)
        trained = time.perf_counter()
        reports = cpunet.validate(folder / "runs", sim, raw, folder / "reports", read=read)
        end = time.perf_counter()
    print(runs, reports, sep="\n")
    print(
        f"{channels} channels on {usable_cores()} cores: train {trained - start:.0f} s, "
        f"validate {end - trained:.0f} s, together {end - start:.0f} s"
    )


if __name__ == "__main__":
    main()
