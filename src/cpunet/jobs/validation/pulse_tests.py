"""Tests of a validation beyond distributions: the classifier test and the A/E survival."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict
from typing import Any

from cpunet.errors import CpunetError
from cpunet.pulses.container import Pulses
from cpunet.pulses.parameters import Values
from cpunet.validation.a_over_e import survival_table
from cpunet.validation.two_sample import classifier_auc

TESTED = 1000  # pulses per side: resolves an AUC to 0.013

ByMethod = Mapping[str, Mapping[str, Values]]


def told_apart(pulses: Mapping[str, Pulses], values: ByMethod, seed: int) -> dict[str, Any]:
    """Classifier test between each method and the data, for one peak.

    Parameters
    ----------
    pulses
        Prepared pulses with noise by method, including ``"data"``.
    values
        Pulse-shape parameters of the pulses.
    seed
        Seed of the folds.

    Returns
    -------
    dict
        Fields of `cpunet.validation.two_sample.TwoSample` by method, or ``missing`` with the
        reason.
    """
    tested: dict[str, Any] = {}
    data = pulses["data"].waveforms
    for method, others in pulses.items():
        if method == "data":
            continue
        try:
            result = classifier_auc(
                data,
                others.waveforms,
                seed=seed,
                features=(values["data"], values[method]),
                largest=TESTED,
            )
        except CpunetError as error:
            tested[method] = {"missing": str(error)}
        else:
            tested[method] = asdict(result)
    return tested


def survivals(values: Mapping[str, ByMethod], seed: int) -> dict[str, Any]:
    """A/E survival of all peaks and methods after cuts at 90 % of the DEP.

    Parameters
    ----------
    values
        Parameters by peak and method, including ``"data"``; empty for peaks that are not
        scored.
    seed
        Seed of the bootstraps for the errors.

    Returns
    -------
    dict
        Result of `cpunet.validation.a_over_e.survival_table`, or ``missing`` with the reason.
    """
    amplitudes = {
        peak: {method: v["current_amplitude"] for method, v in by_method.items()}
        for peak, by_method in values.items()
        if by_method
    }
    methods = set.intersection(*(set(found) for found in amplitudes.values()))
    by_method = {
        method: {peak: found[method] for peak, found in amplitudes.items()}
        for method in next(iter(amplitudes.values()))
        if method in methods
    }
    try:
        return dict(survival_table(by_method.pop("data"), by_method, seed=seed))
    except CpunetError as error:
        return {"missing": str(error)}
