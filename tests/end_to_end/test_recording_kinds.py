"""Recordings of every kind that people have: simulated ones are calibrated, and compared with the truth."""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import cv2
import numpy as np
import pytest
from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin, Writer
from rosbags.typesys import Stores, get_typestore

from calgraph.boards.chessboards import CharucoFinder
from calgraph.config import Board, Charuco, Rig
from calgraph.recording import RecordingWriter, open_recording, open_recordings, resolve_intrinsics
from calgraph.result import Calibration
from calgraph.sensors import Image, PointCloud, RecordedMessage
from calgraph.simulation import (
    CameraOptions,
    GroundTruth,
    LaserOptions,
    MultibeamOptions,
    RigScenario,
    SpinningOptions,
)
from calgraph.simulation.rig_simulation import TRIGGER_TOPIC
from simulated_rigs import SimulatedRecording, build_recording, calibrate, pose_errors, simulate_scenario
from videos import write_video

pytestmark = pytest.mark.slow

CAMERA, LIDAR = "/camera/image_raw/compressed", "/lidar/points"
SCENARIO = RigScenario(
    camera=CameraOptions(width=480, height=360, texels_per_mm=0.5, rate=4.0),
    laser=LaserOptions(count=0),
    spinning=SpinningOptions(count=0),
    multibeam=MultibeamOptions(count=1, rate=4.0, rings=32, resolution=0.4),
    bearings=(-30, -20, -15, -10, 0, 10, 15, 20, 30),
    radii=(1.8,),
    samples=1,
    clutter=2,
    move_time=0.3,
    background=1.0,
)


@dataclass(frozen=True)
class Poses:
    """What the sensors of a simulated robot measure of a board that rests, one message a sensor and pose."""

    rig: Rig
    images: tuple[Image, ...]
    clouds: tuple[PointCloud, ...]
    truth: GroundTruth

    def rig_of(self, topics: Mapping[str, str], **capture: object) -> Rig:
        """The rig with the topics of other files, and other captures."""
        content = self.rig.model_dump(mode="json", exclude_none=True)
        content["sensors"] = {name: {**content["sensors"][name], "topic": topic} for name, topic in topics.items()}
        return Rig.model_validate({**content, "capture": capture})


@pytest.fixture(scope="module")
def poses() -> Poses:
    rig, recording, truth = simulate_scenario(SCENARIO, seed=3)
    triggers = [record.stamp for record in recording.records([TRIGGER_TOPIC])]

    def first_of(topic: str) -> list[object]:
        records = list(recording.records([topic]))
        return [next(r for r in records if r.stamp >= trigger).decode() for trigger in triggers]

    images = tuple(message for message in first_of(CAMERA) if isinstance(message, Image))
    clouds = tuple(message for message in first_of(LIDAR) if isinstance(message, PointCloud))
    assert len(images) == len(clouds) == len(triggers) == 9
    return Poses(resolve_intrinsics(rig, recording), images, clouds, truth)


def check_pose(calibration: Calibration, truth: GroundTruth, sensor: str = "camera") -> None:
    error = pose_errors(calibration, truth)[sensor]
    assert np.linalg.norm(error[:3]) < 0.02
    assert np.degrees(np.linalg.norm(error[3:])) < 0.6


def test_a_folder_of_numbered_files_is_snapshots(poses: Poses, tmp_path: Path) -> None:
    """Numbers with gaps, another file beside, a cloud without image."""
    for folder in ("cam 0", "lidar", "previews"):
        (tmp_path / folder).mkdir()
    (tmp_path / "previews" / "best of 2024-03-01.png").write_bytes(b"")
    for number, (image, cloud) in enumerate(zip(poses.images, poses.clouds, strict=True), start=9):
        if number != 10:
            cv2.imwrite(str(tmp_path / "cam 0" / f"img_{number:04}.png"), image.pixels)
        np.savez(tmp_path / "lidar" / f"pose{number}_full.npz", points=cloud.points)
    with open_recording(tmp_path) as recording:
        found = calibrate(poses.rig_of({"camera": "cam 0", "lidar": "lidar"}), recording)
    assert found.evidence.edges[0].captures == 8
    check_pose(found, poses.truth)


def carry(poses: Poses, clock_offset: float) -> SimulatedRecording:
    """The board rests for irregular times, and something moves in between; the LiDAR has a clock of its own."""
    rng = np.random.default_rng(2)
    moves = 100 + np.cumsum(rng.uniform(2.0, 5.0, len(poses.images)))
    rests = moves + rng.uniform(0.6, 1.2, len(moves))
    records = []
    for time in np.arange(moves[0], moves[-1] + 4, 0.2):
        number = int(np.searchsorted(moves, time, side="right")) - 1
        image, cloud = poses.images[number], poses.clouds[number]
        if moves[number] <= time < rests[number]:
            image = replace(image, pixels=np.roll(image.pixels, rng.integers(20, 200), axis=1))
            cloud = replace(cloud, points=cloud.points + np.array([0, 0, rng.uniform(0.3, 0.6)]))
        for topic, message in (
            ("cam", replace(image, stamp=time)),
            ("lidar", replace(cloud, stamp=time + 0.07 + clock_offset)),
        ):
            records.append(RecordedMessage(topic, message.stamp, time, partial(replace, message)))
    return build_recording(records)


