"""Drafts of rig.yaml: what is taken for a sensor, and that every draft loads."""

import re
from pathlib import Path

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from calgraph.config import CameraSpec, FoundBackground, FoundTopic, Kind, Rig, draft_rig, load_rig
from calgraph.errors import InputError

IMAGE, INFO = "sensor_msgs/msg/Image", "sensor_msgs/msg/CameraInfo"


def image(name: str, frame_id: str = "", problem: str = "") -> FoundTopic:
    return FoundTopic(name, IMAGE, "camera", 100, frame_id, problem)


def info(name: str, frame_id: str = "", problem: str = "") -> FoundTopic:
    return FoundTopic(name, INFO, "camera_info", 100, frame_id, problem)


def scan(name: str, count: int = 500) -> FoundTopic:
    return FoundTopic(name, "sensor_msgs/msg/LaserScan", "lidar2d", count)


def cloud(name: str) -> FoundTopic:
    return FoundTopic(name, "sensor_msgs/msg/PointCloud2", "lidar3d", 200)


def event(name: str, count: int) -> FoundTopic:
    return FoundTopic(name, "std_msgs/msg/Empty", "event", count)


TARGET = "target: {kind: board, size: [1.2, 0.9], tags: [{id: 0, size: 0.3}]}"


def drafted(tmp_path: Path, *topics: FoundTopic, background: FoundBackground | None = None) -> Rig:
    (tmp_path / "rig.yaml").write_text(draft_rig(topics, "bag", TARGET, background), encoding="utf-8")
    return load_rig(tmp_path / "rig.yaml")


def camera(rig: Rig) -> CameraSpec:
    [spec] = rig.cameras().values()
    return spec


def test_the_root_is_the_3d_lidar(tmp_path: Path) -> None:
    assert drafted(tmp_path, image("/a/image_raw"), scan("/b/scan"), cloud("/c/points")).root == "c"


def test_the_root_of_a_network_may_be_any_of_its_sensors_or_the_floor() -> None:
    topics = (scan("/b/scan"), cloud("/c/points"), cloud("/d/points"), image("/a/image_raw"))
    text = draft_rig(topics, "bag", network="3-D LiDARs are at rest")
    assert "could be d, b, floor.\nroot: c\n" in text
    assert "the height, roll and pitch of a 2-D scanner" in text
    assert "2-D scanner" not in draft_rig(topics[1:], "bag", network="3-D LiDARs are at rest")


def test_without_a_3d_lidar_the_root_is_the_first_sensor(tmp_path: Path) -> None:
    assert drafted(tmp_path, scan("/b/scan"), scan("/c/scan")).root == "b"


def test_raw_and_compressed_images_are_one_camera(tmp_path: Path) -> None:
    rig = drafted(tmp_path, image("/cam/image_raw"), image("/cam/image_raw/compressed"))
    assert camera(rig).topic == "/cam/image_raw"


def test_images_of_one_camera_are_taken_unrectified(tmp_path: Path) -> None:
    rig = drafted(tmp_path, image("/cam/image_rect"), image("/cam/image_raw/compressed"))
    assert camera(rig).topic == "/cam/image_raw/compressed"


def test_cameras_in_one_namespace_stay_two(tmp_path: Path) -> None:
    rig = drafted(tmp_path, image("/cameras/left"), image("/cameras/right"))
    assert set(rig.cameras()) == {"left", "right"}


@pytest.mark.parametrize(
    ("topics", "expected"),
    [
        ([info("/cam/camera_info"), info("/other/camera_info")], "/cam/camera_info"),
        ([info("/cam/image_raw/camera_info")], "/cam/image_raw/camera_info"),
        ([info("/x", frame_id="optical"), info("/y", frame_id="else")], "/x"),
        ([info("/the_only_one")], "/the_only_one"),
        ([info("/x"), info("/y")], None),
        ([info("/cam/camera_info", problem="K has no focal lengths")], None),
    ],
)
def test_the_camera_info_is_found(tmp_path: Path, topics: list[FoundTopic], expected: str | None) -> None:
    assert camera(drafted(tmp_path, image("/cam/image_raw", frame_id="optical"), *topics)).camera_info == expected


@pytest.mark.parametrize(
    "topic",
    [image("/depth/image_raw"), image("/cam/image", problem="encoding 32FC1 is not supported"), scan("/empty", 0)],
)
def test_what_cannot_be_used_is_listed_but_not_drafted(tmp_path: Path, topic: FoundTopic) -> None:
    rig = drafted(tmp_path, cloud("/points"), topic)
    assert list(rig.sensors) == ["lidar"]
    assert f"#   {topic.name} ({topic.type}): " in (tmp_path / "rig.yaml").read_text()


