"""Predicts the uncertainty of a rig's poses before it is recorded, and the best places for the board.

Boards are drawn where two sensors or more detect them, and the joint problem is linearized at noise-free
detections of them. Its information is proportional to the number of captures, and that of priors is added. Its
covariance includes what that of a calibration includes: the usual bias of views, and drifts that captures do not
exclude.
"""

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, replace
from functools import cache
from itertools import islice
from typing import Literal

import numpy as np

from calgraph.boards.board_beams import MIN_BEAMS, MIN_POINTS, MIN_RINGS, find_beams_on_board, find_crossings
from calgraph.boards.detections import BoardCorners, Detection, PlanePatch, Segment, to_beams
from calgraph.boards.printed_boards import compute_landmarks, select_marks_in_view
from calgraph.config import Rig
from calgraph.errors import CalibrationError
from calgraph.geometry import Array, plane, se3, so3
from calgraph.result import ErrorBudget, Suggestion
from calgraph.result.sensor_pose import stddev_along_axes
from calgraph.rig.bundle.board_observations import BoardObservation
from calgraph.rig.bundle.board_outlines import add_outlines
from calgraph.rig.bundle.bundle_setup import build_bundle, update_noise
from calgraph.rig.bundle.bundle_solver import MinimizedBundle, linearize_bundle
from calgraph.rig.bundle.covariances import information_by_board, pose_covariance, pose_jacobian, sum_information
from calgraph.rig.bundle.observations import stack_poses
from calgraph.rig.bundle.solution import RigSolution, SolvedBundle
from calgraph.rig.bundle.variance_components import usual_bias_variances
from calgraph.rig.captures.detect import CaptureSet
from calgraph.rig.checks.assemble import split_budget
from calgraph.rig.checks.drift_tests import DriftStatistics, include_drifts, order_boards, score_drifts
from calgraph.rig.checks.next_best_pose import MAX_PREDICTED_TILT, MIN_SEGMENT_SHARE, axes_of, select_board_poses
from calgraph.rig.fields_of_view import FieldOfView, PlannedRig
from calgraph.sensors import CameraModel
from calgraph.sensors.beam_pattern import BeamPattern
from calgraph.sensors.kinds import KINDS
from calgraph.verdict.grades import max_good_stddev
from calgraph.verdict.remedy_choice import choose_amount

Detections = Mapping[str, Mapping[int, tuple[Detection, ...]]]
"""By sensor and board."""

# Numbers of captures that are tried: fewer do not determine the bias of views, and no person records more.
_COUNTS = (10, 12, 15, 20, 25, 30, 40, 50, 60, 80, 100, 150, 200, 300, 500)
# Captures that stand for any number: a thousandth of the variance of ten is left of what captures average.
_UNLIMITED = 10_000
# Boards that stand for all places: with other draws, standard deviations differ by 6 % (RMS); with 100, by 10 %.
_BOARDS = 200
# Boards that are tried at most for each one that two sensors detect.
_DRAWN_PER_BOARD = 5
# Best places of the board that are named.
_PLACES = 6


@dataclass(frozen=True, eq=False)
class PlannedSensor:
    """Predicted uncertainty of one sensor's pose."""

    name: str
    kind: str
    stddev: Array
    """(6,) along and about its axes, m and rad, with the captures."""
    limit: Array
    """(6,) with any number of captures: what priors leave."""
    detected: float
    """Share of the boards that it detects."""


@dataclass(frozen=True, eq=False)
class RecordingPlan:
    """What a recording of a rig will give."""

    captures: int
    sensors: tuple[PlannedSensor, ...]
    """All but the root."""
    max_stddev: Array
    """(6,) standard deviations (m, rad) up to which errors are within the tolerance."""
    needed: int | None
    """Captures with which all sensors are within the tolerance that ever are, with a reserve of what captures
    reduce if that is possible (:func:`choose_amount`); None if 500 do not suffice."""
    places: tuple[Suggestion, ...]
    """Where to hold the board, the most informative place first, each in addition to those before."""
    limit_budget: ErrorBudget
    """What the uncertainty with any number of captures comes from; the root first."""

    def judge(self, sensor: PlannedSensor) -> Literal["good", "more", "impossible"]:
        """Whether a sensor is within the tolerance with the captures, with more of them, or with no number."""
        if (sensor.stddev <= self.max_stddev).all():
            return "good"
        return "more" if (sensor.limit <= self.max_stddev).all() else "impossible"


def plan_recording(planned: PlannedRig, captures: int, rng: np.random.Generator) -> RecordingPlan:
    """Predicts the standard deviations of a recording, and selects the best places for the board.

    Args:
        planned: the rig.
        captures: number of captures, at places where two sensors or more detect the board.
        rng: draws places.

    Raises:
        CalibrationError: no board was found that two sensors detect.
    """
    return plan_captures(planned, captures, *detect_boards(planned, draw_boards(planned, rng), _BOARDS), rng)


