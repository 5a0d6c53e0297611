"""How a recording shows the board: at rest, in separate snapshots, or in synchronized frames while it moves."""

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from calgraph.config import Capture, CaptureMode
from calgraph.config.settings import CaptureSettings
from calgraph.errors import CalibrationError, RecordingError
from calgraph.geometry import Array
from calgraph.recording import Recording
from calgraph.rig.captures.motion_detection import BASELINE, ActivityMeter
from calgraph.rig.captures.rests import find_noise, find_rests
from calgraph.rig.captures.timeline import MAX_MOTION_PERIOD, RecordingTimeline, SensorTimes, build_timeline
from calgraph.rig.kinds import MOTION_SIGNATURES

StampGroup = Mapping[str, Array]
"""Messages of at least two sensors that were measured of one pose of the board.

By sensor, its stamps in ascending order, s; no entry for a sensor without message in the group.
"""


def find_span(group: StampGroup) -> tuple[float, float]:
    """First and last stamp, s."""
    return min(float(stamps[0]) for stamps in group.values()), max(float(stamps[-1]) for stamps in group.values())


def group_bursts(bursts: Mapping[str, Sequence[Array]], max_gap: float, max_spread: float) -> list[StampGroup]:
    """Groups the bursts of several sensors so that a group has at most one burst of each.

    Groups are consecutive in time. As many bursts as possible are joined with the one before; of the groupings
    with that number, the one with the shortest gaps inside its groups is taken (dynamic programming over the
    bursts).

    Args:
        bursts: by sensor, the stamps of the messages that belong together, in order of time.
        max_gap: maximum time between a burst and the one before it in a group, s.
        max_spread: maximum time between the first stamps of the first and of the last burst of a group, s.

    Returns:
        The groups with at least two sensors, in order of time.
    """
    events = sorted(
        ((float(burst[0]), float(burst[-1]), name, burst) for name, all_ in bursts.items() for burst in all_),
        key=lambda event: event[:3],
    )
    # Of the best grouping of the first k events: (number of groups, sum of gaps, first event of the last group).
    best: list[tuple[int, float, int]] = [(0, 0.0, 0)]
    for k in range(1, len(events) + 1):
        options = []
        sensors: set[str] = set()
        gaps, first = 0.0, k - 1
        while True:
            sensors.add(events[first][2])
            groups, sum_of_gaps, _ = best[first]
            options.append((groups + 1, sum_of_gaps + gaps, first))
            if first == 0 or events[first - 1][2] in sensors:
                break
            gap = max(events[first][0] - events[first - 1][1], 0.0)
            if gap > max_gap or events[k - 1][0] - events[first - 1][0] > max_spread:
                break
            gaps, first = gaps + gap, first - 1
        best.append(min(options))
    groups_found: list[StampGroup] = []
    k = len(events)
    while k:
        first = best[k][2]
        if k - first > 1:
            groups_found.append({name: burst for _, _, name, burst in events[first:k]})
        k = first
    return groups_found[::-1]


@dataclass(frozen=True)
class RecognizedMode:
    """How a recording shows the board."""

    mode: CaptureMode
    """``rest``, ``snapshots`` or ``synchronized``."""
    reason: str
    """Why, in one sentence without full stop."""
    spread: float | None = None
    """Median time between the first and the last stamp of a set of frames, s, where the stamps show such sets."""


# Number of rests from which the captures are rests although the stamps show sets of frames of a moving board: a
# dozen poses calibrate a sensor, and frames of a board at rest are the better ones.
_MIN_RESTS = 12
# Share of the recording in which nothing moves, below which fewer rests than _MIN_RESTS are those of a moving
# board, at start and end or where it is turned back: operators who hold the board still do so for half of the
# time.
_MIN_REST_SHARE = 0.2


