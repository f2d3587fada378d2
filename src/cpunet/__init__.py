"""cpunet: make simulated germanium-detector pulses look measured.

Data flow in one direction through its subpackages:
``pulses`` (containers, files, preparation) → ``networks`` → ``training`` →
``translation`` → ``analysis`` → ``jobs`` → ``cli``.  See ``docs/design.md``.
"""

from __future__ import annotations

import warnings
from typing import TYPE_CHECKING, Any

from cpunet.installation import other_package

__version__ = "0.1.0"
__all__ = ["IREN", "REN", "Pulses", "__version__", "open_pulses"]

if TYPE_CHECKING:
    from cpunet.pulses.container import Pulses
    from cpunet.pulses.reading import open_pulses
    from cpunet.translation.translator import IREN, REN


def __getattr__(name: str) -> Any:
    if name in __all__ and (clash := other_package()):
        warnings.warn(clash, stacklevel=2)
    # torch takes seconds to import; `import cpunet` and `cpunet --help` do not need it
    if name in ("REN", "IREN"):
        from cpunet.translation import translator

        return getattr(translator, name)
    if name == "Pulses":
        from cpunet.pulses.container import Pulses

        return Pulses
    if name == "open_pulses":
        from cpunet.pulses.reading import open_pulses

        return open_pulses
    raise AttributeError(f"module 'cpunet' has no attribute {name!r}")
