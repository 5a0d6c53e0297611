"""The next board poses: they fix what upright boards leave open, and by as much as they promise."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest

from bundle_scenes import HEIGHT, LEVER, WIDTH, bias_variances, board_poses, scene, views_of, with_range_bias
from calgraph.config import Tolerance
from calgraph.config.settings import DiagnosticsSettings, VerdictSettings
from calgraph.geometry import Array, se3, so3
from calgraph.result import Suggestion
from calgraph.rig.bundle.bundle_parameters import SystematicParameter
from calgraph.rig.bundle.bundle_solver import (
    Bundle,
    BundleState,
    MinimizedBundle,
    linearize_bundle,
    minimize_bundle,
)
from calgraph.rig.bundle.covariances import pose_covariance
from calgraph.rig.bundle.observations import relative_poses
from calgraph.rig.bundle.range_observations import RangeObservations
from calgraph.rig.bundle.solution import SolvedBundle
from calgraph.rig.checks.next_best_pose import (
    _draw_candidates,
    _log_volume,
    _multiply_covariance_with,
    describe_pose,
    predict_board_information,
    suggest_board_poses,
)
from calgraph.verdict.grades import axis_names, grade_pose

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
    bundle = Bundle(NAMES, views, np.arange(3), bias_variances(3, 1e-3), lever=LEVER)
    return SolvedBundle(
        bundle, minimize_bundle(bundle, BundleState(T_ROBOT_SENSOR, boards, np.zeros(0))), np.arange(len(boards))
    )


def suggested(boards: Array) -> tuple[Suggestion, ...]:
    return suggest_board_poses(
        adjusted(boards),
        KINDS,
        (WIDTH, HEIGHT),
        np.random.default_rng(0),
        Tolerance(),
        settings=DiagnosticsSettings(),
    )


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
    found = grade_pose(
        "laser", "lidar2d", T_ROBOT_SENSOR[2], spread, tolerance=Tolerance(), settings=VerdictSettings()
    )
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


def test_the_covariance_with_one_more_board_is_the_inverse_of_both_informations() -> None:
    exact = scene(boards=12)
    # Of a board before the camera and the root alone, the information is that on the camera's pose.
    bundle = exact.bundle.with_views([*exact.bundle.views[:2], exact.bundle.views[2].select(np.zeros(0, np.intp))])
    H, _, _ = linearize_bundle(exact.bundle, exact.truth).eliminate_boards()
    V = np.asarray(np.linalg.inv(H), dtype=np.float64)
    at_truth = MinimizedBundle(exact.truth, linearize_bundle(bundle, exact.truth), 0, converged=True)
    solved = SolvedBundle(bundle, at_truth, np.arange(len(exact.truth.T_root_board)))
    predicted = predict_board_information(solved, KINDS, (WIDTH, HEIGHT), exact.truth.T_root_board)
    added = [one for one in predicted if len(one.columns)]
    assert len(added) > 3
    for one in added:
        assert one.columns.tolist() == list(range(6))
        expected = H.copy()
        expected[:6, :6] += one.information
        found = _multiply_covariance_with(one, V, np.arange(len(V)), V)
        np.testing.assert_allclose(found @ expected, np.eye(len(V)), atol=1e-6)
        laser = np.arange(6, 12)
        of_laser = _multiply_covariance_with(one, V, laser, V[:, laser])
        np.testing.assert_allclose(of_laser, found[6:, 6:], atol=1e-9 * np.abs(found).max())


def test_suggestions_beat_boards_of_the_same_kind_as_before() -> None:
    exact = scene(boards=12)
    known = SolvedBundle(exact.bundle, minimize_bundle(exact.bundle, exact.truth), np.arange(12))
    suggestions = suggest_board_poses(
        known, KINDS, (WIDTH, HEIGHT), np.random.default_rng(0), Tolerance(), settings=DiagnosticsSettings()
    )
    assert suggestions
    # Three more boards among twelve like them shrink deviations by a tenth.
    assert suggestions[0].expected / suggestions[0].stddev < 0.9


@pytest.mark.parametrize("bias", [-0.15, 0.15])
def test_an_estimated_error_of_a_sensor_does_not_change_what_a_board_is_expected_to_determine(bias: float) -> None:
    def suggest_with(bias: float) -> tuple[Suggestion, ...]:
        exact = scene(boards=12)
        lidar = exact.bundle.views[0]
        assert isinstance(lidar, RangeObservations)
        biased = with_range_bias(replace(lidar, ranges=lidar.ranges + bias))
        bundle = replace(
            exact.bundle,
            views=(biased, *exact.bundle.views[1:]),
            extra_parameters=(SystematicParameter("lidar", "range bias", "m", 0.2, (0,)),),
        )
        solved = SolvedBundle(
            bundle, minimize_bundle(bundle, replace(exact.truth, extra=np.zeros(1))), np.arange(12)
        )
        assert solved.minimized.state.extra == pytest.approx([bias], abs=0.01)
        return suggest_board_poses(
            solved, KINDS, (WIDTH, HEIGHT), np.random.default_rng(0), Tolerance(), settings=DiagnosticsSettings()
        )

    without, estimated = suggest_with(0.0), suggest_with(bias)
    assert [s.expected for s in estimated] == pytest.approx([s.expected for s in without], rel=0.02)


def test_words_say_where_the_board_is_and_how_it_is_tilted() -> None:
    # 2 m ahead, 30 degrees to the left, half a metre up, its face turned up by 40 degrees.
    bearing, tilt = np.radians(30), np.radians(40)
    z = np.array([-np.cos(tilt) * np.cos(bearing), -np.cos(tilt) * np.sin(bearing), np.sin(tilt)])
    x = np.cross([0, 0, 1], z) / np.cos(tilt)
    T = se3.pose(
        np.column_stack([x, np.cross(z, x), z]), np.array([2 * np.cos(bearing), 2 * np.sin(bearing), 0.5])
    )
    words = "hold the board 2.0 m from laser, 30° to its left, 0.5 m above it, tilted back by 40°"
    assert describe_pose("laser", KINDS, {"laser": T}) == words
    camera = se3.inverse(se3.pose(OPTICAL, np.zeros(3))) @ T
    assert describe_pose("laser", KINDS, {"camera": camera}) == words.replace("laser", "camera")


def draw_candidates_before(sensor: int) -> tuple[Array, Array]:
    """Centres (K, 3) and normals (K, 3) of candidates near a board, in the frame of the sensor before it."""
    exact = scene(boards=1)
    views = tuple(v if s == sensor else v.select(np.zeros(1, bool)) for s, v in enumerate(exact.bundle.views))
    candidates = _draw_candidates(replace(exact.bundle, views=views), exact.truth, np.random.default_rng(0))
    T = relative_poses(exact.truth.T_root_sensor[sensor], candidates)
    return T[:, :3, 3], T[:, :3, 2]


def test_candidates_are_tilted_from_the_line_of_sight_up_to_the_limit() -> None:
    """300 angles, uniform up to 60 degrees: their mean has a standard deviation of 1 degree."""
    centers, normals = draw_candidates_before(1)
    cosine = -np.sum(normals * centers, axis=1) / np.linalg.norm(centers, axis=1)
    tilt = np.degrees(np.arccos(cosine))
    assert tilt.max() < 60
    assert abs(tilt.mean() - 30) < 3


def test_candidates_are_tilted_to_all_sides_equally() -> None:
    """A camera, z ahead: the mean of 300 unit vectors across the line of sight is zero, ±0.04."""
    centers, normals = draw_candidates_before(1)
    across = normals - centers * (np.sum(normals * centers, axis=1) / np.sum(centers**2, axis=1))[:, None]
    across /= np.linalg.norm(across, axis=1, keepdims=True)
    np.testing.assert_allclose(across[:, :2].mean(axis=0), 0, atol=0.1)


def test_candidates_are_near_recorded_boards() -> None:
    """Within 0.3 m along each axis of the root, uniformly."""
    exact = scene(boards=1)
    centers, _ = draw_candidates_before(0)
    off = centers - exact.truth.T_root_board[0, :3, 3]
    np.testing.assert_allclose([off.min(axis=0), off.max(axis=0)], [[-0.3] * 3, [0.3] * 3], atol=0.01)


def test_the_volume_is_the_product_of_the_standard_deviations() -> None:
    """Of 7 along six axes of length two, each in addition to 1: sqrt(197) to the sixth power."""
    np.testing.assert_allclose(_log_volume(4 * 49 * np.eye(6)), 3 * np.log(197))


def test_without_an_estimated_pose_no_board_is_suggested() -> None:
    exact = scene(boards=4)
    bundle = replace(exact.bundle, body=np.zeros(3, dtype=np.intp))
    solved = SolvedBundle(bundle, minimize_bundle(bundle, exact.truth), np.arange(4))
    assert (
        suggest_board_poses(
            solved, KINDS, (WIDTH, HEIGHT), np.random.default_rng(0), Tolerance(), settings=DiagnosticsSettings()
        )
        == ()
    )


def test_the_sensor_and_axis_of_a_suggestion_are_those_of_the_largest_standard_deviation() -> None:
    """Relative to the tolerance."""
    exact = scene(("lidar", "camera"), boards=2)
    solved = SolvedBundle(exact.bundle, minimize_bundle(exact.bundle, exact.truth), np.arange(2))
    covariance = pose_covariance(exact.bundle, solved.minimized.state, solved.minimized.equations)[6:, 6:]
    to_camera = np.kron(np.eye(2), exact.truth.T_root_sensor[1, :3, :3].T)
    deviations = np.sqrt(np.diag(to_camera @ covariance @ to_camera.T))
    worst = int(np.argmax(deviations / Tolerance().limits))
    first = suggest_board_poses(
        solved, KINDS, (WIDTH, HEIGHT), np.random.default_rng(0), Tolerance(), settings=DiagnosticsSettings()
    )[0]
    assert (first.sensor, first.axis) == ("camera", axis_names("camera")[worst])
    assert first.stddev == pytest.approx(deviations[worst])
