"""Report folders: how they are recognised, and which of their files the program owns."""

from __future__ import annotations

from cpunet.outputs import FolderKind

METRICS, VALUES = "metrics.json", "parameters.npz"
REPORT = FolderKind(
    name="report",
    command="cpunet validate",
    known_by=METRICS,
    own=r"metrics\.json|report\.html|parameters\.npz",
    older=r"(spectrum|losses|.*_(forward_cycle|backward_cycle|mean_pulse|single_pulse|superpulses"
    r"|A_over_E|A_over_E_and_drift_time|noise|current_amplitude|drift_time|tail_slope))\.png",
)
