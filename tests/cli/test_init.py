"""calgraph init: a rig.yaml that loads, from what was recorded."""

import json
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest
from typer.testing import Result

from calgraph.config import load_rig
from calgraph.errors import InputError
from calgraph.recording import RecordingWriter
from calgraph.sensors import Trigger
from videos import write_video

Run = Callable[..., Result]


@pytest.fixture
def board(tmp_path: Path) -> Path:
    """A file as ``calgraph board`` prints it."""
    file = tmp_path / "board.yaml"
    file.write_text("target: {kind: board, size: [1.2, 0.9], tags: [{id: 3, size: 0.3}]}")
    return file


@pytest.fixture
def drafted(run: Run, simulated: Path, tmp_path: Path, board: Path) -> Path:
    result = run("init", simulated / "recording", "-o", tmp_path / "rig.yaml", "--board", board)
    assert result.exit_code == 0, result.output
    return tmp_path / "rig.yaml"


def test_the_draft_finds_what_the_simulated_robot_has(drafted: Path, simulated: Path) -> None:
    draft, truth = load_rig(drafted), load_rig(simulated / "rig.yaml")
    found = {name: (s.kind, s.topic, s.frame_id) for name, s in draft.sensors.items()}
    assert found == {name: (s.kind, s.topic, s.frame_id) for name, s in truth.sensors.items()}


def test_the_draft_has_root_trigger_and_camera_info(drafted: Path) -> None:
    rig = load_rig(drafted)
    info = rig.cameras()["camera"].camera_info
    assert (rig.root, rig.capture.trigger, info) == ("lidar", "/trigger", "/camera/camera_info")


def test_the_draft_has_the_board_of_the_file(drafted: Path) -> None:
    (board,) = load_rig(drafted).boards
    assert [(tag.id, tag.size) for tag in board.tags] == [(3, 0.3)]


def test_without_a_board_an_empty_start_is_a_comment(run: Run, simulated: Path, tmp_path: Path) -> None:
    """A camera may detect the board in it, and nothing else would notice."""
    result = run("init", simulated / "recording", "-o", tmp_path / "rig.yaml")
    assert result.exit_code == 0, result.output
    lines = [
        line.strip() for line in (tmp_path / "rig.yaml").read_text("utf-8").splitlines() if "background:" in line
    ]
    assert len(lines) == 1
    assert lines[0].startswith("# background: [0.0, ")
    assert lines[0].endswith("used unless a camera detects the board in it")


def test_the_draft_has_the_empty_start_as_background(drafted: Path, simulated: Path) -> None:
    window, truth = load_rig(drafted).capture.background, load_rig(simulated / "rig.yaml").capture.background
    assert window is not None
    assert truth is not None
    assert truth[1] - 0.5 <= window[1] <= truth[1]


def test_without_a_board_the_draft_says_where_to_get_one(run: Run, simulated: Path, tmp_path: Path) -> None:
    assert run("init", simulated / "recording", "-o", tmp_path / "rig.yaml").exit_code == 0
    with pytest.raises(InputError, match="calgraph board prints"):
        load_rig(tmp_path / "rig.yaml")


def test_a_plain_folder_is_drafted(run: Run, tmp_path: Path, board: Path) -> None:
    (tmp_path / "data" / "lidar").mkdir(parents=True)
    np.savez(tmp_path / "data" / "lidar" / "12.5.npz", points=np.eye(3))
    (tmp_path / "data" / "scan").mkdir()
    np.savez(tmp_path / "data" / "scan" / "12.5.npz", ranges=np.ones(4), angle_min=0, angle_increment=0.1)
    assert run("init", tmp_path / "data", "-o", tmp_path / "rig.yaml", "--board", board).exit_code == 0
    rig = load_rig(tmp_path / "rig.yaml")
    assert {name: sensor.kind for name, sensor in rig.sensors.items()} == {"lidar": "lidar3d", "laser": "lidar2d"}


def test_the_flat_clouds_of_a_real_recording_are_a_2d_scanner(
    run: Run, tmp_path: Path, data_dir: Path, board: Path
) -> None:
    recording = data_dir / "acfr-rpg-camera-2dlidar"
    assert run("init", recording, "-o", tmp_path / "rig.yaml", "--board", board).exit_code == 0
    rig = load_rig(tmp_path / "rig.yaml")
    assert {sensor.topic: sensor.kind for sensor in rig.sensors.values()} == {
        "images": "camera",
        "lasers": "lidar2d",
    }


def test_two_real_scanners_are_named_after_their_topics(
    run: Run, tmp_path: Path, data_dir: Path, board: Path
) -> None:
    bag = data_dir / "two-static-2d-lidars-moving-object" / "scans_demo.bag"
    assert run("init", bag, "-o", tmp_path / "rig.yaml", "--board", board).exit_code == 0
    rig = load_rig(tmp_path / "rig.yaml")
    assert {name: s.topic for name, s in rig.sensors.items()} == {"front": "/front_scan", "rear": "/rear_scan"}


def test_a_drive_is_drafted_with_surroundings(run: Run, tmp_path: Path) -> None:
    simulated = run("simulate", "drive", "-o", tmp_path / "drive", "--duration", "12", "--rig", "two_scanners")
    assert simulated.exit_code == 0, simulated.output
    result = run("init", tmp_path / "drive" / "recording", "-o", tmp_path / "rig.yaml")
    assert result.exit_code == 0, result.output
    assert "it is of a robot that drives, as what scanners measure changes in" in " ".join(result.stderr.split())
    draft, truth = load_rig(tmp_path / "rig.yaml"), load_rig(tmp_path / "drive" / "rig.yaml")
    assert draft.is_drive
    assert {s.topic: s.kind for s in draft.sensors.values()} == {s.topic: s.kind for s in truth.sensors.values()}


