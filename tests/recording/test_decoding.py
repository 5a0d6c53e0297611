from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from calgraph.errors import RecordingError
from calgraph.recording import RecordingWriter, open_recording
from calgraph.sensors import CameraInfo, CameraModel, LaserScan, Message

Decoded = Callable[[Any], Message]


def as_scan(message: Message) -> LaserScan:
    assert isinstance(message, LaserScan)
    return message


def as_camera(message: Message) -> CameraModel:
    assert isinstance(message, CameraInfo)
    return message.camera


def test_scan_angles_count_up_from_the_first(ros: SimpleNamespace, decoded: Decoded) -> None:
    np.testing.assert_allclose(as_scan(decoded(ros.scan())).angles, [-0.5, -0.25, 0, 0.25, 0.5])


def test_scan_angles_may_run_backwards(ros: SimpleNamespace, decoded: Decoded) -> None:
    scan = as_scan(decoded(ros.scan(angle_min=0.5, angle_increment=-0.25)))
    np.testing.assert_allclose(scan.angles, [0.5, 0.25, 0, -0.25, -0.5])


def test_scan_lasts_from_its_first_to_its_last_beam(ros: SimpleNamespace, decoded: Decoded) -> None:
    assert as_scan(decoded(ros.scan())).duration == pytest.approx(4e-3, rel=1e-6)


def test_ranges_outside_the_limits_are_no_measurements(ros: SimpleNamespace, decoded: Decoded) -> None:
    ranges = np.array([0.49, 0.5, 8.0, 8.01, np.inf], np.float32)
    np.testing.assert_array_equal(
        as_scan(decoded(ros.scan(ranges=ranges))).valid, [False, True, True, False, False]
    )


@pytest.mark.parametrize("unset", [0.0, np.nan])
def test_limits_that_are_not_set_do_not_count(ros: SimpleNamespace, decoded: Decoded, unset: float) -> None:
    ranges = np.array([0, 0.01, 100, np.nan, -1], np.float32)
    scan = as_scan(decoded(ros.scan(ranges=ranges, range_min=unset, range_max=unset)))
    np.testing.assert_array_equal(scan.valid, [False, True, True, False, False])


def test_first_echo_of_each_beam_is_taken(ros: SimpleNamespace, decoded: Decoded) -> None:
    echo = ros.types["sensor_msgs/msg/LaserEcho"]
    beams = [echo(np.array(values, np.float32)) for values in ([1, 2], [], [3])]
    message = ros.types["sensor_msgs/msg/MultiEchoLaserScan"](
        header=ros.header(), angle_min=0.0, angle_max=0.2, angle_increment=0.1, time_increment=0.0, scan_time=0.1,
        range_min=0.1, range_max=10.0, ranges=beams, intensities=[],
    )  # fmt: skip
    np.testing.assert_array_equal(as_scan(decoded(message)).ranges, [1, np.nan, 3])


def test_scan_without_finite_angles_is_unusable(ros: SimpleNamespace, decoded: Decoded) -> None:
    with pytest.raises(RecordingError, match="angle_increment"):
        decoded(ros.scan(angle_increment=np.nan))


def test_unusable_message_names_topic_and_stamp(ros: SimpleNamespace, decoded: Decoded) -> None:
    with pytest.raises(RecordingError, match=r"topic /topic, stamp 12\.500000"):
        decoded(ros.scan(angle_increment=np.nan))


def test_stamps_are_read_past_an_unusable_message(ros: SimpleNamespace, make_bag: Callable[..., Path]) -> None:
    bad, good = ros.scan(angle_increment=np.nan), ros.scan(header=ros.header(14.0))
    with open_recording(make_bag(("/scan", bad, 1.0), ("/scan", good, 2.0))) as recording:
        assert [record.stamp for record in recording.records()] == [12.5, 14.0]


def test_plumb_bob_is_a_pinhole_with_five_coefficients(ros: SimpleNamespace, decoded: Decoded) -> None:
    camera = as_camera(decoded(ros.camera_info()))
    assert (camera.model, camera.width, camera.height) == ("pinhole", 640, 480)
    np.testing.assert_allclose(camera.distortion, [0.1, -0.2, 0.001, 0.002, 0.03])


def test_rational_polynomial_keeps_eight_coefficients(ros: SimpleNamespace, decoded: Decoded) -> None:
    info = ros.camera_info(distortion_model="rational_polynomial", d=np.arange(1, 9) / 100)
    np.testing.assert_allclose(as_camera(decoded(info)).distortion, np.arange(1, 9) / 100)


