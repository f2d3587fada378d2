"""Side and origin of the pulses of a file: as recorded by this program, or as they look.

What is in a file of pulses, in words: counts, energies, lines, traces.

Signs that pulses are not what they are given as: the other side, counts that roll over,
energies of other events, and a second rate.
"""

from __future__ import annotations

import json
import logging
from collections import Counter
from collections.abc import Iterable
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
import numpy.typing as npt

from cpunet.errors import CpunetError
from cpunet.pulses.container import FloatArray, Pulses, line_slope
from cpunet.pulses.parameters import Values, tail_slope
from cpunet.pulses.peaks import Peaks, label_peaks, suggested_calibration
from cpunet.pulses.reading.source import PulseSource, amplitude
from cpunet.recipes.schema import PreparationConfig, Recipe
from cpunet.settings import flat
from cpunet.tables import counted, span

if TYPE_CHECKING:
    from cpunet.pulses.preparation import Kind

log = logging.getLogger(__name__)

Words = list[tuple[str, str]]

# attributes of a table, and of a file
SIDE, MADE_BY, TRANSLATED_BY = "side", "made_by", "translated_by"
RUN, SIMULATION, TRANSLATION = "run", "simulation", "cpunet_translation"
REN, IREN, SIMULATE = "cpunet ren", "cpunet iren", "cpunet simulate"
_NETWORKS = {REN: "REN", IREN: "IREN"}

_FIRST_PULSES = 256  # pulses
_MIN_SAMPLES = 100  # per trace; a shorter one has no baseline and tail to inspect
_FULL_HEIGHT = 10.0  # in ADC counts; smaller whole numbers may be a charge in its own units
_TURNS = 3  # turning points of the baseline: noise has at least this many, a signal fewer
_SMALL = 1e-5  # of the height: rounding of a flat line
_MIN_END = 0.98  # of the height: without electronics a pulse ends at its maximum


class Recognised(NamedTuple):
    """Recognised side of a set of pulses.

    Parameters
    ----------
    side
        Simulated or measured; translated pulses count as the side they imitate.
    why
        Reason, phrased to follow "these".
    """

    side: Kind
    why: str


def require_side(source: PulseSource, wanted: Kind, remedy: str, *, insist: bool) -> None:
    """Refuse pulses of the wrong side.

    Parameters
    ----------
    source
        File of pulses.
    wanted
        Side that the user states.
    remedy
        Remedy to suggest if the pulses are of the other side.
    insist
        Whether to override a guess.

    Raises
    ------
    CpunetError
        If the file states that its pulses are of the other side, or if they appear to be
        and `insist` is False.
    """
    side = recorded = recorded_side(source)
    if side is None and not insist:
        side = apparent_side(next(source.blocks(_FIRST_PULSES)).waveforms)
    if side is not None and side.side != wanted:
        if recorded is None:
            begin = " If" if remedy.endswith("?") else "; if"
            remedy += f"{begin} they are {wanted}, say so with `insist`"
        text = f"{source.path}: given as {wanted} pulses, but these {side.why}"
        raise CpunetError(text, remedy)


def recorded_side(source: PulseSource) -> Recognised | None:
    """Side recorded in a file that this program wrote; None for other files."""
    side, made_by = source.attrs.get(SIDE), source.attrs.get(MADE_BY, "")
    if network := _NETWORKS.get(source.attrs.get(TRANSLATED_BY, "")):
        made: Kind = "measured" if network == "REN" else "simulated"
        return Recognised(made, f"were translated by {network} already")
    if made_by.startswith(SIMULATE) or side == "simulated":
        return Recognised("simulated", f"were simulated by {made_by}")
    if side == "measured":
        return Recognised("measured", f"are traces behind electronics ({made_by})")
    return None


