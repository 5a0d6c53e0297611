"""Whether a pose is new, what captures cover, and what is said of sensors that detect nothing."""

from collections.abc import Mapping

import numpy as np
import pytest

from calgraph.boards.detections import BoardCorners, DetectionResult, PlanePatch, Segment
from calgraph.config import Board, CameraSpec, Lidar2dSpec, Lidar3dSpec, Rig, Tag
from calgraph.config.settings import LiveCaptureSettings
from calgraph.errors import Rejected
from calgraph.geometry import Array, se3, so3
from calgraph.live.analysis_jobs import reduce_camera
from calgraph.live.live_captures import LiveCapture, count_coverage, explain_rejection, find_same_pose
from calgraph.rig.captures.holds import Hold
from calgraph.sensors import CameraModel

CAMERA = CameraModel("pinhole", 600, 300, np.array([[300.0, 0, 299.5], [0, 300, 149.5], [0, 0, 1]]), np.zeros(0))
SETTINGS = LiveCaptureSettings()
RIG = Rig(
    root="lidar",
    target=Board(size=(1.0, 0.8), tags=(Tag(id=0, size=0.4, center=(0.0, 0.0)),)),
    sensors={
        "lidar": Lidar3dSpec(topic="/points"),
        "laser": Lidar2dSpec(topic="/scan"),
        "camera": CameraSpec(topic="/image"),
    },
)


def make_corners(position: Array, turn: float = 0.0) -> BoardCorners:
    """The board in front of the camera, turned about its optical axis by degrees."""
    T = se3.pose(so3.exp(np.radians([180.0, 0, 0])) @ so3.exp(np.radians([0, 0, turn])), position)
    corners = np.array([[-0.2, -0.2, 0], [0.2, -0.2, 0], [0.2, 0.2, 0], [-0.2, 0.2, 0]])
    pixels = CAMERA.project(corners @ T[:3, :3].T + T[:3, 3])
    return BoardCorners(corners, pixels, T, np.eye(6), np.array([0, 0, -1.0, position[2]]), np.eye(3), 0.1)


def make_patch(center: Array, tilt: float = 0.0) -> PlanePatch:
    normal = np.array([-np.cos(np.radians(tilt)), -np.sin(np.radians(tilt)), 0])
    return PlanePatch(np.array([*normal, -normal @ center]), np.eye(3), np.ones(1), np.eye(3)[:1], center)


def make_segment(center: Array, tilt: float = 0.0, *, exchanged: bool = False) -> Segment:
    half = 0.5 * np.array([-np.sin(np.radians(tilt)), np.cos(np.radians(tilt)), 0])
    ends = np.array([center - half, center + half])
    return Segment(ends[::-1] if exchanged else ends, np.eye(6), np.ones(1), np.eye(3)[:1])


def make_capture(**detections: DetectionResult) -> LiveCapture:
    absent = dict.fromkeys(RIG.sensors, Rejected("no foreground beams"))
    return LiveCapture(Hold(0, 0.0, 1.0), {**absent, **detections})


def find(now: Mapping[str, DetectionResult], *earlier: LiveCapture) -> int | None:
    return find_same_pose(make_capture(**now).detections, earlier, SETTINGS)


AHEAD = np.array([2.0, 0, 0])
IN_VIEW = np.array([0, 0, 2.0])


@pytest.mark.parametrize(("moved", "tilt", "same"), [(0.05, 5, 0), (0.15, 5, None), (0.05, 12, None)])
def test_a_pose_is_new_if_it_is_elsewhere_or_tilted(moved: float, tilt: float, same: int | None) -> None:
    there = AHEAD + np.array([0, moved, 0])
    assert find({"lidar": (make_patch(there, tilt),)}, make_capture(lidar=(make_patch(AHEAD),))) == same
    segment = make_segment(there, tilt, exchanged=True)
    assert find({"laser": (segment,)}, make_capture(laser=(make_segment(AHEAD),))) == same
    position = IN_VIEW + np.array([moved, 0, 0])
    assert find({"camera": (make_corners(position, tilt),)}, make_capture(camera=(make_corners(IN_VIEW),))) == same


def test_poses_are_compared_with_all_captures_by_the_most_reliable_sensor() -> None:
    far = make_capture(lidar=(make_patch(2 * AHEAD),), camera=(make_corners(2 * IN_VIEW),))
    here = make_capture(lidar=(make_patch(-AHEAD),), camera=(make_corners(IN_VIEW),))
    # The LiDAR took a wall for the board this time.
    now: dict[str, DetectionResult] = {"lidar": (make_patch(AHEAD),), "camera": (make_corners(IN_VIEW),)}
    assert find(now, far, here) == 1


def test_without_a_common_sensor_a_pose_is_new() -> None:
    assert find({"lidar": (make_patch(AHEAD),)}, make_capture(camera=(make_corners(IN_VIEW),))) is None


def test_coverage_of_images_counts_the_regions_with_corners() -> None:
    left = make_corners(np.array([-1.4, 0, 2.0]))
    captures = [make_capture(camera=(left,))] * 2 + [make_capture(lidar=(make_patch(AHEAD),))]
    coverage = np.reshape(count_coverage("camera", RIG, CAMERA, captures), (3, 3))
    np.testing.assert_allclose(coverage, np.array([[0, 0, 0], [2 / 3, 0, 0], [0, 0, 0]]))


def test_coverage_of_scanners_counts_sectors_of_azimuth() -> None:
    to_the_left = make_capture(lidar=(make_patch(np.array([0.1, 2.0, 0])),))
    coverage = count_coverage("lidar", RIG, None, [to_the_left] * 5)
    assert coverage == (0.0,) * 8 + (1.0,) + (0.0,) * 3


@pytest.mark.parametrize(
    ("reason", "short"),
    [
        ("no tag of family tag36h11 found; ids 0 to 2 expected", "not in view"),
        ("board moved between images: its corners by 3.2 px", "the board moved"),
        ("board moved between messages: hold it still", "the board moved"),
        ("too small in the image: two poses 20° apart fit its corners equally well", "too far"),
        ("no tag of family tag36h11 found (the image is too dark: 99 % of it below grey value 3)", "too dark"),
        ("the corners detected contradict each other", "partly hidden"),
    ],
)
def test_rejections_are_explained_in_a_few_words(reason: str, short: str) -> None:
    assert explain_rejection(reason) == short


def test_a_reduced_image_shows_points_where_the_average_of_its_pixels_does() -> None:
    points = np.array([[0.1, -0.2, 2.0], [-0.8, 0.3, 2.0]])
    # The centre of a block of 3 x 3 pixels is its middle pixel.
    expected = (CAMERA.project(points) - 1.0) / 3
    np.testing.assert_allclose(reduce_camera(CAMERA, 3).project(points), expected)
