from pathlib import Path

import numpy as np
import pytest

from calgraph.errors import RecordingError
from calgraph.recording import open_recording
from calgraph.sensors import PointCloud, convert_cloud_to_scan


def cloud_at(angles: list[float], ranges: list[float], z: float = 0.0) -> PointCloud:
    a, r = np.array(angles, float), np.array(ranges, float)
    return PointCloud(5.0, "laser", np.stack([r * np.cos(a), r * np.sin(a), np.full_like(r, z)], axis=-1))


def test_beams_are_sorted_by_angle() -> None:
    scan = convert_cloud_to_scan(cloud_at([0.2, -0.1, 0.0, 0.1], [4, 1, 2, 3]))
    np.testing.assert_allclose(scan.angles, [-0.1, 0.0, 0.1, 0.2])
    np.testing.assert_allclose(scan.ranges, [1, 2, 3, 4])


def test_gap_between_beams_is_filled_with_invalid_beams() -> None:
    scan = convert_cloud_to_scan(cloud_at([0.0, 0.1, 0.2, 0.5, 0.6], [1, 1, 1, 1, 1]))
    np.testing.assert_allclose(scan.angles, [0.0, 0.1, 0.2, 0.3, 0.4, 0.5, 0.6])
    np.testing.assert_array_equal(scan.valid, [True, True, True, False, False, True, True])


def test_points_at_the_origin_are_no_measurements() -> None:
    scan = convert_cloud_to_scan(cloud_at([0.0, 0.1, 0.2, 0.3, 0.4], [1, 1, 0, 1, 1]))
    np.testing.assert_array_equal(scan.valid, [True, True, False, True, True])


def test_empty_cloud_is_an_empty_scan() -> None:
    assert convert_cloud_to_scan(cloud_at([], [])).angles.shape == (0,)


def test_cloud_that_is_not_flat_is_refused() -> None:
    with pytest.raises(RecordingError, match=r"0\.300 m off z = 0"):
        convert_cloud_to_scan(cloud_at([0.0, 0.1], [1, 1], z=0.3))


@pytest.mark.parametrize(("z", "ranges"), [(0.021, 1.0), (0.051, 4.0)])
def test_points_farther_off_the_plane_than_a_hundredth_of_the_range_are_refused(z: float, ranges: float) -> None:
    # 1 cm, and 1 % of the range.
    assert len(convert_cloud_to_scan(cloud_at([0.0, 0.1], [ranges, ranges], z=z - 0.002)).ranges) == 2
    with pytest.raises(RecordingError, match="off z = 0"):
        convert_cloud_to_scan(cloud_at([0.0, 0.1], [ranges, ranges], z=z))


def test_gaps_have_no_more_beams_than_a_turn_can_have() -> None:
    scan = convert_cloud_to_scan(cloud_at([0.0, 1e-5, 2e-5, 3e-5, 1.0], [1, 1, 1, 1, 1]))
    assert len(scan.angles) == round(20_000 / (2 * np.pi)) - 1 + 5


@pytest.mark.parametrize("count", [2, 3])
def test_several_returns_of_each_beam_are_the_scan_of_the_nearest(count: int) -> None:
    angles = np.linspace(-1.2, 1.9, 200)
    nearest = np.random.default_rng(4).uniform(1.0, 9.0, 200)
    returns = nearest[:, None] + np.arange(count) * 0.3
    a, r = np.repeat(angles, count), returns.ravel()
    rounded = np.stack([r * np.cos(a), r * np.sin(a), np.zeros_like(r)], axis=-1).astype(np.float32)
    scan = convert_cloud_to_scan(PointCloud(5.0, "laser", rounded.astype(float)))
    np.testing.assert_allclose([scan.angles, scan.ranges], [angles, nearest], atol=1e-5)


def test_real_laser_clouds_are_full_turns(data_dir: Path) -> None:
    with open_recording(data_dir / "acfr-rpg-camera-2dlidar") as recording:
        clouds = [record.decode() for record in recording.records(["lasers"])]
    for cloud in clouds:
        assert isinstance(cloud, PointCloud)
        scan = convert_cloud_to_scan(cloud)
        assert 500 <= len(scan.angles) <= 510
        np.testing.assert_allclose(scan.points[scan.valid], cloud.points[np.argsort(
            np.arctan2(cloud.points[:, 1], cloud.points[:, 0]), kind="stable")], atol=1e-9)  # fmt: skip
