"""Check before a training whether two sets of pulses can be compared.

A training on the wrong energies, on another detector's simulation or on two sampling periods
fails late or, worse, ends in a poor fit.  Such problems appear in quantities that no readout
changes: energies, counts, sampling, the spread of drift times (a readout delays all pulses
equally), and current amplitudes (a readout only makes pulses slower).
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from enum import StrEnum
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from scipy.ndimage import gaussian_filter1d

from cpunet.errors import CpunetError
from cpunet.outputs import refuse_picture, written_aside
from cpunet.pulses.channels import Pair, paired
from cpunet.pulses.container import FloatArray
from cpunet.pulses.loading import (
    REMEDIES,
    InputSet,
    load_pulses,
    require_both_sides,
    require_same_sampling,
)
from cpunet.pulses.parameters import Values, current_amplitude
from cpunet.pulses.peaks import EnergySelection, line_near, parse_selection
from cpunet.pulses.preparation import Kind, Rejection
from cpunet.pulses.reading.files import ALL, ReadOptions, Source
from cpunet.recipes import load_recipe
from cpunet.recipes.schema import PreparationConfig, Recipe
from cpunet.training.energy_bands import MIN_PULSES
from cpunet.training.pulse_sets import spread

if TYPE_CHECKING:
    from matplotlib.figure import Figure

FEW = 1000  # pulses per side needed for a precise fit
# Ratios beyond which the detectors may differ by more than a calibration can correct, and
# beyond which these are two detectors
SPREAD_RATIO, SHARPER = 1.2, 1.08
OTHER_SPREAD, OTHER_SHARPER = 1.5, 1.4
# Differences due to rounding, in sampling periods, and to chance, in standard deviations; and
# number of parts of the pulses from which the latter are estimated.
ROUNDING, SURE, PARTS = 2.0, 4.0, 8
# Charge from which a pulse has begun, as much short of all of it has ended; quantile of times.
BEGUN, LONGEST = 0.01, 0.99
LOST = 0.1  # share of the selected pulses left out for a single reason that causes a warning
MAX_PULSES = 2000  # maximum number of pulses per side for shapes
RISES = (0.1, 0.5)  # of the height: a readout adds the same time between them to all pulses
OFF_LINE = 1.5  # keV, maximum deviation of a line
DPI = 150


class Level(StrEnum):
    """How bad a finding is, as it is printed."""

    FINE = "ok"
    WARNING = "look"
    ERROR = "stop"


@dataclass(frozen=True)
class Finding:
    """Something that was checked.

    Parameters
    ----------
    level
        How bad it is.
    text
        What was checked.
    remedy
        What to do; empty if nothing is to be done.
    channel
        Channel of the data, of several.
    """

    level: Level
    text: str
    remedy: str = ""
    channel: str = ""

    def __str__(self) -> str:
        return f"{self.text}; {self.remedy}" if self.remedy else self.text


@dataclass(frozen=True, eq=False)
class CheckResult:
    """Findings on two sets of pulses.

    Parameters
    ----------
    findings
        In order.
    sides
        Prepared pulses of ``"sim"`` and ``"data"``; none if they cannot be read, or are of
        several channels.
    """

    findings: list[Finding]
    sides: dict[str, InputSet] = field(default_factory=dict)

    @property
    def ok(self) -> bool:
        """Whether nothing must be changed before a training."""
        return all(finding.level != Level.ERROR for finding in self.findings)

    def plot(self) -> Figure:
        """Pulses of both sides, and the distributions of two parameters.

        Raises
        ------
        CpunetError
            If the pulses of a side could not be read, or are of several channels.
        """
        from cpunet.training.figures import sides_figure

        if not self.sides:
            raise CpunetError("no pulses of both sides to draw")
        sides = {"data": self.sides["data"], "raw": self.sides["sim"]}  # names in figures
        dt_ns = sides["data"].dt_ns
        pulses = {name: _of_height_one(side) for name, side in sides.items()}
        rises = {name: _rise_ns(of, dt_ns) for name, of in pulses.items()}
        amplitudes = {name: current_amplitude(of, dt_ns) for name, of in pulses.items()}
        quantities = {"Time from 10 to 50 % [ns]": rises}
        quantities["Current amplitude [1/sample]"] = amplitudes
        counts = {name: len(side.prepared) for name, side in sides.items()}
        return sides_figure(pulses, quantities, dt_ns, counts)

    def save(self, path: str | Path, force: bool = False) -> None:
        """Draw the pulses of both sides into a file, see `plot`.

        Raises
        ------
        CpunetError
            If the file exists and `force` is off, or has an unknown format.
        """
        picture = Path(path)
        refuse_picture(picture, force=force)
        figure = self.plot()
        with written_aside(picture) as aside:
            figure.savefig(aside, format=picture.suffix[1:].lower(), dpi=DPI)

    def __str__(self) -> str:
        lines, channel = [], ""
        for finding in self.findings:
            if finding.channel != channel:
                channel = finding.channel
                lines.append(f"{channel}:")
            lines.append(f"{finding.level:<7}{finding}")
        return "\n".join(lines)

    __repr__ = __str__


def check(
    sim: Source,
    data: Source,
    *,
    recipe: str | Path | Recipe = "fast",
    settings: Sequence[str] | Mapping[str, Any] = (),
    peak: str = "FEP",
    read: ReadOptions = ReadOptions(),
    out: str | Path | None = None,
    force: bool = False,
) -> CheckResult:
    """Say whether simulated and measured pulses can be compared, and what to do if not.

    Ends with status 1 if something must be changed before a training.

    Parameters
    ----------
    sim
        Simulated pulses.
    data
        Measured pulses.
    recipe
        ``fast``, ``cpunet``, ``paper``, or a YAML file.
    settings
        Override a value of the recipe, as ``preparation.after_ns=9600`` (repeatable).
    peak
        Energies to train on: FEP, SEP, DEP or a range in keV, as ``300-``, or several.
    read
        How the files are read, if they do not tell themselves.
    out
        Picture to make: pulses of both sides; for all channels, with the name of each.
    force
        Replace existing output.

    Returns
    -------
    CheckResult
        Findings on both sides.

    Raises
    ------
    CpunetError
        If `peak` or the recipe cannot be understood, or `out` cannot be written.

    Examples
    --------
    ``cpunet check --sim sim.lh5 --data raw.lh5 --out check.png``

    ``cpunet check --sim sim.lh5 --data raw.lh5 --data-table all``
    """
    both = read.files(sim, data)
    picture, alone = None if out is None else Path(out), both[1].table != ALL
    if picture is not None:
        given = None if isinstance(recipe, Recipe) else recipe
        files = *both[0].files, *both[1].files, given
        refuse_picture(picture, *files, force=force or not alone)
    chosen = load_recipe(recipe, settings)
    findings: list[Finding] = []
    for name, pair in ({"": both} if alone else paired(*both)).items():
        result = _checked(pair, chosen, peak)
        findings += [replace(finding, channel=name) for finding in result.findings]
        if picture is not None and result.sides:
            result.save(picture.with_stem(f"{picture.stem}-{name}") if name else picture, force)
    return result if alone else CheckResult(findings)


def _checked(pair: Pair | CpunetError, recipe: Recipe, peak: str) -> CheckResult:
    """Read both sides as in a training, and compare them."""
    if isinstance(pair, CpunetError):
        return CheckResult([Finding(Level.ERROR, pair.text, pair.remedy)])
    selection, findings = parse_selection(peak, recipe.peaks), list[Finding]()
    sets: dict[str, InputSet] = {}
    kinds: tuple[tuple[str, Kind], ...] = (("data", "measured"), ("sim", "simulated"))
    for (side, kind), file in zip(kinds, pair[::-1], strict=True):
        how = {"tell": False, "shorten": side == "data"}
        try:
            sets[side] = load_pulses(file, kind, recipe, selection, **how)
            recipe = sets[side].recipe
        except CpunetError as error:
            findings.append(Finding(Level.ERROR, error.text, error.remedy))
    if len(sets) == 2:
        findings += compare_sides(sets["sim"], sets["data"], selection, recipe.preparation)
    return CheckResult(findings, sets if len(sets) == 2 else {})


def _judged(text: str, remedy: str, fine: bool, other: bool = False) -> Finding:
    """A finding that is fine, or doubtful, or that of `other` detectors."""
    if fine:
        return Finding(Level.FINE, text)
    return Finding(Level.ERROR if other else Level.WARNING, text, remedy)


def compare_sides(
    sim: InputSet, data: InputSet, selection: EnergySelection, preparation: PreparationConfig
) -> Iterator[Finding]:
    """Compare two prepared sets."""
    try:  # without these a training raises an error
        require_same_sampling(sim, data)
        yield Finding(Level.FINE, f"every {data.dt_ns:g} ns")
        for note in require_both_sides(sim, data, selection):
            yield Finding(Level.WARNING, note)
    except CpunetError as error:
        yield Finding(Level.ERROR, error.text, error.remedy)
        return
    simulated, measured = _of_height_one(sim), _of_height_one(data)
    too_short = False
    # simulated pulses that reach into the baseline or the tail of a window
    at = preparation.at(sim.dt_ns).samples_before
    begin = at - (simulated > BEGUN).argmax(axis=1)
    end = simulated.shape[1] - (simulated[:, ::-1] < 1 - BEGUN).argmax(axis=1) - at
    for where, what, samples, window_ns, taken_ns in (
        ("before", "begin", begin, preparation.before_ns, preparation.baseline_ns),
        ("after", "rise", end, preparation.after_ns, preparation.decay_fit_ns),
    ):
        longest_ns = float(np.quantile(samples, LONGEST)) * sim.dt_ns
        room_ns = window_ns - taken_ns
        if preparation.align_at == "half_height" and longest_ns > room_ns:
            too_short = True
            text = (
                f"the window is shorter than the drift: pulses {what} up to "
                f"{longest_ns:.0f} ns {where} half of their height, for which it has "
                f"{room_ns:.0f} ns"
            )
            wanted = 100 * math.ceil((window_ns + longest_ns - room_ns) / 100)
            remedy = f"preparation.{where}_ns={wanted} in `settings`"
            yield Finding(Level.WARNING, text, remedy)
    # pulses in their own baselines would be blamed on others
    for inputs, side in ((sim, "simulated"), (data, "measured")):
        yield from _of_side(inputs, side, selection, shares=not too_short)
    if min(len(sim.prepared), len(data.prepared)) < MIN_PULSES:
        return  # too few to compare shapes
    if not too_short:
        yield _spread(simulated, measured, sim.dt_ns)
    # no readout increases current amplitudes much
    ratio = float(
        np.nanquantile(current_amplitude(measured, data.dt_ns), 0.9)
        / np.nanquantile(current_amplitude(simulated, sim.dt_ns), 0.9)
    )
    text = f"measured current amplitudes are {ratio:.2f} of the simulated ones"
    remedy = (
        "electronics cannot make pulses sharper: another detector, too wide a cloud, or other "
        "energies"
    )
    yield _judged(text, remedy, ratio < SHARPER, ratio > OTHER_SHARPER)


def _of_side(
    inputs: InputSet, side: str, selection: EnergySelection, *, shares: bool
) -> Iterator[Finding]:
    """Check number and energies of the pulses of a side, and the `shares` left out of them."""
    name, n = inputs.path.name, len(inputs.prepared)
    text = f"{name}: {n} {side} pulses of {inputs.prepared.n_read} can be used"
    remedy = f"{FEW} or more are better: a file of more events, or more energies (`peak`)"
    yield _judged(text, remedy, n >= FEW, n < MIN_PULSES)
    # the highest gamma line has no neighbours
    highest = sorted(selection.peaks.items(), key=lambda item: item[1].energy_kev)[-1:]
    for label, line in highest:
        if (line_kev := line_near(inputs.energies_kev, line.energy_kev)) is None:
            continue
        off, factor = line_kev - line.energy_kev, line.energy_kev / line_kev
        text = f"{name}: line {label} of the {side} pulses at {line_kev:.1f} keV"
        if not (fine := abs(off) <= OFF_LINE):
            text += f", {off:+.1f} keV from where it should be"
        how = ", as by `kev_per_adc`," if side == "measured" else " in its file"
        yield _judged(text, f"energies times {factor:.5f}{how} would put it right", fine)
    unselected = {Rejection.ENERGY_OUTSIDE_SELECTION.label, Rejection.ENERGY_UNKNOWN.label}
    rejections = inputs.prepared.rejections.items() if shares else ()
    counts = {label: lost for label, lost in rejections if label not in unselected}
    selected = n + sum(counts.values())
    for label, lost in counts.items():
        if lost > LOST * selected or label == Rejection.COPIES.label:
            part = f"{100 * lost / selected:.0f} % of the {side} pulses left out ({label})"
            remedy = REMEDIES.get(Rejection[label.upper()], "look at some of them")
            yield Finding(Level.WARNING, f"{name}: {part}", remedy)


def _spread(waveforms: FloatArray, data: FloatArray, dt_ns: float) -> Finding:
    """Compare the spreads of the drift times, behind a readout as slow as that of the data.

    A readout adds nearly the same time to long rises, and hides differences of short ones.
    """
    measured, simulated = _rise_ns(data, dt_ns), _rise_ns(waveforms, dt_ns)
    median_ns = float(np.median(measured))
    if np.median(simulated) < median_ns:  # then behind a Gaussian response of this median
        slowed = partial(gaussian_filter1d, waveforms, axis=1, mode="nearest")
        low, high = 0.0, median_ns
        while high - low > dt_ns / ROUNDING:
            middle = (low + high) / 2
            slower = np.median(_rise_ns(slowed(middle / dt_ns), dt_ns)) < median_ns
            low, high = (middle, high) if slower else (low, middle)
        simulated = _rise_ns(slowed(high / dt_ns), dt_ns)
    ranges, errors = [], []
    for rise in (simulated, measured):
        parts = rise, *(rise[k::PARTS] for k in range(PARTS))
        whole, *some = (float(np.ptp(np.quantile(part, (0.05, 0.95)))) for part in parts)
        ranges.append(whole)
        errors.append(np.std(some) / PARTS**0.5)
    text = "drift times (10 to 50 %) spread over {:.0f} ns simulated, {:.0f} ns measured"
    ratio = ranges[1] / max(ranges[0], 1e-9)
    chance = float(np.hypot(SURE * np.hypot(*errors), ROUNDING * dt_ns))
    fine = 1 / SPREAD_RATIO < ratio < SPREAD_RATIO or abs(ranges[1] - ranges[0]) < chance
    other = not 1 / OTHER_SPREAD < ratio < OTHER_SPREAD
    remedy = (
        "electronics cannot cause this: another detector or bias, hits of another frame, or "
        "other energies"
    )
    if not other:
        remedy += "; where the simulation is near, cpunet calibrate finds its physics"
    return _judged(text.format(*ranges), remedy, fine, other)


def _of_height_one(inputs: InputSet) -> FloatArray:
    """Some pulses scaled to height 1, whatever the level of their prepared tails."""
    waveforms = inputs.prepared.pulses.waveforms
    waveforms = waveforms[spread(len(waveforms), MAX_PULSES)]
    return np.asarray(waveforms / waveforms.max(axis=1, keepdims=True), np.float32)


def _rise_ns(waveforms: FloatArray, dt_ns: float) -> Values:
    """Time between the last samples below two fractions of the height before the maximum."""
    samples = np.arange(waveforms.shape[1])
    rising = samples < waveforms.argmax(axis=1)[:, np.newaxis]
    begin, end = (
        np.where((waveforms < fraction) & rising, samples, 0).max(axis=1) for fraction in RISES
    )
    return np.asarray((end - begin) * dt_ns, float)
