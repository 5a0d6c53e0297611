"""Predicted views of boards: where a sensor is predicted to detect one, and how much it measures there."""

import numpy as np
import pytest

from bundle_scenes import CORNERS, HEIGHT, WIDTH, views_of
from calgraph.config.settings import RigDiagnosticsSettings
from calgraph.geometry import Array, se3, so3
from calgraph.rig.bundle.corner_observations import CornerObservations
from calgraph.rig.bundle.observations import BoardViews
from calgraph.rig.bundle.range_observations import RangeObservations
from calgraph.rig.checks.next_best_pose import predict_observations

SETTINGS = RigDiagnosticsSettings()
KINDS = {"lidar": "lidar3d", "camera": "camera", "laser": "lidar2d"}
AHEAD = {"lidar": np.array([1.0, 0, 0]), "camera": np.array([0, 0, 1.0]), "laser": np.array([1.0, 0, 0])}
FACING = {
    "lidar": np.array([[0.0, 0, -1], [-1, 0, 0], [0, 1, 0]]),
    "camera": np.diag([1.0, -1, -1]),
    "laser": np.array([[0.0, 0, -1], [-1, 0, 0], [0, 1, 0]]),
}
UP = {"lidar": np.array([0, 0, 1.0]), "camera": np.array([0, -1.0, 0]), "laser": np.array([0, 0, 1.0])}


def board(name: str, distance: float = 2.5, bearing: float = 0.0, tilt: float = 0.0) -> Array:
    """``T_sensor_board`` (4, 4) of an upright board: degrees to the left of the axis, and turned about up."""
    turn = so3.exp(np.radians(bearing) * UP[name])
    R = turn @ so3.exp(np.radians(tilt) * UP[name]) @ FACING[name]
    return se3.pose(R, distance * turn @ AHEAD[name])


def predict(name: str, detected: list[Array], candidates: list[Array]) -> BoardViews:
    recorded = views_of(name, np.array(detected))
    poses = np.array(candidates)
    return predict_observations(recorded, KINDS[name], np.array(detected), poses, (WIDTH, HEIGHT))


def information(views: BoardViews) -> float:
    """Sum of the inverse variances of all ranges, m⁻²."""
    assert isinstance(views, RangeObservations)
    return float(np.sum(views.sigma**-2))


def recorded_information(name: str, T_sensor_board: Array) -> float:
    views = views_of(name, T_sensor_board[None])
    return information(views.update_noise(T_sensor_board[None], views.noise_scale))


@pytest.mark.parametrize("name", KINDS)
@pytest.mark.parametrize(
    ("candidate", "predicted"),
    [
        ({"bearing": 11.0}, True), ({"bearing": 13.0}, False),
        ({"bearing": -11.0}, True), ({"bearing": -13.0}, False),
        ({"distance": 2.5 * 1.29}, True), ({"distance": 2.5 * 1.31}, False),
        ({"distance": 2.5 / 1.29}, True), ({"distance": 2.5 / 1.31}, False),
        ({"tilt": 64.0}, True), ({"tilt": 66.0}, False), ({"tilt": -66.0}, False), ({"tilt": 180.0}, False),
    ],
)  # fmt: skip
def test_boards_near_a_detected_one_are_predicted(name: str, candidate: dict[str, float], predicted: bool) -> None:
    """Within 12 degrees, a factor of 1.3 of the distance, and 65 degrees between normal and line of sight."""
    views = predict(name, [board(name)], [board(name, 9.0), board(name, **candidate)])
    assert views.board.tolist() == ([1] if predicted else [])


def test_bearing_and_distance_are_those_of_one_detected_board() -> None:
    """A board to the left and near, one to the right and far: none to the left and far."""
    detected = [board("lidar", 2.0, 20.0), board("lidar", 4.0, -20.0)]
    candidates = [board("lidar", 4.0, 20.0), board("lidar", 4.0, -20.0), board("lidar", 2.0, 20.0)]
    assert predict("lidar", detected, candidates).board.tolist() == [1, 2]


@pytest.mark.parametrize("name", KINDS)
def test_predicted_measurements_are_exact(name: str) -> None:
    candidates = np.array([board(name, 2.6, 5.0, 20.0), board(name, 2.3, -4.0, -30.0)])
    views = predict(name, [board(name)], list(candidates))
    assert views.board.tolist() == [0, 1]
    found = views.linearize(candidates[views.board], np.zeros(0))
    np.testing.assert_allclose(found.residual, 0, atol=1e-9)


@pytest.mark.parametrize("name", ["lidar", "laser"])
@pytest.mark.parametrize("tilt", [0.0, 40.0])
def test_a_board_where_one_was_detected_is_measured_by_as_many_beams(name: str, tilt: float) -> None:
    """The grid of predicted beams represents the recorded ones: the same sum of inverse variances."""
    recorded = board(name, tilt=tilt)
    views = predict(name, [recorded], [recorded])
    assert information(views) == pytest.approx(recorded_information(name, recorded), rel=0.05)


