from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from calgraph.errors import InputError, RecordingError
from calgraph.recording import open_recording, open_recordings
from calgraph.sensors import CameraInfo, Image, LaserScan, Message, PointCloud

POINTS = np.array([[1.0, 2, 3], [4, 5, 6]])
SCAN = {
    "stamp": 1.5,
    "angle_min": -0.1,
    "angle_increment": 0.1,
    "time_increment": 1e-4,
    "ranges": [1.0, np.nan, 3.0],
}
HEADER = "stamp,angle_min,angle_increment,time_increment,ranges\n"


def put(folder: Path, name: str, content: bytes | str) -> None:
    path = folder / name
    path.parent.mkdir(exist_ok=True)
    path.write_bytes(content if isinstance(content, bytes) else content.encode())


def put_npz(folder: Path, name: str, **arrays: Any) -> None:
    (folder / name).parent.mkdir(exist_ok=True)
    np.savez(folder / name, **arrays)


def only_message(folder: Path) -> Message:
    with open_recording(folder) as recording:
        (record,) = recording.records()
    return record.decode()


def png(value: int = 7) -> bytes:
    return cv2.imencode(".png", np.full((4, 5), value, np.uint8))[1].tobytes()


def test_folder_whose_names_are_unclear_is_an_error_where_it_is_wanted_only(tmp_path: Path) -> None:
    for name in ("a/1.5.png", "b/2024-03-01_12.png", "b/2024-03-02_13.png"):
        put(tmp_path, name, png())
    with open_recording(tmp_path) as recording:
        assert [record.topic for record in recording.records()] == ["a"]
        with pytest.raises(
            InputError, match=r"2024-03-01_12\.png: neither the time .* name the files of each sensor"
        ):
            recording.records(["a", "b"])


def test_folder_of_unclear_names_alone_is_an_error(tmp_path: Path) -> None:
    put(tmp_path, "camera/board.png", png())
    with pytest.raises(InputError, match=r"board\.png: neither the time .* as board has no number"):
        open_recording(tmp_path)


def test_two_files_of_one_name_are_an_error(tmp_path: Path) -> None:
    for name in ("camera/1.png", "camera/1.jpg"):
        put(tmp_path, name, png())
    with pytest.raises(InputError, match=r"1\.jpg and 1\.png have the same name"):
        open_recording(tmp_path)


def test_numbered_files_of_sensors_have_the_stamp_of_their_pose(tmp_path: Path) -> None:
    for name in ("camera/img_0012.png", "camera/img_0002.png"):
        put(tmp_path, name, png())
    put_npz(tmp_path, "lidar/pose12_full.npz", points=POINTS)
    with open_recording(tmp_path) as recording:
        assert [(r.topic, r.stamp) for r in recording.records()] == [
            ("camera", 20.0),
            ("camera", 120.0),
            ("lidar", 120.0),
        ]


def test_numbered_and_timed_sensors_cannot_be_read_together(tmp_path: Path) -> None:
    for name in ("camera/img_12.png", "lidar/1773380642.5.png"):
        put(tmp_path, name, png())
    with open_recording(tmp_path) as recording:
        assert len(list(recording.records(["camera"]))) == 1
        with pytest.raises(InputError, match="files in lidar are named by time, those in camera by number"):
            recording.records(["camera", "lidar"])


def test_files_of_one_folder_are_of_one_sensor_with_its_name(tmp_path: Path) -> None:
    folder = tmp_path / "front camera"
    folder.mkdir()
    for name in ("img_1.png", "img_2.png", "notes.txt"):
        put(folder, name, png())
    put(folder, "camera_info.yaml", MESSAGE_KEYS)
    with open_recording(folder) as recording:
        assert {topic.name: topic.count for topic in recording.topics} == {
            "front camera": 2,
            "front camera/camera_info": 1,
        }


def test_stamp_in_a_numbered_scan_is_not_that_of_its_name(tmp_path: Path) -> None:
    put(tmp_path, "laser/scan_7.csv", f"{HEADER}1.5,-0.1,0.1,1e-4,1.0,,3.0\n")
    assert only_message(tmp_path).stamp == 70.0


def test_files_of_all_sensors_come_in_order_of_time(tmp_path: Path) -> None:
    for name in ("a/3.png", "a/10.png", "b/4.5.png", "b/.4.png", "b/notes.txt", "c/notes.txt"):
        put(tmp_path, name, png())
    with open_recording(tmp_path) as recording:
        assert [(r.topic, r.stamp, r.arrival) for r in recording.records()] == [
            ("a", 3.0, 3.0),
            ("b", 4.5, 4.5),
            ("a", 10.0, 10.0),
        ]


