import tracemalloc
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any, Literal

import numpy as np
import pytest
from rosbags.highlevel import AnyReader

from calgraph.errors import InputError
from calgraph.recording import RecordingWriter, open_recording
from calgraph.sensors import CameraInfo, CameraModel, Image, LaserScan, Message, PointCloud, Trigger

RoundTrip = Callable[..., Any]

SCAN = LaserScan(1.25, "laser", np.linspace(-1, 1, 5), np.array([1, np.nan, 2.5, np.inf, 30]), 1e-3)
CLOUD = PointCloud(
    1.75, "lidar", np.arange(1.0, 13).reshape(4, 3), np.arange(4, dtype=np.int32), np.linspace(-0.1, 0, 4)
)


@pytest.fixture
def round_trip(tmp_path: Path) -> RoundTrip:
    def back(message: Message, **options: Any) -> Message:
        with RecordingWriter(tmp_path / "written") as writer:
            writer.write("/topic", message, **options)
        with open_recording(tmp_path / "written") as recording:
            return next(recording.records()).decode()

    return back


def picture(rng: np.random.Generator, *shape: int) -> Image:
    return Image(1.5, "camera", rng.integers(0, 256, shape, dtype=np.uint8))


@pytest.mark.parametrize("encoding", ["raw", "png"])
@pytest.mark.parametrize("shape", [(6, 8), (6, 8, 3)])
def test_image_comes_back_without_loss(
    round_trip: RoundTrip, rng: np.random.Generator, shape: tuple[int, ...], encoding: Literal["raw", "png"]
) -> None:
    image = picture(rng, *shape)
    np.testing.assert_array_equal(round_trip(image, encoding=encoding).pixels, image.pixels)


def test_jpeg_image_comes_back_nearly(round_trip: RoundTrip) -> None:
    image = Image(1.5, "camera", np.full((16, 16, 3), (20, 120, 220), np.uint8))
    np.testing.assert_allclose(round_trip(image, encoding="jpeg").pixels, image.pixels, atol=3)


def test_scan_comes_back(round_trip: RoundTrip) -> None:
    scan = round_trip(SCAN)
    np.testing.assert_allclose(scan.angles, SCAN.angles, atol=1e-6)
    np.testing.assert_array_equal(scan.valid, SCAN.valid)
    np.testing.assert_allclose(scan.ranges[scan.valid], [1, 2.5, 30])


def test_scan_keeps_stamp_frame_and_time_of_beams(round_trip: RoundTrip) -> None:
    scan = round_trip(SCAN)
    assert (scan.stamp, scan.frame_id) == (1.25, "laser")
    assert scan.time_increment == pytest.approx(1e-3)


def test_uneven_scan_cannot_be_written(round_trip: RoundTrip) -> None:
    with pytest.raises(InputError, match="not evenly spaced"):
        round_trip(LaserScan(1.0, "", np.array([0, 0.1, 0.3]), np.ones(3)))


def test_cloud_comes_back_with_rings_and_times(round_trip: RoundTrip) -> None:
    cloud = round_trip(CLOUD)
    np.testing.assert_array_equal(cloud.points, CLOUD.points)
    np.testing.assert_array_equal(cloud.rings, CLOUD.rings)
    np.testing.assert_allclose(cloud.times, np.linspace(-0.1, 0, 4), atol=1e-8)


def test_bare_cloud_comes_back_bare(round_trip: RoundTrip) -> None:
    cloud = round_trip(PointCloud(1.0, "", np.ones((2, 3))))
    assert cloud.rings is None
    assert cloud.times is None


@pytest.mark.parametrize(
    ("model", "distortion"),
    [
        ("pinhole", []),
        ("pinhole", [0.1, 0.2, 0.3, 0.4, 0.5]),
        ("pinhole", np.arange(8) / 10),
        ("fisheye", [1, 2, 3, 4]),
    ],
)
def test_camera_info_comes_back(
    round_trip: RoundTrip, model: Literal["pinhole", "fisheye"], distortion: list[float]
) -> None:
    K = np.array([[500.5, 0, 320], [0, 510, 240], [0, 0, 1]])
    camera = round_trip(CameraInfo(2.0, "camera", CameraModel(model, 640, 480, K, np.array(distortion)))).camera
    assert (camera.model, camera.width, camera.height) == (model, 640, 480)
    np.testing.assert_array_equal(camera.K, K)
    np.testing.assert_array_equal(camera.distortion, distortion)


def test_trigger_comes_back(round_trip: RoundTrip) -> None:
    assert round_trip(Trigger(3.25)) == Trigger(3.25)


