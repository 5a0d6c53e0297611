"""Two legs that walk through the views of three scanners, with exact beams and known truth."""

import numpy as np

from calgraph.config.settings import NetworkEstimationSettings
from calgraph.geometry import Array, se2
from calgraph.network.joint.legs import LegObservations, raycast_legs
from calgraph.network.joint.problem import BodyPath, BodyScans, NetworkProblem, NetworkState
from calgraph.network.joint.scanner_unknowns import SYSTEMATIC_ERRORS
from calgraph.network.joint.splines import Knots, evaluate_spline
from calgraph.network.tracking.clusters import Foreground

T_ROOT = np.stack([se2.pose(yaw, np.array([x, y])) for yaw, x, y in ((0, 0, 0), (2, 4, 0.5), (-1, 1, 4))])
OFFSET = np.array([0.0, 0.02, -0.01])
SHAPE = np.array([0.06, 0.006, 0.001, -0.002, 0.001])
SETTINGS = NetworkEstimationSettings()
DURATION, PERIOD = 3.0, 0.08


def walk_leg(side: float, times: Array) -> Array:
    """(N, 3) pose of a leg 8 cm beside a straight path, which swings about it."""
    x = 0.8 + 0.9 * times + side * 0.15 * np.sin(2 * np.pi * times / 1.1)
    heading = np.full_like(times, 0.3)
    forward, left = np.array([np.cos(0.3), np.sin(0.3)]), np.array([-np.sin(0.3), np.cos(0.3)])
    return np.column_stack([x[:, None] * forward + (0.9 + side * 0.08) * left, heading])


def build_path(side: float) -> tuple[Knots, BodyPath]:
    """A leg's true path; its control points are nearly its positions."""
    knots = Knots.spanning(-0.3, DURATION + 0.3, 0.06)
    return knots, BodyPath(walk_leg(side, knots.control_times()), np.append(SHAPE, np.zeros(3)))


def cast_beams(scanner: int, side: float, times: Array) -> BodyScans:
    """The beams of 0.5° that hit a leg in scans at times (V,) by the root's clock, with exact ranges."""
    T = T_ROOT[scanner]
    knots, path = build_path(side)
    parts = []
    for time in times:
        first, weights, _ = knots.basis_at(np.array([time]))
        pose = evaluate_spline(path.control, first, weights)[0]
        x, y = se2.inverse(T)[:2, :2] @ (pose[:2] - T[:2, 2])
        angles = np.arange(np.round(np.degrees(np.arctan2(y, x)) * 2) - 8, 1000)[:17] * np.radians(0.5)
        direction = np.stack([np.cos(angles), np.sin(angles)], axis=1)
        offset = np.abs(direction[:, 0] * y - direction[:, 1] * x)
        direction = direction[offset < 0.95 * SHAPE[0]]
        hits = raycast_legs(
            T[:2, 2],
            direction @ T[:2, :2].T,
            np.tile(pose[:2], (len(direction), 1)),
            np.full(len(direction), pose[2]),
            SHAPE,
        )
        parts.append((direction, hits.ranges))
    count = np.array([len(ranges) for _, ranges in parts])
    return BodyScans(
        scanner,
        times + OFFSET[scanner],
        np.asarray(np.cumsum(count) - count, dtype=np.intp),
        np.concatenate([direction for direction, _ in parts]),
        np.concatenate([ranges for _, ranges in parts]),
        np.zeros(count.sum()),
        np.ones(count.sum()),
    )


def scan_times(scanner: int) -> Array:
    """(V,) by the root's clock, s."""
    return np.arange(0.05 + 0.021 * scanner, DURATION, PERIOD)


def build_network() -> tuple[NetworkProblem, NetworkState]:
    """Two legs with exact ranges, and the true state."""
    legs, paths = [], []
    for side in (-1.0, 1.0):
        knots, path = build_path(side)
        scans = tuple(cast_beams(s, side, scan_times(s)) for s in range(3))
        control = path.control[:, 2]
        legs.append(LegObservations(knots, scans, control, np.full(len(control), 10.0), 1e-5, 30.0))
        paths.append(path)
    problem = NetworkProblem(
        3,
        tuple(legs),
        (),
        np.full(3, 0.01),
        np.zeros(2),
        np.zeros((3, len(SYSTEMATIC_ERRORS))),
        1.5,
        0.5,
        SETTINGS,
    )
    return problem, NetworkState(T_ROOT, OFFSET, np.zeros((3, len(SYSTEMATIC_ERRORS))), tuple(paths))


def build_foreground(scanner: int) -> Foreground:
    """The foreground of a scanner: both legs, with all beams of a scan at one time."""
    scans = [cast_beams(scanner, side, scan_times(scanner)) for side in (-1.0, 1.0)]
    index = [
        np.repeat(np.arange(len(one.times)), np.diff(one.first_beam, append=len(one.ranges))) for one in scans
    ]
    scan = np.concatenate(index)
    angles = np.concatenate([np.arctan2(one.direction[:, 1], one.direction[:, 0]) for one in scans])
    ranges = np.concatenate([one.ranges for one in scans])
    times = np.concatenate([one.times[i] for one, i in zip(scans, index, strict=True)])
    beam = np.asarray(np.round((angles + np.pi) / np.radians(0.5)), dtype=np.intp)
    # Of two legs in one direction, the nearer one ends the beam.
    order = np.lexsort((ranges, beam, scan))
    nearest = np.flatnonzero(np.diff(scan[order] * 10_000 + beam[order], prepend=-1) != 0)
    kept = order[nearest]
    spacing = np.full(scan.max() + 1, np.radians(0.5))
    hidden = np.zeros(len(kept), dtype=np.bool_)
    return Foreground(scan[kept], beam[kept], angles[kept], ranges[kept], times[kept], hidden, spacing)