def test_start_and_end_are_those_of_the_first_and_last_file(tmp_path: Path) -> None:
    for name in ("a/3.png", "a/10.png"):
        put(tmp_path, name, png())
    with open_recording(tmp_path) as recording:
        assert (recording.start, recording.end) == (3.0, 10.0)
        assert [r.stamp for r in recording.records(start=3.5, end=10.0)] == [10.0]


def topics_of(folder: Path) -> dict[str, tuple[str, int]]:
    with open_recording(folder) as recording:
        return {topic.name: (topic.type, topic.count) for topic in recording.topics}


XYZ = "1 2 3\n4 5 6\n"


@pytest.mark.parametrize(
    ("names", "topics"),
    [
        (("{}.jpg", "{}.xyz"), {"image": "image", "cloud": "cloud"}),
        (("left_{}.png", "right_{}.png"), {"left": "image", "right": "image"}),
        (("left{:02d}.jpg", "right{:02d}.jpg"), {"left": "image", "right": "image"}),
        (("{:04d}_left.png", "{:04d}_right.png"), {"left": "image", "right": "image"}),
        (("cam0_{}.png", "cam1_{}.png", "cam12_{}.png"), dict.fromkeys(("cam0", "cam1", "cam12"), "image")),
        (("cam_0_{}.png", "cam_1_{}.png"), {"cam_0": "image", "cam_1": "image"}),
        (("{}_cam0.png", "{}_cam1.png"), {"cam0": "image", "cam1": "image"}),
        (("image_{}.png", "cloud_{}.xyz"), {"image": "image", "cloud": "cloud"}),
        (("frame_{}.png", "frame_{}.xyz"), {"frame_image": "image", "frame_cloud": "cloud"}),
        (("left_{}.png", "right_{}.png", "{}.xyz"), {"left": "image", "right": "image", "cloud": "cloud"}),
        (("l_17733807218{}3329820.png", "r_17733807218{}3329920.png"), {"l": "image", "r": "image"}),
    ],
)
@pytest.mark.parametrize("inside", ["", "data/"])
def test_files_of_several_sensors_in_one_folder_are_told_apart(
    tmp_path: Path, names: tuple[str, ...], topics: dict[str, str], inside: str
) -> None:
    for number in range(1, 6):
        for name in names:
            put(tmp_path, f"{inside}{name.format(number)}", XYZ if name.endswith("xyz") else png())
    assert topics_of(tmp_path) == {f"{inside}{name}": (kind, 5) for name, kind in topics.items()}
    with open_recording(tmp_path) as recording:
        for record in recording.records():
            record.decode()


def test_images_and_clouds_of_one_number_are_one_pose(tmp_path: Path) -> None:
    for number in range(3):
        put(tmp_path, f"{number}.jpg", png())
        put(tmp_path, f"{number}.xyz", XYZ)
    with open_recording(tmp_path) as recording:
        stamps = [(record.topic, record.stamp) for record in recording.records()]
    assert sorted(stamps) == [(topic, 10.0 * k) for topic in ("cloud", "image") for k in range(3)]


@pytest.mark.parametrize(
    ("names", "kept"),
    [
        # Two batches of one camera, and times of one.
        (("a_1.png", "a_2.png", "b_3.png", "b_4.png"), 4),
        (("a_1773380721863329828.png", "a_1773380722863329828.png", "b_1773380723863329828.png"), 3),
        # Notes and labels, and other tables, beside images.
        (("1.png", "2.png", "1.txt", "2.txt", "notes.txt"), 2),
        (("1.png", "2.png", "timestamps.csv"), 2),
    ],
)
def test_other_files_of_one_folder_are_of_one_sensor(tmp_path: Path, names: tuple[str, ...], kept: int) -> None:
    for name in names:
        put(tmp_path, f"camera/{name}", png() if name.endswith("png") else XYZ)
    assert topics_of(tmp_path) == {"camera": ("image", kept)}


