"""Do translated pulses agree with the data?  A p-value for each quantity, and words.

Each p-value is the probability that two samples of one distribution differ by more.  It
contains the sampling of both sides and, of a REN with a covariance, the errors of the fit; that
of the classifier contains the sampling alone.  What is less likely than `ALARM`, three standard
deviations, is off.  ``benchmarks/p_values.py`` shows that p is uniform where nothing is wrong.

An agreement says no more than its sensitivity: the difference is quoted with its error.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from scipy.stats import norm
from scipy.stats import t as student

from cpunet.plotting import label
from cpunet.pulses.parameters import PARAMETERS
from cpunet.pulses.shape_parameters import A_OVER_E, LABELLED
from cpunet.pulses.two_sample import SHUFFLES
from cpunet.tables import NO_VALUE, with_std

ALARM = 2.7e-3  # p of three standard deviations
SAME = 3e-5  # 1 - p of samples that agree too well
SMALLEST = 1e-12  # p that is stated
NAMED = 3  # quantities that a headline names

Words = dict[str, float | str | None]
Metrics = Mapping[str, Any]  # content of ``metrics.json``

# Quantities of the main table, those of LEGEND; the first needs the double-escape peak.
MAIN = (A_OVER_E, "rise_time", "tail_slope", "lq")
RIVALS = ("rc", "rc_late")

_SHORT = {"ren": "REN", "iren": "IREN"}
_AUC, _SURVIVAL, _NOISE, _SPECTRUM = "auc", "ae_survival", "noise", "noise_spectrum"
QUANTITIES = {
    A_OVER_E: "A/E",
    "current_amplitude": "A",
    "rise_time": "T(10–90 %)",
    "tail_slope": "tail slope",
    "lq": "LQ",
    _AUC: "classifier AUC",
    _SURVIVAL: "A/E survival",
}


@dataclass(frozen=True)
class Verdict:
    """Whether a quantity agrees with the data.

    Attributes
    ----------
    p
        Probability of a larger difference if both are of one distribution; None if unknown.
    numbers
        Difference and its error, as quoted.
    reason
        Why there is no verdict.
    """

    p: float | None
    numbers: str = ""
    reason: str = ""

    @property
    def sigma(self) -> float | None:
        """Standard deviations of a two-sided difference as unlikely."""
        return None if self.p is None else float(norm.isf(max(self.p, 1e-300) / 2))

    @property
    def agrees(self) -> bool | None:
        """Whether the difference may be statistical; None without a verdict."""
        return None if self.p is None else self.p >= ALARM

    @property
    def words(self) -> str:
        """The verdict, such as ``off by 3.4 sigma``."""
        if self.p is None or self.sigma is None:
            return self.reason
        if not self.agrees:
            return f"off by {self.sigma:.1f} sigma"
        if 1 - self.p < SAME:
            return "closer than statistics permit: are the same events on both sides?"
        return "agrees"

    def __str__(self) -> str:
        if self.p is None:
            return f"not judged ({self.reason})"
        return f"{self.numbers}, {_p(self.p)}" if self.numbers else _p(self.p)


def two_sided(value: float | None, error: float | None) -> float | None:
    """P of a difference of 0 with a normal error; None if either is unknown or without error.

    Examples
    --------
    >>> round(two_sided(-9.5, 5.0), 3)
    0.057
    """
    if value is None or not error:
        return None
    return float(2 * norm.sf(abs(value) / error))


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
        For each parameter, under its name, chi-square of its distribution.  ``auc``: the
        classifier against shuffled labels.  ``ae_survival``: the difference from the data,
        for peaks other than that which defines the cut.  ``noise``: its RMS against that of
        the data; ``noise_spectrum``: the worst frequency band.
    """
    judgements: dict[str, Verdict] = {}
    scores = part(metrics, "peaks", peak)
    for name, score_of in judged_parameters(scores).items():
        p = number(score_of, "p", method)
        judgements[name] = Verdict(p, shifted(name, score_of, method), "too few pulses")
    if tested := part(scores, "two_sample", method):
        auc, mean, std = (number(tested, key) for key in ("auc", "null_mean", "null_std"))
        p = None
        if auc is not None and mean is not None and std:
            distance = (auc - mean) / (std * math.sqrt(1 + 1 / SHUFFLES))
            p = float(student.sf(distance, SHUFFLES - 1))
        numbers = f"AUC {with_std(auc, std)}, {number_text(mean)} expected"
        judgements[_AUC] = Verdict(p, numbers, tested.get("missing", "no value"))
    survival = part(metrics, "ae_survival", peak)
    if "difference" in survival:
        off, std = (number(survival, k, method) for k in ("difference", "difference_std"))
        reason = "too few events of the double-escape peak, or none of this one"
        numbers = f"{signed(off, std)} points" if std else ""
        judgements[_SURVIVAL] = Verdict(two_sided(off, std), numbers, reason)
    own, data = part(scores, "noise", method), part(scores, "noise", "data")
    if own:
        errors = number(own, "rms_std"), number(data, "rms_std")
        rms = number(own, "rms"), number(data, "rms")
        reason = own.get("missing", data.get("missing", "no noise"))
        p, size = None, ""
        if None not in (*errors, *rms) and rms[1]:
            spread = math.hypot(*filter(None, errors))
            p = two_sided((rms[0] or 0.0) - rms[1], spread)
            size = f"RMS {with_std((rms[0] or 0.0) / rms[1], spread / rms[1])} of the data's"
        judgements[_NOISE] = Verdict(p, size, reason)
        if (worst := number(own, "spectrum_sigma")) is not None:
            numbers = "worst band of the spectrum"
            judgements[_SPECTRUM] = Verdict(float(norm.sf(worst)), numbers)
    return judgements


