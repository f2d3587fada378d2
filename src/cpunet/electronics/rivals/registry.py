"""All baseline methods by name, from the simplest to the most flexible."""

from __future__ import annotations

from cpunet.electronics.rivals.base import Rival
from cpunet.electronics.rivals.gauss_exp import GaussExp
from cpunet.electronics.rivals.raw import Raw
from cpunet.electronics.rivals.rc import RC
from cpunet.electronics.rivals.superpulse import Superpulse

RIVALS: dict[str, type[Rival]] = {
    rival.name: rival for rival in (Raw, RC, GaussExp, Superpulse)
}
