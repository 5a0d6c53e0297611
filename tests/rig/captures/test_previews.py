"""Previews of messages."""

from collections.abc import Sequence
from functools import partial

import numpy as np
import pytest

from calgraph.config import Board, CameraSpec, Checkerboard, Lidar2dSpec, Lidar3dSpec, Rig
from calgraph.errors import Rejected
from calgraph.rig.captures.hold_messages import PreviewSize, make_preview, plan_previews, search_holds
from calgraph.rig.captures.holds import Hold
from calgraph.rig.captures.sensor_detection import detect_in_hold
from calgraph.sensors import Image, LaserScan, PointCloud, RecordedMessage
from calgraph.sensors.kinds import SensorSpec

LARGE = PreviewSize(640, 8000)
BOARD = Board(size=(1, 1), pattern=Checkerboard(kind="checkerboard", columns=7, rows=5, square=0.1))


def rig_of(cameras: int, lidars: int, lasers: int) -> Rig:
    """A rig with these numbers of sensors."""
    sensors: dict[str, SensorSpec] = {"lidar": Lidar3dSpec(kind="lidar3d", topic="/l")}
    sensors |= {f"c{i}": CameraSpec(kind="camera", topic=f"/c{i}", camera_info="/i") for i in range(cameras)}
    sensors |= {f"l{i}": Lidar3dSpec(kind="lidar3d", topic=f"/l{i}") for i in range(1, lidars)}
    sensors |= {f"s{i}": Lidar2dSpec(kind="lidar2d", topic=f"/s{i}") for i in range(lasers)}
    return Rig(root="lidar", target=BOARD, sensors=sensors)


def holds(count: int) -> list[Hold]:
    return [Hold(i, float(i), i + 0.5) for i in range(count)]


def test_image_preview_keeps_shape_and_content() -> None:
    pixels = np.zeros((960, 1280, 3), np.uint8)
    pixels[:, 640:] = [0, 0, 255]
    preview = make_preview(5, "camera", [Image(1.0, "c", pixels)], LARGE)
    assert (preview.width, preview.height, preview.picture.shape) == (1280, 960, (480, 640, 3))
    assert preview.picture[240, 500].tolist() == pytest.approx([255, 0, 0], abs=6)


@pytest.mark.parametrize("shape", [(48, 64), (480, 640), (1, 3000), (3000, 1, 3)])
def test_images_of_any_shape_have_a_preview(shape: tuple[int, ...]) -> None:
    h, w = make_preview(0, "camera", [Image(0.0, "c", np.full(shape, 128, np.uint8))], LARGE).picture.shape[:2]
    assert (h, w) == (max(round(shape[0] * min(1, 640 / shape[1])), 1), min(shape[1], 640))


def test_scan_preview_keeps_valid_beams() -> None:
    scan = LaserScan(2.5, "laser", np.linspace(0, 1, 5), np.array([1.0, np.nan, 2, np.inf, 3]))
    preview = make_preview(0, "laser", [scan], LARGE)
    np.testing.assert_allclose(np.linalg.norm(preview.points, axis=1), [1, 2, 3], rtol=1e-6)
    assert preview.stamp == 2.5


@pytest.mark.parametrize("rings", [4, 16, 32, 64, 128])
@pytest.mark.parametrize("columns", [1000, 1024, 1800])
def test_subsampling_keeps_every_ring_of_a_lidar(rings: int, columns: int) -> None:
    """In any order of the points, each ring keeps between half and twice its share."""
    ring = np.tile(np.arange(rings), columns)
    points = np.column_stack([np.zeros((rings * columns, 2)), ring])
    for order in (points, points[np.argsort(ring, kind="stable")]):
        kept = make_preview(0, "lidar", [PointCloud(0.0, "l", order)], PreviewSize(640, 2000)).points
        share = np.bincount(kept[:, 2].astype(int), minlength=rings) * rings / len(kept)
        assert len(kept) == 2000
        assert 0.5 < share.min() <= share.max() < 2


def test_few_captures_all_have_large_previews() -> None:
    kept = plan_previews(holds(48), rig_of(1, 1, 3))
    assert list(kept.values()) == [LARGE] * 48


@pytest.mark.parametrize("count", [61, 300, 5000])
@pytest.mark.parametrize("sensors", [(1, 1, 3), (8, 4, 4), (0, 1, 0)])
def test_many_captures_stay_within_the_budget(count: int, sensors: tuple[int, int, int]) -> None:
    cameras, lidars, lasers = sensors
    kept = plan_previews(holds(count), rig_of(*sensors)).values()
    size = sum(
        cameras * 0.2 * d.width * d.width * 0.75 + 12 * (lidars * d.points + lasers * min(d.points, 2000))
        for d in kept
    )
    assert size < 18e6
    assert sum(d == LARGE for d in kept) <= 60


def test_large_previews_are_spread_over_the_recording() -> None:
    large = [i for i, d in plan_previews(holds(300), rig_of(1, 1, 3)).items() if d == LARGE]
    assert (large[0], large[-1]) == (0, 299)
    assert np.ptp(np.diff(large)) <= 1


def test_messages_are_decoded_once_and_previewed_where_requested() -> None:
    decoded = []

    def decode(i: int) -> LaserScan:
        decoded.append(i)
        return LaserScan(float(i), "laser", np.zeros(3), np.full(3, float(i + 1)))

    def reject(_messages: Sequence[LaserScan]) -> Rejected:
        return Rejected("no board")

    records = [RecordedMessage("/scan", float(i), float(i), partial(decode, i)) for i in range(4)]
    both = [Hold(0, 0.0, 1.0, {"laser": np.array([0.0, 1.0])}), Hold(1, 2.0, 3.0, {"laser": np.array([2.0, 3.0])})]
    results = list(
        search_holds(
            detect_in_hold, {"laser": reject}, records, both, {"laser": "/scan"}, preview_sizes={1: LARGE}
        )
    )
    assert decoded == [0, 1, 2, 3]
    assert results[0].snapshot is None
    assert results[1].snapshot is not None
    assert results[1].snapshot.stamp == 3.0


def test_a_rig_of_which_no_sensor_can_detect_has_no_previews() -> None:
    rig = rig_of(1, 1, 0).model_copy(update={"sensors": {}})
    assert plan_previews(holds(3), rig) == {}
