import pytest

from calgraph.config.draft import name_sensors


@pytest.mark.parametrize(
    ("topic", "kind", "name"),
    [
        ("/camera/image_raw", "camera", "camera"),
        ("/camera/image_raw/compressed", "camera", "camera"),
        ("/scan", "lidar2d", "laser"),
        ("/points", "lidar3d", "lidar"),
        ("/velodyne_points", "lidar3d", "velodyne"),
        ("/ouster/points", "lidar3d", "ouster"),
        ("/scan_front", "lidar2d", "front"),
        ("/image_raw", "camera", "camera"),
        ("/sensors/cam-0/image_rect_color", "camera", "cam_0"),
        ("lidar", "lidar3d", "lidar"),
    ],
)
def test_a_name_is_the_specific_part_of_the_topic(topic: str, kind: str, name: str) -> None:
    assert name_sensors({topic: kind}) == {topic: name}


def test_names_that_would_be_the_same_take_more_of_the_topic() -> None:
    topics = {"/left/camera/image": "camera", "/right/camera/image": "camera"}
    assert list(name_sensors(topics).values()) == ["left_camera", "right_camera"]


def test_the_kind_distinguishes_sensors_of_one_name() -> None:
    topics = {"/front/image_raw": "camera", "/front/scan": "lidar2d"}
    assert list(name_sensors(topics).values()) == ["front_camera", "front_laser"]


def test_the_rest_is_numbered() -> None:
    topics = dict.fromkeys(("/scan", "/scans", "/laser_scan"), "lidar2d")
    assert len(set(name_sensors(topics).values())) == 3