@pytest.mark.parametrize(
    ("name", "candidate", "factor"),
    [
        ("lidar", {"distance": 2.5 * 1.2}, 1.2**-2), ("lidar", {"tilt": 60.0}, 0.5),
        ("lidar", {"bearing": 10.0}, 1.0),
        ("laser", {"distance": 2.5 * 1.2}, np.arctan(0.2) / np.arctan(0.24)), ("laser", {"bearing": 10.0}, 1.0),
    ],
)  # fmt: skip
def test_beams_are_as_dense_as_recorded(name: str, candidate: dict[str, float], factor: float) -> None:
    """Of a 3-D scanner in solid angle, of a 2-D scanner in angle: on a board 1.2 m wide at 2.5 and at 3 m."""
    recorded = board(name)
    same, other = (information(predict(name, [recorded], [T])) for T in (recorded, board(name, **candidate)))
    assert other / same == pytest.approx(factor, rel=0.01)


def test_predicted_beams_of_a_scanner_cover_the_board() -> None:
    """Of a 3-D scanner evenly over the whole board, of a 2-D scanner along its section at half height."""
    for name, half_height in (("lidar", HEIGHT / 2), ("laser", 0.0)):
        T = board(name, 2.5, 5.0, 30.0)
        views = predict(name, [board(name)], [T])
        assert isinstance(views, RangeObservations)
        x, y, _ = se3.apply(se3.inverse(T), views.directions * views.ranges[:, None]).T
        np.testing.assert_allclose([x.min(), x.max()], np.array([-1, 1]) * WIDTH / 2 * 6 / 7, atol=1e-9)
        np.testing.assert_allclose([y.min(), y.max()], np.array([-1, 1]) * half_height * 6 / 7, atol=1e-9)


@pytest.mark.parametrize(("share", "predicted"), [(0.36, True), (0.31, False)])
def test_a_scan_line_shorter_than_a_third_of_the_board_is_not_predicted(share: float, predicted: bool) -> None:
    """Of a board turned by 45 degrees in its plane, the scanner's plane cuts off a corner: of its shorter side."""
    c = np.sqrt(0.5)
    T = board("laser")
    T[:3, :3] = T[:3, :3] @ np.array([[c, -c, 0], [c, c, 0], [0, 0, 1]])
    highest = (WIDTH + HEIGHT) / 2 * c  # of the board's corners above its centre
    length = share * HEIGHT
    T[2, 3] = -(highest - length / 2)  # a corner of 90 degrees is twice as wide as high
    assert len(predict("laser", [T], [T]).board) == predicted


def test_corners_are_predicted_for_boards_within_the_image_as_a_whole() -> None:
    """Corners reach 10 degrees to either side of the board's centre at 2.5 m; the image, 38.6 degrees."""
    candidates = [board("camera", 2.5, bearing) for bearing in (0.0, 26.0, 30.0)]
    views = predict("camera", [board("camera", 2.5, bearing) for bearing in (0.0, 28.0)], candidates)
    assert isinstance(views, CornerObservations)
    assert views.board.tolist() == [0, 1]
    assert len(views.pixels) == 2 * len(CORNERS)


def test_the_view_with_the_most_corners_is_predicted() -> None:
    detected = np.array([board("camera", 2.5), board("camera", 2.4)])
    both = views_of("camera", detected)
    assert isinstance(both, CornerObservations)
    fewer = CornerObservations(
        both.board,
        np.array([0, 4]),
        both.printed.select(np.arange(8, 24)),
        both.pixels[8:],
        both.camera,
        both.noise,
        parameters=both.parameters,
    )
    found = predict_observations(fewer, "camera", detected, detected, (WIDTH, HEIGHT))
    assert isinstance(found, CornerObservations)
    assert found.start.tolist() == [0, 12]
    np.testing.assert_allclose(found.printed.nominal[:12], CORNERS)


@pytest.mark.parametrize("name", KINDS)
def test_a_sensor_without_views_is_predicted_to_detect_nothing(name: str) -> None:
    views = views_of(name, board(name)[None]).select(np.zeros(1, dtype=np.bool_))
    found = predict_observations(views, KINDS[name], np.zeros((0, 4, 4)), board(name)[None], (WIDTH, HEIGHT))
    assert len(found.board) == 0


@pytest.mark.parametrize("height", [0.12, -0.12])
def test_a_scan_line_is_where_the_scan_plane_cuts_the_board(height: float) -> None:
    """The board is 0.12 m above or below the scan plane, and rolled by 30° about its normal."""
    T = board("laser")
    T[2, 3] = height
    T[:3, :3] = T[:3, :3] @ so3.exp(np.array([0, 0, np.radians(30)]))
    views = predict("laser", [board("laser")], [T])
    assert isinstance(views, RangeObservations)
    points = views.directions * views.ranges[:, None]
    np.testing.assert_allclose(points[:, 2], 0, atol=1e-12)
    on_board = se3.apply(se3.inverse(T), points)
    np.testing.assert_allclose(on_board[:, 2], 0, atol=1e-12)
    assert np.all(np.abs(on_board[:, :2]) <= np.array([WIDTH, HEIGHT]) / 2)
