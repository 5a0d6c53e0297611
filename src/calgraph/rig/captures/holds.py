"""Holds: the times in which the board rests; and which messages of each sensor were measured in them."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import pairwise
from typing import Any, TypeVar, cast

import numpy as np
from numpy.typing import NDArray

from calgraph.config import Capture, Rig
from calgraph.config.settings import CaptureSettings
from calgraph.errors import CalibrationError
from calgraph.geometry import Array
from calgraph.rig.captures.capture_mode import (
    StampGroup,
    find_frame_sets,
    find_snapshots,
    find_span,
    recognize_mode,
)
from calgraph.rig.captures.rests import find_noise, find_rests
from calgraph.rig.captures.timeline import MAX_MOTION_PERIOD, RecordingTimeline, SensorTimes
from calgraph.rig.kinds import RIG_KINDS


@dataclass(frozen=True, eq=False)
class Hold:
    """One time in which the board rests."""

    index: int
    start: float
    end: float
    """s, header time."""
    stamps: Mapping[str, Array] = field(default_factory=dict)
    """By sensor, the stamps of the messages measured entirely within the hold."""
    auxiliary: bool = False
    """Whether it only shows the velocity of the board in another capture, and is none itself."""


def find_holds(timeline: RecordingTimeline, capture: Capture, settings: CaptureSettings) -> tuple[Hold, ...]:
    """Finds the holds: by trigger, from separate snapshots, by stillness, or each set of synchronized frames.

    Args:
        timeline: when the sensors measured, and when captures were triggered.
        capture: the trigger if there is one, and the windows in which no hold may lie.
        settings: of the search.

    Returns:
        The holds in order of time, each with the messages to use; auxiliary ones after all others.

    Raises:
        CalibrationError: there is none.
    """
    mode = recognize_mode(timeline, capture, settings).mode
    if mode == "synchronized":
        sets = find_frame_sets(timeline, capture)
        begin = timeline.start
        frames = [group for group in sets if capture.allows(*(stamp - begin for stamp in find_span(group)))]
        if sets and not frames:
            raise CalibrationError(
                f"all {len(sets)} sets of frames lie in capture.background or capture.exclude; make these "
                "shorter, or record longer"
            )
        chosen = select_frame_sets(frames, timeline, settings.moving_board.max_captures)
        # After the captures, the frames that show the velocity of the board.
        velocities = _hold_groups(find_neighbours(chosen, timeline), timeline, auxiliary=True)
        found = [*_hold_groups(chosen, timeline), *velocities]
    else:
        if capture.trigger:
            candidates = _select_messages(timeline, _find_spans_by_trigger(timeline), 0.0)
        elif mode == "snapshots":
            candidates = _hold_groups(find_snapshots(timeline, capture, settings), timeline)
        else:
            spans = select_middles(timeline, find_rests(timeline, settings))
            candidates = _select_messages(timeline, spans, MAX_MOTION_PERIOD)
        begin = timeline.start
        found = [hold for hold in candidates if capture.allows(hold.start - begin, hold.end - begin)]
    if not found:
        raise CalibrationError(_explain_no_holds(timeline, capture, mode))
    return tuple(replace(hold, index=i) for i, hold in enumerate(found))


def _select_messages(
    timeline: RecordingTimeline, spans: list[tuple[float, float]], max_period: float
) -> list[Hold]:
    """The holds of some intervals, each with the messages that were measured entirely within it.

    Sensors with periods up to ``max_period``, s, are known to measure rest before the interval, too.
    """
    sensors = timeline.sensors.items()
    return [
        Hold(0, a, b, {name: _select_stamps(one, a, b, one.period <= max_period) for name, one in sensors})
        for a, b in spans
    ]


def _hold_groups(groups: list[StampGroup], timeline: RecordingTimeline, *, auxiliary: bool = False) -> list[Hold]:
    """One hold a group, with all of its messages."""
    nothing = dict.fromkeys(timeline.sensors, np.zeros(0))
    return [Hold(0, *find_span(one), {**nothing, **one}, auxiliary=auxiliary) for one in groups]


def _explain_no_holds(timeline: RecordingTimeline, capture: Capture, mode: str) -> str:
    if capture.trigger and not len(timeline.triggers):
        return (
            f"the topic {capture.trigger} has no message: check capture.trigger, or leave it out to find the "
            "holds from the data"
        )
    if capture.trigger:
        return (
            f"all {len(timeline.triggers)} messages of {capture.trigger} lie in capture.background or "
            "capture.exclude; make these shorter"
        )
    if mode == "snapshots":
        return (
            "no pose was measured by two sensors: their stamps lie too far apart; state capture.max_spread in "
            "seconds, or give one recording per pose"
        )
    if mode == "synchronized":
        return (
            "no two sensors have frames whose stamps are nearly equal: state capture.max_spread in seconds, the "
            "largest difference that is acceptable, or hold the board still"
        )
    return "the board never rests: hold it still twice as long as the slowest sensor takes, or record a trigger"


# Length of the middle of a rest whose messages are used, s: near its ends the board may move by less than views
# show, and scans of one second average to less than the bias of a scanner.
_MIDDLE = 1.0
# Change of a view in the middle of a rest, over that in its quietest part, from which the latter is used: a small
# move between two rests was missed, or someone passed. Noise of single messages scatters by a factor of two.
_LOUD = 3.0
# Distance of the parts that are compared, s: every other image at 10 Hz.
_STEP = 0.2


def select_middles(timeline: RecordingTimeline, rests: Sequence[tuple[float, float]]) -> list[tuple[float, float]]:
    """The middle of each rest, or its quietest part where views change in the middle.

    Twice the period of the slowest sensor holds one full measurement for certain.
    """
    periods = [times.period for times in timeline.sensors.values() if np.isfinite(times.period)]
    length = max(_MIDDLE, *(2 * period for period in periods))
    noise = find_noise(timeline, rests)
    views = [(timeline.sensors[name].with_content(), level) for name, level in noise.items() if level > 0]
    sums = [(one, one.reach, np.append(0.0, np.cumsum(one.activity / level))) for one, level in views]

    def measure_change(starts: Array) -> Array:
        """Largest mean change of a view from each of some times on, over the noise of the view in rests."""
        changes = np.zeros(len(starts))
        for times, reach, total in sums:
            first = np.searchsorted(times.stamps, starts + reach)
            count = np.maximum(np.searchsorted(times.stamps, starts + length) - first, 0)
            changes = np.maximum(changes, (total[first + count] - total[first]) / np.maximum(count, 1))
        return changes

    parts = []
    for a, b in rests:
        margin = max((b - a - length) / 2, 0.0)
        least = min(margin, length / 2)
        starts = np.append(a + margin, np.arange(a + least, b - length - least, _STEP))
        changes = measure_change(starts)
        quietest = int(np.argmin(changes))
        start = float(starts[quietest if changes[0] > _LOUD * changes[quietest] else 0])
        parts.append((start, min(start + length, b)))
    return parts


def _find_spans_by_trigger(timeline: RecordingTimeline) -> list[tuple[float, float]]:
    """From each trigger until every sensor has measured twice (MSG-Cal, III), or until the next trigger."""
    spans = []
    for start, next_trigger in pairwise([*timeline.triggers, np.inf]):
        measured_twice = [start]
        for times in timeline.sensors.values():
            after = np.unique(times.stamps[times.stamps >= start])
            if len(after) >= 2:
                measured_twice.append(after[1] + times.duration)
        spans.append((float(start), float(min(max(measured_twice), next_trigger))))
    return spans


def _select_stamps(times: SensorTimes, start: float, end: float, rested: bool) -> Array:
    """Stamps of the messages that were measured entirely between start and end.

    Where messages do not state how long they took, their stamp may be of the first or of the last point: unless
    the board rested before, only a message with another one before it in the hold is used (MSG-Cal's second
    measurement).
    """
    inside = times.stamps[(times.stamps >= start) & (times.stamps + times.duration <= end + 1e-6)]
    return inside if rested or times.duration > 0 else inside[1:]


def select_frame_sets(groups: Sequence[StampGroup], timeline: RecordingTimeline, limit: int) -> list[StampGroup]:
    """At most ``limit`` of the sets of frames, spread over the recording.

    Of each of ``limit`` equal parts of the recording, the set is taken that most sensors are part of, and of those
    with as many, the one in which the views change least: the board is slow there, and images are sharp.
    """
    if len(groups) <= limit:
        return list(groups)
    change = np.mean([_relative_activity(times, name, groups) for name, times in timeline.sensors.items()], axis=0)
    parts = np.array_split(np.arange(len(groups)), limit)
    return [groups[min(part, key=lambda i: (-len(groups[i]), change[i]))] for part in parts]


def find_neighbours(groups: Sequence[StampGroup], timeline: RecordingTimeline) -> list[StampGroup]:
    """The messages of each sensor before and after those of some groups, as far as they are in none of them.

    They show the velocity of the board. Groups may be of a single sensor.
    """
    used = {(name, float(stamps[0])) for group in groups for name, stamps in group.items()}
    all_stamps = {name: np.unique(times.stamps) for name, times in timeline.sensors.items()}
    found: list[StampGroup] = []
    for group in groups:
        for step in (-1, 1):
            stamps: dict[str, Array] = {}
            for name, (stamp, *_) in group.items():
                i = int(np.searchsorted(all_stamps[name], stamp)) + step
                if 0 <= i < len(all_stamps[name]) and (name, float(all_stamps[name][i])) not in used:
                    used.add((name, float(all_stamps[name][i])))
                    stamps[name] = all_stamps[name][i : i + 1]
            if stamps:
                found.append(stamps)
    return found


def _relative_activity(times: SensorTimes, name: str, groups: Sequence[StampGroup]) -> Array:
    """(G,) change of a sensor's view at its frame of each group, over its median; 0 where it has none."""
    activity = np.nan_to_num(times.activity)
    typical = float(np.median(activity)) if len(activity) else 0.0
    if typical == 0.0:
        return np.zeros(len(groups))
    by_stamp = dict(zip(times.stamps.tolist(), activity.tolist(), strict=True))
    return np.array([by_stamp[float(g[name][0])] / typical if name in g else 0.0 for g in groups])


