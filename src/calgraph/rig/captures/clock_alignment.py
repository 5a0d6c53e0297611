"""Clock offsets of a rig's sensors, from the times at which their views change."""

from collections.abc import Collection, Iterator, Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.fft import irfft, next_fast_len, rfft

from calgraph.config import Rig
from calgraph.config.settings import CaptureSettings, MotionDetectionSettings
from calgraph.geometry import Array
from calgraph.result.finding import Finding
from calgraph.rig.captures.timeline import RecordingTimeline, SensorTimes


@dataclass(frozen=True)
class ClockOffset:
    """The clock of a sensor relative to that of the root."""

    offset: float
    """The sensor's clock minus the root's, s."""
    correlation: float
    """Of the changes of both views with this offset, at most 1."""


def estimate_clock_offsets(
    timeline: RecordingTimeline,
    root: str,
    wanted: Collection[str],
    settings: CaptureSettings = CaptureSettings(),
) -> Mapping[str, ClockOffset]:
    """Estimates clock offsets from the motion of the board, which starts and stops in all views at the same times.

    The normalised cross-correlation of the changes of two views, over the time that both cover with each offset
    (Padfield 2012, "Masked object registration in the Fourier domain"), has one maximum that stands out.
    A sensor is compared with the root first, then with the sensors whose offsets are known.

    Args:
        timeline: with the activity of the sensors.
        root: the sensor whose clock counts.
        wanted: the other sensors to estimate the offset of; those left out have the root's clock.
        settings: of the correlation, and of the activity.

    Returns:
        The offset of each sensor for which one offset stands out.
    """
    reference = [root, *(name for name in timeline.sensors if name != root and name not in wanted)]
    found: dict[str, ClockOffset] = {}
    for other in reference:
        for name in wanted:
            if name not in found:
                offset = _compare(timeline.sensors[other], timeline.sensors[name], settings)
                if offset:
                    found[name] = offset
    return found


def check_clocks(rig: Rig, timeline: RecordingTimeline) -> Iterator[Finding]:
    """Remarks on sensors whose views change long before or after that of the root, where no offset is stated.

    Args:
        rig: the rig.
        timeline: with the activity of the sensors.
    """
    settings = rig.settings.captures
    unstated = [name for name, spec in rig.sensors.items() if name != rig.root and spec.clock_offset is None]
    found = estimate_clock_offsets(timeline, rig.root, unstated, settings)
    for name, one in found.items():
        if abs(one.offset) >= settings.clock_alignment.min_remark:
            order = "after" if one.offset > 0 else "before"
            yield Finding(
                f"by its stamps, the view of {name} changes {abs(one.offset):.2f} s {order} that of {rig.root}: "
                f"their clocks differ; state sensors.{name}.clock_offset: {one.offset:.3f}, or estimate"
            )


def _compare(reference: SensorTimes, other: SensorTimes, captures: CaptureSettings) -> ClockOffset | None:
    """The offset of the other's clock; None if no offset stands out."""
    settings = captures.clock_alignment
    pair = (reference, other)
    if any(len(times.stamps) < settings.min_messages or np.ptp(times.stamps) == 0 for times in pair):
        return None
    if any(times.period > captures.max_motion_period for times in pair):
        return None
    step = max(min(times.period for times in pair) / 2, settings.min_step)
    if any(np.ptp(times.stamps) > step * settings.max_samples for times in pair):
        return None
    first, second = (_sample_activity(times, step, captures.motion) for times in pair)
    lags, correlation = _correlate(first, second, settings.min_overlap)
    if not len(lags):
        return None
    best = int(np.argmax(correlation))
    apart = np.abs(lags - lags[best]) * step > settings.peak_width
    rival = float(correlation[apart].max(initial=0.0))
    peak = float(correlation[best])
    significance = peak * np.sqrt(_count_independent(first, second))
    if (
        peak < settings.min_correlation
        or peak - rival < settings.min_distinction
        or significance < settings.min_significance
    ):
        return None
    lag = lags[best] + _refine_peak(correlation, best)
    offset = float(_center(other) - _center(reference) - step * lag)
    return ClockOffset(0.0 if abs(offset) < settings.resolution else offset, peak)


def _center(times: SensorTimes) -> float:
    """Time of the first sample, s: a change happens between two messages."""
    return float(times.stamps[0] - times.period / 2)


def _sample_activity(times: SensorTimes, step: float, motion: MotionDetectionSettings) -> Array:
    """The logarithm of the activity at equal steps, s."""
    grid = np.arange(times.stamps[0], times.stamps[-1], step)
    return np.interp(grid, times.stamps, np.log10(times.activity + motion.min_activity))


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
