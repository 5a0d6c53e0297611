"""The clocks of a rig's sensors: stamps by one clock, from arrivals and from the times at which views change."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import combinations

import numpy as np
from scipy.fft import irfft, next_fast_len, rfft

from calgraph.config import Rig
from calgraph.geometry import Array
from calgraph.recording import NO_CACHE, Recording, RecordingCache, correct_stamps
from calgraph.recording.clocks import Clocks, compare_clocks
from calgraph.result.finding import Finding
from calgraph.rig.captures.capture_mode import recognize_mode
from calgraph.rig.captures.timeline import MAX_MOTION_PERIOD, RecordingTimeline, SensorTimes
from calgraph.solver.lagged_correlation import correlate_at_lags


@dataclass(frozen=True)
class ClockOffset:
    """The clock of a sensor relative to that of others."""

    offset: float
    """The sensor's clock minus theirs, s."""
    correlation: float
    """Of the changes of both views with this offset, at most 1."""


def correct_by_arrival(
    rig: Rig, recording: Recording, cache: RecordingCache = NO_CACHE
) -> tuple[Rig, Recording, Clocks, list[Finding]]:
    """Corrects the stamps by what rig.yaml states of clocks, and by when messages arrived.

    The offsets that rig.yaml states are relative to the root's clock, which arrivals may correct itself. A trigger
    whose arrivals show nothing has the clock of the sensors with which it has some time in common.

    Args:
        rig: the rig.
        recording: open recording with the rig's topics.
        cache: has what earlier runs read.

    Returns:
        The rig with the uncertainty of what was corrected, the recording with stamps by one clock as far as
        arrivals and rig.yaml determine them, what arrivals show of clocks, and what was corrected.
    """
    names = {topic: name for name, topic in rig.topics.items()}
    triggers = [rig.capture.trigger] if rig.capture.trigger else []
    clocks = compare_clocks(recording, [*names, *triggers], cache)
    by_arrival = clocks.certain_offsets()
    of_root = by_arrival.get(rig.topics[rig.root], 0.0)
    stated = {
        spec.topic: of_root + spec.clock_offset
        for spec in rig.sensors.values()
        if isinstance(spec.clock_offset, float)
    }
    moved = {topic: clocks.differences[topic] for topic in by_arrival if topic not in stated}
    findings = [
        Finding(f"the stamps of {names.get(topic, topic)} {one.describe()}, and were corrected")
        for topic, one in moved.items()
    ]
    offsets = by_arrival | stated
    for trigger in triggers:
        if trigger not in moved and (shared := clocks.shares_time(trigger, stated)):
            offsets[trigger] = stated[shared]
    rig = _widen_delays(rig, {names[topic]: one.stddev for topic, one in moved.items() if topic in names})
    return rig, correct_stamps(recording, offsets), clocks.after_correction(offsets, moved), findings


def _widen_delays(rig: Rig, stddev: Mapping[str, float]) -> Rig:
    """The rig with the delays of stamps as uncertain as the clocks of some sensors are, s.

    Delays are relative to the root's.
    """
    sensors = {}
    for name, spec in rig.sensors.items():
        of_clocks = float(np.hypot(stddev.get(name, 0.0), stddev.get(rig.root, 0.0)))
        delay = max(spec.uncertainty.stamp_delay, of_clocks)
        uncertainty = spec.uncertainty.model_copy(update={"stamp_delay": delay})
        sensors[name] = spec.model_copy(update={"uncertainty": uncertainty})
    return rig.model_copy(update={"sensors": sensors}) if stddev else rig


def need_activity(rig: Rig, clocks: Clocks) -> bool:
    """Whether the changes of views are needed to know the clocks of a rig."""
    spans = {name: clocks.spans[topic] for name, topic in rig.topics.items() if topic in clocks.spans}
    return bool(_list_wanted(rig) or _find_hints(rig, clocks) or _find_apart(spans, rig.root))


def _list_wanted(rig: Rig) -> list[str]:
    """The sensors whose offsets rig.yaml asks to estimate."""
    return [name for name, spec in rig.sensors.items() if spec.clock_offset == "estimate"]