def judged_parameters(scores: Mapping[str, Any]) -> dict[str, Mapping[str, Any]]:
    """Comparisons of the paper's parameters, and of those of LEGEND that the table has."""
    available = {**part(scores, "parameters"), **part(scores, "further")}
    return {name: available[name] for name in (*PARAMETERS, *MAIN) if name in available}


def held_out(metrics: Metrics) -> list[str]:
    """Scored peaks that took no part in the training; all scored ones if there are none."""
    peaks = part(metrics, "peaks")
    scored = [peak for peak, score_of in peaks.items() if part(score_of, "parameters")]
    trained = str(part(metrics, "training").get("peak")).split(",")
    return [peak for peak in scored if peak not in trained] or scored


def headline(metrics: Metrics, method: str = "ren") -> tuple[bool, str]:
    """Whether nothing is off at peaks that were not trained on, and that in a sentence."""
    peaks, name = held_out(metrics), _SHORT.get(method, label(method))
    judged = sorted(
        (v.p, f"{peak} {called(quantity)}")
        for peak in peaks
        for quantity, v in method_verdicts(metrics, peak, method).items()
        if v.p is not None
    )
    if not judged:
        return False, f"{name}: not judged"
    of, off = f"quantities of {' and '.join(peaks)}", sum(p < ALARM for p, _ in judged)
    named = judged[: min(max(off, 1), NAMED)]
    first = ", ".join(f"{quantity} ({_p(p)})" for p, quantity in named)
    if not off:
        agreed = f"{name} agrees with the data in all {len(judged)} {of}"
        return True, f"{agreed}; the least likely is {first}"
    more = " and others" if off > NAMED else ""
    return False, f"{name} is off in {off} of {len(judged)} {of}: {first}{more}"


def main_table(metrics: Metrics, peaks: Sequence[str]) -> tuple[list[str], list[list[str]]]:
    """Differences from the data with errors and p, by peak and quantity.

    Returns
    -------
    head, rows
        Peak, quantity, the data, the REN with its p, and rivals; overlap with the data.
    """
    rivals = [m for m in RIVALS if any(m in methods_of(metrics, peak) for peak in peaks)]
    head = ["Peak", "Quantity", "Data", "REN − data", "p"]
    head += [f"{label(m)} − data" for m in rivals] + ["IoU: REN [%]", "data vs data"]
    rows = []
    for peak in peaks:
        scores = part(metrics, "peaks", peak)
        judged, verdicts = judged_parameters(scores), method_verdicts(metrics, peak, "ren")
        first = A_OVER_E if A_OVER_E in judged else "current_amplitude"
        for name in (first, *MAIN[1:], _AUC, _SURVIVAL):
            if name not in verdicts or (p := verdicts[name].p) is None:
                continue
            unit = "%" if name == _SURVIVAL else LABELLED[name].unit if name in judged else ""
            own, score_of = QUANTITIES[name], judged.get(name, {})
            overlap = [
                with_std(*(number(score_of, key, m) for key in ("iou", "iou_std")))
                for m in ("ren", "ceiling")
            ]
            rows.append([
                *(peak, f"{own} [{unit}]" if unit else own),
                _of_data(metrics, peak, name, score_of),
                signed(*_difference(metrics, peak, name, "ren")),
                f"{p:.2g}" if p > SMALLEST else f"< {SMALLEST:g}",
                *(signed(*_difference(metrics, peak, name, m)) for m in rivals),
                *overlap,
            ])  # fmt: skip
    return head, rows


