"""Poses from corners: accuracy as stated, with outliers among the corners."""

import re

import numpy as np
import pytest
from numpy.typing import NDArray

from calgraph.boards.board_pose import BoardPose, fit_pose, plane_covariance
from calgraph.boards.printed_boards import compute_landmarks
from calgraph.config import Board, Tag
from calgraph.errors import Rejected
from calgraph.geometry import Array, plane, se3, so3
from calgraph.sensors import CameraModel

SIGMA = 0.3
K = np.array([[700.0, 0, 640], [0, 700, 480], [0, 0, 1]])
PINHOLE = CameraModel("pinhole", 1280, 960, K, np.array([-0.3, 0.1, 0.001, -0.002]))
FISHEYE = CameraModel(
    "fisheye", 1280, 960, K * [[0.57, 1, 1], [1, 0.57, 1], [1, 1, 1]], np.array([0.05, 0.01, 0, 0])
)
MARKS = compute_landmarks(
    Board(
        size=(1.0, 0.8),
        tags=(
            Tag(id=3, size=0.3, center=(-0.28, 0.16)),
            Tag(id=5, size=0.3, center=(0.28, 0.16)),
            Tag(id=7, size=0.25, center=(0, -0.2)),
        ),
    )
)
UPSIDE = np.diag([1.0, -1, -1])
"""A board held upright in front of a camera faces it: its y is the camera's -y, its z the camera's -z."""


def a_pose(
    turn: tuple[float, float, float] = (0.3, 0.2, 0.1), t: tuple[float, float, float] = (0.2, 0.1, 3)
) -> Array:
    return se3.pose(so3.exp(np.array(turn)) @ UPSIDE, np.array(t))


def project(T: Array, camera: CameraModel, rng: np.random.Generator | None = None, sigma: float = SIGMA) -> Array:
    pixels = camera.project(se3.apply(T, MARKS.corners.reshape(-1, 3))).reshape(-1, 4, 2)
    return pixels if rng is None else pixels + rng.normal(size=pixels.shape) * sigma


def fit(pixels: Array, camera: CameraModel = PINHOLE, ids: NDArray[np.intp] = MARKS.ids) -> BoardPose:
    pose = fit_pose(ids, MARKS.corners_of(ids), pixels, camera, SIGMA)
    assert isinstance(pose, BoardPose), pose.reason
    return pose


def pose_error(pose: BoardPose, T: Array) -> tuple[float, float]:
    """Metres and radians."""
    error = se3.difference(pose.T_camera_board, T)
    return float(np.linalg.norm(error[:3])), float(np.linalg.norm(error[3:]))


@pytest.mark.parametrize("camera", [PINHOLE, FISHEYE], ids=["pinhole", "fisheye"])
def test_exact_corners_give_the_exact_pose(camera: CameraModel) -> None:
    T = a_pose()
    assert max(pose_error(fit(project(T, camera), camera), T)) < 1e-7


def test_a_board_at_the_edge_of_a_fisheye_image_is_detected() -> None:
    camera = CameraModel("fisheye", 1280, 960, K * [[0.5, 1, 1], [1, 0.5, 1], [1, 1, 1]], np.zeros(4))
    T = se3.pose(so3.exp(np.array([0, -1.6, 0])) @ UPSIDE, np.array([-2.0, 0, -0.05]))
    assert max(pose_error(fit(project(T, camera), camera), T)) < 1e-7


@pytest.mark.parametrize("camera", [PINHOLE, FISHEYE], ids=["pinhole", "fisheye"])
def test_errors_of_pose_and_plane_match_their_covariances(camera: CameraModel, rng: np.random.Generator) -> None:
    pose_nees, plane_nees, n = 0.0, 0.0, 150
    for _ in range(n):
        z = rng.uniform(1.2, 3.5)
        offset = rng.uniform(-0.25, 0.25, 2) * z
        T = a_pose(tuple(rng.normal(size=3) * 0.3), (offset[0], offset[1], z))
        pose = fit(project(T, camera, rng), camera)
        error = se3.difference(pose.T_camera_board, T)
        pose_nees += float(error @ np.linalg.solve(pose.covariance, error)) / n
        found, true = plane.from_pose(pose.T_camera_board), plane.from_pose(T)
        away = np.append(plane.tangent_basis(found[:3]).T @ (true - found)[:3], (true - found)[3])
        covariance = plane_covariance(pose.T_camera_board, pose.covariance)
        plane_nees += float(away @ np.linalg.solve(covariance, away)) / n
    # χ² of 150 · 6 and 150 · 3 degrees of freedom; max(sigma, rms) makes the covariance a little large.
    assert 5.0 < pose_nees < 6.9
    assert 2.3 < plane_nees < 3.6


def test_covariance_grows_with_the_residuals(rng: np.random.Generator) -> None:
    T = a_pose()
    calm, shaky = fit(project(T, PINHOLE, rng)), fit(project(T, PINHOLE, rng, sigma=1.2))
    growth = np.sqrt(np.diag(shaky.covariance) / np.diag(calm.covariance))
    assert (growth > 2).all()