def test_messages_come_back_in_order_of_arrival(tmp_path: Path) -> None:
    with RecordingWriter(tmp_path / "written") as writer:
        writer.write("/b", Trigger(1.0), arrival=9.0)
        writer.write("/a", Trigger(2.0))
    with open_recording(tmp_path / "written") as recording:
        assert [(r.stamp, r.arrival) for r in recording.records()] == [(2.0, 2.0), (1.0, 9.0)]


def test_other_readers_of_rosbag2_understand_the_recording(tmp_path: Path) -> None:
    with RecordingWriter(tmp_path / "written") as writer:
        writer.write("/scan", SCAN)
        writer.write("/points", CLOUD)
    with AnyReader([tmp_path / "written"]) as reader:
        found = [(c.topic, reader.deserialize(raw, c.msgtype)) for c, _, raw in reader.messages()]
    assert [topic for topic, _ in found] == ["/scan", "/points"]


def test_epoch_stamps_are_kept_to_a_microsecond(round_trip: RoundTrip) -> None:
    assert round_trip(Trigger(1773380642.785313)).stamp == pytest.approx(1773380642.785313, abs=5e-7)


def test_one_topic_has_one_type(tmp_path: Path) -> None:
    with RecordingWriter(tmp_path / "written") as writer:
        writer.write("/topic", SCAN)
        with pytest.raises(InputError, match="topic /topic has"):
            writer.write("/topic", CLOUD)


def test_existing_recording_is_not_overwritten(tmp_path: Path) -> None:
    (tmp_path / "written").mkdir()
    with pytest.raises(InputError, match="exists already"):
        RecordingWriter(tmp_path / "written")


def test_interrupted_recording_leaves_nothing(tmp_path: Path) -> None:
    def interrupted() -> None:
        with RecordingWriter(tmp_path / "written") as writer:
            writer.write("/scan", SCAN)
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        interrupted()
    assert list(tmp_path.iterdir()) == []


def test_memory_does_not_grow_with_the_recording(tmp_path: Path) -> None:
    image = Image(0.0, "camera", np.zeros((1000, 1000), np.uint8))
    tracemalloc.start()
    try:
        with RecordingWriter(tmp_path / "long") as writer:
            for i in range(200):
                writer.write("/image", image, arrival=float(i))
        with open_recording(tmp_path / "long") as recording:
            images = (record.decode() for record in recording.records())
            total = sum(image.pixels.size for image in images if isinstance(image, Image))
        _, peak = tracemalloc.get_traced_memory()
    finally:
        tracemalloc.stop()
    assert total == 200e6
    assert peak < 20e6


def test_a_recording_in_several_files_is_read_as_one(tmp_path: Path) -> None:
    stamps = [10.0, 11.0, 12.5, 13.0, 20.0]
    with RecordingWriter(tmp_path / "split", max_file_duration=2.0) as writer:
        for k, stamp in enumerate(stamps):
            writer.write(f"/laser_{k % 2}", replace(SCAN, stamp=stamp))
    with open_recording(tmp_path / "split") as recording:
        read = [(record.topic, record.arrival) for record in recording.records()]
        counts = {topic.name: topic.count for topic in recording.topics}
    assert read == [(f"/laser_{k % 2}", stamp) for k, stamp in enumerate(stamps)]
    assert counts == {"/laser_0": 3, "/laser_1": 2}
    assert len(list((tmp_path / "split").glob("split_*.mcap"))) == 3


def test_rosbags_reads_a_recording_in_several_files(tmp_path: Path) -> None:
    with RecordingWriter(tmp_path / "split", max_file_duration=1.0) as writer:
        for stamp in (10.0, 12.0, 14.0):
            writer.write("/laser", replace(SCAN, stamp=stamp))
    with AnyReader([tmp_path / "split"]) as reader:
        assert (reader.message_count, reader.start_time, reader.end_time) == (3, 10 * 10**9, 14 * 10**9 + 1)
        assert [time for _, time, _ in reader.messages()] == [10 * 10**9, 12 * 10**9, 14 * 10**9]


def test_a_failed_recording_in_several_files_leaves_nothing(tmp_path: Path) -> None:
    def fail() -> None:
        with RecordingWriter(tmp_path / "split", max_file_duration=1.0) as writer:
            for stamp in (10.0, 12.0):
                writer.write("/laser", replace(SCAN, stamp=stamp))
            raise ZeroDivisionError

    with pytest.raises(ZeroDivisionError):
        fail()
    assert list(tmp_path.iterdir()) == []


def test_an_empty_recording_in_several_files_has_no_messages(tmp_path: Path) -> None:
    with RecordingWriter(tmp_path / "empty", max_file_duration=1.0):
        pass
    with open_recording(tmp_path / "empty") as recording:
        assert list(recording.records()) == []