def test_intrinsics_of_one_of_two_cameras_in_a_folder_have_its_name(tmp_path: Path) -> None:
    for name in ("left_1.png", "left_2.png", "right_1.png", "right_2.png"):
        put(tmp_path, name, png())
    put(tmp_path, "left_camera_info.yaml", "{width: 5, height: 4, K: [9, 9, 2, 2]}")
    put(tmp_path, "camera_info.yaml", "{width: 5, height: 4, K: [8, 8, 2, 2]}")
    assert set(topics_of(tmp_path)) == {"left", "right", "left/camera_info"}


def test_intrinsics_beside_images_and_clouds_are_those_of_the_images(tmp_path: Path) -> None:
    for name in ("1.png", "2.png", "1.xyz", "2.xyz"):
        put(tmp_path, name, png() if name.endswith("png") else XYZ)
    put(tmp_path, "camera_info.yaml", "{width: 5, height: 4, K: [9, 9, 2, 2]}")
    assert set(topics_of(tmp_path)) == {"image", "cloud", "image/camera_info"}


@pytest.mark.parametrize("suffix", [".png", ".jpg", ".bmp", ".tif", ".tiff", ".webp"])
def test_images_of_all_formats_are_read(tmp_path: Path, suffix: str) -> None:
    put(tmp_path, f"camera/1.5{suffix}", cv2.imencode(suffix, np.full((4, 5), 7, np.uint8))[1].tobytes())
    message = only_message(tmp_path)
    assert isinstance(message, Image)
    np.testing.assert_allclose(message.gray, np.full((4, 5), 7), atol=1)


@pytest.mark.parametrize("suffix", [".xyz", ".txt", ".asc", ".pts", ".csv"])
@pytest.mark.parametrize(
    "text",
    [
        "1 2 3\n4 5 6\n",
        "1,2,3\n4,5,6",
        "1.0e0; 2; 3;\r\n4; 5; 6;\r\n",
        "x y z\n1 2 3\n4 5 6\n",
        "# X, Y, Z, intensity\n1, 2, 3, 9\n4, 5, 6, 9\n",
        '"x","y","z"\n1,2,3\n4,5,6\n',
        "//X Y Z R G B\n1 2 3 255 0 0\n4 5 6 255 0 0\n",
        "ring,z,y,x\n1,3,2,1\n2,6,5,4\n",
        "nan nan nan\n1 2 3\n4 5 6\n",
    ],
)
def test_clouds_of_text_are_read(tmp_path: Path, suffix: str, text: str) -> None:
    put(tmp_path, f"lidar/1.5{suffix}", text)
    message = only_message(tmp_path)
    assert isinstance(message, PointCloud)
    np.testing.assert_array_equal(message.points, POINTS)
    if "ring" in text:
        np.testing.assert_array_equal(message.rings, [1, 2])


def test_a_text_may_state_the_number_of_its_points(tmp_path: Path) -> None:
    put(tmp_path, "lidar/1.5.pts", "2\n1 2 3 77 255 0 0\n4 5 6 80 0 0 0\n")
    message = only_message(tmp_path)
    assert isinstance(message, PointCloud)
    np.testing.assert_array_equal(message.points, POINTS)


@pytest.mark.parametrize("text", ["1 2\n3 4\n", "1 2 3\n4 5\n", "1 2 3\na b c\n", "hello\n1 2\n"])
def test_a_text_without_points_is_an_error_with_the_reason(tmp_path: Path, text: str) -> None:
    put(tmp_path, "lidar/1.5.xyz", text)
    with pytest.raises(RecordingError, match=r"1\.5\.xyz: .*(each line must have x, y and z|could not convert)"):
        only_message(tmp_path)


def test_topics_have_the_kind_of_the_folders_content(tmp_path: Path) -> None:
    put(tmp_path, "camera/1.png", png())
    put(tmp_path, "camera/camera_info.yaml", "{}")
    put(tmp_path, "laser/1.csv", HEADER)
    put_npz(tmp_path, "lidar/1.npz", points=POINTS)
    put_npz(tmp_path, "lrf/1.npz", **SCAN)
    with open_recording(tmp_path) as recording:
        assert {topic.name: (topic.type, topic.count) for topic in recording.topics} == {
            "camera": ("image", 1),
            "camera/camera_info": ("camera_info", 1),
            "laser": ("scan", 1),
            "lidar": ("cloud", 1),
            "lrf": ("scan", 1),
        }


def test_image_is_read(tmp_path: Path) -> None:
    put(tmp_path, "camera/1.png", png(42))
    image = only_message(tmp_path)
    assert isinstance(image, Image)
    np.testing.assert_array_equal(image.pixels, np.full((4, 5), 42))


