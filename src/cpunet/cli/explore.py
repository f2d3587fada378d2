"""``cpunet explore``."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from cpunet.cli import options
from cpunet.cli.messages import monitor, tell
from cpunet.outputs import refuse_inputs

Out = Annotated[Path, typer.Option("--out", help="HTML file to write.")]
Data = Annotated[
    Path | None, typer.Option("--data", help="File of measured pulses to find the nearest in.")
]
Points = Annotated[int, typer.Option(help="Places in the crystal, about; 20 to 600.")]


@options.grouped
def explore(
    *,
    runs: options.Runs,
    detector: options.DetectorFile,
    out_file: Out,
    data: Data = None,
    points: Points = 400,
    set_values: options.Set = None,
    crystal: options.Crystal = None,
    settings_file: options.SettingsFile = None,
    read_as: options.DataAs,
    device: options.Device = "auto",
    force: options.Force = False,
) -> None:
    """Make a page to click on places in the crystal and see their pulses.

    Example: cpunet explore run --detector icpc --data raw.lh5 --out explorer.html
    """
    from cpunet.jobs.inspection.explore import explore_runs
    from cpunet.jobs.simulation.simulation_settings import load_settings
    from cpunet.simulation.geometry_readers import read_detector

    refuse_inputs(out_file, detector, crystal, settings_file)
    told = explore_runs(
        runs,
        read_detector(detector, set_values or (), crystal),
        out_file,
        data=None if data is None else read_as.data(data),
        points=points,
        settings=None if settings_file is None else load_settings(settings_file),
        device=device,
        force=force,
        monitor=monitor(),
    )
    left_out = ", ".join(f"{n} {why}" for why, n in told["left_out"].items())
    tell(
        f"{out_file}: pulses of {told['shown']} of {told['places']} places"
        + (f" (none: {left_out})" if left_out else "")
        + (f", {told['drawn']} measured ones beside them" if "drawn" in told else "")
        + f"; {told['bytes'] / 1e6:.1f} MB",
    )