def test_trailing_zero_coefficients_of_richer_models_are_dropped(ros: SimpleNamespace, decoded: Decoded) -> None:
    info = ros.camera_info(distortion_model="rational_polynomial", d=np.append(np.arange(1.0, 9), np.zeros(6)))
    assert as_camera(decoded(info)).distortion.size == 8


def test_equidistant_is_fisheye(ros: SimpleNamespace, decoded: Decoded) -> None:
    info = ros.camera_info(distortion_model="equidistant", d=np.array([0.1, 0.2, 0.3, 0.4]))
    assert as_camera(decoded(info)).model == "fisheye"


def test_uncalibrated_camera_is_unusable(ros: SimpleNamespace, decoded: Decoded) -> None:
    with pytest.raises(RecordingError, match="not calibrated"):
        decoded(ros.camera_info(k=np.zeros(9)))


def test_unknown_distortion_model_is_an_error_that_lists_the_supported_ones(
    ros: SimpleNamespace, decoded: Decoded
) -> None:
    with pytest.raises(RecordingError, match="'double_sphere' is not supported; known are plumb_bob"):
        decoded(ros.camera_info(distortion_model="double_sphere"))


def test_region_of_interest_moves_the_principal_point(ros: SimpleNamespace, decoded: Decoded) -> None:
    roi = ros.types["sensor_msgs/msg/RegionOfInterest"](100, 40, 300, 400, False)
    camera = as_camera(decoded(ros.camera_info(roi=roi)))
    assert (camera.width, camera.height) == (400, 300)
    np.testing.assert_allclose(camera.K, [[500, 0, 220], [0, 510, 200], [0, 0, 1]])


def test_binning_maps_the_centre_of_four_pixels_to_one(ros: SimpleNamespace, decoded: Decoded) -> None:
    k = np.array([500.0, 0, 320.5, 0, 510, 240.5, 0, 0, 1])
    camera = as_camera(decoded(ros.camera_info(binning_x=2, binning_y=2, k=k)))
    assert (camera.width, camera.height) == (320, 240)
    np.testing.assert_allclose(camera.K, [[250, 0, 160], [0, 255, 120], [0, 0, 1]])


def test_a_region_smaller_than_its_binning_is_refused(ros: SimpleNamespace, decoded: Decoded) -> None:
    with pytest.raises(RecordingError, match=r"a region of 1 x 480 pixels, binned by 2 x 1: no pixel remains"):
        decoded(
            ros.camera_info(binning_x=2, roi=ros.types["sensor_msgs/msg/RegionOfInterest"](0, 0, 480, 1, False))
        )


@pytest.mark.parametrize("field", ["k", "d"])
def test_intrinsics_beyond_any_camera_are_unusable(ros: SimpleNamespace, decoded: Decoded, field: str) -> None:
    values = np.array([500.0, 0, 320, 0, 510, 240, 0, 0, 1]) if field == "k" else np.array([0.1, 0, 0, 0])
    values[0] = 1.7e16
    with pytest.raises(RecordingError, match=r"must not exceed 1e\+06, got .*1\.7e\+16"):
        decoded(ros.camera_info(**{field: values}))


def test_ranges_farther_than_any_scanner_measures_are_no_measurements(
    ros: SimpleNamespace, decoded: Decoded
) -> None:
    ranges = np.array([1e30, 2.0, 1e6], np.float32)
    scan = decoded(ros.scan(ranges=ranges, range_max=0.0))
    assert isinstance(scan, LaserScan)
    np.testing.assert_array_equal(scan.valid, [False, True, False])


@pytest.mark.parametrize(
    ("stated", "frame_id"),
    [("laser\x1b[31m\n", "laser[31m"), ("x" * 5000, "x" * 255), ("lidar/ünten", "lidar/ünten")],
    ids=["control characters", "long", "usual"],
)
def test_frames_are_as_names_may_be(stated: str, frame_id: str, tmp_path: Path) -> None:
    with RecordingWriter(tmp_path / "recording") as writer:
        writer.write("/scan", LaserScan(1.0, stated, np.linspace(-1, 1, 5), np.ones(5)))
    with open_recording(tmp_path / "recording") as recording:
        (record,) = recording.records()
        message = record.decode()
        assert isinstance(message, LaserScan)
        assert message.frame_id == frame_id
        assert record.digest is not None
        assert record.digest().frame_id == frame_id