def _find_hints(rig: Rig, clocks: Clocks) -> dict[str, float]:
    """By sensor whose clock is not stated, an offset that its arrivals may show, s, or a delay of its messages."""
    return {
        name: clocks.differences[spec.topic].offset
        for name, spec in rig.sensors.items()
        if spec.topic in clocks.differences
        and not clocks.differences[spec.topic].certain
        and not isinstance(spec.clock_offset, float)
    }


def align_views(
    rig: Rig, recording: Recording, timeline: RecordingTimeline, clocks: Clocks
) -> tuple[Recording, RecordingTimeline, list[Finding]]:
    """Corrects the stamps of the sensors whose views change at other times than those of the others.

    Offsets are estimated of sensors for which rig.yaml asks for it, or whose stamps have no time in common with
    those of the others. Where a board rests, all sensors are compared, as the stamps of any may be late.

    Args:
        rig: the rig.
        recording: corrected by arrivals.
        timeline: of this recording, with activity.
        clocks: what arrivals show.

    Returns:
        Recording and timeline with the stamps by one clock, and what was corrected. A clock that cannot be
        estimated is taken for that of the others.
    """
    topics, wanted = rig.topics, _list_wanted(rig)
    hints = _find_hints(rig, clocks) | {name: 0.0 for name, topic in topics.items() if topic in clocks.corrected}
    unknown = [name for name in wanted if topics[name] not in clocks.informative]
    spans = {n: (one.stamps[0], one.stamps[-1]) for n, one in timeline.sensors.items() if len(one.stamps)}
    unknown += [name for name in _find_apart(spans, rig.root) if name not in unknown]
    found = estimate_clock_offsets(timeline, rig.root, unknown)
    timeline = _shift_stamps(timeline, found)
    rests = not rig.capture.trigger and recognize_mode(timeline, rig.capture, rig.settings.captures).mode == "rest"
    compared = [name for name in rig.sensors if (rests or name in wanted or name in hints) and name not in unknown]
    stated = [name for name in compared if isinstance(rig.sensors[name].clock_offset, float)]
    late = find_late_views(timeline, rig.root, [name for name in compared if name not in stated], hints)
    timeline = _shift_stamps(timeline, late)
    found = found | late
    recording = correct_stamps(recording, {topics[name]: one.offset for name, one in found.items()})
    described = dict.fromkeys([*(name for name in wanted if name != rig.root or name in found), *found])
    return recording, timeline, [_describe(name, found.get(name), rig, clocks) for name in described]


def _shift_stamps(timeline: RecordingTimeline, offsets: Mapping[str, ClockOffset]) -> RecordingTimeline:
    """The timeline with offsets of sensors' clocks subtracted from their stamps."""
    sensors = {
        name: replace(times, stamps=times.stamps - offsets[name].offset) if name in offsets else times
        for name, times in timeline.sensors.items()
    }
    return replace(timeline, sensors=sensors)


def _describe(name: str, found: ClockOffset | None, rig: Rig, clocks: Clocks) -> Finding:
    if found is not None:
        return Finding(
            f"the clock of {name} minus that of the others is {found.offset:.3f} s, estimated from the times at "
            f"which their views change (correlation {found.correlation:.2f}), and its stamps were corrected"
        )
    if rig.topics[name] in clocks.informative:
        return Finding(
            f"the clock of {name} is that of the others to {clocks.stddev(rig.topics[name]):.1f} s, by when its "
            "messages arrived, and its view changes when theirs do"
        )
    return Finding(
        f"the clock offset of {name} cannot be estimated: no offset stands out with which its view changes at "
        "the times of those of the others; move the board in view of both, at irregular times, or state it",
        (name,),
    )


def _find_apart(spans: Mapping[str, tuple[float, float]], root: str) -> list[str]:
    """The sensors without time in common with the one that shares it with most; of first and last stamps, s."""

    def list_apart(name: str) -> list[str]:
        return [other for other, (a, b) in spans.items() if a > spans[name][1] or b < spans[name][0]]

    return min((list_apart(n) for n in sorted(spans, key=lambda n: n != root)), key=len, default=[])


