"""Open a file of pulses of any supported format."""

from __future__ import annotations

from pathlib import Path

from cpunet.pulses.reading.recognition import recognise
from cpunet.pulses.reading.source import PulseSource, ReadOptions


def open_pulses(
    path: str | Path,
    *,
    table: str | None = None,
    energy: str | None = None,
    kev_per_adc: float | None = None,
    dt_ns: float | None = None,
) -> PulseSource:
    """Open a file of pulses; the format is recognised by its content.

    Supported formats are LH5 (waveform tables, plain or encoded) and other HDF5, FlashCam
    ``.fcio``, NumPy ``.npz`` and ``.npy``, siggen's ``.spe`` and text, the Majorana
    Demonstrator's data release for machine learning, and CPU-Net's pickled pulses.

    Parameters
    ----------
    path
        The file.
    table
        Location of the waveforms, needed only if there are several: a table or waveform
        column of an LH5 file, a group or dataset of an HDF5 file, an array of an ``.npz``, a
        channel of an ``.fcio``, a detector of the Majorana release.
    energy
        Column of the energies, or ``FILE:path/to/column`` for a column of another
        HDF5 file of the same events, such as LEGEND's hit tier.
    kev_per_adc
        Calibration: keV per unit of the energy column, or of the amplitude (maximum above
        the baseline) if there is no such column.
    dt_ns
        Sampling period in ns, if it is not in the file.

    Returns
    -------
    PulseSource
        Source of blocks of `Pulses`, with energies in keV (NaN if unknown).

    Raises
    ------
    CpunetError
        If the file is missing, of an unknown format, damaged or without pulses, if `table` or
        `energy` is missing or wrong, or if the file contradicts `dt_ns` or `kev_per_adc`.
    """
    options = ReadOptions(Path(path), table, energy, kev_per_adc, dt_ns)
    # readers are imported when needed: the LH5 library alone takes seconds to load
    match recognise(options.path):
        case "hdf5":
            from cpunet.pulses.reading.hdf5_sources import open_hdf5

            return open_hdf5(options)
        case "fcio":
            from cpunet.pulses.reading.flashcam import FlashCamSource

            return FlashCamSource(options)
        case "npz" | "npy":
            from cpunet.pulses.reading.arrays import ArraySource

            return ArraySource(options)
        case "pickle":
            from cpunet.pulses.reading.pickles import PickleSource

            return PickleSource(options)
        case "spe":
            from cpunet.pulses.reading.siggen import SpectrumSource

            return SpectrumSource(options)
        case "text":
            from cpunet.pulses.reading.siggen import TextSource

            return TextSource(options)


def tables_of(path: str | Path) -> list[str]:
    """List the waveform tables of an LH5 or other HDF5 file; empty for formats without tables.

    For the Majorana release these are the detectors, for FlashCam files the channels with
    traces.

    Raises
    ------
    CpunetError
        If the file is missing or cannot be read.
    """
    return list(table_sizes(path))


def table_sizes(path: str | Path) -> dict[str, int | None]:
    """Tables as in `tables_of`, with the number of pulses if it had to be counted, else None.

    Raises
    ------
    CpunetError
        If the file is missing or cannot be read.
    """
    path = Path(path)
    match recognise(path):
        case "hdf5":
            return dict.fromkeys(_hdf5_tables(path))
        case "fcio":
            from cpunet.pulses.reading.flashcam import channel_sizes

            return channel_sizes(path)
    return {}


def _hdf5_tables(path: Path) -> list[str]:
    from cpunet.hdf5_files import opened
    from cpunet.pulses.reading.hdf5_tables import waveform_tables
    from cpunet.pulses.reading.majorana import detectors, is_majorana

    with opened(path) as file:
        return detectors(file) if is_majorana(file) else waveform_tables(file)
