"""Translate the templates of a pulse-shape library without noise or time shifts.

A template is the charge pulse of one position in the detector.  Users of the library sum
templates weighted by energy.  Templates must therefore not be aligned or normalised, unlike in
`Translator.translate`: a readout chain acts directly on the template.
"""

from __future__ import annotations

import copy
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
import scipy.ndimage
import torch

from cpunet.errors import CpunetError
from cpunet.networks.response_generator import ResponseGenerator
from cpunet.networks.response_layer import PADDING_BEFORE
from cpunet.pulses.container import FloatArray, Pulses
from cpunet.pulses.preparation import Codes, Prepared, Rejection, prepare
from cpunet.translation.translator import BATCH, REN

EVENTS = 200  # sums in the test of linearity
SITES = 3  # templates per sum
# Number and width of the moving averages of the current amplitude.
WINDOW_NS, WINDOWS = 48.0, 3
BEFORE_NS, AFTER_NS = 1000.0, 4000.0  # around the maximum current


@dataclass(frozen=True)
class Linearity:
    """Deviation of the sum of translated templates from the translated sum.

    Parameters
    ----------
    events
        Number of compared sums of three templates.
    largest, rms
        Maximum and RMS of the deviations of all samples, in units of the highest translated
        sample.
    current_amplitude
        Largest relative deviation of the steepest step between samples.
    """

    events: int
    largest: float
    rms: float
    current_amplitude: float


class TemplateTranslator:
    """Translates templates without noise; sample k of the result is at the time of sample k.

    A readout chain responds to a template of any height.  Its poles and decays are times, so
    the sampling period can differ from that of the training.  A network accepts only prepared
    pulses of its own sampling: a template is prepared, translated, shifted back to its
    original time (99.9 % sample on 99.9 % sample, since a network learns no delay) and
    multiplied by its height.  The window is padded with 0 before it and with its last value
    after it.

    Parameters
    ----------
    ren
        Trained run.
    dt_ns
        Sampling period of the templates in ns.

    Raises
    ------
    CpunetError
        If the run has a network and the sampling is not that of its training.
    """

    def __init__(self, ren: REN, dt_ns: float) -> None:
        self.ren = ren
        self.dt_ns = dt_ns
        self.chain: ResponseGenerator | None = None
        learned = ren.recipe.generator.name == "learned"
        if ren.backend.chain is not None:
            self.chain = copy.deepcopy(ren.backend.chain)
            if learned and self.chain.response.drift is not None:
                raise CpunetError(
                    "the run's U-Net changes whole pulses, not the templates that they are "
                    "summed from; give a run of the recipe fast"
                )
            self.chain.response.dt_ns.fill_(dt_ns)
            if self.chain.response.drift is not None:
                self.chain.response.drift.keeps_begin = True  # templates are summed by time
        if (learned or self.chain is None) and not np.isclose(dt_ns, ren.dt_ns):
            raise CpunetError(
                f"templates sampled every {dt_ns:g} ns, but what the run has learned is for "
                f"{ren.dt_ns:g} ns alone; give a run of the recipe fast, or resample the "
                "library"
            )

    def __call__(self, templates: FloatArray) -> tuple[FloatArray, Codes]:
        """Translate templates.

        Parameters
        ----------
        templates
            Charge, 0 before it moves, shape (n, samples).

        Returns
        -------
        FloatArray
            Translated templates of the same shape, per unit charge for a readout chain, in
            units of prepared pulses (tail at 0.80) for a network; rejected rows are NaN.
        Codes
            A `Rejection` for each row.
        """
        results = np.zeros_like(templates, np.float32)
        codes = np.zeros(len(templates), np.uint8)
        unknown = np.isnan(templates).any(axis=1)
        results[unknown], codes[unknown] = np.nan, Rejection.NAN
        # templates without charge have no signal and nothing to align
        todo = np.flatnonzero(~unknown & templates.any(axis=1))
        act = self._through_network if self.chain is None else self._respond
        with torch.inference_mode():
            for first in range(0, len(todo), BATCH):
                rows = todo[first : first + BATCH]
                results[rows], codes[rows] = act(np.asarray(templates[rows], np.float32))
        return results, codes

    def _respond(self, templates: FloatArray) -> tuple[FloatArray, Codes]:
        assert self.chain is not None
        records = self.chain(torch.from_numpy(templates).to(self.ren.backend.device))
        inside = records[:, PADDING_BEFORE : PADDING_BEFORE + templates.shape[1]].cpu().numpy()
        lost = ~np.isfinite(inside).all(axis=1)
        inside[lost] = np.nan
        return inside, np.where(lost, Rejection.NO_AMPLITUDE, Rejection.ACCEPTED).astype(
            np.uint8
        )

    def _through_network(self, templates: FloatArray) -> tuple[FloatArray, Codes]:
        config = self.ren.recipe.preparation
        prepared = prepare(Pulses.of(templates, dt_ns=self.dt_ns), config, "simulated")
        windows = self.ren.apply(prepared.pulses.waveforms, noise=False)
        results = np.full_like(templates, np.nan)
        results[prepared.index] = _put_back(windows, prepared, config.samples_before, templates)
        return results, prepared.codes


