"""Which foreground beam ends on which leg."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from calgraph.geometry import Array, Index, se2
from calgraph.network.joint.leg_problem import LegPath
from calgraph.network.joint.problem import BodyScans
from calgraph.network.joint.scanner_unknowns import correct_points
from calgraph.network.joint.splines import Knots, evaluate_spline
from calgraph.network.tracking.clusters import Foreground

# Distance from a leg where there is none, m: above all limits.
_FAR = 10.0
# A point behind the centre by more than this share of the radius is not on the visible side.
_MAX_DEPTH_RATIO = 0.3


@dataclass(frozen=True, eq=False)
class LegCandidate:
    """A leg that beams may end on."""

    knots: Knots
    start: float
    """First time at which it was tracked, s."""
    end: float
    """Last time, s."""
    path: LegPath


@dataclass(frozen=True, eq=False)
class ScannerBeams:
    """The P foreground beams of one scanner in order of time."""

    direction: Array
    """(P, 2) unit vectors, scanner frame."""
    ranges: Array
    """(P,) m."""
    times: Array
    """(P,) by the scanner's clock, s."""
    scan: Index
    """(P,) of each beam."""

    @classmethod
    def from_foreground(cls, beams: Foreground) -> "ScannerBeams":
        """The beams of a foreground, sorted."""
        order = np.argsort(beams.times, kind="stable")
        angles = beams.angles[order]
        direction = np.stack([np.cos(angles), np.sin(angles)], axis=-1)
        return cls(direction, beams.ranges[order], beams.times[order], beams.scan[order])


# Maximum distance of a point from the outline of its leg, m, plus the one below: shins are up to 2 cm from
# circles, and start paths 3 cm off.
_MAX_DISTANCE = 0.06
# The same in standard deviations of a range.
_MAX_DISTANCE_SIGMAS = 2.0
# Minimum difference between the distances from the outlines of the nearest and the second nearest leg, m:
# otherwise the beam is not used.
_MIN_MARGIN = 0.02


def associate_beams(
    beams: ScannerBeams,
    scanner: int,
    T_root_scanner: Array,
    clock_offset: float,
    systematic: Array,
    sigma: float,
    legs: Sequence[LegCandidate],
) -> list[BodyScans | None]:
    """Associates the beams of one scanner with the leg whose outline is nearest to their end points.

    A beam is not used if it is far from all outlines, or nearly as close to that of a second leg.

    Args:
        beams: of the scanner.
        scanner: its index.
        T_root_scanner: (3, 3).
        clock_offset: its clock minus the root clock, s.
        systematic: (E,) its ``SYSTEMATIC_ERRORS``, of which those that displace points are corrected.
        sigma: its noise, m.
        legs: with paths in the root frame.

    Returns:
        The scans of each leg; None without beams.
    """
    nearest, second = np.full((2, len(beams.times)), _FAR)
    leg_of = np.full(len(beams.times), -1)
    direction = beams.direction @ T_root_scanner[:2, :2].T
    points = se2.apply(T_root_scanner, correct_points(beams.ranges[:, None] * beams.direction, systematic))
    times = beams.times - clock_offset
    for k, leg in enumerate(legs):
        inside = slice(*np.searchsorted(times, [leg.start, leg.end]))
        first, weights, _ = leg.knots.basis_at(times[inside])
        offset = points[inside] - evaluate_spline(leg.path.control[:, :2], first, weights)
        radius = leg.path.shape[0]
        depth = np.sum(offset * direction[inside], axis=1)
        distance = np.abs(np.hypot(*offset.T) - radius)
        distance[depth > _MAX_DEPTH_RATIO * radius] = _FAR
        closer = distance < nearest[inside]
        second[inside] = np.where(closer, nearest[inside], np.minimum(second[inside], distance))
        nearest[inside] = np.where(closer, distance, nearest[inside])
        leg_of[inside][closer] = k
    used = (nearest < _MAX_DISTANCE + _MAX_DISTANCE_SIGMAS * sigma) & (second - nearest > _MIN_MARGIN)
    return [_select_beams(beams, scanner, np.flatnonzero(used & (leg_of == k))) for k in range(len(legs))]


def _select_beams(beams: ScannerBeams, scanner: int, index: Index) -> BodyScans | None:
    if not len(index):
        return None
    first = np.flatnonzero(np.diff(beams.scan[index], prepend=-1))
    count = np.diff(first, append=len(index))
    times = beams.times[index]
    mean = np.add.reduceat(times - times[0], first) / count + times[0]
    return BodyScans(
        scanner,
        mean,
        np.asarray(first, dtype=np.intp),
        beams.direction[index],
        beams.ranges[index],
        times - np.repeat(mean, count),
        np.ones(len(index)),
    )