def test_sensors_may_have_clocks_of_their_own(poses: Poses) -> None:
    rig = poses.rig_of({"camera": "cam", "lidar": "lidar"})
    camera = rig.sensors["camera"].model_copy(update={"clock_offset": "estimate"})
    rig = rig.model_copy(update={"sensors": {**rig.sensors, "camera": camera}})
    found = calibrate(rig, carry(poses, clock_offset=-3.7))
    [remark] = [one for one in found.evidence.remarks if "the clock of camera minus that of the others" in one]
    # The clouds are stamped 0.07 s late, and both sensors measure every 0.2 s.
    assert float(remark.split(" is ")[1].split(" s,")[0]) == pytest.approx(3.63, abs=0.15)
    # Rests shorter than a second may be missed where clocks are known to a tenth.
    assert found.evidence.edges[0].captures >= 8
    check_pose(found, poses.truth)


def test_snapshots_may_follow_each_other_closely_and_drivers_answer_late(poses: Poses) -> None:
    """Poses are 1.2 to 3 s apart; the LiDAR answers half a second late, twice not at all, and sends two clouds."""
    stamps = 1e9 + np.cumsum(np.random.default_rng(0).uniform(1.2, 3.0, len(poses.images)))
    records = []
    for number, (image, cloud) in enumerate(zip(poses.images, poses.clouds, strict=True)):
        messages: list[tuple[str, Image | PointCloud]] = [("cam", replace(image, stamp=stamps[number]))]
        if number not in (2, 5):
            late = stamps[number] + 0.5
            messages += [("lidar", replace(cloud, stamp=late)), ("lidar", replace(cloud, stamp=late + 0.1))]
        records += [RecordedMessage(topic, m.stamp, m.stamp, partial(replace, m)) for topic, m in messages]
    found = calibrate(poses.rig_of({"camera": "cam", "lidar": "lidar"}), build_recording(records))
    assert found.evidence.edges[0].captures == 7
    check_pose(found, poses.truth)


def test_each_of_several_short_recordings_is_a_pose(poses: Poses, tmp_path: Path) -> None:
    """Clocks of the sensors start at 0 in each, and the LiDAR is two seconds late."""
    paths = []
    for number, (image, cloud) in enumerate(zip(poses.images, poses.clouds, strict=True)):
        paths.append(tmp_path / f"pose {number}")
        with RecordingWriter(paths[-1]) as writer:
            writer.write("/cam", replace(image, stamp=0.5), 0.5)
            writer.write("/lidar", replace(cloud, stamp=2.5), 2.5)
    with open_recordings(paths) as recording:
        found = calibrate(poses.rig_of({"camera": "/cam", "lidar": "/lidar"}), recording)
    assert found.evidence.edges[0].captures == 9
    check_pose(found, poses.truth)


def test_two_recordings_of_one_rig_from_the_same_stamp_on_give_the_captures_of_both(tmp_path: Path) -> None:
    """Overlapping stamps: the captures of the second were dropped without a word."""
    paths, sigmas, poses = [], [], []
    for name, bearings in (("first", (-30, -15, 0, 15, 30)), ("second", (-22, -7, 7, 22))):
        rig, recording, truth = simulate_scenario(SCENARIO.model_copy(update={"bearings": bearings}), seed=11)
        paths.append(tmp_path / name)
        with RecordingWriter(paths[-1]) as writer:
            for record in recording.records():
                writer.write(record.topic, record.decode(), record.arrival)
        poses.append(truth)
    assert poses[0].T_root_sensor["camera"] == pytest.approx(poses[1].T_root_sensor["camera"])
    for given in (paths[:1], paths):
        with open_recordings(given) as opened:
            found = calibrate(rig, opened)
        assert found.evidence.edges[0].captures == 5 + 4 * (len(given) - 1)
        check_pose(found, poses[0])
        sigmas.append(np.sqrt(np.diag(found.covariance("lidar", "camera"))[:3]).max())
    assert sigmas[1] < 0.9 * sigmas[0]


