"""The content of ``metrics.json``, and what it says: do translated pulses agree with the data?

There is a p-value for each quantity, and words.  Each p-value is the probability that two
samples of one distribution differ by more.  It contains the sampling of both sides and, of a
REN with a covariance, the errors of the fit.  What is less likely than `ALARM`, three standard
deviations, is off.
``benchmarks/p_values.py`` shows that p is uniform where nothing is wrong.

An agreement says no more than its sensitivity: the difference is quoted with its error.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from pydantic import Field
from scipy.special import ndtr, ndtri, stdtr

from cpunet.plotting import label
from cpunet.pulses.parameters import PARAMETERS
from cpunet.pulses.shape_parameters import A_OVER_E, LABELLED
from cpunet.pulses.two_sample import SHUFFLES, TwoSample
from cpunet.tables import NO_VALUE, number, with_std
from cpunet.validation.a_over_e import RangeSurvival, SurvivalRow
from cpunet.validation.ae_energy import AgainstEnergy
from cpunet.validation.comparisons import Compared, Missing, Number, Result
from cpunet.validation.noise import Spectrum

ALARM = 2.7e-3  # p of three standard deviations
SAME = 3e-5  # 1 - p of samples that agree too well
SMALLEST = 1e-12  # p that is stated
LEAST_AUC = 1e-3  # and most: beyond, quantiles diverge
QUANTILE_SLOPE = math.sqrt(2 * math.pi)  # of the normal quantile at one half
NAMED = 3  # quantities that a headline names
WRITTEN = ("p", "sigma", "numbers", "words")  # of a verdict

# Quantities of the main table, those of LEGEND; the first needs the double-escape peak.
MAIN = (A_OVER_E, "rise_time", "tail_slope", "lq")
RIVALS = ("rc", "rc_late")

SURVIVAL, _AUC, _NOISE, _SPECTRUM = "ae_survival", "auc", "noise", "noise_spectrum"
QUANTITIES = {
    A_OVER_E: "A/E",
    "current_amplitude": "A",
    "rise_time": "T(10–90 %)",
    "tail_slope": "tail slope",
    "lq": "LQ",
    _AUC: "classifier AUC",
    SURVIVAL: "A/E survival",
}
_CALLED = QUANTITIES | {_AUC: "classifier", "current_amplitude": "current amplitude"}


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
    difference
        Difference from the data and its error, where the main table has them.
    of_data
        What the data have there.
    """

    p: float | None
    numbers: str = ""
    reason: str = ""
    difference: tuple[float | None, float | None] = (None, None)
    of_data: str = NO_VALUE

    @property
    def sigma(self) -> float | None:
        """Standard deviations of a two-sided difference as unlikely."""
        return None if self.p is None else float(-ndtri(max(self.p, 1e-300) / 2))

    @property
    def agrees(self) -> bool | None:
        """Whether the difference may be statistical; None without a verdict."""
        return None if self.p is None else self.p >= ALARM

    @property
    def words(self) -> str:
        """The verdict, such as ``off by 3.4 sigma``."""
        if self.p is None:
            return self.reason
        if not self.agrees:
            return f"off by {self.sigma:.1f} sigma"
        if 1 - self.p < SAME:
            return "closer than statistics permit: are the same events on both sides?"
        return "agrees"

    def __str__(self) -> str:
        if self.p is None:
            return f"not judged ({self.reason})"
        return ", ".join(filter(None, (self.numbers, _p(self.p))))


class PairedScores(Result):
    """RMS differences of pulse pairs in units of the full charge, and pairs left out.

    An RMS difference is None if no pair is left; a pair is left out because one of the two does
    not cross half of its maximum.
    """

    rmse: Number = None
    edge_rmse: Number = None
    unaligned: int = 0


class PeakScores(Result):
    """Scores of a peak.

    Attributes
    ----------
    n_sim, n_data
        Numbers of pulses.
    not_prepared
        Number of translated pulses that cannot be prepared like data, by method.
    parameters, further
        Comparison of each parameter, of `PARAMETERS` and of all others.
    two_sample
        Classifier test between each method and the data.
    noise
        Noise before the pulse by method.
    paired
        Paired scores by method; none if the truth is unknown.
    missing
        Reason why the peak is not scored.
    """

    n_sim: int | None = None
    n_data: int | None = None
    not_prepared: dict[str, int] = Field(default_factory=dict)
    parameters: dict[str, Compared] = Field(default_factory=dict)
    further: dict[str, Compared] = Field(default_factory=dict)
    two_sample: dict[str, TwoSample | Missing] = Field(default_factory=dict)
    noise: dict[str, Spectrum] = Field(default_factory=dict)
    paired: dict[str, PairedScores] = Field(default_factory=dict)
    missing: str | None = None

    @property
    def judged(self) -> dict[str, Compared]:
        """Comparisons of the paper's parameters, and of those of LEGEND that the table has."""
        available = self.parameters | self.further
        return {name: available[name] for name in (*PARAMETERS, *MAIN) if name in available}

    @property
    def methods(self) -> list[str]:
        """Methods with scores, in their order there."""
        names = [*(m for compared in self.parameters.values() for m in compared.iou)]
        return [m for m in dict.fromkeys([*names, *self.two_sample]) if m != "ceiling"]


