"""Detections from arrays that were segmented outside calgraph."""

import numpy as np
import pytest

from calgraph.boards.detections import BoardCorners, PlanePatch, Segment
from calgraph.config import PixelNoise, RangeNoise
from calgraph.errors import InputError, Rejected
from calgraph.geometry import Array, plane, se3, so3
from calgraph.rig.detection.from_measurements import (
    board_corners_from_pixels,
    plane_patch_from_points,
    segment_from_points,
)
from calgraph.sensors import CameraModel

CAMERA = CameraModel("pinhole", 1280, 960, np.array([[800.0, 0, 640], [0, 800, 480], [0, 0, 1]]), np.zeros(0))
CORNERS = np.stack(np.meshgrid(np.linspace(-0.4, 0.4, 7), np.linspace(-0.3, 0.3, 5)), axis=-1).reshape(-1, 2)
# z out of the printed face, towards the camera: turned by half a turn about x, and tilted.
T_CAMERA_BOARD = se3.pose(so3.exp(np.array([0.3, -0.4, 0.1])) @ np.diag([1.0, -1, -1]), np.array([0.1, -0.2, 2.0]))
BOARD = np.array([-np.cos(0.3), -np.sin(0.3), 0.0, 2.0])
"""A plane 2 m ahead of a scanner, turned by 0.3 rad."""


def on_board(rng: np.random.Generator, directions: Array, sigma: float) -> Array:
    """The ends of beams on BOARD, with noise along them."""
    ranges = -BOARD[3] / (directions @ BOARD[:3]) + rng.normal(0, sigma, len(directions))
    return np.asarray(ranges[:, None] * directions)


def fan(first: float, last: float, count: int) -> Array:
    angles = np.linspace(first, last, count)
    return np.column_stack([np.cos(angles), np.sin(angles), 0 * angles])


def corners(rng: np.random.Generator, sigma: float = 0.2) -> Array:
    true = CAMERA.project(se3.apply(T_CAMERA_BOARD, np.column_stack([CORNERS, 0 * CORNERS[:, 0]])))
    return np.asarray(true + rng.normal(0, sigma, true.shape))


def test_corners_give_the_pose_within_their_covariance() -> None:
    distances = []
    for seed in range(60):
        found = board_corners_from_pixels(
            CORNERS, corners(np.random.default_rng(seed)), CAMERA, PixelNoise(pixel=0.2)
        )
        assert isinstance(found, BoardCorners)
        error = se3.difference(found.T_camera_board, T_CAMERA_BOARD)
        distances.append(error @ np.linalg.solve(found.covariance, error))
    # Mean of 60 values of χ² with six degrees of freedom: 6 ± 0.45; four standard deviations.
    assert 4.2 < np.mean(distances) < 7.8


def test_an_outlier_among_corners_is_left_out(rng: np.random.Generator) -> None:
    pixels = corners(rng)
    pixels[3] += 25
    found = board_corners_from_pixels(CORNERS, pixels, CAMERA)
    assert isinstance(found, BoardCorners)
    assert len(found.pixels) == len(CORNERS) - 1


def test_three_corners_are_rejected_with_a_reason(rng: np.random.Generator) -> None:
    found = board_corners_from_pixels(CORNERS[:3], corners(rng)[:3], CAMERA)
    assert isinstance(found, Rejected)
    assert "too few" in found.reason


def test_points_give_the_plane_within_its_covariance() -> None:
    directions = np.concatenate([se3.apply(se3.pose(so3.exp(np.array([0, a, 0])), np.zeros(3)), fan(-0.1, 0.3, 20))
                                 for a in np.linspace(-0.2, 0.2, 9)])  # fmt: skip
    distances = []
    for seed in range(60):
        points = on_board(np.random.default_rng(seed), directions, 0.02)
        found = plane_patch_from_points(points, RangeNoise(range=0.02, angle=1e-5))
        assert isinstance(found, PlanePatch)
        step = np.append(plane.tangent_basis(found.plane[:3]).T @ BOARD[:3], BOARD[3] - found.plane[3])
        distances.append(step @ np.linalg.solve(found.covariance, step))
        assert abs(plane.distance(found.plane, found.center[None])[0]) < 1e-12
    # χ² with three degrees of freedom: 3 ± 0.32. Rejection of 3 σ takes a few true points.
    assert 1.8 < np.mean(distances) < 4.4


def test_beams_give_the_cut_of_the_board(rng: np.random.Generator) -> None:
    found = segment_from_points(on_board(rng, fan(-0.15, 0.25, 80), 0.005)[:, :2], RangeNoise(range=0.005))
    assert isinstance(found, Segment)
    ends = on_board(rng, fan(-0.15, 0.25, 2), 0.0)
    assert np.abs(found.endpoints - ends).max() < 0.005


def test_board_behind_the_scanner_is_not_split_where_angles_wrap(rng: np.random.Generator) -> None:
    half_turn = np.diag([-1.0, -1, 1])
    found = segment_from_points(on_board(rng, fan(-0.2, 0.2, 60), 0.003) @ half_turn)
    assert isinstance(found, Segment)
    ends = on_board(rng, fan(-0.2, 0.2, 2), 0.0) @ half_turn
    assert np.abs(found.endpoints - ends).max() < 0.01


def test_several_scans_of_a_resting_board_are_one_segment(rng: np.random.Generator) -> None:
    scans = [on_board(rng, fan(-0.2, 0.2, 41), 0.01) for _ in range(6)]
    one, six = segment_from_points(scans[0]), segment_from_points(np.concatenate(scans))
    assert isinstance(one, Segment)
    assert isinstance(six, Segment)
    # Along the line, the spacing of the beams decides; across it, their number does.
    along = six.endpoints[1] - six.endpoints[0]
    across = np.cross([0, 0, 1], along / np.linalg.norm(along))
    ratio = across @ six.covariance[:3, :3] @ across / (across @ one.covariance[:3, :3] @ across)
    assert 1 / 8 < ratio < 1 / 4


@pytest.mark.parametrize("count", [1, 2])
def test_too_few_beams_are_rejected(count: int, rng: np.random.Generator) -> None:
    found = segment_from_points(on_board(rng, fan(-0.1, 0.1, count), 0.0))
    assert found == Rejected(f"a line needs three beams, got {count}")


def test_three_points_make_no_plane() -> None:
    assert plane_patch_from_points(np.eye(3)) == Rejected("a plane needs four points, got 3")


def test_points_on_a_line_make_no_plane(rng: np.random.Generator) -> None:
    found = plane_patch_from_points(on_board(rng, fan(-0.1, 0.1, 30), 0.0))
    assert found == Rejected("the 30 points lie on no plane, or on one along the beams")


@pytest.mark.parametrize(
    ("points", "complaint"),
    [
        (np.zeros((4, 4)), r"points: must have the shape \(N, 3\), got \(4, 4\)"),
        (np.full((5, 3), np.nan), "points: must be finite"),
        (np.zeros((5, 3)), "points: lie in the sensor's origin"),
    ],
)
def test_arrays_that_are_no_points_are_named(points: Array, complaint: str) -> None:
    with pytest.raises(InputError, match=complaint):
        plane_patch_from_points(points)


def test_beams_off_the_scan_plane_are_an_error() -> None:
    with pytest.raises(InputError, match="scan plane"):
        segment_from_points(np.ones((5, 3)))


def test_pixels_must_be_as_many_as_corners(rng: np.random.Generator) -> None:
    with pytest.raises(InputError, match="pixels: must be as many as corners_board, 35, got 34"):
        board_corners_from_pixels(CORNERS, corners(rng)[:-1], CAMERA)
