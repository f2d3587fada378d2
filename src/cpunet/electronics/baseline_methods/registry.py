"""All baseline methods by name, from the simplest to the most flexible."""

from __future__ import annotations

from cpunet.electronics.baseline_methods.base import BaselineMethod
from cpunet.electronics.baseline_methods.gauss_exp import GaussExp
from cpunet.electronics.baseline_methods.raw import Raw
from cpunet.electronics.baseline_methods.rc import RC
from cpunet.electronics.baseline_methods.superpulse import Superpulse

BASELINE_METHODS: dict[str, type[BaselineMethod]] = {
    method.name: method for method in (Raw, RC, GaussExp, Superpulse)
}
