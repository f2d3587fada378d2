"""Devices of a job, and their memory."""

from __future__ import annotations

import re
import resource
import sys

import torch

from cpunet.errors import CpunetError


def resolve_device(device: str) -> str:
    """Resolve ``"auto"`` to a device; raise a `CpunetError` if a device is missing."""
    if device == "auto":
        return "cuda" if torch.cuda.is_available() else "cpu"
    known = re.fullmatch(r"cpu|cuda(?::(\d+))?", device)
    if known is None:
        raise CpunetError(f"device {device!r} is not known; use cpu, cuda or auto")
    if device != "cpu" and not torch.cuda.is_available():
        raise CpunetError("no GPU was found; use `device` cpu or install a CUDA build of torch")
    if known[1] and int(known[1]) >= torch.cuda.device_count():
        count = torch.cuda.device_count()
        raise CpunetError(f"device {device!r}: the last of {count} GPUs is cuda:{count - 1}")
    return device


def peak_memory_mb(device: str) -> dict[str, float]:
    """Peak memory of this process in MB, and of its tensors on the GPU."""
    unit = 2**20 if sys.platform == "darwin" else 2**10
    peak = {"host": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / unit}
    if device.startswith("cuda"):
        peak["gpu"] = torch.cuda.max_memory_allocated(device) / 2**20
    return {where: round(mb, 1) for where, mb in peak.items()}
