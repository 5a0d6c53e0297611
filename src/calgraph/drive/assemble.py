"""Assembles the Calibration of a drive: poses with verdicts, and why sensors have none."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from calgraph.config import Rig
from calgraph.drive.adjustment import Adjustment
from calgraph.drive.board_views import BoardMeasurements
from calgraph.drive.sources import SOURCES
from calgraph.drive.sources.camera import MIN_VIEWS
from calgraph.drive.start import MotionStart
from calgraph.errors import Rejected
from calgraph.geometry import Array, se2
from calgraph.result import BaseFrame, Calibration, Edge, Evidence, FitError, Pictures, SensorPose, Verdict
from calgraph.result.estimated_parameter import EstimatedParameter
from calgraph.result.finding import Finding
from calgraph.solver.connected_parts import label_parts
from calgraph.surfaces.sensor_states import BESIDE_POSE
from calgraph.verdict.grades import LONE_ROOT, collect_findings, grade_pose

_ADVICE = "drive longer, with more turns, so that all sensors pass the same walls and furniture"
_MOTION_ADVICE = "drive longer, with turns to both sides, and over ramps or thresholds"
# Of motions and boards: a height was 27 mm off at a stated 8 mm with cameras, the NEES of trajectories up to 5.
_UNVERIFIED = (
    "it and the root do not both measure surfaces: standard deviations from trajectories and boards were up to "
    "three times too small in tests, so that such poses are weak in this version"
)
# Of 2-D scanners in space: one of ten was 0.23 m off at a stated 26 mm, from a start at another minimum.
_UNVERIFIED_TILT = (
    "only rocking of the robot shows the height and tilt of a 2-D scanner, and another place may fit as well: "
    "beside 3-D LiDARs, they are weak in this version"
)
_OPEN_HEIGHT = (
    "the robot turned about one axis only, and it and the root do not both measure the floor, which leaves its "
    "height open: drive over ramps, too, let both measure the floor, or state it as a prior"
)
# Surfaces by which maps of two sensors have to agree in each direction, chained to the root: 14 and more in drives
# of 30 s and in 14 of 15 minutes of real scans (7 in the other, which is weak); 2.5 at most for 6 sensors whose
# odometry failed and 4 beside lorries.
_MIN_AGREEMENT = 8.0
# Correlation of the turn rates of two LiDARs below which one of them followed something that moves along, or lost
# its way: 0.65 to 0.93 beside a lorry, usually 0.99. One of 45 real minutes has 0.93, and three of 11 simulated
# drives have 0.82 to 0.92 with poses that are right: the price of the rule.
_MIN_CORRELATION = 0.94
# RMS reprojection error above which a solution is wrong, pixels: motion blur of a slow drive is less.
_MAX_REPROJECTION_ERROR = 3.0
# Squared last step, in standard deviations, from which the adjustment has not converged.
_MAX_SQUARED_STEP = 25.0
# What a sensor's state has beside pose and clock: quantity, unit, and the value without errors.
_SENSOR_ERRORS = (
    ("range bias", "m", 0.0), ("range scale", "", 1.0), ("time from first to last beam", "s", 0.0),
    ("delay of odd beams", "s", 0.0),
)  # fmt: skip


@dataclass(frozen=True, eq=False)
class DriveResult:
    """What the stages of a drive's calibration found."""

    used: Sequence[str]
    """The sensors that were adjusted, the root first."""
    frames: Mapping[str, str]
    """frame_id by sensor, as its messages state it."""
    starts: Mapping[str, MotionStart | Rejected]
    """By sensor but the root."""
    adjusted: Adjustment | None
    """None where only the root has a trajectory."""
    findings: Sequence[Finding]
    """What does not fit the rig in the messages."""
    views: Mapping[str, Array] = field(default_factory=dict)
    """By sensor that was adjusted, the images of boards; see :func:`measure_views`."""
    systematic: tuple[EstimatedParameter, ...] = ()
    """Errors of lenses, prints, ranges, and times of beams."""
    base: BaseFrame | None = None
    """The vehicle's frame, where rig.yaml states that there is one."""
    pictures: Pictures = field(default_factory=Pictures)