def _put_back(
    windows: FloatArray, prepared: Prepared, samples_before: int, templates: FloatArray
) -> FloatArray:
    """Windows at the times of their templates, shape (accepted, samples)."""
    time = np.arange(templates.shape[1])
    source = time - prepared.align_sample[:, np.newaxis] + samples_before
    inside = source.clip(0, windows.shape[1] - 1)
    placed = np.take_along_axis(windows, inside, axis=1)
    return np.where(source < 0, 0, placed * prepared.scale[:, np.newaxis]).astype(np.float32)


def aligned_currents(
    charge: FloatArray, dt_ns: float
) -> tuple[FloatArray, npt.NDArray[np.float64]]:
    """Currents of pulses, averaged as for the current amplitude and aligned at their maximum.

    Parameters
    ----------
    charge
        Translated templates, shape (n, samples); rows of NaN remain NaN.
    dt_ns
        Sampling period in ns.

    Returns
    -------
    currents
        Currents in 1/ns, shape (n, samples from `BEFORE_NS` before to `AFTER_NS` after the
        maximum).
    times_ns
        Time of the maximum after the start of each template in ns; NaN for rows of NaN.
    """
    known = ~np.isnan(charge).any(axis=1)
    first = np.zeros_like(charge[:, :1])
    current = np.diff(np.nan_to_num(charge), axis=1, prepend=first) / dt_ns
    for _ in range(WINDOWS):
        size = max(1, round(WINDOW_NS / dt_ns))
        current = scipy.ndimage.uniform_filter1d(current, size, axis=1, mode="constant")
    highest = current.argmax(axis=1)
    around = np.arange(-round(BEFORE_NS / dt_ns), round(AFTER_NS / dt_ns))
    index = highest[:, np.newaxis] + around
    inside = (index >= 0) & (index < charge.shape[1])
    taken = np.take_along_axis(current, index.clip(0, charge.shape[1] - 1), axis=1)
    taken = np.where(inside, taken, 0).astype(np.float32)
    taken[~known] = np.nan
    return taken, np.where(known, highest * dt_ns, np.nan)


def linearity(translate: TemplateTranslator, templates: FloatArray) -> Linearity:
    """Compare sums of translated templates with translated sums.

    Parameters
    ----------
    translate
        Translator to test.
    templates
        Translatable templates, shape (n, samples); sums of three with random weights are
        compared.

    Raises
    ------
    CpunetError
        If none of the sums can be translated.
    """
    rng = np.random.default_rng(0)
    sites = rng.integers(len(templates), size=(EVENTS, SITES))
    weights = rng.dirichlet(np.ones(SITES), EVENTS).astype(np.float32)
    alone, alone_codes = translate(templates)
    summed, codes = translate(_sums(weights, templates[sites]))
    valid = (codes == Rejection.ACCEPTED) & (alone_codes[sites] == Rejection.ACCEPTED).all(1)
    if not valid.any():
        raise CpunetError("no sum of templates can be translated; are they charge pulses?")
    expected, found = _sums(weights, alone[sites])[valid], summed[valid]
    apart = (expected - found) / np.abs(found).max()
    steepest = [np.diff(set_, axis=1).max(axis=1) for set_ in (expected, found)]
    return Linearity(
        events=int(valid.sum()),
        largest=float(np.abs(apart).max()),
        rms=float(np.sqrt(np.mean(apart.astype(float) ** 2))),
        current_amplitude=float(np.abs(steepest[0] / steepest[1] - 1).max()),
    )


def _sums(weights: FloatArray, of_sites: FloatArray) -> npt.NDArray[np.float32]:
    """Weighted sums (events, samples) over sites of (events, sites, samples)."""
    return np.asarray(np.einsum("es,est->et", weights, of_sites), np.float32)
