"""The calibration of a rig from the captures until now, in less time than the operator needs for the next one.

Poses, covariances and verdicts are those of ``calgraph calibrate`` on the same captures, without the errors of
held-out captures: cross-validation and bootstrap take longest.
"""

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from calgraph.config import Rig
from calgraph.errors import CalgraphError
from calgraph.geometry import Array, se3
from calgraph.live.sensor_solution import SensorSolution, Solution, describe_sensors
from calgraph.live.state import Advice, SceneState
from calgraph.report.pose_picture import DrawnSensor, draw_pose, estimate_up
from calgraph.result import Calibration, Remedy, Suggestion
from calgraph.rig.bundle.problem import explain_singular_equations
from calgraph.rig.bundle.solution import SolvedBundle
from calgraph.rig.captures.detect import CaptureSet, state_estimated_intrinsics
from calgraph.rig.checks.assemble import assemble_rig
from calgraph.rig.checks.drift_tests import include_drifts, measure_drifts
from calgraph.rig.checks.next_best_pose import suggest_board_poses
from calgraph.rig.checks.remedies import find_remedies
from calgraph.rig.options import RigOptions
from calgraph.rig.pipeline import build_problem_from_captures, solve_after_bumps
from calgraph.sensors import CameraModel
from calgraph.sensors.kinds import KINDS

# How well a sensor alone locates the board: a partner that measures its plane needs the fewest shared captures.
_PARTNER_RANK = {name: rank for rank, name in enumerate(KINDS)}


def advise_missing_pair(rig: Rig, captures: CaptureSet, connected: Collection[str]) -> str:
    """Which sensors should detect the board together next, as long as some have no pose; empty if all have one.

    They are the pair with the most common captures, of a sensor without a pose and one with a pose.

    Args:
        rig: the rig.
        captures: the detections until now.
        connected: the sensors that have a pose, the root included.
    """
    placed = {rig.root, *connected}
    pairs = [(name, partner) for name in rig.sensors if name not in placed for partner in sorted(placed)]
    if not pairs:
        return ""

    def count_shared(pair: tuple[str, str]) -> int:
        return len(captures.detections[pair[0]].keys() & captures.detections[pair[1]].keys())

    # Of several, that of the kinds which locate the board best; the first in rig.yaml.
    rank = {name: _PARTNER_RANK[spec.kind] for name, spec in rig.sensors.items()}
    pair = min(pairs, key=lambda pair: (-count_shared(pair), rank[pair[0]] + rank[pair[1]]))
    first, shared = f"Show the board to {pair[0]} and {pair[1]} together", count_shared(pair)
    if not shared:
        return f"{first}, in several places, tilted and turned differently each time"
    times = "once" if shared == 1 else f"{shared} times"
    return f"{first}, tilted and turned differently than before: they have detected it together {times}"


@dataclass(frozen=True, eq=False)
class LiveSolution(Solution):
    """The calibration of a rig from the captures until now."""

    captures: int
    """Number of captures that it was computed from."""
    advice: Advice | None = None
    """The next board pose; None where all sensors are good, and where no pose has a relevant gain."""
    suggestion: Suggestion | None = None
    """The next best board pose, where all sensors have a pose and some are not good."""
    scene: SceneState | None = None
    """The sensors that have poses, the boards of the captures, and the next one."""


