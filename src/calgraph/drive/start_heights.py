"""Heights of LiDARs on a robot that turned about one axis only, by the floor or the ceiling that they measure."""

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from calgraph.drive.adjustment import Adjustment
from calgraph.drive.sources.lidar import LidarSource
from calgraph.drive.sources.source import Source
from calgraph.drive.start import MotionStart
from calgraph.drive.stated_poses import StatedPose
from calgraph.errors import Rejected
from calgraph.geometry import Array, se_n

# Distances along the axis of turning that are compared, m, in steps that range noise and waves of floors fill;
# at points that are no farther than this, m: the axis is known to a degree.
_STEP, _NEAREST, _FARTHEST, _MAX_RANGE = 0.05, 0.1, 6.0, 10.0
# Share of the points that the floor has to have: a shelf has less.
_MIN_SHARE = 0.1
# Standard deviation of a height that no floor shows, m: the size of robots. Edges and slopes fit at several
# heights, and which of them is found depends on the start: from other starts than that of height 0, two of five
# drives ended 0.2 and 0.4 m off at a stated 0.04 m.
_OPEN_STDDEV = 1.0
# Sweeps whose points are taken: floors are the same all the time.
_SWEEPS = 40


def add_heights(
    starts: Mapping[str, MotionStart | Rejected],
    lead: str,
    sources: Mapping[str, Source],
    stated: Mapping[str, StatedPose],
) -> dict[str, MotionStart | Rejected]:
    """The starts with the heights of LiDARs over what they and the sensor that leads measure below or above them.

    Args:
        starts: by sensor; those by motions in the plane are at height 0.
        lead: the sensor that they are against.
        sources: by sensor.
        stated: poses by sensor, whose heights are taken first.
    """
    root = sources[lead]
    return {
        name: _raise_to(start, start.axis, float(stated[name].T[:3, 3] @ start.axis))
        if isinstance(start, MotionStart) and start.axis is not None and name in stated
        else _add_height(start, start.axis, root, source)
        if isinstance(start, MotionStart)
        and start.axis is not None
        and isinstance(root, LidarSource)
        and isinstance(source := sources[name], LidarSource)
        and not source.flat_in_space
        else start
        for name, start in starts.items()
    }


def leave_open(adjusted: Adjustment, starts: Sequence[MotionStart]) -> Adjustment:
    """The solution with heights that no floor shows as uncertain as they are.

    Args:
        adjusted: of the sensor that leads, and of others.
        starts: of the others, in their order.
    """
    change = np.zeros((sum(start.open_height for start in starts), *adjusted.free.shape))
    opened = [(k, start.axis) for k, start in enumerate(starts, start=1) if start.open_height]
    for row, (k, axis) in zip(change, opened, strict=True):
        row[k, :3] = axis
    by_height = _OPEN_STDDEV * change[:, adjusted.free]
    return replace(adjusted, covariance=adjusted.covariance + by_height.T @ by_height)


def _add_height(start: MotionStart, up: Array, root: LidarSource, sensor: LidarSource) -> MotionStart:
    ups = up, se_n.rotation(start.T_root_sensor).T @ up
    found = []
    for sign in (1.0, -1.0):
        (height, share), (other, other_share) = (
            _find_level(source, -sign * axis) for source, axis in zip((root, sensor), ups, strict=True)
        )
        found.append((min(share, other_share), sign * (other - height)))
    share, height = max(found)
    return replace(start, open_height=True) if share < _MIN_SHARE else _raise_to(start, up, height)


def _raise_to(start: MotionStart, up: Array, height: float) -> MotionStart:
    T = start.T_root_sensor.copy()
    T[:3, 3] += (height - T[:3, 3] @ up) * up
    return replace(start, T_root_sensor=T)


def _find_level(source: LidarSource, down: Array) -> tuple[float, float]:
    """The distance of the level surface with most points along a direction (3,), m, and their share."""
    sweeps = source.sweeps[:: max(len(source.sweeps) // _SWEEPS, 1)]
    points = np.concatenate([sweep.points for sweep in sweeps])
    points = points[np.linalg.norm(points, axis=1) < _MAX_RANGE]
    distance = points @ down
    edges = np.arange(_NEAREST, _FARTHEST, _STEP)
    counts = np.histogram(distance, edges)[0]
    # Noise spreads a floor over neighbouring steps.
    best = int(np.argmax(np.convolve(counts, np.ones(3), mode="same")))
    near = np.abs(distance - (edges[best] + _STEP / 2)) < 1.5 * _STEP
    return float(np.median(distance[near])) if near.any() else 0.0, float(near.sum()) / max(len(points), 1)