def plan_captures(
    planned: PlannedRig,
    captures: int,
    T_root_board: Array,
    detections: Detections,
    rng: np.random.Generator | None = None,
) -> RecordingPlan:
    """As :func:`plan_recording`, from boards (C, 4, 4) and detections of them.

    Captures are of boards that are drawn from these; without ``rng``, of each of these equally often.
    """
    rig, settings = planned.rig, planned.rig.settings.diagnostics
    boards = _linearize_boards(planned, T_root_board, detections)
    limits = max_good_stddev(rig.tolerance, settings.verdict)

    excess = _measure_excess(boards, captures, rng) if rng else 0.0

    @cache
    def predict(count: int) -> Array:
        return (1 + excess * captures / count) * _predict_stddev(_scale_captures(boards, count), rig)

    stddev, least = predict(captures), predict(_UNLIMITED)
    possible = (least <= limits).all(axis=1)
    # Variances that captures reduce, and what priors leave of the tolerance for them; none of the root.
    left = np.maximum(limits**2 - least[possible] ** 2, np.finfo(float).tiny)

    def exceed(count: int) -> float:
        return float(np.sqrt(np.max((predict(count)[possible] ** 2 - least[possible] ** 2) / left)))

    needed = choose_amount(_COUNTS, exceed, None)
    bundle, kinds = boards.bundle, {name: spec.kind for name, spec in rig.sensors.items()}
    known = list(information_by_board(bundle, boards.minimized.equations))
    places = select_board_poses(
        _scale_captures(boards, 0), kinds, rig.tolerance, settings.verdict, T_root_board,
        lambda chosen: (known[i] for i in chosen.tolist()),
        lambda board: [name for name, found in detections.items() if board in found],
        _PLACES,
    )  # fmt: skip
    sensors = tuple(
        PlannedSensor(name, kinds[name], stddev[i], least[i], len(detections[name]) / len(T_root_board))
        for i, name in enumerate(bundle.sensors)
        if i
    )
    unlimited = _scale_captures(boards, _UNLIMITED)
    published, drifts = _publish(unlimited, rig)
    # Information of views is scaled: biases of as many views average, too.
    averaged = replace(bundle, bias_variance=bundle.bias_variance * len(boards.captures) / _UNLIMITED)
    published = replace(published, solved_bundle=replace(unlimited, bundle=averaged))
    budget = split_budget(published, bundle.sensors, drifts)
    assert budget is not None
    return RecordingPlan(captures, sensors, limits, needed, places, budget)


def _linearize_boards(planned: PlannedRig, T_root_board: Array, detections: Detections) -> SolvedBundle:
    """The joint problem of boards (C, 4, 4), one capture each, with the usual bias of views, at its solution."""
    rig = planned.rig
    cameras = {name: field for name, field in planned.fields.items() if isinstance(field, CameraModel)}
    captured = CaptureSet(0.0, {}, (), detections, {}, cameras)
    boards = [
        BoardObservation(c, {name: 0 for name in planned.T_root_sensor if c in detections[name]})
        for c in range(len(T_root_board))
    ]
    bundle, state = build_bundle(rig, captured, boards, planned.T_root_sensor)
    state = replace(state, T_root_board=T_root_board)
    bundle, outlined = add_outlines(bundle, state, rig, detections, boards, 0.0)
    state, usual = replace(state, extra=outlined.extra), usual_bias_variances(bundle)
    bias = np.array([bundle.least_bias_variance(k) for k in range(len(bundle.all_views))])
    for k in range(len(bundle.views)):
        bias[k, list(bundle.bias_components(k))] = usual[list(bundle.bias_components(k))]
    bundle = replace(update_noise(bundle, state), bias_variance=bias)
    solution = MinimizedBundle(state, linearize_bundle(bundle, state), 0, converged=True)
    return SolvedBundle(bundle, solution, np.arange(len(T_root_board)))


def _scale_captures(boards: SolvedBundle, captures: int) -> SolvedBundle:
    """The problem with the information of a number of captures that are distributed as the boards."""
    bundle, minimized = boards.bundle, boards.minimized
    equations, share = minimized.equations, captures / len(boards.captures)
    priors = np.diag(bundle.prior_stddev**-2.0)
    scaled = replace(
        equations,
        views=tuple(replace(at, information=share * at.information) for at in equations.views),
        H=share * (equations.H - priors) + priors,
        H_board=share * equations.H_board,
        H_board_sensor=share * equations.H_board_sensor,
    )
    return replace(boards, minimized=replace(minimized, equations=scaled))