# Log-likelihood of an offset that is searched among all, and its difference from that of any other, from which it
# is that of a clock: the best of some thousand by chance has 8, and moves at equal intervals repeat themselves.
_MIN_LIKELIHOOD, _MIN_DISTINCTION = 12.0, 5.0
# Time to both sides of an offset, s, within which others are of the same maximum: moves of a board take a second.
_PEAK_WIDTH = 1.0
# Distance of the offsets that are compared, s: a tenth of what views determine.
_GRID = 0.01


def estimate_clock_offsets(
    timeline: RecordingTimeline, root: str, wanted: Sequence[str]
) -> dict[str, ClockOffset]:
    """Estimates clock offsets from the motion of the board, which starts and stops in all views at equal times.

    With the correlation ρ(τ) of the changes of two views and the number n of their independent samples, the offset
    τ has the log-likelihood -n/2 log(1 - ρ²), which is summed over the sensors whose offsets are known.

    Args:
        timeline: with the activity of the sensors.
        root: the sensor whose clock counts, unless only that of another one is known.
        wanted: the sensors to estimate the offset of; those left out have one clock.

    Returns:
        The offset of each sensor for which one offset stands out.
    """
    if not wanted:
        return {}
    pairs = _compare_all(timeline)
    known = {name: 0.0 for name in timeline.sensors if name not in wanted} or {root: 0.0}
    found: dict[str, ClockOffset] = {}
    while True:
        searched = {
            name: one for name in wanted if name not in known and (one := _search(name, pairs, known)) is not None
        }
        if not searched:
            return found
        name = max(searched, key=lambda name: (searched[name].distinction, name))
        one = searched[name]
        found[name] = ClockOffset(0.0 if abs(one.offset) < _RESOLUTION else one.offset, one.correlation)
        known[name] = found[name].offset


# Standard deviation of an offset from the times at which views change, s: half a period of usual sensors.
_VIEW_STDDEV = 0.05
# Smallest offset, s, that is corrected where nothing else hints at one: smaller ones leave captures within rests,
# and views from different sides change at times that differ by tenths of a second.
_MIN_LATE = 0.3
# Largest one, s: drivers that stamp late are late by less, and moves that an operator repeats follow at intervals.
_MAX_LATE = 1.5
# Gain of the log-likelihood by an offset, from which it is that of a clock: where nothing else hints at it, and
# where arrivals do. Simulated recordings with one clock gain up to 2.3, with a sensor that is 0.5 s late 9 to 22.
_MIN_GAIN, _MIN_HINTED_GAIN = 8.0, 4.0
# Difference of the log-likelihood from that of another offset, below which it is not known which one is right.
_MIN_LEAD = 2.0
# Distance of an offset from a hint, s, within which it confirms the hint: three standard deviations of both.
_HINT_WIDTH = 0.4


def find_late_views(
    timeline: RecordingTimeline, root: str, compared: Sequence[str], hints: Mapping[str, float]
) -> dict[str, ClockOffset]:
    """The sensors whose views change some time before or after those of all others.

    An offset is that of the clock where it explains the changes much better than none does, see
    :func:`estimate_clock_offsets`; the sensor that gains most is corrected first.

    Args:
        timeline: with the activity of the sensors.
        root: the sensor whose clock counts where two explain the same.
        compared: the sensors whose clocks may differ.
        hints: by sensor, an offset that its arrivals may show, s.
    """
    if not compared:
        return {}
    pairs = _compare_all(timeline)
    corrected = dict.fromkeys(timeline.sensors, 0.0)
    found: dict[str, ClockOffset] = {}
    waiting = sorted(compared, key=lambda name: name == root)
    while waiting:
        late = {name: _find_late(name, pairs, corrected, hints.get(name)) for name in waiting}
        name = max(waiting, key=lambda name: late[name][0])
        gain, offset = late[name]
        if gain <= 0:
            break
        found[name], corrected[name] = offset, offset.offset
        waiting.remove(name)
    return found


Comparison = tuple[Array, Array, float]
"""Offsets (N,) of one clock from another, s, ascending, the correlation (N,) of the changes of both views with
each of them, and the number of independent samples."""
Pairs = Mapping[tuple[str, str], Comparison]