def assemble_drive(rig: Rig, result: DriveResult) -> Calibration:
    """The calibration of a drive."""
    adjusted, used = result.adjusted, result.used
    names = used if adjusted else [rig.root]
    covariance, clocks = _lift_covariance(adjusted) if adjusted else (np.zeros((6, 6)), np.zeros(1))
    by_sensor = collect_findings(result.findings)
    sensors = []
    in_space = adjusted is not None and adjusted.free.shape[1] == 6 + BESIDE_POSE
    scanners = {name for name in names if in_space and rig.sensors[name].kind == "lidar2d"}
    for k, name in enumerate(names):
        spec, block = rig.sensors[name], slice(6 * k, 6 * k + 6)
        frame = spec.frame_id or result.frames.get(name)
        state = adjusted.states[k] if adjusted else None
        T = np.eye(4) if state is None else se2.to_se3(state.T_root_sensor)
        if k == 0:
            located = result.base is not None and result.base.known
            verdict = Verdict("good") if len(names) > 1 or located else LONE_ROOT
        else:
            assert adjusted is not None
            verdict = grade_pose(
                name, spec.kind, T, np.nan_to_num(covariance[block, block]),
                [
                    *by_sensor.get(name, ()),
                    *_find_contradictions(adjusted, k, result.views[name], result.starts[name]),
                    *([_UNVERIFIED_TILT] if {rig.root, name} & scanners else ()),
                ],
                tolerance=rig.tolerance, settings=rig.settings.diagnostics.verdict,
                data="motions and surfaces" if adjusted.point_counts.any() else "motions",
                advice=_ADVICE if adjusted.point_counts[k] else _MOTION_ADVICE,
            )  # fmt: skip
        sensors.append(
            SensorPose(
                name,
                None if k == 0 else rig.root,
                # Wheels measure the motion of the vehicle's frame, which cannot be below its root.
                name if not frame or (rig.base and frame == rig.base.frame) else frame,
                spec.kind,
                T,
                verdict,
                clock_offset=None if k == 0 or state is None else state.clock_offset,
                clock_offset_stddev=None if k == 0 else float(clocks[k]),
            )
        )
    unconnected = {name: start.reason for name, start in result.starts.items() if isinstance(start, Rejected)}
    # What gyroscopes cannot measure.
    turning = (
        f"turns do not determine where {name} is: its rotation is calibrated only"
        for name in names
        if rig.sensors[name].kind == "gyroscope"
    )
    return Calibration(
        root=rig.root,
        sensors=tuple(sensors),
        joint_covariance=covariance,
        systematic=result.systematic,
        base=result.base,
        evidence=Evidence(
            estimator="joint",
            tolerance=rig.tolerance,
            # Of the root with each other sensor: relative motions, and those that agree.
            edges=tuple(
                Edge(rig.root, name, start.motions, round(start.inliers * start.motions), True, np.zeros(0))
                if isinstance(start, MotionStart)
                else Edge(rig.root, name, 0, 0, False, np.zeros(0), note=start.reason)
                for name, start in result.starts.items()
            ),
            unconnected=unconnected,
            remarks=(*(finding.text for finding in result.findings), *turning),
            fit=_describe_fit(names, adjusted, result.views) if adjusted else {},
        ),
        pictures=result.pictures,
    )


def describe_sensor_errors(rig: Rig, names: Sequence[str], adjusted: Adjustment) -> tuple[EstimatedParameter, ...]:
    """Errors of ranges and times of beams from the joint solution with its parts.

    Those of times are of scans that do not state them.
    """
    found = []
    for k in np.flatnonzero(adjusted.point_counts).tolist():
        name, state = names[k], adjusted.states[k]
        spec, n = rig.sensors[name], len(state.T_root_sensor) - 1
        timing = np.concatenate([np.atleast_2d(part.points[k].timing) for part in adjusted.parts])
        units = np.array([1.0, 1.0, *timing.max(axis=0)[:2]])
        prior = SOURCES[spec.kind].stddev(spec, n)[1 - BESIDE_POSE : -1] * units
        values = np.array([state.range_bias, 1 / (1 - state.range_scale), *state.timing[:2]]) * units
        stddev = adjusted.stddev[k, 1 - BESIDE_POSE : -1] * units
        rows = zip(_SENSOR_ERRORS, prior.tolist(), values.tolist(), stddev.tolist(), strict=True)
        found += [EstimatedParameter(name, *error, *numbers) for error, *numbers in rows if numbers[0] > 0]
    return tuple(found)