def recognize_mode(timeline: RecordingTimeline, capture: Capture, settings: CaptureSettings) -> RecognizedMode:
    """Recognises how a recording shows the board.

    A timeline without activity (built without meters) shows whether the recording consists of snapshots, but not
    whether the board ever rests: the mode is then ``rest``, and ``spread`` is stated where the stamps show sets of
    frames.
    """
    if capture.mode:
        return RecognizedMode(capture.mode, f"rig.yaml states capture.mode: {capture.mode}")
    if capture.trigger or len(timeline.triggers):
        return RecognizedMode("rest", f"each of {len(timeline.triggers)} triggers starts a capture")
    if timeline.poses:
        return RecognizedMode("snapshots", f"each of {len(timeline.poses)} recordings is short, and of one pose")
    if is_snapshot_recording(timeline, settings.max_snapshot_gap) or _has_separate_bursts(timeline, settings):
        poses = max((len(_bursts(times)) for times in timeline.sensors.values()), default=0)
        return RecognizedMode("snapshots", f"the sensors measured {poses} times, with pauses in between")
    frames = find_frame_sets(timeline, capture)
    spread = None
    if _are_synchronized(frames, timeline, settings):
        spread = float(np.median([last - first for first, last in map(find_span, frames)]))
    if not any(np.nan_to_num(times.activity).any() for times in timeline.sensors.values()):
        reason = "the sensors measure continuously; how much their views change was not measured"
        return RecognizedMode("rest", reason, spread)
    begin = timeline.start
    rests = [(a, b) for a, b in find_rests(timeline, settings) if capture.allows(a - begin, b - begin)]
    # A moving board may rest for a moment: when the recording starts and ends, and where it is turned back.
    duration = np.ptp(np.concatenate([times.stamps for times in timeline.sensors.values()]))
    share = sum(b - a for a, b in rests) / max(float(duration), 1e-9)
    enough = len(rests) >= _MIN_RESTS or (len(rests) >= settings.min_poses and share >= _MIN_REST_SHARE)
    rested = enough and not _are_moving(timeline, rests)
    if rests and (spread is None or rested):
        return RecognizedMode("rest", f"nothing moves in {len(rests)} intervals of the recording", spread)
    if spread is None:
        return RecognizedMode("rest", "the sensors measure continuously, and their stamps show no sets of frames")
    return RecognizedMode(
        "synchronized",
        f"the board never rests, and the stamps of {len(frames)} sets of frames lie {1000 * spread:.1f} ms apart "
        "(median)",
        spread,
    )


def _are_moving(timeline: RecordingTimeline, rests: Sequence[tuple[float, float]]) -> bool:
    """Whether a view changes by more than noise in most of the rests: slow parts of a motion."""
    limits = {message.__name__: signature.noise for message, signature in MOTION_SIGNATURES.items()}
    return any(
        noise > limits.get(timeline.sensors[name].message_type, 1.0)
        for name, noise in find_noise(timeline, rests).items()
    )


def is_snapshot_recording(timeline: RecordingTimeline, max_gap: float) -> bool:
    """Whether no two messages of a sensor lie within twice ``max_gap``, s: each pose has one of each."""
    gaps = [np.diff(times.stamps) for times in timeline.sensors.values() if len(times.stamps) > 1]
    return not gaps or bool(np.min(np.concatenate(gaps)) > 2 * max_gap)


# Maximum time between the stamps of a set of frames, where rig.yaml states none, over the shortest period of a
# sensor: sets of consecutive frames do not overlap, and triggers of cameras and drivers that read one camera
# after the other stay within it.
_MAX_SPREAD_SHARE = 0.35


def find_frame_sets(timeline: RecordingTimeline, capture: Capture) -> list[StampGroup]:
    """The sets of frames of different sensors within ``capture.max_spread``, or a share of the shortest period.

    A set has at most one message of each sensor.
    """
    periods = [times.period for times in timeline.sensors.values() if np.isfinite(times.period)]
    if not periods:
        return []
    max_spread = capture.max_spread or _MAX_SPREAD_SHARE * min(periods)
    frames = {name: list(np.unique(times.stamps)[:, None]) for name, times in timeline.sensors.items()}
    return group_bursts(frames, max_spread, max_spread)


def find_snapshots(timeline: RecordingTimeline, capture: Capture, settings: CaptureSettings) -> list[StampGroup]:
    """The poses of a recording of snapshots, each with the messages of all sensors.

    Messages of different sensors belong to one pose if at most ``settings.max_snapshot_gap`` lies between them.
    Where that leaves half of the messages alone, as drivers respond late, the gap is doubled, until it exceeds
    ``settings.max_snapshot_spread``. A stated ``capture.max_spread`` is the time between the first stamps of the
    first and of the last sensor of a pose. Where each recording is of one pose, stamps do not matter.
    """
    if timeline.poses:
        return [group for start, end in timeline.poses if (group := _select_between(timeline, start, end))]
    bursts = {name: _bursts(times) for name, times in timeline.sensors.items()}
    if capture.max_spread:
        return group_bursts(bursts, capture.max_spread, capture.max_spread)
    count = sum(len(one) for one in bursts.values())
    gap, groups = settings.max_snapshot_gap, group_bursts(bursts, settings.max_snapshot_gap, np.inf)
    while 2 * sum(map(len, groups)) < count and 2 * gap <= settings.max_snapshot_spread:
        gap *= 2
        groups = group_bursts(bursts, gap, np.inf)
    return groups


