"""cpunet: make simulated germanium-detector pulses look measured.

Data flow in one direction through its subpackages: ``pulses`` → ``simulation`` →
``electronics`` → ``networks`` → ``training`` → ``calibration`` → ``translation`` →
``validation`` → ``legend`` → ``cli``.  See ``docs/design.md``.

The authors of CPU-Net publish their own code as ``cpunet``; this package's distribution is
called ``cpunet-hpge`` and is also imported as ``cpunet``.  Both install into the same folder,
so an environment can contain only one of them.
"""

from __future__ import annotations

import re
import warnings
from functools import cache
from importlib import import_module
from pathlib import Path
from typing import Any

__version__ = "0.1.0"
DISTRIBUTION, OTHER = "cpunet-hpge", "cpunet"

# torch takes seconds to import: `import cpunet` and `cpunet --help` must not wait for it
_STUB = Path(__file__).with_suffix(".pyi").read_text("utf-8")
HOMES = {n: home for home, n in re.findall(r"^from (\S+) import (\w+)", _STUB, re.MULTILINE)}
__all__ = sorted(["__version__", *HOMES])


@cache
def other_package() -> str | None:
    """One-line message with a remedy if the other package is installed over this one.

    Returns
    -------
    str or None
        None if it is not installed, or in another folder.
    """
    here = Path(__file__).resolve().parent
    metadata = next(here.parent.glob(f"{OTHER}-*.dist-info"), None)
    if metadata is None:
        return None
    package = metadata.stem.replace("-", " ")  # with its version
    return (
        f"the package {package} is installed over {DISTRIBUTION}, of the same import name; "
        f"pip uninstall {OTHER} {DISTRIBUTION}, then install the one you want"
    )


def __getattr__(name: str) -> Any:
    if name not in HOMES:
        raise AttributeError(f"module 'cpunet' has no attribute {name!r}")
    if clash := other_package():
        warnings.warn(clash, stacklevel=2)
    return getattr(import_module(HOMES[name]), name)


def __dir__() -> list[str]:
    return __all__