class Metrics(Result):
    """The content of ``metrics.json``; numbers that do not exist are None.

    Attributes
    ----------
    peaks
        Scores by peak.
    compared, training, rejections
        What was compared, the training, and rejected pulses by side and reason.
    ae_survival, ae_details
        Survival of the A/E cut by peak, and of lines without their background and continua.
    ae_energy
        A/E against energy.
    a_over_e_scale
        A/E of the double-escape peak and its error, by method.
    baseline_methods
        Parameters of the fitted methods, and why others are missing.
    tails
        Pile-up tails of the training.
    """

    peaks: dict[str, PeakScores]
    compared: dict[str, str] = Field(default_factory=dict)
    training: dict[str, Any] = Field(default_factory=dict)
    rejections: dict[str, dict[str, int]] = Field(default_factory=dict)
    ae_survival: dict[str, SurvivalRow] | Missing = Field(default_factory=dict)
    ae_details: dict[str, dict[str, dict[str, RangeSurvival]] | Missing] = Field(
        default_factory=dict
    )
    ae_energy: AgainstEnergy = Field(default_factory=AgainstEnergy)
    a_over_e_scale: dict[str, tuple[float, float]] = Field(default_factory=dict)
    baseline_methods: dict[str, dict[str, Any]] = Field(default_factory=dict)
    tails: dict[str, Any] | None = None

    @property
    def survival(self) -> dict[str, SurvivalRow]:
        """Survival by peak; empty without a cut."""
        return {} if isinstance(self.ae_survival, Missing) else self.ae_survival

    @property
    def scored(self) -> list[str]:
        """Peaks with scores."""
        return [peak for peak, scores in self.peaks.items() if scores.parameters]

    @property
    def held_out(self) -> list[str]:
        """Scored peaks that took no part in the training; all scored ones if none did not."""
        trained = str(self.training.get("peak")).split(",")
        return [peak for peak in self.scored if peak not in trained] or self.scored

    def to_dict(self) -> dict[str, Any]:
        """What the file has: the numbers, and verdicts in words."""
        table: dict[str, dict[str, Any]] = {peak: {} for peak in self.peaks}
        for peak, scores in self.peaks.items():
            for method in scores.methods:
                own = self.judge(peak, method).items()
                table[peak][method] = {q: {k: getattr(v, k) for k in WRITTEN} for q, v in own}
        words = {"summary": [self.summary(peak) for peak in self.scored], "table": table}
        return {**self.model_dump(mode="json", exclude_unset=True), "verdicts": words}

    def judge(self, peak: str, method: str) -> dict[str, Verdict]:
        """Verdicts on one method at one peak, by quantity.

        Returns
        -------
        dict
            For each parameter, under its name, chi-square of its distribution.  ``auc``: the
            classifier against shuffled labels.  ``ae_survival``: the difference from the
            data, for peaks other than that which defines the cut.  ``noise``: its RMS against
            that of the data; ``noise_spectrum``: the worst frequency band.
        """
        scores, verdicts = self.peaks[peak], {}
        for name, compared in scores.judged.items():
            difference, error = compared.shift.get(method), compared.shift_std.get(method)
            mean = number(compared.mean, "#.4g")
            words, unit, scale = "", LABELLED[name].unit, 1.0
            if name == "current_amplitude" and compared.mean:
                unit, scale = "%", 100 / compared.mean
            if difference is not None and error is not None:
                words = f"{signed(scale * difference, scale * error)} {unit}".rstrip()
            off = difference, error
            verdicts[name] = Verdict(compared.p.get(method), words, "too few pulses", off, mean)
        tested = scores.two_sample.get(method)
        if isinstance(tested, Missing):
            verdicts[_AUC] = Verdict(None, reason=tested.missing)
        elif tested is not None:
            # the errors of a fit raise the AUC by so much, with a spread as large; on the scale
            # of the normal quantile separations add
            null, std, p = tested.null_mean + tested.of_fit, tested.null_std, None
            aucs = np.clip((tested.auc, null, tested.null_mean), LEAST_AUC, 1 - LEAST_AUC)
            place, expected, least = ndtri(aucs) / QUANTILE_SLOPE
            if std:
                spread = math.hypot(std, expected - least) * math.sqrt(1 + 1 / SHUFFLES)
                p = stdtr(SHUFFLES - 1, (expected - place) / spread)
            more, std = tested.auc - null, math.hypot(std, tested.of_fit)
            words = f"AUC {with_std(tested.auc, std)}, {null:.2f} expected"
            data = with_std(null, std)
            verdicts[_AUC] = Verdict(p and float(p), words, "no value", (more, std), data)
        row = self.survival.get(peak)
        if row is not None and row.difference:
            off = row.difference.get(method), row.difference_std.get(method)
            verdicts[SURVIVAL] = Verdict(
                two_sided(*off),
                f"{signed(*off)} points" if off[1] else "",
                "too few events of the double-escape peak, or none of this one",
                off,
                with_std(row.survival.get("data"), row.survival_std.get("data")),
            )
        own, data_noise = scores.noise.get(method), scores.noise.get("data")
        if own is not None and data_noise is not None:
            p, words = None, ""
            if own.rms is not None and data_noise.rms:
                spread = math.hypot(own.rms_std or 0.0, data_noise.rms_std or 0.0)
                p = two_sided(own.rms - data_noise.rms, spread)
                ratio = with_std(own.rms / data_noise.rms, spread / data_noise.rms)
                words = f"RMS {ratio} of the data's"
            reason = own.missing or data_noise.missing or "no noise"
            verdicts[_NOISE] = Verdict(p, words, reason)
            if own.spectrum_sigma is not None:
                p = float(ndtr(-own.spectrum_sigma))
                verdicts[_SPECTRUM] = Verdict(p, "worst band of the spectrum")
        return verdicts

    def off(self, method: str) -> tuple[int, int]:
        """Number of scores of a method that are off, and number of scores with a verdict."""
        verdicts = [v for peak in self.peaks for v in self.judge(peak, method).values()]
        agreements = [v.agrees for v in verdicts if v.agrees is not None]
        return agreements.count(False), len(agreements)

    def headline(self) -> tuple[bool, str]:
        """Whether nothing is off at peaks that were not trained on, and that in a sentence."""
        peaks = self.held_out
        judged = sorted(
            (v.p, f"{peak} {called(quantity)}")
            for peak in peaks
            for quantity, v in self.judge(peak, "ren").items()
            if v.p is not None
        )
        if not judged:
            return False, "REN: not judged"
        of, off = f"quantities of {' and '.join(peaks)}", sum(p < ALARM for p, _ in judged)
        named = judged[: min(max(off, 1), NAMED)]
        first = ", ".join(f"{quantity} ({_p(p)})" for p, quantity in named)
        if not off:
            agreed = f"REN agrees with the data in all {len(judged)} {of}"
            return True, f"{agreed}; the least likely is {first}"
        more = " and others" if off > NAMED else ""
        return False, f"REN is off in {off} of {len(judged)} {of}: {first}{more}"

    def summary(self, peak: str, method: str = "ren") -> str:
        """One line: what is off, the least likely first, and with what p the others agree.

        Returns
        -------
        str
            For instance ``REN, SEP: drift time off by 3.1 sigma (+12 ± 3 ns, p = 0.002);
            current amplitude agrees (+0.02 ± 0.11 %, p = 0.4)``.
        """
        verdicts = self.judge(peak, method)
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
        name = "REN" if method == "ren" else label(method)
        return f"{name}, {peak}: {'; '.join(parts) or 'not scored'}"

    def main_table(self, peaks: Sequence[str]) -> tuple[list[str], list[list[str]]]:
        """Differences from the data with errors and p, by peak and quantity.

        Returns
        -------
        head, rows
            Peak, quantity, the data, the REN with its p, and rivals; overlap with the data.
        """
        rivals = [m for m in RIVALS if any(m in self.peaks[peak].methods for peak in peaks)]
        head = ["Peak", "Quantity", "Data", "REN − data", "p"]
        head += [f"{label(m)} − data" for m in rivals] + ["IoU: REN [%]", "data vs data"]
        rows = []
        for peak in peaks:
            judged, verdicts = self.peaks[peak].judged, self.judge(peak, "ren")
            others = [self.judge(peak, m) for m in rivals]
            first = A_OVER_E if A_OVER_E in judged else "current_amplitude"
            for name in (first, *MAIN[1:], _AUC, SURVIVAL):
                if name not in verdicts or (p := verdicts[name].p) is None:
                    continue
                compared = judged.get(name, Compared())
                own = LABELLED[name].unit if name in judged else ""
                unit = "%" if name == SURVIVAL else own
                rows.append([
                    *(peak, f"{QUANTITIES[name]} [{unit}]" if unit else QUANTITIES[name]),
                    verdicts[name].of_data,
                    signed(*verdicts[name].difference),
                    f"{p:.2g}" if p > SMALLEST else f"< {SMALLEST:g}",
                    *(signed(*of.get(name, Verdict(None)).difference) for of in others),
                    *(with_std(compared.iou.get(m), compared.iou_std.get(m))
                      for m in ("ren", "ceiling")),
                ])  # fmt: skip
        return head, rows


def two_sided(value: float | None, error: float | None) -> float | None:
    """P of a difference of 0 with a normal error; None if either is unknown or without error.

    Examples
    --------
    >>> round(two_sided(-9.5, 5.0), 3)
    0.057
    """
    return None if value is None or not error else float(2 * ndtr(-abs(value) / error))


def signed(value: float | None, error: float | None) -> str:
    """A difference with its sign and error."""
    text = with_std(value, error)
    return text if value is None or text.startswith("−") else f"+{text}"


def called(quantity: str) -> str:
    """Name of a quantity in a sentence."""
    return _CALLED.get(quantity, quantity.replace("_", " "))


def _p(value: float) -> str:
    return f"p = {value:.2g}" if value > SMALLEST else f"p < {SMALLEST:g}"