def _predict_stddev(solved: SolvedBundle, rig: Rig) -> Array:
    """(S, 6) published standard deviations along and about the axes of all sensors."""
    published, _ = _publish(solved, rig)
    T_root_sensor, covariance = published.T_root_sensor, published.covariance
    return np.array([stddev_along_axes(T, covariance[name]) for name, T in T_root_sensor.items()])


def _publish(solved: SolvedBundle, rig: Rig) -> tuple[RigSolution, DriftStatistics]:
    """The solution with the covariance that a calibration publishes, and what shows drifts."""
    bundle, state, equations = solved.bundle, solved.minimized.state, solved.minimized.equations
    T_root_sensor = dict(zip(bundle.sensors, state.T_root_sensor, strict=True))
    covariance = pose_covariance(bundle, state, equations)
    solution = RigSolution("bundle", T_root_sensor, covariance, {}, converged=True)
    drifts = score_drifts(bundle, state, equations, order_boards(solved))
    return include_drifts(solution, solved, drifts, rig.settings.diagnostics), drifts


# Draws of the places of a recording, of whose standard deviations the median is predicted.
_DRAWS = 25


def _measure_excess(boards: SolvedBundle, captures: int, rng: np.random.Generator) -> Array:
    """(S, 6) excess of standard deviations with captures at drawn places over those with each place equally often.

    Of few captures, those that determine an axis may be missing. It is relative, and inversely proportional to the
    number of captures.
    """
    bundle, state = boards.bundle, boards.minimized.state
    C, J = len(boards.captures), pose_jacobian(boards.bundle, state)
    draws = rng.multinomial(captures, np.full(C, 1 / C), _DRAWS)
    weights = np.concatenate([np.full((1, C), captures / C), draws])
    H = sum_information(bundle, boards.minimized.equations, weights) + np.diag(bundle.prior_stddev**-2.0)
    blocks = (J @ np.linalg.inv(H) @ J.T).reshape(len(weights), len(bundle.sensors), 6, -1, 6)
    stddev = np.array([
        [stddev_along_axes(T, of_draw[i, :, i]) for i, T in enumerate(state.T_root_sensor)] for of_draw in blocks
    ])  # fmt: skip
    return np.asarray(np.median(stddev[1:], axis=0) / np.where(stddev[0] > 0, stddev[0], 1.0) - 1)


# Measurements of each scanner at rest: a hold takes twice as long as the slowest one.
_MEASUREMENTS = 2
# Limits of ranges that exclude no board, m.
_ANY_RANGE = 0.0, 100.0
# Distances of boards of 1 m, m, growing with the board: see "Where to hold it" in docs/recording.md.
_DISTANCES = 1.5, 3.0
# Largest roll, pitch and yaw relative to facing a sensor, rad (35°): see "Turn and tilt" there.
_MAX_TURN = np.radians(35)
# Largest elevation of the board's centre before the sensor that it faces, rad (15°): 0.5 m up or down at 2 m, as
# persons hold boards.
_MAX_ELEVATION = np.radians(15)


def draw_boards(planned: PlannedRig, rng: np.random.Generator) -> Iterator[Array]:
    """``T_root_board`` (4, 4) of boards before each sensor in turn, anywhere in its field of view."""
    axes = {name: axes_of(spec.kind) for name, spec in planned.rig.sensors.items()}
    directions = {name: _list_directions(field, axes[name]) for name, field in planned.fields.items()}
    while True:
        for name, T_root_sensor in planned.T_root_sensor.items():
            yield T_root_sensor @ _draw_board(directions[name], axes[name][2], planned.rig.board_size, rng)


def detect_boards(planned: PlannedRig, T_root_board: Iterable[Array], count: int) -> tuple[Array, Detections]:
    """The boards (C, 4, 4) that two sensors or more detect, ``count`` at most, and the detections.

    Raises:
        CalibrationError: there is none among the first ones.
    """
    rig = planned.rig
    number = [board.size for board in rig.boards].index(rig.board_size)
    found: list[Array] = []
    detections: dict[str, dict[int, tuple[Detection, ...]]] = {name: {} for name in rig.sensors}
    for T in islice(T_root_board, _DRAWN_PER_BOARD * count):
        of_board = {
            name: detection
            for name, T_root_sensor in planned.T_root_sensor.items()
            if (detection := _detect_board(planned, name, number, se3.inverse(T_root_sensor) @ T))
        }
        if len(of_board) > 1:
            for name, detection in of_board.items():
                detections[name][len(found)] = (detection,)
            found.append(T)
        if len(found) == count:
            break
    if not found:
        raise CalibrationError(
            "no place of the board was found at which two sensors detect it: their fields of view do not overlap, "
            "or the board is too small"
        )
    return stack_poses(found), detections


