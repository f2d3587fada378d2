"""Scores in plain words: agrees with the data within errors, or off by N sigma.

A score is compared with its expectation for two samples of one distribution: the IoU with
its ceiling, the Wasserstein distance and the classifier's AUC with their nulls, the A/E
survival and the baseline noise with those of the data.  The question is whether chance
alone explains a score, so deviations are measured in units of the spread of the *null*.
The spread of the score itself under resampling tells how well the score is known; that of
a poor translation would make it appear closer to the ceiling than it is.

IoU, Wasserstein distance and AUC are worse than chance on one side only.  A score on the
other side, such as an IoU above its ceiling, agrees.  Up to `AGREES` sigma is agreement.
A perfect translation exceeds it in 2 … 5 % of IoU, 4 … 7 % of Wasserstein distances (which
scatter with an upward tail) and 8 % of parameters in either, so of twenty parameters one or
two are off by chance.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Literal

from cpunet.plotting import label
from cpunet.pulses.parameters import PARAMETERS

AGREES = 2.0  # sigma
TOO_CLOSE = 4.0  # sigma on the good side: not by chance, but the same events on both sides
WITHIN = "agrees within errors"

Worse = Literal["lower", "higher", "both"]
Words = dict[str, float | str | None]
Metrics = Mapping[str, Any]  # content of ``metrics.json``

_SHORT = {"ren": "REN", "iren": "IREN"}
_W1, _SPECTRUM = "_wasserstein", "_spectrum"
_SECOND = (_W1, _SPECTRUM)  # suffixes of verdicts that are combined with the quantity's
_AUC, _SURVIVAL, _NOISE = "auc", "ae_survival", "noise"


@dataclass(frozen=True)
class Verdict:
    """Whether a score agrees with its expectation by chance, and its deviation.

    Attributes
    ----------
    sigma
        Deviation from the expectation in units of its spread, positive if worse than
        expected (if both sides are worse: score minus expectation); None if undefined.
    agrees
        Whether the score agrees; None if there is no value.
    words
        Verdict in words: ``agrees within errors``, ``off by 3.1 sigma``, or the reason why
        there is no verdict.
    numbers
        The score and its expectation, as quoted.
    """

    sigma: float | None
    agrees: bool | None
    words: str
    numbers: str = ""

    @property
    def severity(self) -> float:
        """Deviation of a score that is off; infinite if it is unknown by how much."""
        if self.agrees:
            return 0.0
        return math.inf if self.sigma is None else abs(self.sigma)


def verdict(
    value: float | None,
    expected: float | None,
    spread: float | None,
    worse: Worse,
    numbers: str = "",
    reason: object = None,
) -> Verdict:
    r"""Verdict on one score.

    .. math:: z = \pm (v - \langle v \rangle_0) / \sigma_0

    with the mean and the standard deviation of the score :math:`v` for two samples of one
    distribution, and the sign such that :math:`z > 0` is worse than expected.

    Parameters
    ----------
    value
        Score.
    expected, spread
        Mean and standard deviation of the score for two samples of one distribution, for
        example the ceiling of an IoU.
    worse
        Side that is worse than chance: ``"lower"`` (IoU), ``"higher"`` (a distance, an
        AUC) or ``"both"`` (a difference).
    numbers
        How to quote ``value`` and ``expected``, in Python's format.
    reason
        Why there is no verdict, if known.

    Examples
    --------
    >>> verdict(83.1, 85.9, 0.9, "lower").words
    'off by 3.1 sigma'
    >>> verdict(86.5, 85.9, 0.9, "lower").words
    'agrees within errors'
    >>> verdict(None, 85.9, 0.9, "lower").words
    'no value'
    """
    if value is None or expected is None or spread is None:
        words = "no value" if value is None else "nothing to compare with"
        return Verdict(None, None, str(reason or words))
    quoted = numbers.format(value=value, expected=expected)
    apart = (expected - value) if worse == "lower" else (value - expected)
    off = abs(apart) if worse == "both" else apart
    if spread <= 0:
        # for example all events in one bin: chance gives exactly one value
        if off <= 1e-9 * max(abs(expected), 1.0):
            return Verdict(0.0, True, WITHIN, quoted)
        return Verdict(None, False, "off", quoted)
    sigma = apart / spread
    if off / spread > AGREES:
        return Verdict(sigma, False, f"off by {abs(sigma):.1f} sigma", quoted)
    if worse != "both" and sigma < -TOO_CLOSE:
        words = f"closer than chance by {-sigma:.1f} sigma: are the same events on both sides?"
        return Verdict(sigma, True, words, quoted)
    return Verdict(sigma, True, WITHIN, quoted)


def method_verdicts(metrics: Metrics, peak: str, method: str) -> dict[str, Verdict]:
    """Verdicts on one method at one peak, by quantity.

    Parameters
    ----------
    metrics
        Content of ``metrics.json``.
    peak, method
        Names of the peak and of the method.

    Returns
    -------
    dict
        For each parameter, under its name, its IoU against the ceiling and, with the suffix
        ``_wasserstein``, its distance against the null.  ``auc``: the classifier against
        its null.  ``ae_survival``: the difference from the data, for peaks other than that
        which defines the cut.  ``noise``: its RMS against that of the data;
        ``noise_spectrum``: the worst frequency band.
    """
    found: dict[str, Verdict] = {}
    scores = part(metrics, "peaks", peak)
    for name, one in part(scores, "parameters").items():
        found[name] = verdict(
            number(one, "iou", method),
            number(one, "iou", "ceiling"),
            number(one, "iou_std", "ceiling"),
            "lower",
            "IoU {value:.1f} of {expected:.1f}",
        )
        unit = f" {PARAMETERS[name].unit}" if name in PARAMETERS else ""
        found[name + _W1] = verdict(
            number(one, "wasserstein", method),
            number(one, "wasserstein_null"),
            number(one, "wasserstein_null_std"),
            "higher",
            f"W₁ {{value:.3g}}{unit}, by chance {{expected:.3g}}{unit}",
        )
    if tested := part(scores, "two_sample", method):
        auc, mean, std = (number(tested, key) for key in ("auc", "null_mean", "null_std"))
        numbers = "AUC {value:.2f}, by chance {expected:.2f}"
        found[_AUC] = verdict(auc, mean, std, "higher", numbers, tested.get("missing"))
    survival = part(metrics, "ae_survival", peak)
    if "difference" in survival:
        off, std = (number(survival, k, method) for k in ("difference", "difference_std"))
        reason = "too few events of the double-escape peak, or none of this one"
        found[_SURVIVAL] = verdict(off, 0.0, std, "both", "{value:+.1f} points", reason)
    own, data = part(scores, "noise", method), part(scores, "noise", "data")
    if own:
        errors = number(own, "rms_std"), number(data, "rms_std")
        spread = None if None in errors else math.hypot(*filter(None, errors))
        ratio = number(own, "rms_ratio")
        size = "" if ratio is None else f"RMS {ratio:.2f} of the data's"
        reason = own.get("missing", data.get("missing"))
        rms = number(own, "rms"), number(data, "rms")
        found[_NOISE] = verdict(*rms, spread, "both", size, reason)
        if (worst := number(own, "spectrum_sigma")) is not None:
            band = "; ".join(filter(None, ("worst band of its spectrum", size)))
            found[_NOISE + _SPECTRUM] = verdict(worst, 0.0, 1.0, "higher", band)
    return found


def verdict_table(metrics: Metrics) -> dict[str, dict[str, dict[str, Words]]]:
    """Verdicts on all methods, ready for JSON.

    Parameters
    ----------
    metrics
        Content of ``metrics.json``.

    Returns
    -------
    dict
        ``{"sigma": …, "words": …}`` by peak, method and quantity, see `method_verdicts`.
        A peak that is not scored has no methods.
    """
    return {
        peak: {
            method: {
                quantity: {"sigma": v.sigma, "words": v.words}
                for quantity, v in method_verdicts(metrics, peak, method).items()
            }
            for method in methods_of(metrics, peak)
        }
        for peak in part(metrics, "peaks")
    }


def summary(metrics: Metrics, peak: str, method: str) -> str:
    """Return one line with the quantities that agree with the data and those that are off.

    A parameter is off if its IoU or its Wasserstein distance is; the noise is off if its RMS
    or its spectrum is.  The larger deviation is quoted.

    Returns
    -------
    str
        For instance ``REN, SEP: current amplitude and tail slope agree with the data
        within errors; drift time off by 3.1 sigma (IoU 83.1 of 85.9)``.
    """
    verdicts = method_verdicts(metrics, peak, method)
    agreeing: list[str] = []
    off: list[tuple[float, str]] = []
    silent: list[str] = []
    for name in [n for n in verdicts if not n.endswith(_SECOND)]:
        both = (name, *(name + ending for ending in _SECOND))
        pair = {n: verdicts[n] for n in both if n in verdicts}
        known = {n: v for n, v in pair.items() if v.agrees is not None}
        if not known:
            silent.append(f"{_called(name)} not judged ({pair[name].words})")
        elif all(v.agrees for v in known.values()):
            agreeing.append(_called(name))
        else:
            worst = max(known.values(), key=lambda v: v.severity)
            quoted = f" ({worst.numbers})" if worst.numbers else ""
            off.append((worst.severity, f"{_called(name)} {worst.words}{quoted}"))
    parts = []
    if agreeing:
        *first, last = agreeing
        names = f"{', '.join(first)} and {last}" if first else last
        parts = [f"{names} {'agree' if first else 'agrees'} with the data within errors"]
    parts += [text for _, text in sorted(off, key=lambda pair: -pair[0])]
    head = f"{_SHORT.get(method, label(method))}, {peak}"
    return f"{head}: {'; '.join(parts + silent) or 'not scored'}"


def methods_of(metrics: Metrics, peak: str) -> list[str]:
    """Methods in the scores of a peak, in their order there."""
    scores = part(metrics, "peaks", peak)
    names = [
        *(m for p in part(scores, "parameters") for m in part(scores, "parameters", p, "iou")),
        *part(scores, "two_sample"),
    ]
    return [m for m in dict.fromkeys(names) if m != "ceiling"]


def part(metrics: Any, *keys: str) -> Mapping[str, Any]:
    """The mapping at `keys` of nested mappings; empty if there is none."""
    for key in keys:
        metrics = metrics.get(key) if isinstance(metrics, Mapping) else None
    return metrics if isinstance(metrics, Mapping) else {}


def number(metrics: Any, *keys: str) -> float | None:
    """The finite number at `keys` of nested mappings; None if there is none."""
    value = part(metrics, *keys[:-1]).get(keys[-1])
    if isinstance(value, bool) or not isinstance(value, (int, float)):
        return None
    return float(value) if math.isfinite(value) else None


def _called(quantity: str) -> str:
    named = {_AUC: "classifier", _SURVIVAL: "A/E survival"}
    return named.get(quantity, quantity.replace("_", " "))


def judged_scores(metrics: Metrics, method: str) -> tuple[int, int]:
    """Number of scores of a method that are off, and number of scores with a verdict."""
    judged = [
        found.agrees
        for peak in part(metrics, "peaks")
        for found in method_verdicts(metrics, peak, method).values()
        if found.agrees is not None
    ]
    return judged.count(False), len(judged)
