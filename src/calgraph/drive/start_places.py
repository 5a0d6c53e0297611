"""Places that motions do not show: heights of LiDARs on a robot that turned about one axis, and 2-D scanners.

LiDARs are above the floor or below the ceiling that they measure. The points of 2-D scanners are on the surfaces
that a 3-D LiDAR measured.
"""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from itertools import product

import numpy as np

from calgraph.drive.adjustment import Adjustment
from calgraph.drive.segments import Segments
from calgraph.drive.sources.lidar import LidarSource
from calgraph.drive.sources.source import Source
from calgraph.drive.start import MIN_SECOND_TURN, MOTION_DURATION, MotionStart, measure_turns
from calgraph.drive.stated_poses import StatedPose
from calgraph.drive.sweeps import join_sweeps, thin_sweep
from calgraph.errors import Rejected
from calgraph.geometry import Array, plane, se_n
from calgraph.surfaces.flat_cells import FlatCells, fit_flat_cells, sum_moments
from calgraph.surfaces.surface_points import CELL_LIMITS
from calgraph.surfaces.trajectory import Track

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


# Points of each sweep that make surfaces; and points of the scanner.
_MAPPED_POINTS, _PLACED_POINTS = 400, 6000
# Standard deviation of points from a flat cell, m: range noise, and drift of odometry over the drive.
_MAX_THICKNESS = 0.1
# Heights, m, tilts about each axis and turns, rad, from the start by motions that are tried: scanners are mounted
# level to some degrees, and motions of 30 s show where they look to 0.1 rad.
_HEIGHTS, _TILTS, _TURNS = (-0.8, -0.4, 0.0, 0.4, 0.8), (-0.1, 0.0, 0.1), (-0.15, 0.0, 0.15)
# Of the place, m, and the rotation, rad, from these.
_STDDEV = np.repeat([1.0, 0.2], 3)
# Scales of the robust weight in each Gauss–Newton step, m (Geman–McClure).
_SCALES = (0.5, 0.36, 0.26, 0.19, 0.14, *[0.1] * 5)


def place_scanners(
    starts: Mapping[str, MotionStart | Rejected], lead: str, tracks: Mapping[str, Segments | Rejected],
    sources: Mapping[str, Source], rng: np.random.Generator,
) -> dict[str, MotionStart | Rejected]:  # fmt: skip
    """The starts with heights and tilts of 2-D scanners, which motions in their plane do not show.

    Args:
        starts: by sensor, against the one that leads.
        lead: that sensor.
        tracks: trajectory by sensor.
        sources: by sensor.
        rng: draws points.
    """
    root, along = sources[lead], tracks[lead]
    placed = dict(starts)
    for name, start in starts.items():
        scanner = sources[name]
        if isinstance(start, Rejected) or not (isinstance(scanner, LidarSource) and scanner.flat_in_space):
            continue
        if not (isinstance(root, LidarSource) and isinstance(along, Segments) and start.axis is not None):
            placed[name] = Rejected(
                f"no 3-D LiDAR shows where the scan plane of {name} is: add one, or calibrate 2-D scanners alone"
            )
        elif _turns_about_one_axis(along):
            placed[name] = Rejected(
                f"the robot turned about one axis only, which leaves the height, roll and pitch of {name} open: "
                "drive over ramps, too"
            )
        else:
            placed[name] = _place(start, start.axis, scanner, root, along.tracks[0], rng)
    return placed


def _turns_about_one_axis(along: Segments) -> bool:
    times = np.arange(along.start, along.end - MOTION_DURATION, MOTION_DURATION / 3)
    motions, known = along.relative(times, MOTION_DURATION)
    return bool(measure_turns(motions[known])[0][1] < MIN_SECOND_TURN)


def _place(
    start: MotionStart, up: Array, scanner: LidarSource, root: LidarSource, track: Track, rng: np.random.Generator
) -> MotionStart:
    mapped = join_sweeps([thin_sweep(sweep, _MAPPED_POINTS, rng) for sweep in root.sweeps])
    world = se_n.apply(track.at(mapped.times), mapped.points[:, None])[:, 0]
    surfaces = fit_flat_cells(sum_moments(world, CELL_LIMITS[3].cell), CELL_LIMITS[3], _MAX_THICKNESS)
    measured = thin_sweep(join_sweeps(scanner.sweeps), _PLACED_POINTS, rng)
    T_world_root = track.at(measured.times - start.clock_offset)
    across = plane.tangent_basis(up)
    found = []
    for height, a, b, turn in product(_HEIGHTS, _TILTS, _TILTS, _TURNS):
        T = se_n.retract(start.T_root_sensor, np.concatenate([height * up, across @ [a, b] + turn * up]))
        found.append(_fit(T, T_world_root, measured.points, surfaces))
    return replace(start, T_root_sensor=min(found, key=lambda one: one[1])[0])


def _fit(T: Array, T_world_root: Array, points: Array, surfaces: FlatCells) -> tuple[Array, float]:
    """The pose on the root with which points (N, 3) are nearest to surfaces, from one, and its robust cost."""
    before, R_world = T, se_n.rotation(T_world_root)
    cost = np.inf
    for scale in _SCALES:
        arm = points @ T[:3, :3].T
        world = se_n.apply(T_world_root, (arm + T[:3, 3])[:, None])[:, 0]
        index = surfaces.find(world)
        hit = index >= 0
        cells = index[hit]
        r = np.einsum("ni,ni->n", surfaces.normals[cells], world[hit] - surfaces.center[cells]) / scale
        # Without a surface, a point is as far as any.
        cost = float(np.sum(r**2 / (1 + r**2)) + np.sum(~hit))
        normals = np.einsum("nij,ni->nj", R_world[hit], surfaces.normals[cells])
        J = np.concatenate([normals, np.cross(arm[hit], normals)], axis=1) / scale
        weight = (1 + r**2) ** -2.0
        H = (J * weight[:, None]).T @ J + np.diag(_STDDEV**-2.0)
        g = J.T @ (weight * r) + se_n.difference(T, before) / _STDDEV**2
        T = se_n.retract(T, -np.linalg.solve(H, g))
    return T, cost
