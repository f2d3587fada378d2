"""Translate the templates of a pulse-shape library without noise or time shifts.

A template is the charge pulse of one position in the detector.  Users of the library sum
templates weighted by energy.  Templates must therefore not be aligned or normalised, unlike in
`Translator.translate`: a readout chain acts directly on the template.
"""

from __future__ import annotations

import copy

import numpy as np
import torch

from cpunet.errors import CpunetError
from cpunet.networks.response_layer import PADDING_BEFORE
from cpunet.pulses.container import FloatArray
from cpunet.translation.translator import BATCH, REN


class TemplateTranslator:
    """Translates templates without noise; sample k of the result is at the time of sample k.

    A readout chain responds to a template of any height.  Its poles and decays are times, so
    the sampling period can differ from that of the training.

    Parameters
    ----------
    ren
        Trained run.
    dt_ns
        Sampling period of the templates in ns.

    Raises
    ------
    CpunetError
        If the run has a network, which translates prepared pulses alone.
    """

    def __init__(self, ren: REN, dt_ns: float) -> None:
        if ren.backend.chain is None or ren.recipe.generator.name == "learned":
            raise CpunetError(
                "the run's network translates whole pulses, not the templates that they are "
                "summed from; give a run of the recipe fast"
            )
        self._device = ren.backend.device
        self._chain = copy.deepcopy(ren.backend.chain)
        self._chain.response.dt_ns.fill_(dt_ns)
        if self._chain.response.drift is not None:
            self._chain.response.drift.keeps_begin = True  # templates are summed by time

    def __call__(self, templates: FloatArray) -> FloatArray:
        """Translate templates of charge, 0 before it moves, shape (n, samples)."""
        results = np.empty(templates.shape, np.float32)
        inside = slice(PADDING_BEFORE, PADDING_BEFORE + templates.shape[1])
        with torch.inference_mode():
            for first in range(0, len(templates), BATCH):
                rows = slice(first, first + BATCH)
                charge = torch.from_numpy(np.ascontiguousarray(templates[rows], np.float32))
                records = self._chain(charge.to(self._device))
                results[rows] = records[:, inside].cpu().numpy()
        return results