def test_cloud_of_npz_is_read_with_rings_and_times(tmp_path: Path) -> None:
    put_npz(tmp_path, "lidar/1.npz", points=POINTS, ring=np.array([3, 4]), time=np.array([0.0, 0.05]))
    cloud = only_message(tmp_path)
    assert isinstance(cloud, PointCloud)
    np.testing.assert_array_equal(cloud.points, POINTS)
    np.testing.assert_array_equal(cloud.rings, [3, 4])
    np.testing.assert_array_equal(cloud.times, [0, 0.05])


@pytest.mark.parametrize("suffix", ["npz", "csv"])
def test_scan_is_read(tmp_path: Path, suffix: str) -> None:
    if suffix == "npz":
        put_npz(tmp_path, "laser/1.5.npz", **SCAN)
    else:
        put(tmp_path, "laser/1.5.csv", f"{HEADER}1.5,-0.1,0.1,1e-4,1.0,,3.0\n")
    scan = only_message(tmp_path)
    assert isinstance(scan, LaserScan)
    np.testing.assert_allclose(scan.angles, [-0.1, 0, 0.1], atol=1e-12)
    np.testing.assert_array_equal(scan.ranges, [1, np.nan, 3])
    assert scan.time_increment == 1e-4


@pytest.mark.parametrize(
    ("content", "complaint"),
    [
        ("", "first line must be stamp,"),
        ("1.5,-0.1,0.1,1e-4,1.0\n", "first line must be stamp,"),
        (HEADER, "one line of values"),
        (f"{HEADER}1.5,-0.1,0.1,1e-4\n", "at least one range"),
        (f"{HEADER}9.5,-0.1,0.1,1e-4,1.0\n", "stamp 9.500000 is not that of its name"),
        (f"{HEADER}1.5,-0.1,,1e-4,1.0\n", "angle_increment must be a finite number"),
        (f"{HEADER}1.5,-0.1,0.1,1e-4,one\n", "could not convert string to float: 'one'"),
    ],
)
def test_unusable_scan_file_is_an_error_with_the_reason(tmp_path: Path, content: str, complaint: str) -> None:
    put(tmp_path, "laser/1.5.csv", content)
    with pytest.raises(RecordingError, match=complaint):
        only_message(tmp_path)


def test_npz_without_points_or_ranges_is_refused(tmp_path: Path) -> None:
    put_npz(tmp_path, "lidar/1.npz", xyz=POINTS)
    with pytest.raises(RecordingError, match="either points or ranges, this one has xyz"):
        only_message(tmp_path)


ROS_CALIBRATION = """\
image_width: 640
image_height: 480
camera_name: front
camera_matrix: {rows: 3, cols: 3, data: [500, 0, 320, 0, 510, 240, 0, 0, 1]}
distortion_model: plumb_bob
distortion_coefficients: {rows: 1, cols: 5, data: [0.1, 0.2, 0.3, 0.4, 0.5]}
"""
MESSAGE_KEYS = """\
width: 640
height: 480
distortion_model: fisheye
K: [500, 0, 320, 0, 510, 240, 0, 0, 1]
D: [0.1, 0.2, 0.3, 0.4]
"""


@pytest.mark.parametrize(
    ("content", "model", "coefficients"), [(ROS_CALIBRATION, "pinhole", 5), (MESSAGE_KEYS, "fisheye", 4)]
)
def test_camera_info_comes_with_the_first_image(
    tmp_path: Path, content: str, model: str, coefficients: int
) -> None:
    put(tmp_path, "camera/4.png", png())
    put(tmp_path, "camera/camera_info.yaml", content)
    with open_recording(tmp_path) as recording:
        (record,) = recording.records(["camera/camera_info"])
    info = record.decode()
    assert record.stamp == 4.0
    assert isinstance(info, CameraInfo)
    assert (info.camera.model, info.camera.distortion.size) == (model, coefficients)
    np.testing.assert_array_equal(info.camera.K, [[500, 0, 320], [0, 510, 240], [0, 0, 1]])