def test_a_single_wrong_corner_is_rejected(rng: np.random.Generator) -> None:
    pixels = project(a_pose(), PINHOLE, rng)
    pixels[1, 2] += [9, -7]
    assert np.argwhere(~fit(pixels).inliers).tolist() == [[1, 2]]


def test_a_false_tag_is_rejected(rng: np.random.Generator) -> None:
    pixels = project(a_pose(), PINHOLE, rng)
    pixels[2] += [150, 40]
    assert fit(pixels).inliers.all(axis=1).tolist() == [True, True, False]


def test_a_tag_rotated_by_a_quarter_turn_is_rejected(rng: np.random.Generator) -> None:
    pixels = project(a_pose(), PINHOLE, rng)
    pixels[0] = np.roll(pixels[0], 1, axis=0)
    assert fit(pixels).inliers.all(axis=1).tolist() == [False, True, True]


def test_of_two_tags_with_one_id_the_one_on_the_board_is_used(rng: np.random.Generator) -> None:
    pixels = project(a_pose(), PINHOLE, rng)
    copy = pixels[:1] + np.array([300.0, 200])
    used = fit(np.concatenate([copy, pixels]), ids=np.append(3, MARKS.ids)).inliers
    assert used.all(axis=1).tolist() == [False, True, True, True]


def test_two_tags_that_contradict_each_other_are_rejected(rng: np.random.Generator) -> None:
    pixels = project(a_pose(), PINHOLE, rng)[:2]
    pixels[1] += [150, 40]
    pose = fit_pose(MARKS.ids[:2], MARKS.corners[:2], pixels, PINHOLE, SIGMA)
    assert isinstance(pose, Rejected)
    assert pose.reason.startswith("tags 3, 5 do not lie on one board")


@pytest.mark.parametrize("size", [0.8, 0.95, 1.05, 1.2])
@pytest.mark.parametrize("camera", [PINHOLE, FISHEYE], ids=["pinhole", "fisheye"])
def test_tags_that_all_have_another_size_are_used(size: float, camera: CameraModel) -> None:
    T, centers = a_pose((0.1, 0.2, 0.1), (0.2, 0.1, 2)), MARKS.corners.mean(axis=1, keepdims=True)
    printed = centers + size * (MARKS.corners - centers)
    pixels = camera.project(se3.apply(T, printed.reshape(-1, 3))).reshape(-1, 4, 2)
    pose = fit(pixels, camera)
    assert pose.inliers.all()
    assert pose.rms < 1e-6
    assert max(pose_error(pose, T)) < 1e-7


def test_one_tag_that_has_another_size_is_rejected() -> None:
    T, center = a_pose(), MARKS.corners[0].mean(axis=0)
    corners = MARKS.corners.copy()
    corners[0] = center + 1.2 * (corners[0] - center)
    pixels = PINHOLE.project(se3.apply(T, corners.reshape(-1, 3))).reshape(-1, 4, 2)
    assert fit(pixels).inliers.all(axis=1).tolist() == [False, True, True]


def test_a_board_of_another_shape_is_rejected(rng: np.random.Generator) -> None:
    pixels = project(a_pose((0, 0, 0), (0, 0, 1.2)), PINHOLE, rng)
    pose = fit_pose(np.arange(12), (0.6 * MARKS.corners).reshape(-1, 1, 3) * [1, 0.8, 1], pixels.reshape(-1, 1, 2),
                    PINHOLE, SIGMA)  # fmt: skip
    assert isinstance(pose, Rejected)
    assert "wrong sizes, or wrong intrinsics" in pose.reason


def test_corners_on_one_line_determine_no_pose() -> None:
    line = np.stack([np.linspace(-0.3, 0.3, 6), np.zeros(6), np.zeros(6)], axis=-1)[:, None]
    pixels = PINHOLE.project(se3.apply(a_pose(), line[:, 0]))[:, None]
    pose = fit_pose(np.arange(6), line, pixels, PINHOLE, SIGMA)
    assert isinstance(pose, Rejected)
    assert "on one line" in pose.reason


def test_a_far_tilted_tag_whose_mirrored_tilt_fits_as_well_is_rejected(rng: np.random.Generator) -> None:
    pixels = project(a_pose((0.5, 0.3, 0), (0, 0, 9)), PINHOLE, rng)[:1]
    pose = fit_pose(MARKS.ids[:1], MARKS.corners[:1], pixels, PINHOLE, SIGMA)
    assert isinstance(pose, Rejected)
    # The mirrored normal lies as far on the other side of the viewing direction.
    normal = a_pose((0.5, 0.3, 0), (0, 0, 9))[:3, 2]
    tilt = 2 * np.degrees(np.arccos(-normal[2]))
    stated = re.search(r"two poses (\d+)° apart fit its corners equally well", pose.reason)
    assert stated is not None
    assert float(stated[1]) == pytest.approx(tilt, abs=8)


def test_of_two_tilts_the_true_one_is_found(rng: np.random.Generator) -> None:
    turns = rng.normal(size=(40, 3)) * 0.4
    wrong = 0
    for turn in turns:
        T = a_pose(tuple(turn), (0, 0, 3))
        wrong += pose_error(fit(project(T, PINHOLE, rng)), T)[1] > 0.1
    assert wrong == 0
