"""The clocks of a rig's sensors: offsets by the times at which views change, and stamps by the root's clock."""

from collections.abc import Collection, Iterator, Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.fft import irfft, next_fast_len, rfft

from calgraph.config import Rig
from calgraph.geometry import Array
from calgraph.parallel.engine import THIS_PROCESS, Engine
from calgraph.parallel.progress import Progress, no_progress
from calgraph.recording import NO_CACHE, ClockCorrectedRecording, Recording, RecordingCache
from calgraph.recording.input_checks import InputMonitor
from calgraph.result.finding import Finding
from calgraph.rig.captures.motion_detection import MIN_ACTIVITY
from calgraph.rig.captures.timeline import MAX_MOTION_PERIOD, RecordingTimeline, SensorTimes
from calgraph.rig.captures.timeline_reading import read_rig_timeline


@dataclass(frozen=True)
class ClockAlignment:
    """A rig and its recording with all stamps by the root's clock."""

    rig: Rig
    """With estimated clock offsets as numbers."""
    recording: Recording
    findings: tuple[Finding, ...]
    """What was estimated, and whose clock remains unknown."""


@dataclass(frozen=True)
class ClockOffset:
    """The clock of a sensor relative to that of the root."""

    offset: float
    """The sensor's clock minus the root's, s."""
    correlation: float
    """Of the changes of both views with this offset, at most 1."""


def align_clocks(
    rig: Rig,
    recording: Recording,
    cache: RecordingCache = NO_CACHE,
    engine: Engine = THIS_PROCESS,
    progress: Progress = no_progress,
) -> ClockAlignment:
    """Corrects the stamps of the sensors whose clock offsets rig.yaml states or asks to estimate.

    A clock that cannot be estimated is taken for that of the root, and the sensor's pose is weak.

    Args:
        rig: the rig.
        recording: open recording with the rig's topics.
        cache: has what earlier runs read.
        engine: measures how much views change.
        progress: called with the step and the fraction done.
    """
    offsets = {name: spec.clock_offset for name, spec in rig.sensors.items() if spec.clock_offset is not None}
    wanted = [name for name, offset in offsets.items() if offset == "estimate"]
    findings = []
    if wanted:
        monitor = InputMonitor(rig, recording.start)
        timeline = read_rig_timeline(rig, recording, monitor, cache, engine, progress)
        found = estimate_clock_offsets(timeline, rig.root, wanted)
        findings = [_describe(name, rig.root, found.get(name)) for name in wanted]
        offsets |= {name: found[name].offset if name in found else 0.0 for name in wanted}
    stated = {name: float(offset) for name, offset in offsets.items()}
    if any(stated.values()):
        by_topic = {rig.sensors[name].topic: offset for name, offset in stated.items()}
        recording = ClockCorrectedRecording(recording, by_topic)
    sensors = {
        name: spec.model_copy(update={"clock_offset": stated.get(name)}) for name, spec in rig.sensors.items()
    }
    return ClockAlignment(rig.model_copy(update={"sensors": sensors}), recording, tuple(findings))


def _describe(name: str, root: str, found: ClockOffset | None) -> Finding:
    if found is None:
        return Finding(
            f"the clock offset of {name} cannot be estimated: no offset stands out with which its view changes at "
            f"the times of that of {root}; move the board in view of both, at irregular times, or state it",
            (name,),
        )
    return Finding(
        f"the clock of {name} minus that of {root} is {found.offset:.3f} s, estimated from the times at which "
        f"their views change (correlation {found.correlation:.2f})"
    )


def estimate_clock_offsets(
    timeline: RecordingTimeline, root: str, wanted: Collection[str]
) -> Mapping[str, ClockOffset]:
    """Estimates clock offsets from the motion of the board, which starts and stops in all views at the same times.

    The normalised cross-correlation of the changes of two views, over the time that both cover with each offset
    (Padfield 2012, "Masked object registration in the Fourier domain"), has one maximum that stands out.
    A sensor is compared with the root first, then with the sensors whose offsets are known.

    Args:
        timeline: with the activity of the sensors.
        root: the sensor whose clock counts.
        wanted: the other sensors to estimate the offset of; those left out have the root's clock.

    Returns:
        The offset of each sensor for which one offset stands out.
    """
    reference = [root, *(name for name in timeline.sensors if name != root and name not in wanted)]
    found: dict[str, ClockOffset] = {}
    for other in reference:
        for name in wanted:
            if name not in found:
                offset = _compare(timeline.sensors[other], timeline.sensors[name])
                if offset:
                    found[name] = offset
    return found


# Minimum offset, s, that is remarked on where rig.yaml states none: smaller ones leave captures within rests, and
# views from different sides differ by them.
_MIN_REMARK = 0.5


def check_clocks(rig: Rig, timeline: RecordingTimeline) -> Iterator[Finding]:
    """Remarks on sensors whose views change long before or after that of the root, where no offset is stated.

    Args:
        rig: the rig.
        timeline: with the activity of the sensors.
    """
    unstated = [name for name, spec in rig.sensors.items() if name != rig.root and spec.clock_offset is None]
    found = estimate_clock_offsets(timeline, rig.root, unstated)
    for name, one in found.items():
        if abs(one.offset) >= _MIN_REMARK:
            order = "after" if one.offset > 0 else "before"
            yield Finding(
                f"by its stamps, the view of {name} changes {abs(one.offset):.2f} s {order} that of {rig.root}: "
                f"their clocks differ; state sensors.{name}.clock_offset: {one.offset:.3f}, or estimate"
            )


