"""Add a waveform column to a copy of an LH5 file."""

from __future__ import annotations

import shutil
from collections.abc import Iterable, Mapping
from contextlib import ExitStack
from pathlib import Path
from typing import Any, Self

import h5py
import lh5
import numpy as np
import numpy.typing as npt
from lgdo import LGDO, Array

from cpunet.errors import CpunetError
from cpunet.files import written_aside
from cpunet.hdf5_files import text_attribute
from cpunet.outputs import refuse_existing
from cpunet.pulses.container import Pulses
from cpunet.pulses.writing import Columns, FileInTheMaking, waveform_table, write_errors


class ColumnAppender:
    """Writer of a copy of an LH5 file whose table gains a column of waveforms.

    Everything else in the file is unchanged.  Values that belong to the waveforms become
    columns ``NAME_…``.  The file appears only when it is complete.

    Parameters
    ----------
    path
        The file to write.
    source
        The file to copy.
    table
        Path of the table in the file, for example ``"geds/raw"``.
    name
        Name of the new column.
    waveform_units, t0_ns, samples, force
        See `cpunet.pulses.writing.PulseWriter`.
    attrs
        Attributes of the column's samples, such as the origin of the pulses.

    Raises
    ------
    CpunetError
        If the file exists (without `force`) or cannot be written, if the table is not an
        LH5 table or already has the column, or if the number of rows differs.
    """

    def __init__(
        self,
        path: str | Path,
        source: Path,
        *,
        table: str,
        name: str,
        waveform_units: str = "",
        t0_ns: float = 0.0,
        attrs: Mapping[str, str | float] | None = None,
        samples: npt.DTypeLike = np.float32,
        force: bool = False,
    ) -> None:
        self.path = Path(path)
        self.n_pulses = 0
        self._source, self._table, self._name = source, table.strip("/"), name
        self._units, self._t0_ns, self._samples = waveform_units, t0_ns, samples
        self._attrs = dict(attrs or {})
        self._stack = ExitStack()
        self._file: FileInTheMaking | None = None
        self._new: list[str] = []
        if not name or "/" in name:
            raise CpunetError(f"{name!r} is no name of a column; give one as waveform_ren")
        refuse_existing(self.path, source, force=force)

    def __enter__(self) -> Self:
        with ExitStack() as stack:
            aside = stack.enter_context(written_aside(self.path))
            with write_errors(self.path):
                shutil.copyfile(self._source, aside)
            self._file = stack.enter_context(FileInTheMaking(aside, self.path, "r+"))
            self._require_table(self._file.h5)
            self._stack = stack.pop_all()
        return self

    def __exit__(self, *error: Any) -> None:
        if error[1] is not None:
            self._stack.__exit__(*error)
            return
        with self._stack:
            assert self._file is not None
            rows = int(lh5.read_n_rows(self._table, self._file.h5) or 0)
            if rows != self.n_pulses:
                raise CpunetError(
                    f"{self._source}: {self.n_pulses} pulses beside {rows} rows of "
                    f"{self._table}; translate it into a table of its own"
                )
            self._declare(self._file.h5[self._table])

    def append(
        self,
        pulses: Pulses,
        columns: Columns | None = None,
        others: Mapping[str, LGDO] | None = None,
    ) -> None:
        """Append the waveforms of a block of pulses and the values that belong to them.

        Parameters
        ----------
        pulses
            Pulses of the next rows of the table.
        columns
            Name → (array of shape ``(n,)``, units); becomes column ``NAME_name``.
        others
            Columns that the table already has; not written again.
        """
        del others
        if self._file is None:
            raise ValueError("append outside of the appender's with block")
        content: dict[str, Any] = {
            self._name: waveform_table(
                pulses, t0_ns=self._t0_ns, units=self._units, samples=self._samples
            )
        }
        # set on the samples: a waveform table with its own attributes can be read only once
        content[self._name].values.attrs.update(self._attrs)
        for name, (values, units) in (columns or {}).items():
            array = Array(np.asarray(values), attrs={"units": units} if units else {})
            content[f"{self._name}_{name}"] = array
        if not self._new:
            self._require_new(self._file.h5[self._table], content)
            self._new = list(content)
        for name, column in content.items():
            self._file.write(column, name, self._table)
        self.n_pulses += len(pulses)

    def stamp(self, name: str, text: str) -> None:
        """Set an attribute of the file, such as its provenance record."""
        if self._file is None:
            raise ValueError("stamp outside of the appender's with block")
        self._file.h5.attrs[name] = text

    def _require_table(self, file: h5py.File) -> None:
        if not text_attribute(file[self._table], "datatype").startswith("table{"):
            raise CpunetError(
                f"{self._source}: {self._table} is no table of LH5, so no column can be "
                "appended; leave out --append-column"
            )
        self._require_new(file[self._table], [self._name])

    def _require_new(self, table: h5py.Group, names: Iterable[str]) -> None:
        for name in names:
            if name in table:
                raise CpunetError(
                    f"{self._source}: {self._table} has a column {name} already; "
                    "choose another name"
                )

    def _declare(self, table: h5py.Group) -> None:
        """List the new columns in the table's datatype attribute, as LH5 requires."""
        named = text_attribute(table, "datatype").removeprefix("table{").removesuffix("}")
        names = [name for name in named.split(",") if name]
        names += [name for name in self._new if name not in names]
        table.attrs["datatype"] = f"table{{{','.join(names)}}}"