def solve_captures(rig: Rig, captures: CaptureSet, start: LiveSolution | None = None) -> LiveSolution:
    """Solves for the poses of all sensors from the captures until now.

    Args:
        rig: sensors and board.
        captures: the detections until now; cameras without intrinsics are left out.
        start: the last solution.

    Returns:
        The solution, for any captures: sensors that nothing connects to the root have no pose.
    """
    rig, captures = state_estimated_intrinsics(rig, captures), _leave_out_unprojected(rig, captures)
    try:
        calibration, solved = _solve(rig, captures, _select_known_poses(start))
    except CalgraphError:
        missing = advise_missing_pair(rig, captures, ())
        return LiveSolution(describe_sensors(rig, None), len(captures.holds), Advice(missing) if missing else None)
    sensors = tuple(
        replace(one, field_of_view=_measure_field_of_view(captures.cameras.get(one.name)))
        for one in describe_sensors(rig, calibration)
    )
    done = all(sensor.grade == "good" for sensor in sensors)
    connected = {sensor.name for sensor in sensors if sensor.T_root_sensor is not None}
    missing = advise_missing_pair(rig, captures, connected)
    suggestion = None
    if solved and not missing and not done:
        repeated = start and start.captures != len(captures.holds)
        suggestion = suggest_next_pose(rig, solved, start.suggestion if start and repeated else None)
    picture = _draw_suggestion(rig, sensors, suggestion) if suggestion else ""
    advice = None if done else _advise(sensors, missing, suggestion, picture)
    scene = _make_scene(rig, sensors, calibration, suggestion)
    return LiveSolution(sensors, len(captures.holds), advice, suggestion, scene)


def _make_scene(
    rig: Rig, sensors: Sequence[SensorSolution], calibration: Calibration, suggestion: Suggestion | None
) -> SceneState:
    posed = (one for one in sensors if one.T_root_sensor is not None)
    # Nothing is drawn at infinity.
    drawn = tuple(one for one in posed if one.covariance is None or np.isfinite(one.covariance).all())
    boards = tuple(outline.corners for outline in calibration.pictures.board_outlines)
    corners = np.array([[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]]) * [*rig.board_size, 0.0] / 2
    return SceneState(drawn, boards, se3.apply(suggestion.T_root_board, corners) if suggestion else None)


def _advise(
    sensors: Sequence[SensorSolution], missing: str, suggestion: Suggestion | None, picture: str
) -> Advice | None:
    """What to do next, in words; what keeps a sensor from being good where no board pose helps."""
    if missing:
        return Advice(missing)
    if suggestion:
        return Advice(
            suggestion.hold[0].upper() + suggestion.hold[1:],
            picture,
            str(suggestion).removeprefix(f"{suggestion.hold}: "),
        )
    reasons = [sensor.reason for sensor in sensors if sensor.grade != "good" and sensor.reason]
    return Advice(reasons[0]) if reasons else None


def _draw_suggestion(rig: Rig, sensors: Sequence[SensorSolution], suggestion: Suggestion) -> str:
    """The picture of a suggestion, as viewed by its sensor, or a camera."""
    drawn = [
        DrawnSensor(one.name, one.kind, one.T_root_sensor, one.field_of_view)
        for one in sorted(sensors, key=lambda one: one.name != rig.root)
        if one.T_root_sensor is not None
    ]
    return draw_pose(drawn, suggestion.T_root_board, rig.board_size, suggestion.sensor)


def _measure_field_of_view(camera: CameraModel | None) -> tuple[float, float] | None:
    """Horizontal and vertical field of view, rad; None without intrinsics."""
    if camera is None:
        return None
    u, v = camera.principal_point
    rays = camera.rays(np.array([[0.0, v], [camera.width - 1.0, v], [u, 0.0], [u, camera.height - 1.0]]))
    left, right, top, bottom = rays / np.linalg.norm(rays, axis=1, keepdims=True)
    return float(np.arccos(np.clip(left @ right, -1, 1))), float(np.arccos(np.clip(top @ bottom, -1, 1)))


def _leave_out_unprojected(rig: Rig, captures: CaptureSet) -> CaptureSet:
    """The captures with detections of every sensor of the rig, none of cameras that have no intrinsics yet."""
    usable = {name for name in rig.sensors if name in captures.cameras or name not in rig.cameras()}
    found = {name: captures.detections.get(name, {}) if name in usable else {} for name in rig.sensors}
    waiting = {(hold.index, name): "not measured yet" for hold in captures.holds for name in rig.sensors}
    return replace(captures, detections=found, rejections=waiting | dict(captures.rejections))


def _select_known_poses(start: LiveSolution | None) -> dict[str, Array]:
    """The poses of an earlier solution without ambiguous or unobservable ones, by sensor."""
    return {
        sensor.name: sensor.T_root_sensor
        for sensor in (start.sensors if start else ())
        if sensor.T_root_sensor is not None and sensor.grade in ("good", "weak")
    }


