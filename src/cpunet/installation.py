"""Detect another package installed over this one.

The authors of CPU-Net publish their own code as ``cpunet``; this package's distribution is
called ``cpunet-hpge`` and is also imported as ``cpunet``.  Both install into the same folder,
so an environment can contain only one of them.
"""

from __future__ import annotations

from functools import cache
from pathlib import Path

DISTRIBUTION, OTHER = "cpunet-hpge", "cpunet"


@cache
def other_package() -> str | None:
    """One-line message with a remedy if the other package is installed over this one.

    Returns
    -------
    str or None
        None if it is not installed, or in another folder.
    """
    here = Path(__file__).resolve().parent
    found = next(here.parent.glob(f"{OTHER}-*.dist-info"), None)
    if found is None:
        return None
    # Imported only here, since it would make `cpunet --help` wait for tens of milliseconds
    from importlib.metadata import Distribution

    other = Distribution.at(found)
    files = (Path(str(other.locate_file(file))) for file in other.files or ())
    if not any(here == file.parent.resolve() for file in files if file.suffix == ".py"):
        return None
    return (
        f"the package {OTHER} {other.version} is installed over {DISTRIBUTION}, of the same "
        f"import name; pip uninstall {OTHER} {DISTRIBUTION}, then install the one you want"
    )