def test_lidars_in_a_hall_are_drafted_with_people(run: Run, tmp_path: Path) -> None:
    simulated = run("simulate", "network", "-o", tmp_path / "hall", "--lidars", "2", "--duration", "11")
    assert simulated.exit_code == 0, simulated.output
    result = run("init", tmp_path / "hall" / "recording", "-o", tmp_path / "rig.yaml")
    assert result.exit_code == 0, result.output
    assert "it is of LiDARs that are fixed in a building, as 3-D LiDARs are at rest" in " ".join(
        result.stderr.split()
    )
    draft, truth = load_rig(tmp_path / "rig.yaml"), load_rig(tmp_path / "hall" / "rig.yaml")
    assert draft.target == truth.target
    assert {s.topic: s.kind for s in draft.sensors.values()} == {s.topic: s.kind for s in truth.sensors.values()}


def test_an_existing_file_is_kept(run: Run, simulated: Path, drafted: Path) -> None:
    drafted.write_text("mine")
    result = run("init", simulated / "recording", "-o", drafted)
    assert (result.exit_code, drafted.read_text()) == (2, "mine")
    assert "give --force to overwrite it" in result.stderr


def test_an_existing_file_is_overwritten_by_force(run: Run, simulated: Path, drafted: Path, board: Path) -> None:
    drafted.write_text("mine")
    assert run("init", simulated / "recording", "-o", drafted, "--force", "--board", board).exit_code == 0
    assert load_rig(drafted).root == "lidar"


def test_a_recording_without_sensors_is_refused_with_its_topics(run: Run, tmp_path: Path) -> None:
    with RecordingWriter(tmp_path / "bag") as writer:
        writer.write("/trigger", Trigger(1.0))
    result = run("init", tmp_path / "bag", "-o", tmp_path / "rig.yaml")
    assert (result.exit_code, (tmp_path / "rig.yaml").exists()) == (2, False)
    assert "no topic with usable images, laser scans or point clouds; its topics are: /trigger (" in result.stderr


def write_numbered(folder: Path) -> None:
    for sensor in ("cam0", "lidar"):
        (folder / sensor).mkdir(parents=True)
        for number in range(4):
            if sensor == "cam0":
                cv2.imwrite(str(folder / sensor / f"img_{number:03}.png"), np.zeros((48, 64), np.uint8))
            else:
                np.savez(folder / sensor / f"pose{number}.npz", points=np.eye(3))


def write_corners(folder: Path) -> None:
    """Of a board that moves all the time, in frames 0.1 s apart."""
    folder.mkdir()
    rows = ["sync_index,cam_id,frame_time,img_loc_x,img_loc_y,obj_loc_x,obj_loc_y"]
    rows += [
        f"{i},{c},{100 + 0.1 * i + 0.004 * c},{50 + 9 * i},{60 + 7 * k},{0.1 * k},0"
        for i in range(40)
        for c in (0, 1)
        for k in (1, 2, 3)
    ]
    (folder / "xy.csv").write_text("\n".join(rows))


def write_videos(folder: Path) -> None:
    """Of something that moves, and rests for a second now and then."""
    folder.mkdir()
    images = [np.zeros((96, 128), np.uint8) for _ in range(60)]
    position = 0
    for i, image in enumerate(images):
        position += 7 if i % 20 < 5 else 0
        image[20:60, position : position + 40] = 255
    for name in ("left.mkv", "right.mkv"):
        write_video(folder / name, images, [0.1 * i for i in range(60)])


@pytest.mark.parametrize(
    ("write", "topics", "mode"),
    [
        (write_numbered, {"cam0", "lidar"}, "snapshots"),
        (write_corners, {"cam_0", "cam_1"}, "synchronized"),
        (write_videos, {"left", "right"}, None),
    ],
)
def test_the_draft_and_the_inspection_state_how_the_board_is_shown(
    run: Run, tmp_path: Path, board: Path, write: Callable[[Path], None], topics: set[str], mode: str | None
) -> None:
    write(tmp_path / "data")
    assert run("init", tmp_path / "data", "-o", tmp_path / "rig.yaml", "--board", board).exit_code == 0
    rig = load_rig(tmp_path / "rig.yaml")
    assert {sensor.topic for sensor in rig.sensors.values()} == topics
    assert rig.capture.mode == mode
    assert "ros2" not in (tmp_path / "rig.yaml").read_text()
    inspected = json.loads(run("inspect", tmp_path / "data", "--json").stdout)
    assert inspected["captures"]["mode"] == (mode or "rest")
    assert f"captures: {mode or 'rest'}: " in run("inspect", tmp_path / "data").stdout


def test_a_message_that_is_damaged_does_not_keep_a_recording_from_being_drafted(
    run: Run, tmp_path: Path, board: Path
) -> None:
    write_videos(tmp_path / "data")
    for name in ("left.mkv", "right.mkv"):
        data = bytearray((tmp_path / "data" / name).read_bytes())
        data[len(data) // 2 : len(data) // 2 + 300] = bytes(300)
        (tmp_path / "data" / name).write_bytes(bytes(data))
    assert run("init", tmp_path / "data", "-o", tmp_path / "rig.yaml", "--board", board).exit_code == 0
    assert len(load_rig(tmp_path / "rig.yaml").sensors) == 2
