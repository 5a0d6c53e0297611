"""Corners that another program detected, in CSV files."""

from pathlib import Path

import numpy as np
import pytest

from calgraph.errors import RecordingError
from calgraph.recording import find_topics, open_recording
from calgraph.sensors import DetectedCorners

HEADER = "sync_index,cam_id,object_id,keypoint_id,img_loc_x,img_loc_y,obj_loc_x,obj_loc_y\n"
ROWS = "7,0,0,0,10.5,20.5,0.1,0.2\n7,0,0,1,30.5,40.5,0.2,0.2\n7,1,0,0,50,60,0.1,0.2\n8,0,0,0,11,21,0.1,0.2\n"
TIMES = "sync_index,cam_id,frame_time\n7,0,100.25\n7,1,100.26\n8,0,100.45\n8,1,100.46\n"


def put(folder: Path, corners: str = HEADER + ROWS, times: str = "") -> Path:
    (folder / "xy.csv").write_text(corners)
    if times:
        (folder / "timestamps.csv").write_text(times)
    return folder


def messages(path: Path) -> list[tuple[str, DetectedCorners]]:
    with open_recording(path) as recording:
        decoded = [(record.topic, record.decode()) for record in recording.records()]
    return [(topic, message) for topic, message in decoded if isinstance(message, DetectedCorners)]


def test_frames_have_their_times_and_corners(tmp_path: Path) -> None:
    found = messages(put(tmp_path, times=TIMES))
    assert [(topic, one.stamp, len(one.pixels)) for topic, one in found] == [
        ("cam_0", 100.25, 2),
        ("cam_1", 100.26, 1),
        ("cam_0", 100.45, 1),
        ("cam_1", 100.46, 0),
    ]
    np.testing.assert_array_equal(found[0][1].board_points, [[0.1, 0.2, 0], [0.2, 0.2, 0]])
    np.testing.assert_array_equal(found[0][1].pixels, [[10.5, 20.5], [30.5, 40.5]])


def test_without_times_frames_of_one_index_are_a_snapshot(tmp_path: Path) -> None:
    assert [(topic, one.stamp) for topic, one in messages(put(tmp_path))] == [
        ("cam_0", 70.0),
        ("cam_1", 70.0),
        ("cam_0", 80.0),
    ]


def test_times_and_depths_may_be_in_the_same_file(tmp_path: Path) -> None:
    corners = f"{HEADER.strip()},frame_time,obj_loc_z\n7,left,0,0,1,2,3,4,99.5,0.25\n"
    ((topic, message),) = messages(put(tmp_path, corners) / "xy.csv")
    assert (topic, message.stamp) == ("left", 99.5)
    np.testing.assert_array_equal(message.board_points, [[3, 4, 0.25]])


def test_topics_are_those_of_cameras(tmp_path: Path) -> None:
    with open_recording(put(tmp_path, times=TIMES)) as recording:
        assert [(topic.name, topic.type, topic.kind) for topic in find_topics(recording)] == [
            ("cam_0", "corners", "camera"),
            ("cam_1", "corners", "camera"),
        ]


@pytest.mark.parametrize(
    ("corners", "times", "complaint"),
    [
        (HEADER + "7,0,0,0,ten,20,0.1,0.2\n", "", r"xy\.csv: line 2: img_loc_x must be a number, got 'ten'"),
        (HEADER + "7,0,0,0,10,20,0.1\n", "", r"xy\.csv: line 2: obj_loc_y must be a number, got None"),
        (HEADER + "7,0,0,0,10,20,0.1,nan\n", "", r"xy\.csv: line 2: obj_loc_y must be finite"),
        (HEADER + "7.5,0,0,0,10,20,0.1,0.2\n", "", r"line 2: sync_index must be a whole number, got 7\.5"),
        (HEADER + ROWS, "sync_index,cam_id\n7,0\n", r"timestamps\.csv: has no column frame_time"),
        (HEADER + ROWS, TIMES.replace("8,0,100.45\n", ""), "has no frame_time of sync_index 8, cam_id 0"),
    ],
)
def test_unusable_files_are_errors_with_line_and_column(
    tmp_path: Path, corners: str, times: str, complaint: str
) -> None:
    with pytest.raises(RecordingError, match=complaint):
        open_recording(put(tmp_path, corners, times))


def test_real_corners_are_read(data_dir: Path) -> None:
    found = messages(data_dir / "four-webcams-charuco-corners")
    assert sum(len(message.pixels) for _, message in found) == 1725
    assert len(found) == 4 * 48
    assert found[0][1].stamp == pytest.approx(48032.9977, abs=0.02)


def test_corners_may_lie_beside_the_folders_of_other_sensors(tmp_path: Path) -> None:
    put(tmp_path, times=TIMES)
    (tmp_path / "lidar").mkdir()
    np.savez(tmp_path / "lidar" / "100.3.npz", points=np.ones((1, 3)))
    with open_recording(tmp_path) as recording:
        assert [(r.topic, r.stamp) for r in recording.records()] == [
            ("cam_0", 100.25), ("cam_1", 100.26), ("lidar", 100.3), ("cam_0", 100.45), ("cam_1", 100.46),
        ]  # fmt: skip
