"""The frame of the vehicle: where the root is above the floor, and from the axle whose wheels do not steer.

The centre of that axle moves along the vehicle and not sideways. While the vehicle moves and turns, as the root
measures both, it has therefore moved sideways by

    e = Σ ȳ · Δp  +  x Σ Δθ  +  κ Σ |v| v Δθ  =  0

with the sum over steps of a tenth of a second, ``ȳ`` the vehicle's left in the middle of a step, ``Δp`` the step
of the point of the floor below the root, ``Δθ`` the turn, ``x`` the distance to the axle, and ``κ`` the slip of
tyres, whose angle grows with the sideways acceleration. Steps are added up before they are compared, as velocities
are too uncertain: regression on them is biased (errors in variables). Where the axle is to the side is not in it.

That needs the distances ``w`` of the axle's centre, which its wheels measure: a root to the left of it goes
less far in curves to the left,

    Σ x̄ · Δp  =  (1 + s) Σ w  -  y Σ Δθ

with ``x̄`` the vehicle's front, and ``s`` the error of the wheels' radius.

The frame has a verdict, as sensors have.
"""

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from numpy.typing import NDArray
from scipy.signal import savgol_filter

from calgraph.config import Rig
from calgraph.drive.adjustment import Adjustment
from calgraph.drive.measurements import DrivePart
from calgraph.drive.points_on_surfaces import select_inside
from calgraph.drive.segments import Segments
from calgraph.errors import Rejected
from calgraph.geometry import (
    STDDEV_PER_MAD,
    Array,
    Index,
    join_rows,
    measure_lengths,
    se2,
    se3,
    se_n,
    select_rows,
    so3,
)
from calgraph.result import BaseFrame, Verdict
from calgraph.surfaces.floor import axes_from, mean_rotations, measure_level
from calgraph.surfaces.sensor_states import BESIDE_POSE, SensorState, move_states
from calgraph.verdict.grades import grade_pose

# Steps in which the heading is taken from the middle, s: knots of trajectories are as dense.
_STEP = 0.1
# Steps over which accelerations are smoothed.
_SMOOTHED = 7
# Steps that are added up to a chord, 2.4 s: errors of places cancel but for those of its ends. On simulated drives
# residuals are 8 mm for chords of 0.1 s and of 4.8 s, and errors of yaw (RMS of 8 drives) 0.18 degrees with chords
# of 0.6 s, 0.11 with 1.2 s, 0.07 with 2.4 s, and 0.08 with 4.8 s.
_CHORD = 24
# Errors of chords beyond which these weigh little, in their robust standard deviation (Geman–McClure): jumps of
# trajectories. Drives of 30 s have a dozen chords, of which narrower limits choose some.
_FAR = 6.0
# Chords that are left out together to see how results scatter (jackknife), 4.8 s: errors of trajectories, waves of
# floors and slip last for a second or two.
_BLOCK = 2
# More than a part has.
_MAX_BLOCKS = 10**6
# Least number of such intervals: with fewer, their scatter is no standard deviation.
_MIN_BLOCKS = 6
# Motions of a chord below which the vehicle stands, m and rad: ten times the noise of a trajectory.
_STANDING = 0.02, 0.01
# Way and turns that yaw and axle need in all, m and rad: errors of 2 mm of single chords are then 0.1 degrees, and
# 2 mm.
_MIN_WAY, _MIN_TURN = 3.0, 1.0
_NO_FRONT = Rejected("the vehicle hardly drove straight on, without which nothing shows where its front is")
# Share of the way ahead: with less, a vehicle that reverses for long may be taken for one that drives ahead.
_MIN_AHEAD = 0.6
# Standard deviation of the slip, s²/m: tyres of rubber take 8 to 20 g per radian of their slip angle.
_SLIP, _NO_SLIP = 0.008, 1e-6
# Standard deviation of the radius of wheels: pressure, load and wear.
_WHEEL_SCALE = 0.05
# Standard deviation of y by wheels of different radii, m: turns change their mean speed as a shift by a quarter of
# the track times the difference of radii does, 0.5 % of 1.6 m.
_SIDE_STDDEV = 0.002
# Distances from the axle to the middle of the vehicle, m: of robots, and of cars.
_HALF_WHEELBASES = (0.0, 0.2, 0.4, 0.6, 0.8, 1.1, 1.4)
# What all measurements of the floor have in common, m and rad: ranges at grazing incidence, and beams' elevations,
# which makers state to 0.1 degrees, averaged over the beams that meet the floor.
_HEIGHT_STDDEV, _TILT_STDDEV = 0.003, 3e-4
# Standard deviations of a sensor's pose up to which its points are of the root's floor, m and rad: twice those of
# usual drives of 30 s, and what the surroundings' waves are.
_LOCATED = 0.03, 0.01
# Length of the way for which a floor tilts to one side, m.
_WAVE = 3.0