ODD = (
    (FoundTopic("/imu", "sensor_msgs/msg/Imu", "other", 9, problem="messages of sensor_msgs/msg/Imu are not read"),
     "/imu: messages of sensor_msgs/msg/Imu are not read"),
    (FoundTopic("/radar", "acme/msg/Targets", "other", 0), "/radar (acme/msg/Targets): has no message"),
    (info("/rear/camera_info", "rear"), f"/rear/camera_info ({INFO}): is of no camera whose images are used"),
    (info("/zero/camera_info", problem="K is zero"), f"/zero/camera_info ({INFO}): K is zero"),
    (event("/note", 3), "/note (std_msgs/msg/Empty): has not the name of a trigger"),
    (event("/fast/trigger", 400), "/fast/trigger (std_msgs/msg/Empty): is not taken for a trigger, because"),
)  # fmt: skip


@pytest.mark.parametrize(("topic", "line"), ODD, ids=[topic.name for topic, _ in ODD])
def test_every_topic_that_is_not_used_is_listed_with_its_type_and_why(
    tmp_path: Path, topic: FoundTopic, line: str
) -> None:
    used = image("/cam/image_raw", "cam"), info("/cam/camera_info", "cam"), scan("/scan"), event("/shutter", 9)
    drafted(tmp_path, *used, topic)
    unused = (tmp_path / "rig.yaml").read_text().partition("but not used:\n")[2].splitlines()
    assert [text.startswith(f"#   {line}") for text in unused] == [True]


def test_a_recording_without_sensors_is_refused_with_all_its_topics(tmp_path: Path) -> None:
    with pytest.raises(InputError) as refused:
        drafted(tmp_path, *(topic for topic, _ in ODD))
    assert all(line in str(refused.value) for _, line in ODD if "/fast" not in line)


def test_a_trigger_that_fires_now_and_then_marks_the_captures(tmp_path: Path) -> None:
    assert drafted(tmp_path, scan("/scan"), event("/capture/trigger", 48)).capture.trigger == "/capture/trigger"


def test_a_trigger_of_every_image_does_not_mark_captures(tmp_path: Path) -> None:
    assert drafted(tmp_path, image("/cam/image_raw"), event("/cam/trigger", 100)).capture.trigger is None


def test_an_event_of_another_name_is_no_trigger(tmp_path: Path) -> None:
    assert drafted(tmp_path, scan("/scan"), event("/heartbeat", 10)).capture.trigger is None


@pytest.mark.parametrize("topics", [(), (event("/trigger", 10),)], ids=["holds", "triggers"])
def test_an_empty_start_becomes_the_background(tmp_path: Path, topics: tuple[FoundTopic, ...]) -> None:
    rig = drafted(tmp_path, scan("/scan"), *topics, background=FoundBackground(4.7, "/scan changes\nat 5.0 s"))
    assert rig.capture.background == (0.0, 4.7)


@pytest.mark.parametrize("topics", [(), (event("/trigger", 10),)], ids=["holds", "triggers"])
def test_a_background_that_was_not_compared_with_images_is_a_comment(
    tmp_path: Path, topics: tuple[FoundTopic, ...]
) -> None:
    found = FoundBackground(4.7, "/scan changes at 5.0 s", searched=False)
    assert drafted(tmp_path, scan("/scan"), *topics, background=found).capture.background is None
    text = (tmp_path / "rig.yaml").read_text(encoding="utf-8")
    assert re.search(r"^ *# *background: \[0\.0, 4\.7\] ", text, re.MULTILINE)
    assert "at 5.0 s; used unless a camera detects the board in it" in text


@pytest.mark.parametrize("topics", [(), (event("/trigger", 10),)], ids=["holds", "triggers"])
def test_without_an_empty_start_there_is_no_background(tmp_path: Path, topics: tuple[FoundTopic, ...]) -> None:
    assert drafted(tmp_path, scan("/scan"), *topics).capture.background is None


def test_videos_have_clocks_of_their_own(tmp_path: Path) -> None:
    videos = [FoundTopic(name, "image", "camera", 100, own_clock=True) for name in ("left", "right")]
    assert [spec.clock_offset for spec in drafted(tmp_path, *videos).sensors.values()] == [None, "estimate"]


def test_messages_have_one_clock(tmp_path: Path) -> None:
    rig = drafted(tmp_path, image("/a/image_raw"), cloud("/c/points"))
    assert [spec.clock_offset for spec in rig.sensors.values()] == [None, None]


