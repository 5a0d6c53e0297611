"""Clouds of 2-D scanners as scans."""

import numpy as np

from calgraph.errors import RecordingError
from calgraph.geometry import Array
from calgraph.sensors.messages import LaserScan, PointCloud

# A scan has no more beams than this a turn, which bounds what a gap is filled with.
_MOST_BEAMS = 20_000
# How far the points may be off the plane z = 0: m, and as a fraction of the range.
_FLAT = (0.01, 0.01)


def scan_of_cloud(cloud: PointCloud) -> LaserScan:
    """The scan of a 2-D scanner whose driver sends it as a cloud with z = 0.

    Beams are sorted by angle. Points at the origin, and gaps between beams (no-returns are often left out), become
    beams without a measurement, so that neighbours in the scan are neighbours in angle. Times of points are not
    kept: every beam counts as measured at the cloud's stamp.

    Raises:
        RecordingError: the points do not lie in the plane z = 0.

    """
    ranges = np.hypot(cloud.points[:, 0], cloud.points[:, 1])
    if np.any(np.abs(cloud.points[:, 2]) > _FLAT[0] + _FLAT[1] * ranges):
        highest = np.abs(cloud.points[:, 2]).max()
        raise RecordingError(
            f"cloud at {cloud.stamp:.6f}: is not a 2-D scan, its points reach {highest:.3f} m off z = 0; "
            "is its sensor's kind lidar3d?"
        )
    measured = np.flatnonzero(ranges > 0)
    angles = np.arctan2(cloud.points[measured, 1], cloud.points[measured, 0])
    order = np.argsort(angles, kind="stable")
    angles, ranges = angles[order], ranges[measured][order]
    angles, ranges = _with_gaps(angles, ranges)
    return LaserScan(cloud.stamp, cloud.frame_id, angles, ranges)


def _with_gaps(angles: Array, ranges: Array) -> tuple[Array, Array]:
    """Adds beams without a measurement wherever neighbours are further apart than the usual step."""
    if len(angles) < 3:
        return angles, ranges
    steps = np.diff(angles)
    usual = max(float(np.median(steps)), 2 * np.pi / _MOST_BEAMS)
    missing = np.maximum(np.round(steps / usual).astype(int) - 1, 0)
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
