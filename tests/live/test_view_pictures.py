"""Pictures of views on the operator's page."""

import cv2
import numpy as np
import pytest

from calgraph.boards.detections import Detection, PlanePatch, Segment
from calgraph.errors import InputError, Rejected
from calgraph.live import view_pictures
from calgraph.live.message_analysis import SensorActivity
from calgraph.live.view_pictures import SensorView, find_reduction, make_view
from calgraph.sensors import CameraModel, Image, LaserScan, PointCloud


def decode(picture: bytes) -> np.ndarray[tuple[int, ...], np.dtype[np.uint8]]:
    return np.asarray(cv2.imdecode(np.frombuffer(picture, np.uint8), cv2.IMREAD_COLOR), dtype=np.uint8)


def test_large_images_become_small_pictures(rng: np.random.Generator) -> None:
    coarse = rng.integers(0, 255, (60, 80)).astype(np.uint8)
    pixels = np.asarray(cv2.resize(coarse, (2561, 1921), interpolation=cv2.INTER_LINEAR), dtype=np.uint8)
    camera = CameraModel(
        "pinhole", 2561, 1921, np.array([[900.0, 0, 1280], [0, 900, 960], [0, 0, 1]]), np.zeros(0)
    )
    factor = find_reduction(camera)
    assert factor == 3
    view = make_view(lambda: Image(0.0, "", pixels), None, None, (), factor)
    assert decode(view.picture).shape == (360, 480, 3)
    assert len(view.picture) < 30_000
    assert view.sees_board is None


def test_scanners_are_drawn_from_above_with_x_up() -> None:
    angles = np.radians([0.0, 90.0])
    scan = LaserScan(0.0, "", angles, np.array([4.0, 2.0]))
    cloud = PointCloud(0.0, "", scan.points)
    for message in (scan, cloud):
        picture = decode(make_view(lambda one=message: one, None, None, (), 1).picture)  # type: ignore[misc]
        bright = picture.max(axis=2) > 90
        assert bright[240 - 192, 240]
        assert bright[240, 240 - 96]
        assert bright.sum() < 100


# Beams at 30° to the left and right end on a board 2 m ahead, seen from above: row 240 - 2 x 48.
BEAMS = np.array([[np.cos(a), np.sin(a), 0.0] for a in np.radians([-30.0, 30.0])])
ENDS = 2.0 / BEAMS[:, :1] * BEAMS
RANGES = np.linalg.norm(ENDS, axis=1)
PATCH = PlanePatch(np.array([-1.0, 0, 0, 2]), np.eye(3), RANGES, BEAMS, ENDS.mean(axis=0))
SEGMENT = Segment(ENDS, np.eye(6), RANGES, BEAMS)


@pytest.mark.parametrize(
    ("found", "middle", "ends"), [(PATCH, False, True), (SEGMENT, True, True), (None, False, False)]
)
def test_the_board_of_a_scanner_is_drawn_in_green(
    found: Detection | None, middle: bool, ends: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A plane as its points, a segment as a line."""
    detect = {"found": () if found is None else (found,)}
    monkeypatch.setattr(view_pictures, "make_detector", lambda _: lambda _: detect["found"])
    cloud = PointCloud(0.0, "", np.array([[4.0, 0.0, 0.0]]))
    view = make_view(lambda: cloud, b"detector", None, (), 1)  # type: ignore[arg-type]  # for none
    blue, green, red = np.moveaxis(decode(view.picture).astype(int), 2, 0)
    is_green = (green > 80) & (green > red + 20) & (green > blue + 20)  # of three pixels, JPEG keeps less colour
    across = round(48 * ENDS[1, 1])
    assert bool(is_green[143:146, 239:242].any()) == middle
    for column in (240 - across, 240 + across):
        assert bool(is_green[142:147, column - 2 : column + 3].any()) == ends


def test_an_unusable_message_has_no_picture() -> None:
    with pytest.raises(InputError, match=r"negative|-1"):
        make_view(lambda: LaserScan(0.0, "", np.zeros(1), np.array([-1.0])), None, None, (), 1)
    activity = SensorActivity()
    activity.set_view(Rejected("a range is negative"))
    assert (activity.pictures, activity.explain_view()) == (0, "")


def test_an_image_is_blurred_if_it_is_less_sharp_than_those_before() -> None:
    activity = SensorActivity()
    for sharpness in (100.0, 110.0, 90.0, 105.0):
        activity.set_view(SensorView(b"jpeg", False, "no tag of family tag36h11 found", sharpness))
        assert activity.explain_view() == "not in view"
    activity.set_view(SensorView(b"jpeg", False, "no tag of family tag36h11 found", 30.0))
    assert activity.explain_view() == "blurred"
    activity.set_view(SensorView(b"jpeg", True, "", 30.0))
    assert activity.explain_view() == ""
    assert activity.pictures == 6
