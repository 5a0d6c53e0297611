"""Whether a recording is of a robot that drives: what its scanners measure changes in most directions.

Or whether it is of LiDARs at rest in a building: what moves is near some and far from others.
"""

from collections.abc import Sequence
from itertools import combinations

import numpy as np

from calgraph.config import FoundTopic, find_triggers
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


def find_moving_robot(recording: Recording, topics: Sequence[FoundTopic]) -> str:
    """How its scanners, or without scanners the poses of other programs, show that a robot drives.

    Args:
        recording: is read once, and few of its messages are decoded.
        topics: of the recording.

    Returns:
        A sentence without full stop; empty if they do not.
    """
    if recording.end - recording.start < MIN_DURATION:
        return ""
    scanners = [topic for topic in topics if topic.kind in _MIN_SHARE and topic.count and not topic.problem]
    if not scanners:
        return _find_moving_pose(recording, topics)
    if any(topic.count < MIN_COUNT for topic in scanners):
        return ""
    shares = np.array(measure_changes(recording, [topic.name for topic in scanners]))
    if np.mean(shares / [_MIN_SHARE[topic.kind] for topic in scanners]) < 1:
        return ""
    return f"what scanners measure changes in {shares.mean():.0%} of all directions on the way"


def _find_moving_pose(recording: Recording, topics: Sequence[FoundTopic]) -> str:
    """The same by poses, where no camera or scanner is recorded."""
    moving = [t.name for t in topics if motion_kind_of(t.type) == "trajectory" and t.count >= MIN_COUNT]
    if any(topic.kind in KINDS for topic in topics):
        return ""
    for topic in moving:
        messages = (record.decode() for record in recording.records([topic]))
        places = np.array([one.position for one in messages if isinstance(one, Pose)]).reshape(-1, 3)
        if len(places) and np.ptp(places, axis=0).max() > _MIN_EXTENT:
            return f"the poses of {topic} move by {np.ptp(places, axis=0).max():.1f} m"
    return ""


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


# Messages of each LiDAR that are compared, spread over the recording.
_COMPARED = 40
# Something moves in a direction if it is nearer than the median by this, m, and relative to it; noise is less.
_MIN_NEARER, _MIN_NEARER_RATIO = 0.5, 0.1
# Directions that are nearer for a larger share of the time are edges that the beams only sometimes meet; a LiDAR
# that drives has hardly any others.
_MAX_SHARE = 0.25
# Directions (2° by 2°) in which something moves, at least: a person at 20 m.
_MIN_DIRECTIONS = 3
# Times at which two LiDARs both measure something that moves, at least.
_MIN_TIMES = 10
# Share of directions that change from one of the messages to the next, up to which a LiDAR is at rest. People
# change 0.08 at most, and drives 0.35 and more, but for corridors.
_MAX_CHANGED = 0.15
# Difference of the distances of what moves, m: by the triangle inequality two LiDARs are as far apart. Those of a
# robot are within some 2 m of each other. In six simulated halls it is 3.3 to 7 m, and 0.6 m where a board was
# carried around two LiDARs of a robot. The share of the times at which the difference has to be so large, and
# quantiles over directions of what is compared: the nearest and the farthest of what moves.
_MIN_DIFFERENCE, _SHARE_OF_TIMES, _QUANTILES = 2.5, 0.25, (0.1, 0.9)


def find_building_network(recording: Recording, topics: Sequence[FoundTopic]) -> str:
    """How its sensors show that they are fixed in a building.

    They are LiDARs at rest, one in space at least, some metres apart, and something moves.

    Args:
        recording: is read once, and few of its messages are decoded.
        topics: of the recording.

    Returns:
        A sentence without full stop; empty if they do not.
    """
    sensors = [topic for topic in topics if topic.kind in KINDS and topic.count and not topic.problem]
    kinds = [topic.kind for topic in sensors]
    if len(sensors) < 2 or "lidar3d" not in kinds or any(kind not in ("lidar2d", "lidar3d") for kind in kinds):
        return ""
    if any(topic.count < MIN_COUNT for topic in sensors):
        return ""
    if recording.end - recording.start < MIN_DURATION or find_triggers(topics)[0]:
        return ""
    distances = measure_moving(recording, [topic.name for topic in sensors])
    apart = max(_compare_distances(distances[a.name], distances[b.name]) for a, b in combinations(sensors, 2))
    if apart < _MIN_DIFFERENCE:
        return ""
    what = "LiDARs" if "lidar2d" in kinds else "3-D LiDARs"
    return f"{what} are at rest, and what moves is {apart:.0f} m nearer to one than to another"


def measure_moving(recording: Recording, topics: Sequence[str]) -> dict[str, Array]:
    """By LiDAR, distances (K, 2) of the nearest and farthest of what moves, at times spread over the recording, m.

    NaN where nothing moves, and at all times of a LiDAR that is not at rest.
    """
    interval = (recording.end - recording.start) / _COMPARED
    images: dict[str, dict[int, Array]] = {topic: {} for topic in topics}
    for record in recording.records(topics):
        k = min(int((record.arrival - recording.start) / interval), _COMPARED - 1)
        if k not in images[record.topic]:
            images[record.topic][k] = image_ranges(record.decode())
    return {topic: _measure_lidar(of) for topic, of in images.items()}


def _measure_lidar(images: dict[int, Array]) -> Array:
    found = np.full((_COMPARED, len(_QUANTILES)), np.nan)
    if not images:
        return found
    ranges = np.array(list(images.values()))
    usual = np.median(ranges, axis=0)
    with np.errstate(invalid="ignore"):
        margin = np.maximum(_MIN_NEARER, _MIN_NEARER_RATIO * usual)
        nearer = (ranges < usual - margin) & np.isfinite(usual)
        changed = np.abs(np.diff(ranges, axis=0)) > margin
    both = np.isfinite(ranges[1:]) & np.isfinite(ranges[:-1])
    if np.sum(changed & both) > _MAX_CHANGED * np.sum(both):
        return found
    nearer &= nearer.mean(axis=0) <= _MAX_SHARE
    for k, image, moves in zip(images, ranges, nearer, strict=True):
        if np.sum(moves) >= _MIN_DIRECTIONS:
            found[k] = np.quantile(image[moves], _QUANTILES)
    return found


def _compare_distances(a: Array, b: Array) -> float:
    """By how much the distances of two LiDARs from what moves differ in many of the times, m; 0 with too few."""
    difference = np.abs(a - b).max(axis=1)
    both = np.isfinite(difference)
    return float(np.quantile(difference[both], 1 - _SHARE_OF_TIMES)) if np.sum(both) >= _MIN_TIMES else 0.0