def apparent_side(waveforms: npt.NDArray[np.floating]) -> Recognised | None:
    """Side that pulses appear to be of; None if it is ambiguous.

    Whole numbers with noise before the pulse are measured; pulses with neither noise nor a
    decay are simulated.  A charge signal with noise, or a trace without its baseline, may be
    either.

    Parameters
    ----------
    waveforms
        Traces of shape ``(n, samples)``, of which the first few hundred are looked at.

    Examples
    --------
    >>> time = np.arange(400)
    >>> charge = 1 / (1 + np.exp((200 - time) / 5))
    >>> apparent_side(charge[None]).side
    'simulated'
    >>> noise = np.random.default_rng(1).normal(0, 10, 400)
    >>> apparent_side(np.round(3000 * charge + noise)[None]).side
    'measured'
    >>> apparent_side((charge + noise / 3000)[None]) is None
    True
    """
    traces = waveforms[:_FIRST_PULSES]
    traces = traces[np.isfinite(traces).all(axis=1)].astype(float)
    traces = traces[np.ptp(traces, axis=1) > 0] if traces.size else traces
    if not len(traces) or traces.shape[1] < _MIN_SAMPLES:
        return None
    height, few, turns = np.ptp(traces, axis=1), traces.shape[1] // 10, []
    for part in (traces[:, :few], traces[:, -few:]):  # before the pulse and after it
        steps = np.diff(part, axis=1)
        signs = np.where(np.abs(steps) > _SMALL * height[:, np.newaxis], np.sign(steps), 0)
        turns.append(np.median([np.count_nonzero(np.diff(row[row != 0])) for row in signs]))
    whole = (traces == np.round(traces)).all() and np.median(height) > _FULL_HEIGHT
    if whole and turns[0] >= _TURNS:
        return Recognised(
            "measured", "look measured (whole numbers with noise before the pulse)"
        )
    end = (traces[:, -few:].mean(axis=1) - traces.min(axis=1)) / height
    if max(turns) < _TURNS and np.median(end) > _MIN_END:
        return Recognised("simulated", "look simulated (no noise, no decay)")
    return None


def provenance(source: PulseSource) -> dict[str, str]:
    """Describe how the pulses of a file were made.

    Returns
    -------
    dict
        Text by name, such as ``made by``, ``detector``, ``hits`` and ``translated``; empty for
        files of other programs.
    """
    attrs = source.attrs
    words = {"made by": attrs.get(MADE_BY, ""), "side": attrs.get(SIDE, "")}
    if translated_by := attrs.get(TRANSLATED_BY):
        network, run = _NETWORKS.get(translated_by, translated_by), attrs.get(RUN)
        words["translated"] = f"by the {network} of {run or 'an unknown run'}"
    # other programs may have attributes of these names
    with suppress(ValueError, LookupError, TypeError, AttributeError):
        made = json.loads(attrs[SIMULATION])
        detector, hits, fwhm = made["detector"], made["hits"], made["settings"]["cloud_fwhm_mm"]
        physics = f"{detector['bias_V']:g} V, {detector['temperature_K']:g} K"
        of_hits, of_events = hits.get("monte_carlo", ""), ""
        if "file" in hits:
            flipped = ", z flipped" if hits["flip_z"] else ""
            of_hits = f"{Path(hits['file']).name}, origin {hits['origin_mm']} mm{flipped}"
        if "events" in made:  # a stand records them in its ``stand.json``
            lost = f"of which {made['events_without_signal']} without a signal"
            of_events = f"{made['events']}, {lost}; seed {made['seed']}"
        of_detector = f"{detector['name']}, {physics}, charge clouds of {fwhm:g} mm"
        words |= {"detector": of_detector, "hits": of_hits, "events": of_events}
    with suppress(ValueError, LookupError, TypeError, AttributeError):
        given = flat(json.loads(attrs[TRANSLATION])["options"], " ")
        words["options"] = ", ".join(f"{k} {v}" for k, v in given if v is not None)
    return {name: text for name, text in words.items() if text}


MIN_SIGMAS = 5.0  # least height of a pulse in standard deviations of the noise
MIN_BASELINE = 16  # minimum number of samples to estimate the noise
MIN_NUMBER = 10  # minimum number of traces