def _select_between(timeline: RecordingTimeline, start: float, end: float) -> StampGroup | None:
    """All messages between two stamps; None of fewer than two sensors."""
    within = {
        name: times.stamps[(times.stamps >= start) & (times.stamps <= end)]
        for name, times in timeline.sensors.items()
    }
    some = {name: stamps for name, stamps in within.items() if len(stamps)}
    return some if len(some) > 1 else None


def _are_synchronized(frames: list[StampGroup], timeline: RecordingTimeline, settings: CaptureSettings) -> bool:
    """Whether the sensors are fast, and half of the messages of the slowest one belong to sets of frames."""
    sensors = [times for times in timeline.sensors.values() if len(times.stamps)]
    if any(times.period > MAX_MOTION_PERIOD for times in sensors):
        return False
    counts = [len(np.unique(times.stamps)) for times in sensors]
    return len(frames) >= settings.min_poses and 2 * len(frames) >= min(counts)


def _has_separate_bursts(timeline: RecordingTimeline, settings: CaptureSettings) -> bool:
    """Whether every sensor measured shortly, with pauses of different lengths in between."""
    sensors = [times for times in timeline.sensors.values() if len(times.stamps)]
    bursts = [_bursts(times) for times in sensors]
    if min((len(one) for one in bursts), default=0) < settings.min_poses:
        return False
    if any(burst[-1] - burst[0] >= settings.min_hold for one in bursts for burst in one):
        return False
    return not all(_is_periodic(times) for times in sensors)


def _bursts(times: SensorTimes) -> list[Array]:
    """The stamps of a sensor, split where it pauses."""
    stamps = times.stamps
    return np.split(stamps, np.flatnonzero(np.diff(stamps) > MAX_MOTION_PERIOD) + 1) if len(stamps) else []


# Maximum median deviation of the pauses of a sensor over their median in a periodic stream: drivers keep their
# period within some percent; operators who take snapshots do not.
_MAX_PERIOD_JITTER = 0.05


def _is_periodic(times: SensorTimes) -> bool:
    """Whether the pauses of a sensor are equal within a share, as those of a slow driver are."""
    periods = np.diff(times.stamps)
    return float(np.median(np.abs(periods - times.period))) < _MAX_PERIOD_JITTER * times.period


# Of a large recording this much is read, s: dozens of rests.
_DURATION = 300.0
# Smaller recordings are read whole.
_MAX_MESSAGES = 20_000


def recognize_recording(
    recording: Recording, topics: Collection[str], settings: CaptureSettings, empty_end: float = 0.0
) -> RecognizedMode | None:
    """Recognises how a recording without triggers shows the board.

    All messages are decoded, of a large recording those of its first minutes, unless their stamps show snapshots.

    Args:
        recording: to be read.
        topics: of its sensors, with usable messages.
        settings: of the search for captures.
        empty_end: end of the time without board at the start, s.

    Returns:
        The mode; None for fewer than two sensors, or if a message is damaged or a stamp days from the others,
        which reading all of them reports.
    """
    if len(topics) < 2:
        return None
    names = {topic: topic for topic in topics}
    try:
        start, is_small = recording.start, sum(topic.count for topic in recording.topics) <= _MAX_MESSAGES
        end = recording.end if is_small else start + _DURATION
        timeline = build_timeline(recording.records(topics, start, end), start, names, None)
        mode = recognize_mode(timeline, Capture(), settings)
        if mode.mode == "snapshots":
            return mode
        meters = {topic: ActivityMeter(BASELINE) for topic in topics}
        records = recording.records(topics, start + empty_end, end)
        return recognize_mode(build_timeline(records, start, names, None, meters=meters), Capture(), settings)
    except (RecordingError, CalibrationError):
        return None