def test_a_video_beside_clouds_is_searched_for_holds(tmp_path: Path) -> None:
    """Its times count from its first frame, as those in the names of the clouds do; there is no trigger."""
    rig, recording, truth = simulate_scenario(SCENARIO.model_copy(update={"hold_time": 1.2}), seed=4)
    records = list(recording.records([CAMERA]))
    images = [message for record in records if isinstance(message := record.decode(), Image)]
    start = images[0].stamp
    write_video(tmp_path / "cam0.mp4", [i.pixels for i in images], [i.stamp - start for i in images])
    (tmp_path / "lidar").mkdir()
    for record in recording.records([LIDAR]):
        cloud = record.decode()
        assert isinstance(cloud, PointCloud)
        if record.stamp >= start:
            np.savez(tmp_path / "lidar" / f"{record.stamp - start:.6f}.npz", points=cloud.points)
    poses = Poses(resolve_intrinsics(rig, recording), (), (), truth)
    with open_recording(tmp_path) as video:
        found = calibrate(poses.rig_of({"camera": "cam0", "lidar": "lidar"}), video)
    assert found.evidence.edges[0].captures >= 7
    check_pose(found, truth)


def test_corners_of_another_program_are_calibrated(tmp_path: Path) -> None:
    """Two cameras and a ChArUco board, whose corners another detector finds; frames of one index are one pose."""
    pattern = Charuco(kind="charuco", columns=8, rows=6, square=0.14, marker=0.1, dictionary="DICT_5X5_100")
    scenario = SCENARIO.model_copy(
        update={
            "board": Board(size=(1.2, 0.9), pattern=pattern),
            "camera": CameraOptions(count=2, width=640, height=480, texels_per_mm=0.5, rate=4.0),
            "multibeam": MultibeamOptions(count=0),
            "bearings": (-12, -9, -6, -3, 0, 3, 6, 9, 12),
        }
    )
    rig, recording, truth = simulate_scenario(scenario, seed=5)
    triggers = [record.stamp for record in recording.records([TRIGGER_TOPIC])]
    finder = CharucoFinder(pattern)
    rows = ["sync_index,cam_id,img_loc_x,img_loc_y,obj_loc_x,obj_loc_y"]
    for camera, topic in enumerate(rig.topics.values()):
        records = list(recording.records([topic]))
        for pose, trigger in enumerate(triggers):
            image = next(record for record in records if record.stamp >= trigger).decode()
            assert isinstance(image, Image)
            marks = finder.find(image.gray)
            for corner, (u, v) in zip(marks.ids.tolist(), marks.pixels[:, 0].tolist(), strict=True):
                row, column = divmod(corner, pattern.columns - 1)
                rows.append(f"{pose},{camera},{u},{v},{0.14 * (column + 1)},{0.14 * (row + 1)}")
    (tmp_path / "xy.csv").write_text("\n".join(rows))
    poses = Poses(resolve_intrinsics(rig, recording), (), (), truth)
    with open_recording(tmp_path) as corners:
        found = calibrate(poses.rig_of({name: f"cam_{i}" for i, name in enumerate(rig.sensors)}), corners)
    (other,) = set(rig.sensors) - {rig.root}
    check_pose(found, truth, other)


def test_an_inverted_board_is_calibrated_to() -> None:
    """Black and white exchanged, as rig.yaml states."""
    board = SCENARIO.board.model_copy(update={"inverted": True})
    rig, recording, truth = simulate_scenario(SCENARIO.model_copy(update={"board": board}), seed=6)
    assert rig.boards[0].inverted
    check_pose(calibrate(rig, recording), truth)


def test_a_bag_of_deep_grey_images_is_calibrated(poses: Poses, tmp_path: Path) -> None:
    """Snapshots with true stamps; a camera with 12 bits in mono16, in chunks compressed with zstd."""
    store = get_typestore(Stores.ROS2_HUMBLE)
    types, name = store.types, "sensor_msgs/msg/Image"
    stamps = np.cumsum([4.0, 7, 5, 11, 6, 9, 4, 8, 5]).tolist()
    writer = Writer(tmp_path / "images", version=8, storage_plugin=StoragePlugin.MCAP)
    writer.set_compression(CompressionMode.STORAGE, CompressionFormat.ZSTD)
    with writer:
        connection = writer.add_connection("/deep", name, typestore=store)
        for stamp, image in zip(stamps, poses.images, strict=True):
            pixels = (image.gray.astype("<u2") * 11 + 300).astype("<u2")
            time = types["builtin_interfaces/msg/Time"](sec=int(stamp), nanosec=0)
            message = types[name](
                header=types["std_msgs/msg/Header"](stamp=time, frame_id="camera"), encoding="mono16",
                height=pixels.shape[0], width=pixels.shape[1], step=2 * pixels.shape[1], is_bigendian=0,
                data=np.frombuffer(pixels.tobytes(), np.uint8),
            )  # fmt: skip
            writer.write(connection, int(1e9 * stamp), store.serialize_cdr(message, name))
    with RecordingWriter(tmp_path / "clouds") as clouds:
        for stamp, cloud in zip(stamps, poses.clouds, strict=True):
            clouds.write("/points", replace(cloud, stamp=stamp + 0.2))
    with open_recordings([tmp_path / "images", tmp_path / "clouds"]) as recording:
        found = calibrate(poses.rig_of({"camera": "/deep", "lidar": "/points"}), recording)
    check_pose(found, poses.truth)