@explain_singular_equations()
def _solve(rig: Rig, captures: CaptureSet, known: Mapping[str, Array]) -> tuple[Calibration, SolvedBundle | None]:
    options = RigOptions()
    rig = _without_bootstrap(rig)
    problem = build_problem_from_captures(rig, captures, options, np.random.default_rng(options.seed), known=known)
    problem, solution, tree = solve_after_bumps(problem)
    drifts, remedies = None, tuple[Remedy, ...]()
    if solved := solution.solved_bundle:
        drifts = measure_drifts(solved)
        solution = include_drifts(solution, solved, drifts, rig.settings.diagnostics)
        remedies = find_remedies(rig, solution, solved, drifts)
    return assemble_rig(problem, tree, solution, drifts=drifts, remedies=remedies), solved


def _without_bootstrap(rig: Rig) -> Rig:
    """The rig with settings by which no number of captures is too small to do without a bootstrap."""
    diagnostics = rig.settings.diagnostics
    tests = diagnostics.rig.model_copy(update={"max_bootstrap_captures": 1})
    diagnostics = diagnostics.model_copy(update={"rig": tests})
    return rig.model_copy(update={"settings": rig.settings.model_copy(update={"diagnostics": diagnostics})})


def suggest_next_pose(rig: Rig, solved: SolvedBundle, last: Suggestion | None) -> Suggestion | None:
    """The board pose that reduces the uncertainty of the least certain sensor most.

    Args:
        rig: the rig.
        solved: the current solution.
        last: the suggestion before the last capture; no pose near it is suggested.

    Returns:
        The suggestion; None where no pose that a person reaches has a relevant gain.
    """
    state = solved.minimized.state
    kinds = {name: rig.sensors[name].kind for name in solved.bundle.sensors}
    up = estimate_up(kinds, dict(zip(solved.bundle.sensors, state.T_root_sensor, strict=True)))
    positions, sensors = state.T_root_board[:, :3, 3], state.T_root_sensor[:, :3, 3]

    def is_reachable(T_root_board: Array) -> NDArray[np.bool_]:
        return _is_reachable(T_root_board[:, :3, 3], positions, sensors, up, last)

    diagnostics = rig.settings.diagnostics
    settings = diagnostics.model_copy(update={"rig": diagnostics.rig.model_copy(update={"suggestions": 1})})
    # Other candidates after each capture, and the same ones for the same captures.
    rng = np.random.default_rng(len(positions))
    found = suggest_board_poses(
        solved, kinds, rig.board_size, rng, rig.tolerance, settings, up=up, is_reachable=is_reachable
    )
    return found[0] if found else None


# Maximum height of the board's centre above or below the median of its heights until now, m: a person holds a
# board whose centre is at 1 m from the knees to above the head.
_MAX_HEIGHT_CHANGE = 0.6
# Minimum distance of the board's centre from every sensor, m: nearer, the robot is in the way.
_MIN_DISTANCE = 0.6
# Distance from the last suggestion, m, within which no other is made after a capture: more than operators miss it
# by, so that a suggestion whose board sensors did not detect is not repeated.
_REPEAT_DISTANCE = 0.25


def _is_reachable(
    candidates: Array, positions: Array, sensors: Array, up: Array, last: Suggestion | None
) -> NDArray[np.bool_]:
    """(K,) which of the board's candidate positions (K, 3) a person reaches, and has not just tried."""
    reachable = np.abs(candidates @ up - np.median(positions @ up)) <= _MAX_HEIGHT_CHANGE
    distances = np.linalg.norm(candidates[:, None] - sensors, axis=-1)
    reachable &= np.all(distances >= _MIN_DISTANCE, axis=1)
    if last is not None:
        away = np.linalg.norm(candidates - last.T_root_board[:3, 3], axis=-1)
        reachable &= away >= _REPEAT_DISTANCE
    return np.asarray(reachable)