def _difference(
    metrics: Metrics, peak: str, name: str, method: str
) -> tuple[float | None, float | None]:
    """A quantity of a method minus that of the data, and its error."""
    scores = part(metrics, "peaks", peak)
    if name == _SURVIVAL:
        row = part(metrics, "ae_survival", peak)
        return number(row, "difference", method), number(row, "difference_std", method)
    if name == _AUC:
        judgements = part(scores, "two_sample", method)
        auc, null = number(judgements, "auc"), number(judgements, "null_mean")
        available = None if auc is None or null is None else auc - null
        return available, None if available is None else number(judgements, "null_std")
    score_of = judged_parameters(scores).get(name, {})
    return number(score_of, "shift", method), number(score_of, "shift_std", method)


def _of_data(metrics: Metrics, peak: str, name: str, score_of: Mapping[str, Any]) -> str:
    """What the data have: mean of a parameter, AUC of shuffled labels, survival."""
    if name == _AUC:
        null = part(metrics, "peaks", peak, "two_sample", "ren")
        return with_std(number(null, "null_mean"), number(null, "null_std"))
    if name == _SURVIVAL:
        row = part(metrics, "ae_survival", peak)
        return with_std(*(number(row, key, "data") for key in ("survival", "survival_std")))
    return number_text(number(score_of, "mean"), "#.4g")


def shifted(name: str, compared: Mapping[str, Any], method: str) -> str:
    """Mean of a parameter minus that of the data, with its error and unit."""
    shift, error = number(compared, "shift", method), number(compared, "shift_std", method)
    if shift is None or error is None:
        return ""
    unit, mean = LABELLED[name].unit, number(compared, "mean")
    if name == "current_amplitude" and mean:
        shift, error, unit = 100 * shift / mean, 100 * error / mean, "%"
    return f"{signed(shift, error)} {unit}".rstrip()


def signed(value: float | None, error: float | None) -> str:
    """A difference with its sign and error."""
    text = with_std(value, error)
    return text if value is None or text.startswith("-") else f"+{text}"


def number_text(value: float | None, digits: str = ".2f") -> str:
    """A number in a format; a dash for none."""
    return NO_VALUE if value is None else f"{value:{digits}}"


def verdict_table(metrics: Metrics) -> dict[str, dict[str, dict[str, Words]]]:
    """Verdicts on all methods, ready for JSON.

    Parameters
    ----------
    metrics
        Content of ``metrics.json``.

    Returns
    -------
    dict
        ``{"p": …, "sigma": …, "numbers": …, "words": …}`` by peak, method and quantity, see
        `method_verdicts`.  A peak that is not scored has no methods.
    """
    return {
        peak: {
            method: {
                quantity: {"p": v.p, "sigma": v.sigma, "numbers": v.numbers, "words": v.words}
                for quantity, v in method_verdicts(metrics, peak, method).items()
            }
            for method in methods_of(metrics, peak)
        }
        for peak in part(metrics, "peaks")
    }


def summary(metrics: Metrics, peak: str, method: str) -> str:
    """One line: what is off, the least likely first, and with what p the others agree.

    Returns
    -------
    str
        For instance ``REN, SEP: drift time off by 3.1 sigma (+12 ± 3 ns, p = 0.002); current
        amplitude agrees (+0.02 ± 0.11 %, p = 0.4)``.
    """
    verdicts = method_verdicts(metrics, peak, method)
    off = sorted(
        (v.p, name) for name, v in verdicts.items() if v.p is not None and not v.agrees
    )
    parts = [f"{called(name)} {verdicts[name].words} ({verdicts[name]})" for _, name in off]
    same = [f"{called(n)} ({v})" for n, v in verdicts.items() if v.words == "agrees"]
    parts += [f"agreement in {', '.join(same)}"] if same else []
    parts += [
        f"{called(name)} {v.words if v.agrees else v}"
        for name, v in verdicts.items()
        if v.p is None or (v.agrees and v.words != "agrees")
    ]
    head = f"{_SHORT.get(method, label(method))}, {peak}"
    return f"{head}: {'; '.join(parts) or 'not scored'}"


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


def called(quantity: str) -> str:
    """Name of a quantity in a sentence."""
    named = QUANTITIES | {_AUC: "classifier", "current_amplitude": "current amplitude"}
    return named.get(quantity, quantity.replace("_", " "))


def _p(value: float) -> str:
    return f"p = {value:.2g}" if value > SMALLEST else f"p < {SMALLEST:g}"


def judged_scores(metrics: Metrics, method: str) -> tuple[int, int]:
    """Number of scores of a method that are off, and number of scores with a verdict."""
    judged = [
        judgements.agrees
        for peak in part(metrics, "peaks")
        for judgements in method_verdicts(metrics, peak, method).values()
        if judgements.agrees is not None
    ]
    return judged.count(False), len(judged)
