"""The next board poses: they fix what upright boards leave open, and by as much as they promise."""

from collections.abc import Sequence

import numpy as np

from bundle_scenes import HEIGHT, WIDTH, board_poses, scene, views_of
from calgraph.config.settings import RigDiagnosticsSettings
from calgraph.diagnostics.rig.next_best_pose import suggest_board_poses
from calgraph.diagnostics.rig.pose_description import describe_pose
from calgraph.diagnostics.verdict import grade_pose
from calgraph.estimation.rig.bundle_solver import Bundle, BundleState, minimize_bundle
from calgraph.estimation.rig.covariances import pose_covariance
from calgraph.estimation.rig.observations import relative_poses
from calgraph.estimation.rig.solution import SolvedBundle
from calgraph.geometry import Array, se3, so3
from calgraph.result import Suggestion

NAMES = ("lidar", "camera", "laser")
KINDS = {"lidar": "lidar3d", "camera": "camera", "laser": "lidar2d"}
# Camera axes, and those of a board that faces a robot which looks along x.
OPTICAL, FACING = np.array([[[0.0, 0, 1], [-1, 0, 0], [0, -1, 0]], [[0.0, 0, -1], [-1, 0, 0], [0, 1, 0]]])
T_ROBOT_SENSOR = np.array(
    [np.eye(4), se3.pose(OPTICAL, np.array([0.1, 0.1, 0])), se3.pose(np.eye(3), np.array([0.1, -0.2, -0.1]))]
)


def upright(count: int) -> Array:
    """``T_robot_board`` of boards that are turned to the left and right only."""
    rng = np.random.default_rng(0)
    boards = board_poses(count, rng)
    return se3.pose(so3.exp(np.outer(rng.uniform(-0.6, 0.6, count), [0, 0, 1])) @ FACING, boards[:, :3, 3])


def adjusted(boards: Array) -> SolvedBundle:
    """Level sensors that all saw these boards."""
    views = tuple(views_of(name, relative_poses(T, boards)) for name, T in zip(NAMES, T_ROBOT_SENSOR, strict=True))
    bundle = Bundle(NAMES, views, np.arange(3), np.full(3, 1e-6), lever=0.5 * WIDTH)
    return SolvedBundle(
        bundle, minimize_bundle(bundle, BundleState(T_ROBOT_SENSOR, boards, np.zeros(0))), np.arange(len(boards))
    )


def suggested(boards: Array) -> tuple[Suggestion, ...]:
    return suggest_board_poses(adjusted(boards), KINDS, (WIDTH, HEIGHT), np.random.default_rng(0))


def laser_deviations(boards: Array) -> Array:
    at = adjusted(boards)
    spread = pose_covariance(at.bundle, at.minimized.state, at.minimized.equations)
    return np.asarray(np.sqrt(np.diag(spread))[12:])


def with_all(boards: Array, suggestions: Sequence[Suggestion]) -> Array:
    return np.concatenate([boards, [s.T_root_board for s in suggestions]])


def test_boards_held_upright_are_to_be_tilted_before_the_scanner_that_they_leave_open() -> None:
    boards = upright(20)
    assert laser_deviations(boards)[2] > 1
    first = suggested(boards)[0]
    assert first.sensor == "laser"
    assert first.axis == "height (z)"
    assert "of laser" not in first.hold
    assert "tilted" in first.hold
    # By more than boards are tilted by chance when they are carried.
    up = first.T_root_board[2, 2]
    assert abs(np.degrees(np.arcsin(up))) > 20


def test_verdict_of_upright_boards_says_what_is_open_and_what_to_do() -> None:
    at = adjusted(upright(20))
    spread = pose_covariance(at.bundle, at.minimized.state, at.minimized.equations)[12:, 12:]
    found = grade_pose("laser", "lidar2d", T_ROBOT_SENSOR[2], spread)
    assert found.grade == "unobservable"
    assert found.reason.startswith(
        "height (z), roll (about x) and pitch (about y) of laser are not observable from these captures"
    )
    assert "tilt and turn the board" in found.reason


def test_three_boards_fix_what_upright_ones_leave_open() -> None:
    boards = upright(20)
    height, roll, pitch = laser_deviations(with_all(boards, suggested(boards)))[2:5]
    assert height < 0.02
    assert max(roll, pitch) < np.radians(0.5)


def test_deviations_shrink_by_as_much_as_promised() -> None:
    boards = upright(20)
    suggestions = suggested(boards)
    last = suggestions[-1]
    axis = {"height (z)": 2, "roll (about x)": 3, "pitch (about y)": 4}[last.axis]
    assert laser_deviations(with_all(boards, suggestions[:-1]))[axis] / last.stddev < 1.5
    assert 1 / 1.5 < laser_deviations(with_all(boards, suggestions))[axis] / last.expected < 1.5


def test_suggestions_beat_boards_of_the_same_kind_as_before() -> None:
    exact = scene(boards=12)
    known = SolvedBundle(exact.bundle, minimize_bundle(exact.bundle, exact.truth), np.arange(12))
    suggestions = suggest_board_poses(known, KINDS, (WIDTH, HEIGHT), np.random.default_rng(0))
    assert suggestions
    # Three more boards among twelve like them shrink deviations by a tenth.
    assert suggestions[0].expected / suggestions[0].stddev < 0.9


def test_words_say_where_the_board_is_and_how_it_is_tilted() -> None:
    # 2 m ahead, 30 degrees to the left, half a metre up, its face turned up by 40 degrees.
    bearing, tilt = np.radians(30), np.radians(40)
    z = np.array([-np.cos(tilt) * np.cos(bearing), -np.cos(tilt) * np.sin(bearing), np.sin(tilt)])
    x = np.cross([0, 0, 1], z) / np.cos(tilt)
    T = se3.pose(
        np.column_stack([x, np.cross(z, x), z]), np.array([2 * np.cos(bearing), 2 * np.sin(bearing), 0.5])
    )
    words = "hold the board 2.0 m from laser, 30° to its left, 0.5 m above it, tilted back by 40°"
    assert describe_pose("laser", KINDS, {"laser": T}, RigDiagnosticsSettings()) == words
    camera = se3.inverse(se3.pose(OPTICAL, np.zeros(3))) @ T
    assert describe_pose("laser", KINDS, {"camera": camera}, RigDiagnosticsSettings()) == words.replace(
        "laser", "camera"
    )
