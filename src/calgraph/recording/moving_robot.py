"""Whether a recording is of a robot that drives: what its scanners measure changes in most directions."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from calgraph.config import FoundTopic
from calgraph.geometry import Array, measure_lengths
from calgraph.recording.recording import Recording
from calgraph.sensors import LaserScan, Message, PointCloud, Pose
from calgraph.sensors.kinds import KINDS, motion_kind_of

# Messages of a sensor, and their duration, s, from which a drive is possible at all: snapshots have fewer.
MIN_COUNT, MIN_DURATION = 50, 10.0
# Messages of each scanner that are compared, spread over the recording, each with the one this many before: in a
# quarter of the recording a robot gets to another place.
_MESSAGES, _LAG = 24, 6
# Edge of the cells in which directions are compared, 2°: several beams of any scanner.
_CELL = np.radians(2.0)
# Change of the nearest range that is something else, m, and relative to it: noise is less, and beams along walls.
_MIN_CHANGE, _MIN_CHANGE_RATIO = 0.2, 0.05
# Share of directions that change, in the median over the recording, from which a scanner moves. On drives
# with turns, simulated and real, a scan plane has 0.8 and more, and a cloud, in which floors do not change, 0.35
# and more, but for corridors. People and boards before scanners at rest change 0.24 and 0.08 at most.
_MIN_SHARE = {"lidar2d": 0.5, "lidar3d": 0.3}
# Extent of a trajectory, m, from which a robot drives: one that is at rest drifts less.
_MIN_EXTENT = 2.0


@dataclass(frozen=True)
class MovingRobot:
    """What shows that a recording is of a robot that drives."""

    reason: str
    """In a sentence without full stop."""


def find_moving_robot(recording: Recording, topics: Sequence[FoundTopic]) -> MovingRobot | None:
    """Whether its scanners, or without scanners the poses of other programs, move; None if not.

    Args:
        recording: is read once, and few of its messages are decoded.
        topics: of the recording.
    """
    if recording.end - recording.start < MIN_DURATION:
        return None
    scanners = [topic for topic in topics if topic.kind in _MIN_SHARE and topic.count and not topic.problem]
    if not scanners:
        return _find_moving_pose(recording, topics)
    if any(topic.count < MIN_COUNT for topic in scanners):
        return None
    shares = np.array(measure_changes(recording, [topic.name for topic in scanners]))
    if np.mean(shares / [_MIN_SHARE[topic.kind] for topic in scanners]) < 1:
        return None
    return MovingRobot(f"what scanners measure changes in {shares.mean():.0%} of all directions on the way")


def _find_moving_pose(recording: Recording, topics: Sequence[FoundTopic]) -> MovingRobot | None:
    """The same by poses, where no camera or scanner is recorded."""
    moving = [t.name for t in topics if motion_kind_of(t.type) == "trajectory" and t.count >= MIN_COUNT]
    if any(topic.kind in KINDS for topic in topics):
        return None
    for topic in moving:
        messages = (record.decode() for record in recording.records([topic]))
        places = np.array([one.position for one in messages if isinstance(one, Pose)]).reshape(-1, 3)
        if len(places) and np.ptp(places, axis=0).max() > _MIN_EXTENT:
            return MovingRobot(f"the poses of {topic} move by {np.ptp(places, axis=0).max():.1f} m")
    return None


def measure_changes(recording: Recording, topics: Sequence[str]) -> list[float]:
    """By scanner, the median share of directions, 0..1, in which the range is another than a while before."""
    interval = (recording.end - recording.start) / _MESSAGES
    due = dict.fromkeys(topics, recording.start)
    kept: dict[str, list[Array]] = {topic: [] for topic in topics}
    for record in recording.records(topics):
        if record.arrival >= due[record.topic]:
            due[record.topic] += interval
            kept[record.topic].append(image_ranges(record.decode()))
    pairs = [zip(some, some[_LAG:], strict=False) for some in kept.values()]
    shares = [[_compare(*pair) for pair in some] for some in pairs]
    return [float(np.median(some)) if some else 0.0 for some in shares]


def _compare(before: Array, after: Array) -> float:
    """Share of the directions with ranges in both in which these differ; 0 without."""
    both = np.isfinite(before) & np.isfinite(after)
    margin = np.maximum(_MIN_CHANGE, _MIN_CHANGE_RATIO * before[both])
    return float(np.mean(np.abs(after[both] - before[both]) > margin)) if both.any() else 0.0


def image_ranges(message: Message) -> Array:
    """(E, A) nearest range by elevation and azimuth, m; infinite without returns."""
    points = np.zeros((0, 3))
    if isinstance(message, LaserScan | PointCloud):
        points = np.pad(message.points, ((0, 0), (0, 3 - message.points.shape[1]))).astype(np.float64)
    points = points[np.isfinite(points).all(axis=1)]
    ranges = measure_lengths(points)
    points, ranges = points[ranges > 0], ranges[ranges > 0]
    elevation = np.arcsin(np.clip(points[:, 2] / ranges, -1, 1)) + np.pi / 2
    azimuth = np.arctan2(points[:, 1], points[:, 0]) + np.pi
    nearest = np.full((round(np.pi / _CELL) + 1, round(2 * np.pi / _CELL) + 1), np.inf)
    cells = ((elevation / _CELL).astype(np.intp), (azimuth / _CELL).astype(np.intp))
    np.minimum.at(nearest, cells, ranges)
    return nearest