def limit_messages(holds: Iterable[Hold], rig: Rig) -> tuple[Hold, ...]:
    """The same holds with the messages of each sensor that sharpen a detection, spread over the hold.

    Sensors of one kind measure at nearly the same times, where they can: a trembling board is then at one place
    for cameras whose images are taken together. Of 84 views of two such cameras, 6 were outliers without it.
    """
    of_kinds = rig.settings.captures.max_messages
    kinds = {name: spec.kind for name, spec in rig.sensors.items()}
    limits = {kind: RIG_KINDS[kind].max_messages(of_kinds) for kind in kinds.values()}
    limited = []
    for hold in holds:
        stamps = dict(hold.stamps)
        for kind, limit in limits.items():
            enough = {name: one for name, one in stamps.items() if kinds[name] == kind and len(one) >= limit}
            if enough:
                times = sample_evenly(_find_common_times(list(enough.values())), limit)
                stamps |= {name: _select_nearest(one, times) for name, one in enough.items()}
        limited.append(replace(hold, stamps=stamps))
    return tuple(limited)


def _find_common_times(stamps: Sequence[Array]) -> Array:
    """Stamps of the sensor that has the fewest, where all others measure within half of its period."""
    times = min(stamps, key=len)
    if len(times) == 1:
        return times
    reach = (times[-1] - times[0]) / (len(times) - 1) / 2
    first, last = max(one[0] for one in stamps), min(one[-1] for one in stamps)
    common = times[(times >= first - reach) & (times <= last + reach)]
    return common if len(common) > 1 else times


def _select_nearest(stamps: Array, times: Array) -> Array:
    """M of the stamps (N,), ascending, that are nearest to times (M,); evenly chosen where some are the same."""
    nearest = np.unique(np.abs(stamps - times[:, None]).argmin(axis=1))
    return stamps[nearest] if len(nearest) == len(times) else sample_evenly(stamps, len(times))


Values = TypeVar("Values", bound=NDArray[Any])


def sample_evenly(values: Values, count: int) -> Values:
    """At most ``count`` of values (N,), evenly chosen."""
    if len(values) <= count:
        return values
    return cast("Values", values[np.linspace(0, len(values) - 1, count).round().astype(int)])