# Minimum number of messages of a sensor: fewer changes of a view agree with others by chance.
_MIN_MESSAGES = 20
# Minimum time between samples of the activity, s; half of the shortest period above it. The offset is
# interpolated to a fraction of it.
_MIN_STEP = 0.005
# Maximum number of samples of a view: two hours at 30 Hz. Views of a longer time, or with a stamp that is far
# from all others, are not compared.
_MAX_SAMPLES = 500_000
# Minimum share of the shorter view that lies within the other with an offset: recordings of cameras that are
# started one after the other overlap for most of their time, and short overlaps agree by chance.
_MIN_OVERLAP = 0.5
# Time to both sides of an offset, s, within which larger correlations are of the same maximum: moves of a board
# take a second.
_PEAK_WIDTH = 1.0
# Minimum correlation: views from different sides change differently, and share starts and stops.
_MIN_CORRELATION = 0.5
# Minimum difference to the correlation with any other offset: moves at equal intervals repeat themselves, and
# those of a hand nearly do.
_MIN_DISTINCTION = 0.25
# Minimum correlation over its standard deviation by chance: the largest of some thousand offsets reaches four in
# views that have nothing in common.
_MIN_SIGNIFICANCE = 5.0
# Offsets below it, s, are taken for zero: the estimate is no better, and a device that starts its recordings
# together gives them one clock.
_RESOLUTION = 0.02


def _compare(reference: SensorTimes, other: SensorTimes) -> ClockOffset | None:
    """The offset of the other's clock; None if no offset stands out."""
    pair = (reference, other)
    if any(len(times.stamps) < _MIN_MESSAGES or np.ptp(times.stamps) == 0 for times in pair):
        return None
    if any(times.period > MAX_MOTION_PERIOD for times in pair):
        return None
    step = max(min(times.period for times in pair) / 2, _MIN_STEP)
    if any(np.ptp(times.stamps) > step * _MAX_SAMPLES for times in pair):
        return None
    first, second = (_sample_activity(times, step) for times in pair)
    lags, correlation = _correlate(first, second, _MIN_OVERLAP)
    if not len(lags):
        return None
    best = int(np.argmax(correlation))
    apart = np.abs(lags - lags[best]) * step > _PEAK_WIDTH
    rival = float(correlation[apart].max(initial=0.0))
    peak = float(correlation[best])
    significance = peak * np.sqrt(_count_independent(first, second))
    if peak < _MIN_CORRELATION or peak - rival < _MIN_DISTINCTION or significance < _MIN_SIGNIFICANCE:
        return None
    lag = lags[best] + _refine_peak(correlation, best)
    offset = float(_center(other) - _center(reference) - step * lag)
    return ClockOffset(0.0 if abs(offset) < _RESOLUTION else offset, peak)


def _center(times: SensorTimes) -> float:
    """Time of the first sample, s: a change happens between the messages that are compared."""
    return float(times.stamps[0] - times.reach / 2)


def _sample_activity(times: SensorTimes, step: float) -> Array:
    """The logarithm of the activity at equal steps, s."""
    grid = np.arange(times.stamps[0], times.stamps[-1], step)
    return np.interp(grid, times.stamps, np.log10(times.activity + MIN_ACTIVITY))


def _correlate(first: Array, second: Array, min_overlap: float) -> tuple[NDArray[np.int64], Array]:
    """Lags of the second behind the first, and the correlation over the overlap at each.

    Only lags at which the overlap has ``min_overlap`` of the shorter one.
    """
    first, second = first - first.mean(), second - second.mean()
    size = next_fast_len(len(first) + len(second) - 1, real=True)

    def sum_products(a: Array, b: Array) -> Array:
        product = irfft(rfft(a, size) * np.conj(rfft(b, size)), size)
        rolled: Array = np.roll(product, len(second) - 1)[: len(first) + len(second) - 1]
        return rolled

    one, two = np.ones_like(first), np.ones_like(second)
    count = np.round(sum_products(one, two))
    enough = count >= min_overlap * min(len(first), len(second))
    n = np.where(enough, count, 1)
    sums = sum_products(first, two), sum_products(one, second)
    squares = sum_products(first**2, two), sum_products(one, second**2)
    variances = [np.maximum(square / n - (total / n) ** 2, 0) for square, total in zip(squares, sums, strict=True)]
    covariance = sum_products(first, second) / n - sums[0] * sums[1] / n**2
    scale = np.sqrt(variances[0] * variances[1])
    # A view without changes in the overlap correlates with nothing.
    floor = 1e-6 * float(np.sqrt(first.var() * second.var()))
    correlation = np.where(scale > floor, covariance / np.maximum(scale, 1e-300), 0.0)
    lags = np.arange(len(count), dtype=np.int64) - (len(second) - 1)
    return lags[enough], correlation[enough]


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


def _refine_peak(values: Array, best: int) -> float:
    """Position of the maximum of the parabola through the largest value and its neighbours, relative to it."""
    if not 0 < best < len(values) - 1:
        return 0.0
    before, at, after = values[best - 1 : best + 2]
    curvature = before - 2 * at + after
    return float(0.5 * (before - after) / curvature) if curvature < 0 else 0.0
