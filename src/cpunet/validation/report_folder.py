"""Report folders: how they are recognised, and which of their files the program owns."""

from __future__ import annotations

from cpunet.outputs import FolderKind

METRICS, VALUES = "metrics.json", "parameters.npz"
REPORT = FolderKind(
    name="report",
    command="cpunet validate",
    known_by=METRICS,
    own=r"metrics\.json|report\.html|parameters\.npz",
)