def trace_properties(whole: Pulses, config: PreparationConfig) -> Words:
    """Describe the traces of a digitiser.

    Parameters
    ----------
    whole
        Measured traces of one channel.
    config
        Preparation settings.

    Returns
    -------
    list
        Names and texts: decay time by the median of the tails, and median RMS of the baselines.

    Raises
    ------
    CpunetError
        If too few traces contain a pulse.
    """
    first = whole.waveforms[:, : max(MIN_BASELINE, whole.length // 20)]
    with np.errstate(invalid="ignore", over="ignore"):
        height, rms = whole.waveforms.max(axis=1) - first.mean(axis=1), first.std(axis=1)
        is_pulse = np.isfinite(height) & (height > MIN_SIGMAS * rms)
    if is_pulse.sum() < MIN_NUMBER:
        raise CpunetError(f"only {is_pulse.sum()} of {len(whole)} traces hold a pulse")
    traces, noise_adc = whole.waveforms[is_pulse], float(np.median(rms[is_pulse].astype(float)))
    noise = f"{noise_adc:.3g} ADC"
    kev_per_adc = whole.energy_kev[is_pulse] / amplitude(traces)
    if np.isfinite(kev_per_adc).sum() >= MIN_NUMBER:
        noise += f", {noise_adc * float(np.nanmedian(kev_per_adc)):.3g} keV"
    # tails where a window has them, but without its compiled loops, which load in a second
    config, top = config.at(whole.dt_ns), traces.argmax(axis=1)
    inside = (top >= config.samples_before) & (top + config.samples_after <= whole.length)
    start = top[inside, np.newaxis] - config.samples_before
    windows = np.take_along_axis(traces[inside], start + np.arange(config.length), axis=1)
    baselines = windows[:, : config.baseline_samples].mean(axis=1, keepdims=True, dtype=float)
    slopes = tail_slope(windows - baselines, whole.dt_ns, config.decay_fit_samples)
    slopes = slopes[np.isfinite(slopes)]
    slope = float(np.median(slopes)) / 1e3 if len(slopes) >= MIN_NUMBER else 0.0  # in 1/µs
    decay = f"{-1 / slope:.3g} µs" if slope < 0 else "the tails do not decay"
    return [("decay", decay), ("noise", f"{noise} (RMS of a baseline, median)")]


def left_out(whole: Pulses, recipe: Recipe) -> str:
    """What preparation and quality cuts of a recipe leave out of measured traces, and why."""
    # compiled loops, which a look at pulses does not need
    from cpunet.pulses.preparation import apply_cuts, fit_cuts, prepare

    prepared = prepare(whole, recipe.preparation, "measured")
    if len(prepared) >= MIN_NUMBER:
        prepared = apply_cuts(prepared, fit_cuts(prepared, recipe.cuts))
    return f"{counted(prepared.rejections) or 'none'} of {len(whole)} traces"


def describe_pulses(source: PulseSource, blocks: Iterable[Pulses], peaks: Peaks) -> Words:
    """Describe the pulses of one table, by names and texts.

    The file is read in blocks; only energies or amplitudes of all pulses are held in memory.

    Parameters
    ----------
    source
        The opened file.
    blocks
        Its pulses.
    peaks
        Gamma lines to count.
    """
    energies, heights, extremes = list[Values](), list[Values](), [np.empty(0)]
    n_pulses, seen, odd = 0, set[int](), Counter[str]()
    for block in blocks:
        n_pulses += len(block)
        energies.append(of_block := block.energy_kev[np.isfinite(block.energy_kev)])
        if not len(of_block):
            heights.append(amplitude(block.waveforms))
        # A sum is NaN or infinite if any sample is; this needs no mask as large as the block.
        with np.errstate(invalid="ignore", over="ignore"):
            finite = np.isfinite(block.waveforms.sum(axis=1, dtype=np.float64))
        good = block.waveforms if finite.all() else block.waveforms[finite]
        low, high = good.min(axis=1), good.max(axis=1)
        extremes += [low, high]
        hashes = [hash(trace.tobytes()) for trace in good[low < high]]
        odd["not finite"] += len(block) - len(good)
        odd["constant"] += len(good) - len(hashes)
        odd["copies of others"] += len(hashes) - len({*hashes} - seen)
        seen.update(hashes)
    kev, samples = np.concatenate(energies), np.concatenate(extremes)
    calibration = suggested_calibration(kev if len(kev) else np.concatenate(heights))
    energy, origin, amplitudes = source.energies, "", ""
    if len(kev):
        energy += f", {span([kev.min(), kev.max()])} keV"
        energy += f"; {n_pulses - len(kev)} pulses have none" if len(kev) < n_pulses else ""
        if calibration is not None:
            place = f"{1 / calibration.kev_per_adc:.4f} of their energies"
            origin = f"lines of {calibration.source}, at {place}"
    else:
        amplitudes = "no lines that stand out" if calibration is None else f"like {calibration}"
    lines = label_peaks(kev, peaks)
    odds = "".join(f"; {n} traces {what}" for what, n in odd.items() if n)
    ends = [samples.min(), samples.max()] if len(samples) else None
    return [
        ("file", str(source.path)),
        ("format", f"{source.format}, table {source.name}"),
        ("traces", f"{n_pulses} of {source.length} samples, every {source.dt_ns:g} ns"),
        ("columns", ", ".join(sorted(source.columns))),
        *provenance(source).items(),
        ("energy", energy),
        ("lines", counted({name: int((lines == name).sum()) for name in peaks})),
        ("source", origin),
        ("amplitudes", amplitudes),
        ("samples", f"values {span(ends)}{odds}"),
    ]


LOW_KEV = 300.0  # at lower energies, noise can be a good part of an amplitude
MIN_PULSES = 30
# Relative deviation from the common gain of what does not go together, and share of pulses up
# to which amplitudes may differ as much and yet be all alike.
FAR, ALIKE = 0.1, 0.1
# Share of pulses whose amplitude and energy do not go together, from which they are refused,
# and from which a warning says so.
MAX_MISMATCHED, FEW_MISMATCHED = 0.2, 0.1
# Samples over which noise is averaged, least part of the tail on either side of a change of
# rate, and least factors by which noise and slope change there.
SMOOTHED, MARGIN, MIN_NOISE, MIN_SLOPE = 64, 0.1, 1.2, 1.5
# Counts that roll over: least period and number of traces, and share of the steep ones;
# share of traces from which all are refused.
LEAST_PERIOD, MIN_ROLLED, MOSTLY, MAX_ROLLED = 256, 3, 0.9, 0.2


class RolledOver(NamedTuple):
    """Counts that jump by a period: the share of such traces, a text, and what to do."""

    share: float
    text: str
    remedy: str


def rolled_over(traces: FloatArray) -> RolledOver | None:
    """Find counts that jump by a power of two, where nothing else rises within a sample.

    Parameters
    ----------
    traces
        Raw traces, shape (pulses, samples).

    Examples
    --------
    >>> ramp = 30_000 + 50.0 * np.arange(200) + np.arange(5)[:, np.newaxis]
    >>> rolled_over(ramp) is None, rolled_over((ramp + 2**15) % 2**16).text[:43]
    (True, '100 % of the traces jump by 65536 = 2^16 co')
    """
    jumps = np.abs(np.diff(traces, axis=1)).max(axis=1)
    steep = (jumps > np.ptp(traces, axis=1) / 2) & (jumps >= LEAST_PERIOD / 2)
    if steep.sum() < MIN_ROLLED or (traces[steep] != np.round(traces[steep])).any():
        return None
    period = 2 ** int(np.round(np.log2(np.median(jumps[steep]))))
    left = np.abs(np.diff(np.unwrap(traces[steep], period=period), axis=1)).max(axis=1)
    rolled = (np.abs(jumps[steep] - period) < period / 4) & (left < period / 4)
    if rolled.mean() <= MOSTLY:
        return None
    share, because, view = float(steep.mean()), "", ""
    if period == 2**16 and traces[steep].min() < 0:
        because = "unsigned samples stored as signed, or "
        view = "as unsigned (values.view('uint16') in NumPy), or "
    text = f"{100 * share:.0f} % of the traces jump by {period} = 2^{period.bit_length() - 1} "
    text += f"counts: {because}counts beyond the range rolled over"
    remedy = f"write them {view}as numpy.unwrap(values.astype(float), period={period})"
    return RolledOver(share, text, remedy)


def mismatched(kev: Values, amplitudes: Values) -> float:
    """Fraction of the pulses whose amplitude does not go with their energy.

    Of a detector and its readout, amplitudes are energies times a gain, but for a few percent
    by trapping, for piled-up and for saturated pulses.  Returns 0 if there are too few, or if
    all amplitudes are alike, as of pulses that were scaled to one height.
    """
    with np.errstate(invalid="ignore"):
        usable = (kev > LOW_KEV) & (amplitudes > 0)
    if usable.sum() < MIN_PULSES:
        return 0.0
    both = amplitudes[usable], amplitudes[usable] / kev[usable]
    far = [float(np.mean(np.abs(values / np.median(values) - 1) > FAR)) for values in both]
    return far[1] if far[0] >= ALIKE else 0.0


def second_rate(traces: FloatArray) -> tuple[int, float] | None:
    """Find where digitisers begin to average samples, which are then longer.

    Averages of m samples have less noise, by the root of m if it is white, and the decay goes
    on m times as fast from sample to sample.

    Parameters
    ----------
    traces
        Raw traces, shape (pulses, samples).

    Returns
    -------
    tuple or None
        The sample at which they begin, and how many they average.
    """
    heights = amplitude(traces)
    good = np.isfinite(heights) & (heights > 0)
    if good.sum() < MIN_PULSES:
        return None
    heights, traces = heights[good, np.newaxis], traces[good]
    start = int(np.median(traces.argmax(axis=1))) + SMOOTHED
    tail: Values = traces[:, start:].astype(np.float64)
    n = tail.shape[1]
    margin = max(2 * SMOOTHED, round(MARGIN * n))
    if n < 3 * margin:
        return None
    noise = np.log(np.median(np.abs(np.diff(tail, 2, axis=1)), axis=0) + 1e-9)  # (samples,)
    places, sums = np.arange(margin, n - margin), np.append(0.0, np.cumsum(noise))
    left, others = sums[places] / places, len(noise) - places
    right = (sums[-1] - sums[places]) / others
    best = int(((left - right) ** 2 * places * others).argmax())
    at, lower = int(places[best]), float(np.exp(left[best] - right[best]))
    baselines = traces.max(axis=1, keepdims=True) - heights
    level = np.log(np.maximum(np.median((tail - baselines) / heights, axis=0), 1e-3))
    before, after = (line_slope(len(part)) @ part for part in (level[:at], level[at:]))
    faster = float(after / before) if before < 0 else 0.0
    if lower < MIN_NOISE or faster < MIN_SLOPE:
        return None
    return start + at + 1, faster


def require_sense(path: Path, traces: FloatArray, kev: Values, amplitudes: Values) -> None:
    """Refuse counts that roll over, and energies of other pulses; warn of a second rate.

    Parameters
    ----------
    path
        The file.
    traces
        Its first traces, shape (pulses, samples).
    kev, amplitudes
        Energies and amplitudes of all pulses.
    """
    if (rolled := rolled_over(traces)) is not None:
        error = CpunetError(f"{path}: {rolled.text}", rolled.remedy)
        if rolled.share >= MAX_ROLLED:
            raise error
        log.warning(str(error))
    share = mismatched(kev, amplitudes)
    text = f"{path}: {100 * share:.0f} % of amplitudes and energies do not go together"
    if share > MAX_MISMATCHED:
        raise CpunetError(
            f"{text}: these energies are not those of these traces",
            "give the energy column of the same channel and events, in their order; select "
            "lower energies (`peak`) where amplitudes saturate, cut samples that pad records",
        )
    if share > FEW_MISMATCHED:
        log.warning(text)
    if (begins := second_rate(traces)) is not None:
        log.warning(
            f"{path}: noise and slope of the tails change at sample {begins[0]}, as if "
            f"{begins[1]:.0f} samples were averaged from there: a second rate; cut the traces "
            "there, or resample them"
        )
