"""An .npz archive with one array that grows block by block, without being held in memory."""

from __future__ import annotations

import io
import shutil
import zipfile
from pathlib import Path
from typing import Any, Self

import numpy as np
import numpy.typing as npt


class GrowingArchive:
    """Appends rows to one float32 array of an ``.npz``; other arrays are added at the end.

    Parameters
    ----------
    path
        The archive; until `close` the rows are in a ``.rows`` file beside it.
    name, columns
        Name and number of columns of the growing array.
    """

    def __init__(self, path: Path, name: str, columns: int) -> None:
        self.path = path
        self.n_rows = 0
        self._name, self._columns = name, columns
        self._rows_path = path.with_suffix(".rows")
        self._rows = self._rows_path.open("wb")

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *error: Any) -> None:
        self._rows.close()

    def append(self, rows: npt.NDArray[np.float32]) -> None:
        """Add rows, shape ``(n, columns)``."""
        self._rows.write(np.ascontiguousarray(rows, np.float32).tobytes())
        self.n_rows += len(rows)

    def close(self, **arrays: npt.NDArray[np.generic]) -> None:
        """Write the archive with all rows and the other arrays."""
        self._rows.close()
        layout = {
            "descr": np.lib.format.dtype_to_descr(np.dtype(np.float32)),
            "fortran_order": False,
            "shape": (self.n_rows, self._columns),
        }
        with zipfile.ZipFile(self.path, "w") as archive:
            with (
                archive.open(f"{self._name}.npy", "w", force_zip64=True) as target,
                self._rows_path.open("rb") as rows,
            ):
                np.lib.format.write_array_header_2_0(target, layout)
                shutil.copyfileobj(rows, target)
            for name, values in arrays.items():
                buffer = io.BytesIO()
                np.lib.format.write_array(buffer, values, allow_pickle=False)
                archive.writestr(f"{name}.npy", buffer.getvalue())
        self._rows_path.unlink()
