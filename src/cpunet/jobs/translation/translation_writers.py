"""Writers of translated pulses, as a new table or as an additional column."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path

from cpunet.errors import CpunetError
from cpunet.jobs.translation.translate_options import TranslateOptions
from cpunet.pulses.appending import ColumnAppender
from cpunet.pulses.reading.source import PulseSource
from cpunet.pulses.row_columns import RowColumns
from cpunet.pulses.writing import PulseWriter
from cpunet.translation.output_form import OutputForm

Writer = PulseWriter | ColumnAppender

OWN_COLUMNS = frozenset(
    {"waveform", "energy", "event_number", "rejection", "realisation", "remains_kev"}
    | {"n_piled", "piled_kev", "piled_ns"}
)


def writer_of(
    pulses: PulseSource,
    out: Path,
    form: OutputForm,
    options: TranslateOptions,
    attrs: Mapping[str, str],
    *,
    force: bool,
) -> Writer:
    """Make the writer of the output; entering its context creates the file.

    Parameters
    ----------
    pulses
        The file that is translated.
    out
        The file to write.
    form
        Type, units and start of the samples.
    options
        Options with the name of the table or the column.
    attrs
        Attributes of the table or the column.
    force
        Whether to replace an existing file.

    Raises
    ------
    CpunetError
        If `out` exists, or a column is to be appended to a file that is not LH5 or HDF5.
    """
    if options.append_column is None:
        return PulseWriter(
            out,
            table=options.table or f"geds/{'iren' if options.inverse else 'ren'}",
            waveform_units=form.units,
            t0_ns=form.t0_ns,
            attrs=attrs,
            samples=form.samples,
            force=force,
        )
    if not _in_hdf5(pulses):
        raise CpunetError(
            f"{pulses.path}: is no LH5 file, so no column can be appended; "
            "leave out --append-column"
        )
    return ColumnAppender(
        out,
        pulses.path,
        table=pulses.describe()["table"].rpartition("/")[0],
        name=options.append_column,
        waveform_units=form.units,
        t0_ns=form.t0_ns,
        attrs=attrs,
        samples=form.samples,
        force=force,
    )


def other_columns(
    pulses: PulseSource, options: TranslateOptions, note: Callable[[str], None]
) -> RowColumns:
    """Find the columns to be copied to a new table; `note` reports the others."""
    if options.append_column is not None:
        return RowColumns(pulses.path)  # they are there already
    if _in_hdf5(pulses):
        waveforms, n_pulses = pulses.describe()["table"], pulses.n_pulses or 0
        others = RowColumns.of_hdf5(pulses.path, waveforms, n_pulses, OWN_COLUMNS)
    else:
        others = RowColumns.of_columns(pulses.path, pulses.columns, OWN_COLUMNS)
    for column, reason in others.left_out.items():
        note(f"warning: {pulses.path.name}: column {column} is left out: {reason}")
    return others


def _in_hdf5(pulses: PulseSource) -> bool:
    return pulses.describe()["format"] in ("LH5", "HDF5")