def _compare_all(timeline: RecordingTimeline) -> Pairs:
    """Every two sensors that can be compared."""
    views = timeline.sensors
    compared = {(a, b): _correlate_views(views[a], views[b]) for a, b in combinations(views, 2)}
    return {pair: one for pair, one in compared.items() if one is not None}


def _select_pairs(name: str, pairs: Pairs, known: Mapping[str, float]) -> Iterator[Comparison]:
    """The comparisons of a sensor with every known one, with offsets of its clock from that which counts."""
    for (a, b), (offsets, correlation, count) in pairs.items():
        if len(offsets) < 2:
            continue
        if name == b and a in known:
            yield offsets + known[a], correlation, count
        elif name == a and b in known:
            yield known[b] - offsets[::-1], correlation[::-1], count


def _weigh(name: str, pairs: Pairs, known: Mapping[str, float], offsets: Array) -> tuple[Array, Array]:
    """(N,) log-likelihoods of offsets (N,) of a sensor's clock, s, and the largest correlations with them."""
    likelihood, largest = np.zeros_like(offsets), np.zeros_like(offsets)
    for grid, values, count in _select_pairs(name, pairs, known):
        correlation = np.clip(_interpolate(offsets, grid, values), 0.0, 1 - 1e-6)
        likelihood -= count / 2 * np.log1p(-(correlation**2))
        largest = np.maximum(largest, correlation)
    return likelihood, largest


def _interpolate(offsets: Array, grid: Array, values: Array) -> Array:
    """Values (N,) at equal distances on a grid, at offsets; a cubic has its maximum between them. 0 outside."""
    from scipy.interpolate import CubicSpline  # takes 30 ms to import, and few recordings need it

    inside = (offsets >= grid[0]) & (offsets <= grid[-1])
    found: Array = np.where(inside, CubicSpline(grid, values)(offsets), 0.0)
    return found


@dataclass(frozen=True)
class _Searched(ClockOffset):
    """An offset that stands out among all."""

    distinction: float
    """Log-likelihood minus that of the next best one."""


def _search(name: str, pairs: Pairs, known: Mapping[str, float]) -> _Searched | None:
    """The offset that stands out among all with which the sensor's view overlaps others; None if none does."""
    grids = [grid for grid, _, _ in _select_pairs(name, pairs, known) if len(grid)]
    if not grids:
        return None
    offsets = np.concatenate([np.arange(grid[0], grid[-1] + _GRID, _GRID) for grid in grids])
    likelihood, correlation = _weigh(name, pairs, known, offsets)
    best = int(np.argmax(likelihood))
    rival = float(likelihood[np.abs(offsets - offsets[best]) > _PEAK_WIDTH].max(initial=0.0))
    distinction = float(likelihood[best] - rival)
    if likelihood[best] < _MIN_LIKELIHOOD or distinction < _MIN_DISTINCTION:
        return None
    return _Searched(float(offsets[best]), float(correlation[best]), distinction)


def _find_late(
    name: str, pairs: Pairs, corrected: Mapping[str, float], hint: float | None
) -> tuple[float, ClockOffset]:
    """The offset of a sensor from all others, and by how much its gain exceeds the least that proves it."""
    steps = np.ceil((_MAX_LATE + abs(hint or 0.0)) / _GRID)
    offsets = np.arange(-steps, steps + 1) * _GRID
    likelihood, correlation = _weigh(name, pairs, corrected, offsets)
    best, none = int(np.argmax(likelihood)), len(offsets) // 2
    offset = ClockOffset(float(offsets[best]), float(correlation[best]))
    rival = float(likelihood[np.abs(offsets - offset.offset) > _MIN_LATE].max())
    least = _MIN_LATE if hint is None else 2 * _VIEW_STDDEV
    if abs(offset.offset) < least or likelihood[best] - rival < _MIN_LEAD:
        return -np.inf, offset
    confirms = hint is not None and abs(offset.offset - hint) <= _HINT_WIDTH
    return float(likelihood[best] - likelihood[none]) - (_MIN_HINTED_GAIN if confirms else _MIN_GAIN), offset


