"""The average of the scans of one capture, during which the board rested."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from calgraph.config import RangeNoise
from calgraph.geometry import Array, Index, find_column_medians
from calgraph.sensors import LaserScan, align_ranges


@dataclass(frozen=True, eq=False)
class AveragedScan:
    """Beams that measured something, in order of angle."""

    angles: Array
    """(N,) ascending, rad; beyond pi where the field of view is a full turn and the seam was moved."""
    ranges: Array
    """(N,) m, finite."""
    sigma_range: Array
    """(N,) standard deviation of each range, m."""
    sigma_angle: Array
    """(N,) standard deviation of each direction, rad."""
    foreground: NDArray[np.bool_]
    """(N,) whether each beam is foreground."""
    spacing: float
    """Angle between neighbouring beams, rad."""

    def measurements(self, beams: Index) -> tuple[Array, Array, Array, Array]:
        """Angles and ranges of some beams (N,), and the standard deviations of ranges and of angles."""
        return self.angles[beams], self.ranges[beams], self.sigma_range[beams], self.sigma_angle[beams]

    @property
    def directions(self) -> Array:
        """(N, 3) unit vectors of the beams."""
        return np.stack([np.cos(self.angles), np.sin(self.angles), np.zeros_like(self.angles)], axis=-1)

    @property
    def points(self) -> Array:
        """(N, 2) end points in the scan plane, m."""
        return self.ranges[:, None] * self.directions[:, :2]


# Distance from a surface within which returns are on it, in standard deviations of a range: 6e-5 of the correct
# ones are beyond.
SAME_SURFACE_SIGMAS = 4.0
# Minimum distance from a surface, m, within which returns are on it: rings of a VLP-16 are biased by -13 to +15
# mm, boards bow by some millimetres, and fingers on the board are as thick.
MIN_THICKNESS = 0.03
# Widest gap between the last and the first beam of a scan all around, in beam spacings: some beams may have no
# return. The scan is cut at a jump in range then, so that no board lies across the seam.
_MAX_SEAM_SPACINGS = 20.0


def average_scans(
    scans: Sequence[LaserScan], noise: RangeNoise, foreground: Sequence[NDArray[np.bool_]]
) -> AveragedScan | None:
    """The robust mean of every beam over scans of a scene at rest, or None if no beam measured anything.

    A beam's ranges near their median are averaged. A beam with returns in less than half of the scans is left out,
    and so is one without a majority near its median: it alternates between two depths at an edge.

    Args:
        scans: one or more, of one sensor; not necessarily with the same beams.
        noise: of a single beam.
        foreground: for each scan whether its beams (N,) are foreground; a beam is if it is in most scans.
    """
    reference = max(scans, key=lambda scan: len(scan.angles))
    angles = np.sort(reference.angles)
    if len(angles) < 2:
        return None
    ranges = np.concatenate([align_ranges(angles, scan.angles, scan.ranges[None]) for scan in scans])
    is_foreground = np.concatenate([
        align_ranges(angles, scan.angles, np.where(scan.valid, marked, np.nan)[None])
        for scan, marked in zip(scans, foreground, strict=True)
    ])  # fmt: skip
    votes = np.nansum(is_foreground, axis=0)
    answered = np.isfinite(ranges).sum(axis=0)
    kept = np.flatnonzero(2 * answered >= len(scans))
    kept = kept[answered[kept] > 0]
    ranges = ranges[:, kept]
    max_deviation = max(SAME_SURFACE_SIGMAS * noise.range, MIN_THICKNESS)
    near = np.abs(ranges - find_column_medians(ranges)) < max_deviation
    steady = 2 * near.sum(axis=0) > answered[kept]
    if not steady.any():
        return None
    kept, ranges, near = kept[steady], ranges[:, steady], near[:, steady]
    count = near.sum(axis=0)
    return _move_seam(
        AveragedScan(
            angles[kept],
            np.where(near, ranges, 0).sum(axis=0) / count,
            noise.range / np.sqrt(count),
            noise.angle / np.sqrt(count),
            np.asarray(2 * votes[kept] > answered[kept]),
            float(np.median(np.diff(angles))),
        )
    )


def _move_seam(scan: AveragedScan) -> AveragedScan:
    """Starts a scan that goes all around at its largest jump in range, so that no board lies across the seam."""
    if scan.angles[-1] - scan.angles[0] < 2 * np.pi - _MAX_SEAM_SPACINGS * scan.spacing:
        return scan
    start = int(np.argmax(np.abs(np.diff(scan.ranges)))) + 1
    turned = np.roll(scan.angles, -start)
    turned[len(turned) - start :] += 2 * np.pi
    return AveragedScan(
        turned,
        np.roll(scan.ranges, -start),
        np.roll(scan.sigma_range, -start),
        np.roll(scan.sigma_angle, -start),
        np.roll(scan.foreground, -start),
        scan.spacing,
    )