def test_a_draft_without_a_target_does_not_load(tmp_path: Path) -> None:
    (tmp_path / "rig.yaml").write_text(draft_rig([scan("/scan")], "bag"), encoding="utf-8")
    with pytest.raises(InputError, match=r"target: is missing .*calgraph board prints"):
        load_rig(tmp_path / "rig.yaml")


def test_no_sensor_is_refused() -> None:
    with pytest.raises(InputError, match=r"bag: has no topic with usable .* /heartbeat \(std_msgs/msg/Empty\)"):
        draft_rig([event("/heartbeat", 10)], "bag")


DRIVES = "what scanners measure changes in 80% of all directions"


def odometry(name: str, topic_type: str = "nav_msgs/msg/Odometry") -> FoundTopic:
    return FoundTopic(name, topic_type, "other", 500, problem="its messages are not read")


def drafted_drive(tmp_path: Path, *topics: FoundTopic) -> Rig:
    (tmp_path / "rig.yaml").write_text(draft_rig(topics, "bag", drive=DRIVES), encoding="utf-8")
    return load_rig(tmp_path / "rig.yaml")


def test_a_drive_has_surroundings_with_the_reason(tmp_path: Path) -> None:
    rig = drafted_drive(tmp_path, scan("/a/scan"), cloud("/b/points"))
    assert (rig.is_drive, list(rig.sensors)) == (True, ["b", "a"])
    text = (tmp_path / "rig.yaml").read_text("utf-8")
    assert f"taken for a robot that drives, as {DRIVES}." in text
    assert "state your board" not in text
    assert "capture" not in text


def test_what_two_scanners_do_not_need_is_a_comment_in_a_drive(tmp_path: Path) -> None:
    """A draft with a camera would need its boards."""
    depth = FoundTopic("/depth/image", IMAGE, "depth_camera", 100)
    others = odometry("/odom"), image("/cam/image_raw"), depth
    rig = drafted_drive(tmp_path, cloud("/a/points"), cloud("/b/points"), *others)
    assert list(rig.sensors) == ["a", "b"]
    text = (tmp_path / "rig.yaml").read_text("utf-8")
    assert "#     kind: trajectory\n#     topic: /odom  # 500 messages" in text
    assert "#     topic: /cam/image_raw  # 100 messages" in text
    assert "Cameras need boards that are fixed in the room" in text
    assert "/depth/image (sensor_msgs/msg/Image): is of a kind that a drive does not calibrate" in text


def test_one_scanner_is_drafted_with_trajectories_and_gyroscopes(tmp_path: Path) -> None:
    topics = cloud("/a/points"), odometry("/odom"), odometry("/imu/data", "sensor_msgs/msg/Imu")
    rig = drafted_drive(tmp_path, *topics, odometry("/tf", "tf2_msgs/msg/TFMessage"))
    assert {spec.topic: spec.kind for spec in rig.sensors.values()} == {
        "/a/points": "lidar3d",
        "/odom": "trajectory",
        "/imu/data": "gyroscope",
    }
    text = (tmp_path / "rig.yaml").read_text("utf-8")
    assert "/tf (tf2_msgs/msg/TFMessage): kind: trajectory with frame_id" in text


def test_without_a_target_the_message_names_surroundings(tmp_path: Path) -> None:
    (tmp_path / "rig.yaml").write_text("root: a\nsensors: {a: {kind: lidar3d, topic: /a}}\n", encoding="utf-8")
    with pytest.raises(InputError, match=r"target: is missing .*\{kind: surroundings\} for a robot that drives"):
        load_rig(tmp_path / "rig.yaml")


kinds: st.SearchStrategy[Kind] = st.sampled_from(["camera", "lidar2d", "lidar3d", "camera_info", "event", "other"])
# Text that YAML files can hold: no surrogates, no control characters.
words = st.text(st.characters(exclude_categories=("Cs", "Cc", "Cn")), min_size=1, max_size=8)
topics = st.builds(FoundTopic, words, words, kinds, st.integers(0, 99), st.text("a1/_ :#'\"{", max_size=5), words)


@given(st.lists(topics, min_size=1, max_size=6, unique_by=lambda topic: topic.name))
@settings(max_examples=60, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
def test_whatever_the_topics_are_called_the_draft_loads(tmp_path: Path, found: list[FoundTopic]) -> None:
    found = [*found, scan("/scan-of-ours")]
    rig = drafted(tmp_path, *found)
    assert {sensor.topic for sensor in rig.sensors.values()} <= {topic.name for topic in found}