# Changes of poses and ranges by which derivatives are taken, m and rad, at most: a root whose height is not known
# would be below the floor.
_MAX_CHANGE = 0.02


@dataclass(frozen=True, eq=False)
class VehiclePose:
    """The root in the frame on the floor below the centre of the axle: x ahead, y to the left, z up."""

    T_base_root: Array
    """(4, 4); 0 for what the covariance does not have."""
    covariance: Array
    """(6, 6) in the axes of the vehicle, m and rad; NaN for what was not measured, as y without wheels."""
    wheel_error: float = 0.0
    """Robust standard deviation of the wheels' distance during a chord, m."""


@dataclass(frozen=True, eq=False)
class Wheels:
    """Odometry of the vehicle's wheels: a sensor of the solution, and its trajectory."""

    number: int
    track: Segments
    """By its clock; its x axis is the vehicle's front."""

    def measure(self, times: Array, clock_offset: float) -> Array:
        """Distances (K - 1,) between times (K,) of the root's clock, evenly spaced, s, m; NaN in gaps."""
        motions, known = self.track.relative(times[:-1] + clock_offset, _STEP)
        T = se2.to_se3(motions)
        ahead = so3.exp(so3.log(T[:, :3, :3]) / 2)[:, :, 0]
        return np.where(known, np.einsum("ki,ki->k", ahead, T[:, :3, 3]), np.nan)


def locate_root(
    adjusted: Adjustment, root: int = 0, *, inverted: bool = False, wheels: Wheels | None = None
) -> VehiclePose | Rejected:
    """The root on the vehicle, from the trajectory and the floor of an adjusted drive.

    Args:
        adjusted: the drive.
        root: number of the sensor that is the root.
        inverted: whether the root's z axis points down.
        wheels: determine y.
    """
    sensors = _select_located(adjusted, root)
    measure = partial(_measure_chords, root=root, inverted=inverted, sensors=sensors, wheels=wheels)
    pose = fit_pose(measure(adjusted.parts, adjusted.states, np.zeros((2, 3))))
    if isinstance(pose, Rejected):
        return pose
    places = _choose_places(partial(measure, adjusted.parts, adjusted.states), pose)
    chords = measure(adjusted.parts, adjusted.states, places)
    pose = fit_pose(chords)
    if isinstance(pose, Rejected):
        return pose
    covariance = scatter_of(chords, pose)
    if isinstance(covariance, Rejected):
        return covariance
    # The floor tilts to one side for metres, and is measured with errors in common.
    places_apart = max(float(measure_lengths(chords.shift.sum(axis=1)).sum()) / _WAVE, 1.0)
    tilt = _scatter_of_level(chords) ** 2 / places_apart + _TILT_STDDEV**2
    covariance += np.diag([0.0, 0.0, _HEIGHT_STDDEV**2, tilt, tilt, 0.0])
    # What the drive leaves open of ranges and poses of sensors changes the trajectory, and the floor with it.
    stddev = np.sqrt(np.diag(adjusted.covariance))
    by_state = np.zeros((6, len(stddev)))
    for k, step in enumerate(np.diag(np.minimum(stddev, _MAX_CHANGE))):
        moved = fit_pose(measure(*_move(adjusted, step), places))
        by_state[:, k] = 0.0 if isinstance(moved, Rejected) else se3.difference(moved, pose) / step[k]
    covariance += by_state @ adjusted.covariance @ by_state.T
    _, variance, wheel_error = fit_side(chords, pose)
    covariance[1, 1] += variance
    planar = adjusted.parts[0].points[0].points.shape[1] == 2
    turned = [one.turned(pose) > _MIN_TURN for one in (chords, select_rows(chords, chords.have_wheels))]
    known = np.array([*turned, *[not planar] * 3, True])
    covariance[~known], covariance[:, ~known] = np.nan, np.nan
    return VehiclePose(se3.pose(pose[:3, :3], np.where(known[:3], pose[:3, 3], 0.0)), covariance, wheel_error)