def _find_contradictions(adjusted: Adjustment, k: int, views: Array, start: MotionStart | Rejected) -> list[str]:
    """Why the pose of a sensor with images of boards (V, 2) and a start cannot be good."""
    reasons = []
    if adjusted.squared_step > _MAX_SQUARED_STEP:
        reasons.append("the joint adjustment has not converged")
    measuring = adjusted.point_counts > 0
    if not (measuring[0] and measuring[k]):
        reasons.append(_UNVERIFIED)
    elif isinstance(start, MotionStart) and not start.by_boards and start.correlation < _MIN_CORRELATION:
        reasons.append(
            f"its turn rates agree with the root's in part only (correlation {start.correlation:.2f}): something "
            "moved along before one of them, as a lorry does, or odometry lost its way; drive slower, where walls "
            "and furniture are near"
        )
    if isinstance(start, MotionStart) and start.open_height:
        reasons.append(_OPEN_HEIGHT)
    connected = label_parts(len(measuring), np.argwhere(adjusted.agreement >= _MIN_AGREEMENT))
    if 0 < len(views) < MIN_VIEWS:
        reasons.append(
            f"it detected boards in {len(views)} images only, fewer than {MIN_VIEWS}: put more boards into its "
            "field of view, and drive before them for longer"
        )
    if len(views):
        corners, squares = views.sum(axis=0)
        error = float(np.sqrt(squares / (2 * corners)))
        if error > _MAX_REPROJECTION_ERROR:
            reasons.append(f"boards are {error:.1f} px from where they should be in its images")
    if measuring[0] and measuring[k] and connected[0] != connected[k]:
        most = max(float(np.delete(adjusted.agreement[k], k).max()), 0.0)
        reasons.append(
            f"walls that it measured agree with those of other sensors in {most:.0f} places along one direction, "
            f"fewer than {_MIN_AGREEMENT:.0f}: drive loops, so that all sensors pass the same places; if they do, "
            "odometry lost its way"
        )
    return reasons


def _describe_fit(names: Sequence[str], adjusted: Adjustment, views: Mapping[str, Array]) -> dict[str, FitError]:
    """Residuals of each sensor: reprojection errors of corners, or distances of points from surfaces."""
    found = {}
    for k, name in enumerate(names):
        corners, squares = views[name].sum(axis=0)
        if corners:
            found[name] = FitError(int(corners), "px", float(np.sqrt(squares / (2 * corners))))
        elif adjusted.point_counts[k]:
            found[name] = FitError(int(adjusted.point_counts[k]), "m", float(adjusted.noise.white[k]))
    return found


def measure_views(adjusted: Adjustment, k: int) -> Array:
    """(V, 2) number of corners, and squared reprojection error, pixels², of each image of a board by a sensor."""
    found = [np.zeros((0, 2))]
    for part in adjusted.parts:
        for one in part.measurements:
            if isinstance(one, BoardMeasurements):
                views = one.measure_views(part.trajectory, adjusted.states, adjusted.shared)
                found.append(views[views[:, 0] == k, 1:])
    return np.concatenate(found)


def _lift_covariance(adjusted: Adjustment) -> tuple[Array, Array]:
    """Covariance (6S, 6S) of all poses, NaN where nothing is measured, and (S,) of clock offsets, s."""
    count, columns = adjusted.free.shape
    axes = np.arange(6) if columns == 6 + BESIDE_POSE else np.array([0, 1, 5])
    # A plane, or a gyroscope, does not measure all axes.
    measured = np.zeros((count, 6), dtype=bool)
    measured[:, axes] = adjusted.free[:, : len(axes)]
    measured[0] = True
    covariance = np.zeros((6 * count, 6 * count))
    covariance[~measured.ravel()] = np.nan
    covariance[:, ~measured.ravel()] = np.nan
    covariance[:6, :6] = 0.0
    sensor, column = np.nonzero(adjusted.free)
    of_pose = np.flatnonzero(column < len(axes))
    rows = 6 * sensor[of_pose] + axes[column[of_pose]]
    covariance[np.ix_(rows, rows)] = adjusted.covariance[np.ix_(of_pose, of_pose)]
    return covariance, adjusted.stddev[:, len(axes)]