@pytest.mark.parametrize(
    ("content", "complaint"),
    [
        ("[]", "must hold a mapping of keys to values"),
        ("width: 640\nheight: 480\n", "key K"),
        ("a: [", "camera_info.yaml"),
        (MESSAGE_KEYS.replace("640", "0"), "states images of 0 x 480 pixels: .* give the intrinsics in rig.yaml"),
        (MESSAGE_KEYS.replace("480", "-1"), "states images of 640 x -1 pixels"),
        ("width: 4\nheight: 4\nK: [.nan, 1, 2, 2]\n", "K must have 9 finite values"),
        ("width: 4\nheight: 4\nK: [1.0e+300, 1, 2, 2]\n", r"K and distortion must not exceed 1e\+06"),
        (
            "width: 4\nheight: 4\nK: [9, 9, 2, 2]\nD: [1.0e+9, 0, 0, 0]\n",
            r"K and distortion must not exceed 1e\+06",
        ),
    ],
)
def test_unusable_camera_info_is_an_error_with_the_reason(tmp_path: Path, content: str, complaint: str) -> None:
    put(tmp_path, "camera/4.png", png())
    put(tmp_path, "camera/camera_info.yaml", content)
    with open_recording(tmp_path) as recording:
        (record,) = recording.records(["camera/camera_info"])
    with pytest.raises(RecordingError, match=complaint):
        record.decode()


def test_real_fisheye_intrinsics_are_read(tmp_path: Path, data_dir: Path) -> None:
    put(tmp_path, "camera/4.png", png())
    content = (data_dir / "acfr-vlp16-checkerboard/camera_info_first_commit.yaml").read_bytes()
    put(tmp_path, "camera/camera_info.yaml", content)
    with open_recording(tmp_path) as recording:
        (record,) = recording.records(["camera/camera_info"])
    info = record.decode()
    assert isinstance(info, CameraInfo)
    np.testing.assert_array_equal(info.camera.distortion, [-0.0540096, -0.0784275, 0.0959641, -0.0515253])


def test_real_camera_and_laser_folders_interleave(data_dir: Path) -> None:
    with open_recording(data_dir / "acfr-rpg-camera-2dlidar") as recording:
        stamps = [(record.topic, record.stamp) for record in recording.records()]
    assert len(stamps) == 10
    assert sorted(stamps, key=lambda entry: entry[1]) == stamps
    assert stamps[0] == ("lasers", 1773380642.785313094)


def test_folder_without_recording_is_an_error_that_lists_the_formats(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"neither bag files nor folders with files named <seconds>\.<png"):
        open_recording(tmp_path)


@pytest.mark.parametrize("target", ["1.5.png", "nothing"])
def test_a_link_that_leads_nowhere_is_named(tmp_path: Path, target: str) -> None:
    for k in range(3):
        put(tmp_path, f"camera/{k}.5.png", png())
    file = tmp_path / "camera/1.5.png"
    file.unlink()
    file.symlink_to(target)
    with open_recording(tmp_path) as recording:
        record = next(r for r in recording.records() if r.stamp == 1.5)
        assert record.digest is not None
        for read in (record.decode, record.digest):
            with pytest.raises(RecordingError, match=r"camera/1\.5\.png: .*(No such file|symbolic links)"):
                read()


def test_folders_of_numbered_files_are_takes_one_after_the_other(tmp_path: Path) -> None:
    for gray, take in enumerate(("first", "second")):
        (tmp_path / take).mkdir()
        put(tmp_path / take, "camera/camera_info.yaml", MESSAGE_KEYS)
        for name in ("camera/img_1.png", "camera/img_3.png"):
            put(tmp_path / take, name, png(gray))
    with open_recordings([tmp_path / "first", tmp_path / "second"]) as recording:
        assert [r.stamp for r in recording.records(["camera"])] == [10.0, 30.0, 100.0, 120.0]
        assert [r.stamp for r in recording.records(["camera"], 25.0, 105.0)] == [30.0, 100.0]
        assert (recording.start, recording.end) == (10.0, 120.0)
        assert [r.decode().stamp for r in recording.records(["camera/camera_info"])] == [10.0, 100.0]


def test_a_second_take_beside_stamps_of_a_clock_is_an_error(tmp_path: Path) -> None:
    for name in ("first", "second", "timed"):
        (tmp_path / name).mkdir()
    for gray, name in enumerate(("first/camera/img_1.png", "second/camera/img_1.png", "timed/lidar/1.5.png")):
        (tmp_path / name).parent.mkdir()
        put(tmp_path, name, png(gray))
    with pytest.raises(InputError, match=r"second: has the topic camera, as another recording has, and its time"):
        open_recordings([tmp_path / name for name in ("first", "second", "timed")])
