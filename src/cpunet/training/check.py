"""Check before a training whether two sets of pulses can be compared.

A training on the wrong energies, on another detector's simulation or on two sampling periods
fails late or, worse, ends in a poor fit.  Such problems appear in quantities that no readout
changes: energies, counts, sampling, the spread of drift times (a readout delays all pulses
equally), and current amplitudes (a readout only makes pulses slower).
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from enum import StrEnum
from pathlib import Path

import numpy as np

from cpunet.errors import CpunetError
from cpunet.outputs import PICTURE_FORMATS, refuse_existing, written_aside
from cpunet.pulses.container import FloatArray, Pulses
from cpunet.pulses.loading import (
    InputSet,
    load_measured,
    load_simulated,
    require_both_sides,
    require_same_sampling,
)
from cpunet.pulses.parameters import Values, current_amplitude
from cpunet.pulses.peaks import EnergySelection, parse_selection
from cpunet.pulses.preparation import Rejection
from cpunet.pulses.reading.files import PulseFile
from cpunet.pulses.spectrum import line_near
from cpunet.recipes.schema import Recipe

MIN_N, FEW = 200, 1000  # pulses per side needed for a fit, and for a precise one
# Ratios beyond which the detectors differ by more than a calibration can correct
SPREAD_RATIO, SHARPER = 1.2, 1.08
# Differences due to rounding, in sampling periods, and to chance, in standard deviations; and
# number of parts of the pulses from which the latter are estimated.
ROUNDING, SURE, PARTS = 2.0, 4.0, 8
LOST = 0.1  # share of the selected pulses left out for one reason that causes a warning
LOOKED_AT = 2000  # maximum number of pulses per side for shapes
RISES = (0.1, 0.5)  # of the height: a readout adds the same time between them to all pulses
OFF_LINE = 1.5  # keV, maximum deviation of a line
DPI = 150


class Level(StrEnum):
    """How bad a finding is."""

    FINE = "fine"
    WARNING = "warning"
    ERROR = "error"


@dataclass(frozen=True)
class Finding:
    """Result of a check.

    Parameters
    ----------
    what
        What was checked, in two words.
    level
        How bad it is.
    text
        What was found.
    remedy
        What to do; empty if nothing is to be done.
    """

    what: str
    level: Level
    text: str
    remedy: str = ""

    def __str__(self) -> str:
        return f"{self.text}; {self.remedy}" if self.remedy else self.text


@dataclass(frozen=True, eq=False)
class Checked:
    """Findings, and the prepared pulses of both sides if these could be read."""

    findings: list[Finding]
    sides: dict[str, InputSet] = field(default_factory=dict)

    @classmethod
    def refused(cls, side: str, error: CpunetError) -> Checked:
        """The finding that one side, ``"sim"`` or ``"data"``, cannot be read."""
        return cls([_refusal(f"{side} pulses", error)])

    @property
    def level(self) -> Level:
        """Level of the worst finding."""
        levels = {finding.level for finding in self.findings}
        return max(levels, key=list(Level).index, default=Level.FINE)


def check(sim: PulseFile, data: PulseFile, recipe: Recipe, peak: str) -> Checked:
    """Read both sides as in a training, and check them.

    Parameters
    ----------
    sim, data
        Simulated and measured pulses.
    recipe
        Recipe with preparation and cuts.
    peak
        Energies, as for a training.

    Raises
    ------
    CpunetError
        If `peak` cannot be understood.
    """
    selection = parse_selection(peak, recipe.peaks)
    findings: list[Finding] = []
    sets: dict[str, InputSet] = {}
    for side, load, file in (("sim", load_simulated, sim), ("data", load_measured, data)):
        try:
            sets[side] = load(file, recipe, selection, tell=False)
        except CpunetError as error:
            findings.append(_refusal(f"{side} pulses", error))
    if len(sets) < 2:
        return Checked(findings)
    findings += compare_sides(sets["sim"], sets["data"], selection)
    return Checked(findings, sets)


def draw(checked: Checked, picture: Path, *, force: bool = False) -> None:
    """Draw the pulses of both sides.

    Raises
    ------
    CpunetError
        If the picture exists or has an unknown format.
    """
    from cpunet.validation.sides_figure import sides_figure

    if picture.suffix.lower() not in PICTURE_FORMATS:
        raise CpunetError(f"{picture}: pictures are made as {', '.join(PICTURE_FORMATS)}")
    refuse_existing(picture, force=force)
    names = {"data": "data", "raw": "sim"}  # names in figures, the measured side first
    sides = {name: checked.sides[side] for name, side in names.items()}
    figure = sides_figure(
        {name: _of_height_one(one) for name, one in sides.items()},
        {
            "Time from 10 to 50 % [ns]": {n: _rise_ns(one) for n, one in sides.items()},
            "Current amplitude [1/sample]": {n: _amplitudes(one) for n, one in sides.items()},
        },
        checked.sides["data"].dt_ns,
        {name: len(one.prepared) for name, one in sides.items()},
    )
    with written_aside(picture) as aside:
        figure.savefig(aside, format=picture.suffix[1:].lower(), dpi=DPI)


def compare_sides(sim: InputSet, data: InputSet, selection: EnergySelection) -> list[Finding]:
    """Compare two prepared sets."""
    findings = [*_required(sim, data, selection)]
    if any(finding.level == Level.ERROR for finding in findings):
        return findings
    for one, side in ((sim, "simulated"), (data, "measured")):
        findings += [_count(one, side), *_left_out(one, side), *_lines(one, side, selection)]
    if min(len(sim.prepared), len(data.prepared)) < MIN_N:
        return findings  # too few to compare shapes
    findings.append(_spread(sim, data))
    findings.append(_amplitude(sim, data))
    return findings


def _refusal(what: str, error: CpunetError) -> Finding:
    return Finding(what, Level.ERROR, error.text, error.remedy)


def _required(sim: InputSet, data: InputSet, selection: EnergySelection) -> Iterator[Finding]:
    """Check the conditions without which a training raises an error."""
    try:
        require_same_sampling(sim, data)
    except CpunetError as error:
        yield _refusal("sampling", error)
    else:
        yield Finding("sampling", Level.FINE, f"every {data.dt_ns:g} ns")
    try:
        notes = require_both_sides(sim, data, selection)
    except CpunetError as error:
        yield _refusal("energies", error)
    else:
        for note in notes:
            yield Finding("energies", Level.WARNING, note)


def _count(one: InputSet, side: str) -> Finding:
    n = len(one.prepared)
    text = f"{one.path.name}: {n} {side} pulses of {one.prepared.n_read} can be used"
    if n >= FEW:
        return Finding("counts", Level.FINE, text)
    level = Level.ERROR if n < MIN_N else Level.WARNING
    remedy = f"{FEW} or more are better: more files, or more energies (--peak)"
    return Finding("counts", level, text, remedy)


REMEDIES = {
    Rejection.SATURATED: "saturated traces have lost their top; choose lower energies",
    Rejection.WINDOW_OUTSIDE_RECORD: (
        "the traces end too soon before or after the pulse; write longer ones, or allow more "
        "padding (--set preparation.max_padding_before=…, max_padding_after)"
    ),
    Rejection.TAIL_SLOPE: "tails differ: pile-up, or remains of earlier pulses",
    Rejection.BASELINE: "baselines differ: remains of earlier pulses (cpunet info tells them)",
    Rejection.BASELINE_SLOPE: (
        "baselines are not flat: remains of earlier pulses (cpunet info tells them)"
    ),
    Rejection.CHI2: "tails are no exponentials: pile-up",
    Rejection.NO_AMPLITUDE: "the polarity may be the other one, or these are noise",
}


def _left_out(one: InputSet, side: str) -> Iterator[Finding]:
    """Warn of reasons for which a large share of the selected pulses is left out."""
    counts = dict(one.prepared.rejections)
    for reason in (Rejection.ENERGY_OUTSIDE_SELECTION, Rejection.ENERGY_UNKNOWN):
        counts.pop(reason.label, None)
    selected = len(one.prepared) + sum(counts.values())
    for label, n in counts.items():
        if n > LOST * selected:
            text = f"{one.path.name}: {100 * n / selected:.0f} % of the {side} pulses left out"
            remedy = REMEDIES.get(Rejection[label.upper()], "look at some of them")
            yield Finding("left out", Level.WARNING, f"{text} ({label})", remedy)


def _lines(one: InputSet, side: str, selection: EnergySelection) -> Iterator[Finding]:
    """Check the position of the highest gamma line."""
    # the highest line has no neighbours
    highest = sorted(selection.peaks.items(), key=lambda item: item[1].energy_kev)[-1:]
    for name, line in highest:
        found = line_near(one.energies_kev, line.energy_kev)
        if found is None:
            continue
        off = found - line.energy_kev
        text = f"{one.path.name}: line {name} of the {side} pulses at {found:.1f} keV"
        if abs(off) <= OFF_LINE:
            yield Finding("calibration", Level.FINE, text)
        else:
            factor = line.energy_kev / found
            yield Finding(
                "calibration",
                Level.WARNING,
                f"{text}, {off:+.1f} keV from where it should be",
                f"energies times {factor:.5f}, as by --kev-per-adc, would put it right",
            )


def _spread(sim: InputSet, data: InputSet) -> Finding:
    """Compare the spreads of the drift times."""
    rises = [_rise_ns(one) for one in (sim, data)]
    ranges = [_range(rise) for rise in rises]
    errors = [
        np.std([_range(rise[k::PARTS]) for k in range(PARTS)]) / PARTS**0.5 for rise in rises
    ]
    text = "drift times (10 to 50 %) spread over {:.0f} ns simulated, {:.0f} ns measured"
    ratio = ranges[1] / max(ranges[0], 1e-9)
    chance = float(np.hypot(SURE * np.hypot(*errors), ROUNDING * data.dt_ns))
    if 1 / SPREAD_RATIO < ratio < SPREAD_RATIO or abs(ranges[1] - ranges[0]) < chance:
        return Finding("drift times", Level.FINE, text.format(*ranges))
    return Finding(
        "drift times",
        Level.WARNING,
        text.format(*ranges),
        "no readout does that: another detector or bias, hits of another frame, or other "
        "energies; where the simulation is near, cpunet calibrate finds its physics",
    )


def _amplitude(sim: InputSet, data: InputSet) -> Finding:
    """Compare the current amplitudes, which no readout increases."""
    highest = [float(np.nanquantile(_amplitudes(one), 0.9)) for one in (sim, data)]
    ratio = highest[1] / highest[0]
    text = f"measured current amplitudes are {ratio:.2f} of the simulated ones"
    if ratio < SHARPER:
        return Finding("current amplitude", Level.FINE, text)
    return Finding(
        "current amplitude",
        Level.WARNING,
        text,
        "no readout makes pulses sharper: another detector, too wide a cloud, or other "
        "energies",
    )


def _some(one: InputSet) -> Pulses:
    pulses = one.prepared.pulses
    return pulses[np.linspace(0, len(pulses) - 1, min(len(pulses), LOOKED_AT)).astype(int)]


def _of_height_one(one: InputSet) -> FloatArray:
    """Some pulses scaled to height 1, whatever the level of their prepared tails."""
    waveforms = _some(one).waveforms
    return np.asarray(waveforms / waveforms.max(axis=1, keepdims=True), np.float32)


def _amplitudes(one: InputSet) -> Values:
    return current_amplitude(_of_height_one(one))


def _rise_ns(one: InputSet) -> Values:
    """Time between the last samples below two fractions of the height before the maximum."""
    waveforms = _of_height_one(one)
    begin, end = (_last_below(waveforms, fraction) for fraction in RISES)
    return np.asarray((end - begin) * one.dt_ns, float)


def _last_below(waveforms: FloatArray, level: float) -> Values:
    """Last sample below a level before each pulse's maximum; the first if there is none."""
    last = waveforms.argmax(axis=1)
    below = (waveforms < level) & (np.arange(waveforms.shape[1]) < last[:, np.newaxis])
    at = waveforms.shape[1] - 1 - below[:, ::-1].argmax(axis=1)
    return np.where(below.any(axis=1), at, 0).astype(float)


def _range(values: Values) -> float:
    low, high = np.quantile(values, (0.05, 0.95))
    return float(high - low)
