"""Conversion of point clouds of 2-D scanners to scans."""

from collections.abc import Iterable

import numpy as np

from calgraph.errors import RecordingError
from calgraph.geometry import Array
from calgraph.sensors.messages import LaserScan, Message, PointCloud

SAME_DIRECTION = 1e-6
"""Points whose directions differ by less are returns of one beam, rad: coordinates in single precision round
directions to 1e-7, and neighbouring beams of scanners are more than 1e-4 apart."""
# Upper limit on beams per turn, which bounds the number of beams that fill a gap.
_MAX_BEAMS_PER_TURN = 20_000
# Maximum distance of points from the plane z = 0: m, plus a fraction of the range. Other clouds are refused: an
# error of the input, and without influence on a result.
_PLANE_TOLERANCE = (0.01, 0.01)


def to_scans(messages: Iterable[Message]) -> list[LaserScan]:
    """Scans of a 2-D scanner, also where its driver sends them as clouds."""
    return [
        m if isinstance(m, LaserScan) else convert_cloud_to_scan(m)
        for m in messages
        if isinstance(m, LaserScan | PointCloud)
    ]


def convert_cloud_to_scan(cloud: PointCloud) -> LaserScan:
    """Converts the cloud of a 2-D scanner, whose driver sends points with z = 0, to a scan.

    Beams are sorted by angle. Points at the origin, and gaps between beams (no-returns are often left out), become
    beams without a measurement, so that neighbours in the scan are neighbours in angle. Of several returns of one
    beam the nearest is used. Times of points are dropped: every beam is taken as measured at the cloud's stamp.

    Raises:
        RecordingError: the points do not lie in the plane z = 0.
    """
    ranges = np.hypot(cloud.points[:, 0], cloud.points[:, 1])
    if np.any(np.abs(cloud.points[:, 2]) > _PLANE_TOLERANCE[0] + _PLANE_TOLERANCE[1] * ranges):
        highest = np.abs(cloud.points[:, 2]).max()
        raise RecordingError(
            f"cloud at {cloud.stamp:.6f}: is not a 2-D scan, its points reach {highest:.3f} m off z = 0; "
            "is its sensor's kind lidar3d?"
        )
    measured = np.flatnonzero(ranges > 0)
    angles = np.arctan2(cloud.points[measured, 1], cloud.points[measured, 0])
    order = np.argsort(angles, kind="stable")
    angles, ranges = _fill_gaps(*_join_returns(angles[order], ranges[measured][order]))
    return LaserScan(cloud.stamp, cloud.frame_id, angles, ranges)


def _join_returns(angles: Array, ranges: Array) -> tuple[Array, Array]:
    """One beam for each of the ascending angles (N,), with the nearest of its ranges (N,)."""
    if not len(angles):
        return angles, ranges
    first = np.append(0, np.flatnonzero(np.diff(angles) > SAME_DIRECTION) + 1)
    return angles[first], np.minimum.reduceat(ranges, first)


def _fill_gaps(angles: Array, ranges: Array) -> tuple[Array, Array]:
    """Adds beams without a measurement wherever neighbours are farther apart than the median step."""
    if len(angles) < 3:
        return angles, ranges
    steps = np.diff(angles)
    step_median = max(float(np.median(steps)), 2 * np.pi / _MAX_BEAMS_PER_TURN)
    missing = np.maximum(np.round(steps / step_median).astype(int) - 1, 0)
    added = [
        angle + step * np.arange(1, n + 1) / (n + 1)
        for angle, step, n in zip(angles[:-1], steps, missing, strict=True)
        if n
    ]
    if not added:
        return angles, ranges
    all_angles = np.concatenate([angles, *added])
    all_ranges = np.concatenate([ranges, np.full(len(all_angles) - len(angles), np.nan)])
    order = np.argsort(all_angles, kind="stable")
    return all_angles[order], all_ranges[order]