# Pixels along each side of an image through which directions to boards are drawn.
_PIXELS = 40


def _list_directions(field: FieldOfView, axes: Array) -> Array:
    """(N, 3) unit vectors in a field of view in which the centres of boards may be."""
    if isinstance(field, CameraModel):
        u, v = np.meshgrid(np.linspace(0, field.width - 1, _PIXELS), np.linspace(0, field.height - 1, _PIXELS))
        rays = field.rays(np.column_stack([u.ravel(), v.ravel()]))
        found = to_beams(rays[np.isfinite(rays).all(axis=1)])[1]
    else:
        found = field.directions
    level = np.abs(found @ axes[2]) <= np.sin(_MAX_ELEVATION)
    return found[level] if level.any() else found


def _draw_board(directions: Array, up: Array, size: tuple[float, float], rng: np.random.Generator) -> Array:
    """``T_sensor_board`` (4, 4) of a board in one of the directions (N, 3), turned away from the sensor."""
    u = directions[rng.integers(len(directions))]
    x = np.cross(u, up)
    x /= np.linalg.norm(x)
    facing = np.column_stack([x, np.cross(x, u), -u])
    distance = rng.uniform(*_DISTANCES) * np.sqrt(size[0] * size[1])
    return se3.pose(facing @ so3.exp(rng.uniform(-_MAX_TURN, _MAX_TURN, 3)), distance * u)


def _detect_board(planned: PlannedRig, name: str, number: int, T_sensor_board: Array) -> Detection | None:
    """The noise-free detection of a board of the rig by one sensor, if it detects it."""
    board, field = planned.rig.boards[number], planned.fields[name]
    surface, center = plane.from_pose(T_sensor_board), T_sensor_board[:3, 3]
    if surface[3] < np.cos(MAX_PREDICTED_TILT) * np.linalg.norm(center):
        return None
    if isinstance(field, CameraModel):
        marks = compute_landmarks(board).corners
        pixels = field.project(se3.apply(T_sensor_board, marks.reshape(-1, 3))).reshape(*marks.shape[:2], 2)
        seen = select_marks_in_view(board, field, pixels)
        if not seen.any():
            return None
        corners, pixels = marks[seen].reshape(-1, 3), pixels[seen].reshape(-1, 2)
        no_error = np.zeros((6, 6)), np.zeros((3, 3))
        return BoardCorners(corners, pixels, T_sensor_board, no_error[0], surface, no_error[1], 0.0, number)
    # Beams begin up to 0.1 m from the origin, and have a neighbour beside the board within as much.
    reach = float(np.linalg.norm(board.size)) / 2 + 0.2
    field = field.select(field.directions @ center > np.sqrt(np.maximum(center @ center - reach**2, 0.0)))
    hits = find_beams_on_board(field, T_sensor_board, board.size, _ANY_RANGE)
    if len(hits) < MIN_BEAMS:
        return None
    origins, directions = np.broadcast_to(field.origins, field.directions.shape)[hits], field.directions[hits]
    points = origins - ((origins @ surface[:3] + surface[3]) / (directions @ surface[:3]))[:, None] * directions
    beams = to_beams(np.tile(points, (_MEASUREMENTS, 1)))
    if KINDS[planned.rig.sensors[name].kind].detects == "line":
        ends = points[[0, -1]]
        if np.linalg.norm(ends[1] - ends[0]) < MIN_SEGMENT_SHARE * min(board.size):
            return None
        return Segment(ends, np.zeros((6, 6)), *beams, edges=_find_edges(field, T_sensor_board, board.size))
    if len(hits) < MIN_POINTS or (field.rings is not None and len(np.unique(field.rings[hits])) < MIN_RINGS):
        return None
    edges = _find_edges(field, T_sensor_board, board.size)
    return PlanePatch(surface, np.zeros((3, 3)), *beams, points.mean(axis=0), edges=edges)


def _find_edges(pattern: BeamPattern, T_sensor_board: Array, size: tuple[float, float]) -> Array:
    """(M, 2, 3) directions of neighbouring beams with the outline in their middle."""
    crossings = find_crossings(pattern, T_sensor_board, size, _ANY_RANGE)
    moved = (crossings.share - 0.5) * crossings.step
    ends = np.stack([crossings.hit + moved, crossings.hit + crossings.step + moved], axis=1)
    on_board = np.concatenate([ends, np.zeros((*ends.shape[:2], 1))], axis=-1)
    at = se3.apply(T_sensor_board, on_board)
    return np.asarray(at / np.linalg.norm(at, axis=-1, keepdims=True))
