"""``cpunet fields``."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from cpunet.cli import options
from cpunet.cli.messages import tell
from cpunet.outputs import refuse_inputs

DetectorFile = Annotated[
    str,
    typer.Argument(
        help="icpc, bege, ppc, a YAML file, a siggen configuration or LEGEND metadata.",
        metavar="DETECTOR",
    ),
]
Out = Annotated[Path | None, typer.Option("--out", help="Picture to make: .png, .pdf or .svg.")]
Paths = Annotated[bool, typer.Option("--paths/--no-paths", help="Draw drift paths.")]


def fields(
    detector: DetectorFile,
    out_file: Out = None,
    set_values: options.Set = None,
    crystal: options.Crystal = None,
    impurity_from: options.ImpurityFrom = options.Impurities.file,
    paths: Paths = True,
    force: options.Force = False,
) -> None:
    """Solve for a detector's fields; tell its capacitance and depletion, and draw them.

    Example: cpunet fields icpc --out icpc.png
    """
    from cpunet.jobs.simulation.fields import describe_fields
    from cpunet.simulation.geometry_readers import read_detector

    if out_file is not None:
        refuse_inputs(out_file, detector, crystal)
    told = describe_fields(
        read_detector(detector, set_values or (), crystal),
        out_file,
        impurity_from=impurity_from.value,
        paths=paths,
        force=force,
    )
    width = max(map(len, told))
    for name, value in told.items():
        tell(f"{name:<{width}}  {value}")
