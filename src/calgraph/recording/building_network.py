"""Whether a recording is of LiDARs at rest in a building: what moves is near some and far from others."""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations

import numpy as np

from calgraph.config import FoundTopic, find_triggers
from calgraph.geometry import Array
from calgraph.recording.moving_robot import MIN_COUNT, MIN_DURATION, image_ranges
from calgraph.recording.recording import Recording
from calgraph.sensors.kinds import KINDS

# Messages of each LiDAR that are compared, spread over the recording.
_MESSAGES = 40
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


@dataclass(frozen=True)
class BuildingNetwork:
    """What shows that LiDARs are fixed in a building."""

    reason: str
    """In a sentence without full stop."""


def find_building_network(recording: Recording, topics: Sequence[FoundTopic]) -> BuildingNetwork | None:
    """Whether its sensors are LiDARs at rest, one in space at least, some metres apart, and something moves.

    Args:
        recording: is read once, and few of its messages are decoded.
        topics: of the recording.
    """
    sensors = [topic for topic in topics if topic.kind in KINDS and topic.count and not topic.problem]
    kinds = [topic.kind for topic in sensors]
    if len(sensors) < 2 or "lidar3d" not in kinds or any(kind not in ("lidar2d", "lidar3d") for kind in kinds):
        return None
    if any(topic.count < MIN_COUNT for topic in sensors):
        return None
    if recording.end - recording.start < MIN_DURATION or find_triggers(topics)[0]:
        return None
    distances = measure_moving(recording, [topic.name for topic in sensors])
    apart = max(_compare(distances[a.name], distances[b.name]) for a, b in combinations(sensors, 2))
    if apart < _MIN_DIFFERENCE:
        return None
    what = "LiDARs" if "lidar2d" in kinds else "3-D LiDARs"
    return BuildingNetwork(f"{what} are at rest, and what moves is {apart:.0f} m nearer to one than to another")


def measure_moving(recording: Recording, topics: Sequence[str]) -> dict[str, Array]:
    """By LiDAR, distances (K, 2) of the nearest and farthest of what moves, at times spread over the recording, m.

    NaN where nothing moves, and at all times of a LiDAR that is not at rest.
    """
    interval = (recording.end - recording.start) / _MESSAGES
    images: dict[str, dict[int, Array]] = {topic: {} for topic in topics}
    for record in recording.records(topics):
        k = min(int((record.arrival - recording.start) / interval), _MESSAGES - 1)
        if k not in images[record.topic]:
            images[record.topic][k] = image_ranges(record.decode())
    return {topic: _measure_lidar(of) for topic, of in images.items()}


def _measure_lidar(images: dict[int, Array]) -> Array:
    found = np.full((_MESSAGES, len(_QUANTILES)), np.nan)
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


def _compare(a: Array, b: Array) -> float:
    """By how much the distances of two LiDARs from what moves differ in many of the times, m; 0 with too few."""
    difference = np.abs(a - b).max(axis=1)
    both = np.isfinite(difference)
    return float(np.quantile(difference[both], 1 - _SHARE_OF_TIMES)) if np.sum(both) >= _MIN_TIMES else 0.0