def _move(adjusted: Adjustment, step: Array) -> tuple[list[DrivePart], list[SensorState]]:
    """The parts with their trajectories, and the sensors, after a step (P,) of the free parameters."""
    parts = []
    for part, response in zip(adjusted.parts, adjusted.responses, strict=True):
        control = part.trajectory.control
        change = (response @ step)[: control.size].reshape(control.shape)
        parts.append(replace(part, trajectory=part.trajectory.moved(change)))
    return parts, move_states(adjusted.states, adjusted.free, step)


def _choose_places(measure: Callable[[Array], "Chords"], pose: Array) -> Array:
    """(2, 3) in the frame of the root: where the floor is parallel to the vehicle, and the axle.

    A vehicle stands on two axles, of which one is unknown: its tilt follows the floor in the middle between them,
    which is where the floor explains most of the tilt.
    """
    axle = -pose[:3, :3].T @ pose[:3, 3]
    ahead = [axle + distance * pose[0, :3] for distance in _HALF_WHEELBASES]
    scatter = [_scatter_of_level(measure(np.array([place, axle]))) for place in ahead]
    return np.array([ahead[int(np.argmin(scatter))], axle])


def _scatter_of_level(chords: "Chords") -> float:
    """Deviation of the floor's normals in the frame of the root, rad."""
    known = np.isfinite(chords.level).all(axis=2)
    return _fit_level(chords.level[known], chords.acceleration[known])[1] if known.any() else np.inf


def _measure_chords(
    parts: Sequence[DrivePart],
    states: Sequence[SensorState],
    places: Array,
    *,
    root: int,
    inverted: bool,
    sensors: Sequence[int],
    wheels: Wheels | None,
) -> "Chords":
    """The motions of all parts, with the floor that sensors measure below places (2, 3) in the root's frame."""
    up = np.array([0.0, 0.0, -1.0 if inverted else 1.0])
    found = []
    for k, part in enumerate(parts):
        times = np.arange(part.trajectory.start, part.trajectory.end, _STEP)
        poses = se2.to_se3(part.trajectory.at(times).poses @ states[root].T_root_sensor)
        if part.points[0].points.shape[1] == 2:
            level = np.tile([*up, 0.0, 0.0, 0.0], (len(poses) - 1, 1))
        else:
            level = measure_level(_world_points(part, states, sensors), poses, up, places)
            if not np.isfinite(level).all(axis=1).any():
                level = measure_level(_world_points(part, states, range(len(states))), poses, up, places)
        travelled = None if wheels is None else wheels.measure(times, states[wheels.number].clock_offset)
        found.append(join_chords(poses, level, places[1], travelled, k))
    return join_rows(found)


def _select_located(adjusted: Adjustment, root: int) -> list[int]:
    """Numbers of the root, and of sensors whose poses are known well enough to measure its floor.

    A root that looks ahead hardly measures where it drives; one whose pose is off by metres finds floors anywhere.
    """
    n = adjusted.states[0].T_root_sensor.shape[0] - 1
    placed, turned = adjusted.stddev[:, :n] < _LOCATED[0], adjusted.stddev[:, n:-BESIDE_POSE] < _LOCATED[1]
    located = np.flatnonzero(placed.all(axis=1) & turned.all(axis=1))
    return sorted({root, *located.tolist()})


def _world_points(part: DrivePart, states: Sequence[SensorState], sensors: Iterable[int]) -> Array:
    """(N, 3) points of some sensors in the world of a part."""
    world = []
    for k in sensors:
        measured, state = part.points[k], states[k]
        inside = select_inside(part, k, state)
        T = part.trajectory.at(state.date(measured)[inside]).poses @ state.T_root_sensor
        world.append(se_n.apply(T, state.correct(measured.points[inside])[:, None])[:, 0])
    return np.concatenate(world)