# Minimum number of messages of a sensor: fewer changes of a view agree with others by chance.
_MIN_MESSAGES = 20
# Minimum duration of a recording, s: in a shorter one a board enters and leaves a view a few times, and the few
# changes agree with others by chance.
_MIN_SPAN = 20.0
# Minimum number of times at which a view begins or ceases to change: what passes through one view after another
# shows the way, not the clocks. Activity is averaged over _SMOOTHING, s, less than a move lasts.
_MIN_CHANGES = 8
_SMOOTHING = 0.4
# Minimum time between samples of the activity, s; half of the shortest period above it. The offset is
# interpolated to a fraction of it.
_MIN_STEP = 0.005
# Maximum number of samples of a view: two hours at 30 Hz. Views of a longer time, or with a stamp that is far
# from all others, are not compared.
_MAX_SAMPLES = 500_000
# Minimum share of the shorter view that lies within the other with an offset: recordings of cameras that are
# started one after the other overlap for most of their time, and short overlaps agree by chance.
_MIN_OVERLAP = 0.5
# Offsets below it, s, are taken for zero: the estimate is no better, and a device that starts its recordings
# together gives them one clock.
_RESOLUTION = 0.02


def _correlate_views(reference: SensorTimes, other: SensorTimes) -> Comparison | None:
    """How similarly two views change with each offset of the other's clock; None if that cannot be known."""
    pair = reference, other = reference.with_content(), other.with_content()
    if any(len(times.stamps) < _MIN_MESSAGES or np.ptp(times.stamps) < _MIN_SPAN for times in pair):
        return None
    if any(times.period > MAX_MOTION_PERIOD or not times.activity.any() for times in pair):
        return None
    step = max(min(times.period for times in pair) / 2, _MIN_STEP)
    if any(np.ptp(times.stamps) > step * _MAX_SAMPLES for times in pair):
        return None
    first, second = (_sample_activity(times, step) for times in pair)
    if min(_count_changes(one, step) for one in (first, second)) < _MIN_CHANGES:
        return None
    lags, correlation = correlate_at_lags(first, second, _MIN_OVERLAP)
    offsets = _center(other) - _center(reference) - step * lags.astype(np.float64)
    return offsets[::-1], correlation[::-1], _count_independent(first, second)


def _count_changes(activity: Array, step: float) -> int:
    """How often activity (N,), every ``step`` s, crosses the middle of its range."""
    width = max(round(_SMOOTHING / step), 1)
    smooth = np.convolve(np.pad(activity, width // 2, "edge"), np.full(width, 1 / width), "valid")
    high = smooth > (smooth.min() + smooth.max()) / 2
    return int(np.sum(high[1:] != high[:-1]))


def _center(times: SensorTimes) -> float:
    """Time of the first sample, s: a change happens between the middles of the measurements that are compared."""
    return float(times.stamps[0] + times.duration / 2 - times.reach / 2)


def _rank(values: Array) -> Array:
    """(N,) the place of each value in ascending order, from 1; equal ones have the mean of their places."""
    _, of_value, counts = np.unique(values, return_inverse=True, return_counts=True)
    return np.asarray((np.cumsum(counts) - (counts - 1) / 2)[of_value])


def _sample_activity(times: SensorTimes, step: float) -> Array:
    """The rank of the activity, 0..1, at equal steps, s: single messages without any change do not dominate."""
    grid = np.arange(times.stamps[0], times.stamps[-1], step)
    measured = np.concatenate([times.activity[1:2], times.activity[1:]])  # of the first, no change is known
    sampled: Array = np.interp(grid, times.stamps, _rank(measured) / len(measured))
    return sampled


def _count_independent(first: Array, second: Array) -> float:
    """The number of independent samples that have the variance of a correlation by chance (Bartlett 1935)."""
    autocorrelations = []
    for signal in (first - first.mean(), second - second.mean()):
        size = next_fast_len(2 * len(signal), real=True)
        products = irfft(np.abs(rfft(signal, size)) ** 2, size)[: len(signal)]
        autocorrelations.append(products / max(float(products[0]), 1e-300))
    n = min(len(first), len(second))
    lags = np.arange(1, n // 2)
    shared = autocorrelations[0][lags] * autocorrelations[1][lags] * (1 - lags / n)
    return float(n / max(1 + 2 * shared.sum(), 1.0))
