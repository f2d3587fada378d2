"""Write the losses for TensorBoard, if it is installed."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

from cpunet.errors import CpunetError
from cpunet.training.loop import Record


class LossBoard:
    """Write training records as TensorBoard scalars below a run folder.

    Raises
    ------
    CpunetError
        If TensorBoard is not installed.
    """

    def __init__(self, folder: Path) -> None:
        try:
            from torch.utils.tensorboard import SummaryWriter
        except ImportError as error:
            raise CpunetError(
                "TensorBoard is not installed; pip install 'cpunet-hpge[tensorboard]'"
            ) from error
        self._writer = SummaryWriter(folder / "tensorboard")

    def add(self, records: Iterable[Record]) -> None:
        """Add the losses of some iterations."""
        for record in records:
            losses = record["losses"]
            assert isinstance(losses, dict)
            for name, value in losses.items():
                self._writer.add_scalar(name, value, record["iteration"])

    def close(self) -> None:
        """Close the files."""
        self._writer.close()