@dataclass(frozen=True, eq=False)
class Chords:
    """Motions during C chords of S steps in the frame of the root, and the floor below it."""

    shift: Array
    """(C, S, 3) of the root along its axes in the middle of each step, m."""
    turn: Array
    """(C, S, 3) rotation vectors of the steps along these axes, rad."""
    acceleration: Array
    """(C, S, 3) of the axle along these axes, m/s²."""
    level: Array
    """(C, S, 6) upward normal of the floor, and a point of it, m; NaN where they are not known."""
    travelled: Array
    """(C, S, 1) distances of the wheels, m; NaN where they are not known."""
    block: Index
    """(C,) number of the interval that is left out with each."""

    @property
    def have_wheels(self) -> NDArray[np.bool_]:
        """(C,) whether distances of the wheels are known."""
        return np.asarray(np.isfinite(self.travelled).all(axis=(1, 2)))

    def turned(self, T_base_root: Array) -> float:
        """Sum of the turns about the vertical axis to either side, rad."""
        return float(np.abs(self.turn.sum(axis=1) @ T_base_root[2, :3]).sum())


def join_chords(poses: Array, level: Array, axle: Array, travelled: Array | None = None, part: int = 0) -> Chords:
    """The chords of a path.

    Args:
        poses: (K, 4, 4) of the root, a step apart.
        level: (K - 1, 6) by step, see :func:`measure_level`.
        axle: (3,) its place in the frame of the root, m: a root ahead of it is accelerated backwards in all
            curves, by up to 0.5 m/s², which does not make the body dive.
        travelled: (K - 1,) distances of the wheels, m.
        part: its number, so that intervals of parts differ.
    """
    R, t = se_n.rotation(poses), se_n.translation(poses)
    middle = se_n.transpose(mean_rotations(poses))
    driven = t + R @ axle
    speed = savgol_filter(np.diff(driven, axis=0) / _STEP, _SMOOTHED, 2, deriv=1, delta=_STEP, axis=0)
    used = len(level) // _CHORD * _CHORD
    columns = (
        np.einsum("kij,kj->ki", middle, np.diff(t, axis=0)),
        np.einsum("kij,kj->ki", middle, se_n.log(R[1:] @ se_n.transpose(R[:-1]))),
        np.einsum("kij,kj->ki", middle, speed),
        level,
        np.full((len(level), 1), np.nan) if travelled is None else travelled[:, None],
    )
    shift, turn, acceleration, floor, wheels = (one[:used].reshape(-1, _CHORD, one.shape[1]) for one in columns)
    block = part * _MAX_BLOCKS + np.arange(used // _CHORD) // _BLOCK
    return Chords(shift, turn, acceleration, floor, wheels, block)


def scatter_of(chords: Chords, pose: Array) -> Array | Rejected:
    """Covariance (6, 6) of a pose: its scatter when intervals are left out (jackknife), and what slip changes."""
    fitted = [fit_pose(select_rows(chords, chords.block != one)) for one in np.unique(chords.block)]
    poses = [one for one in fitted if not isinstance(one, Rejected)]
    if len(poses) < max(_MIN_BLOCKS, len(fitted)):
        return Rejected("the drive is too short for the vehicle's frame: drive for a minute, with curves")
    errors = se3.difference(np.array(poses), pose)
    errors = errors - errors.mean(axis=0)
    # Tyres slip in other ways than the model has: what it corrects is as uncertain as it is large.
    without = fit_pose(chords, _NO_SLIP)
    by_slip = np.zeros(6) if isinstance(without, Rejected) else se3.difference(without, pose)
    return np.asarray((len(errors) - 1) / len(errors) * errors.T @ errors + np.outer(by_slip, by_slip))


def fit_pose(chords: Chords, max_slip: float = _SLIP) -> Array | Rejected:
    """(4, 4) ``T_base_root``, with y = 0 without wheels; the slip of tyres has a standard deviation, s²/m."""
    known = np.isfinite(chords.level).all(axis=2)
    if not known.any():
        return Rejected("no floor was found below the root's path: no scanner measures where the vehicle drives")
    mean, _ = _fit_level(chords.level[known], chords.acceleration[known])
    up = mean[:3] / np.linalg.norm(mean[:3])
    height = -float(up @ mean[3:])
    R = axes_from(up)
    # The point of the floor below the root moves against its turns.
    steps = (chords.shift - np.cross(chords.turn, height * up)) @ R
    fitted = fit_axle(steps[..., :2], chords.turn @ up, max_slip)
    if isinstance(fitted, Rejected):
        return fitted
    angle, x = fitted
    R_root_base = R @ so3.exp(np.array([0.0, 0.0, angle]))
    pose = se3.pose(R_root_base.T, np.array([-x, 0.0, height]))
    pose[1, 3] = fit_side(chords, pose)[0]
    return np.asarray(pose)


def fit_side(chords: Chords, T_base_root: Array) -> tuple[float, float, float]:
    """The root's y by the wheels, m, its variance by their radius and its difference, m²; and the error of chords.

    0 without wheels.
    """
    used = select_rows(chords, chords.have_wheels)
    if not len(used.block):
        return 0.0, 0.0, 0.0
    ahead, up, height = T_base_root[0, :3], T_base_root[2, :3], T_base_root[2, 3]
    shift = (used.shift - np.cross(used.turn, height * up)).sum(axis=1) @ ahead
    travelled, turn = used.travelled.sum(axis=(1, 2)), used.turn.sum(axis=1) @ up
    B, longer = np.column_stack([travelled, -turn]), shift - travelled
    scale, weight = 0.01, np.ones(len(turn))
    for _ in range(20):
        prior = (scale / _WHEEL_SCALE) ** 2
        # The second keeps it regular where the vehicle did not turn: y is not known there.
        inverse = np.linalg.inv((B * weight[:, None]).T @ B + np.diag([prior, 1e-12]))
        solution = inverse @ (B * weight[:, None]).T @ longer
        error = longer - B @ solution
        scale = max(STDDEV_PER_MAD * float(np.median(np.abs(error))), 1e-5)
        weight = (1 + (error / (_FAR * scale)) ** 2) ** -2.0
    return float(solution[1]), float((inverse[1, 0] * prior * _WHEEL_SCALE) ** 2) + _SIDE_STDDEV**2, scale


def _fit_level(level: Array, acceleration: Array) -> tuple[Array, float]:
    """(6,) of normals and points (K, 6) at rest, and the deviation of normals from it, rad.

    Bodies lean out of curves, and dive when they brake. Outliers, as on the edges of ramps, weigh little
    (Geman–McClure). The deviation is along each axis, and what the standard error of the weighted mean is
    ``1 / sqrt(K)`` of if all deviate independently.
    """
    center = np.median(level, axis=0)
    up = center[:3] / np.linalg.norm(center[:3])
    design = np.column_stack([np.ones(len(level)), acceleration @ axes_from(up)[:, :2]])
    solution = np.zeros((3, 6))
    solution[0] = center
    for _ in range(10):
        error = level - design @ solution
        scale = STDDEV_PER_MAD * np.median(np.abs(error), axis=0) + 1e-9
        weight = (1 + np.sum((error / (3 * scale)) ** 2, axis=1)) ** -2.0
        N = (design * weight[:, None]).T @ design + np.diag([0.0, 1.0, 1.0]) * 1e-3
        solution = np.linalg.solve(N, (design * weight[:, None]).T @ level)
    error = (level - design @ solution)[:, :3] * weight[:, None]
    deviation = float(np.sqrt(np.sum(error**2) * len(level) / 2)) / float(weight.sum())
    return np.asarray(solution[0]), deviation


def fit_axle(steps: Array, turns: Array, max_slip: float = _SLIP) -> tuple[float, float] | Rejected:
    """The vehicle's heading in the plane, rad, and the distance of its axle ahead of the root, m.

    Args:
        steps: (C, S, 2) of the point below the root, along the root's level axes, m.
        turns: (C, S) to the left, rad.
        max_slip: standard deviation of κ before the drive, s²/m.
    """
    shift, turn = steps.sum(axis=1), turns.sum(axis=1)
    moving = (np.linalg.norm(shift, axis=1) > _STANDING[0]) | (np.abs(turn) > _STANDING[1])
    steps, turns, shift, turn = steps[moving], turns[moving], shift[moving], turn[moving]
    weight = np.ones(len(turn))
    slip = np.zeros(len(turn))
    scale, angle, distance = 0.01, 0.0, 0.0
    for _ in range(20):
        # e = left · shift + B (x, κ); the best (x, κ) of each heading leaves a quadratic form of it.
        B = np.column_stack([turn, slip])
        N = (B * weight[:, None]).T @ B + np.diag([1e-9, (scale / max_slip) ** 2])
        C = (B * weight[:, None]).T @ shift
        M = (shift * weight[:, None]).T @ shift - C.T @ np.linalg.solve(N, C)
        values, vectors = np.linalg.eigh(M)
        if values[1] < 0.1 * _MIN_WAY:
            return _NO_FRONT
        left = vectors[:, 0]
        ahead = np.array([left[1], -left[0]])
        x, kappa = -np.linalg.solve(N, C @ left)
        speeds = steps @ ahead
        if speeds.sum() < 0:
            left, ahead, x, kappa, speeds = -left, -ahead, -x, -kappa, -speeds
        error = shift @ left + B @ (x, kappa)
        scale = max(STDDEV_PER_MAD * float(np.median(np.abs(error))), 1e-5)
        weight = (1 + (error / (_FAR * scale)) ** 2) ** -2.0
        slip = (np.abs(speeds) * speeds * turns).sum(axis=1) / _STEP**2
        angle, distance = float(np.arctan2(ahead[1], ahead[0])), float(x)
    way = np.abs(speeds).sum()
    if way < _MIN_WAY:
        return _NO_FRONT
    if speeds[speeds > 0].sum() < _MIN_AHEAD * way:
        return Rejected("the vehicle drove backwards as far as ahead: drive ahead, which is where its front is")
    return angle, distance


# Error of wheels in 2.4 s from which they contradict the trajectory, m: slip of half a per cent is 2 cm; it was
# 0.2 m where the odometry of a scanner had lost its way.
_MAX_WHEEL_ERROR = 0.1
_ADVICE = "drive for a minute on a level floor, with curves to both sides and straight parts"


def assess_base(
    rig: Rig, used: Sequence[str], tracks: Mapping[str, Segments | Rejected], adjusted: Adjustment | None
) -> BaseFrame | None:
    """The root on the vehicle with a verdict; None without ``base``.

    Args:
        rig: states the frame.
        used: the sensors of the solution.
        tracks: trajectories of all sensors, by themselves.
        adjusted: the solution; None if there is none.
    """
    base = rig.base
    if base is None:
        return None
    found: VehiclePose | Rejected = Rejected("the root has no trajectory")
    if adjusted:
        wheels = None
        if base.wheels is not None and base.wheels in used:
            track = tracks[base.wheels]
            wheels = Wheels(used.index(base.wheels), track) if isinstance(track, Segments) else None
        found = locate_root(adjusted, used.index(rig.root), inverted=base.inverted, wheels=wheels)
    if isinstance(found, Rejected):
        return BaseFrame(base.frame, base.axle, Verdict("unobservable", f"{found.reason}; {_ADVICE}"))
    T, measured = found.T_base_root, ~np.isnan(np.diag(found.covariance))
    t = np.where(measured[:3], T[:3, 3], np.nan)
    t[1] = t[1] if base.y is None else base.y
    # x, which curves determine, belongs to any vehicle; a scan plane has no height, roll and pitch.
    covariance = np.nan_to_num(found.covariance)
    if not measured[0]:
        covariance[0, 0] = np.inf
    missing = f"curves in which {base.wheels} measures" if base.wheels else "base.wheels"
    open_side = (
        f"y of {rig.root} in {base.frame} is not observable from a drive without {missing}: "
        "measure it, and state base.y"
    )
    reasons = [open_side] if np.isnan(t[1]) else []
    if found.wheel_error > _MAX_WHEEL_ERROR:
        reasons.append(
            f"distances of {base.wheels} and of the root differ by {found.wheel_error:.1f} m in 2.4 s: odometry "
            "of one lost its way, or wheels slipped; drive slower, where walls and furniture are near"
        )
    verdict = grade_pose(
        base.frame, rig.sensors[rig.root].kind, np.eye(4), covariance, reasons,
        tolerance=rig.tolerance, settings=rig.settings.diagnostics.verdict,
        data="motions", advice=_ADVICE,
    )  # fmt: skip
    return BaseFrame(base.frame, base.axle, verdict, se3.pose(T[:3, :3], t), found.covariance)
