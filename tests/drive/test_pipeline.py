"""Whole drives: from simulated messages to poses, and the reasons where there are none."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from calgraph.calibration.dispatch import calibrate
from calgraph.config import Rig, Tolerance
from calgraph.drive.options import DriveOptions
from calgraph.drive.pipeline import calibrate_drive
from calgraph.drive.start import MotionStart, explain_failure
from calgraph.errors import InputError
from calgraph.geometry import Array, se3, so3
from calgraph.io.text_writing import save_yaml
from calgraph.recording import MessageRecording, RecordingWriter, open_recording
from calgraph.result import read_extrinsics
from calgraph.result.extrinsics_file import PriorFile
from calgraph.rig.options import RigOptions
from calgraph.sensors import LaserScan
from calgraph.simulation import STANDARD_RIGS, DriveScenario, simulate_drive
from drive_scenes import scan_drive


def surroundings(kind: str, **topics: str) -> Rig:
    sensors = {name: {"kind": kind, "topic": topic} for name, topic in topics.items()}
    return Rig.model_validate({"root": next(iter(topics)), "target": {"kind": "surroundings"}, "sensors": sensors})


@pytest.mark.slow
def test_lidars_without_a_common_view_are_calibrated_from_a_drive() -> None:
    """Errors of the simulator that the estimator does not have: relief, people, rings, a swinging body."""
    sensors = tuple(replace(one, step=1.6) for one in STANDARD_RIGS["two_lidars"])
    drive = simulate_drive(DriveScenario(seed=1, duration=25.0, sensors=sensors))
    rig = surroundings("lidar3d", lidar_front="/lidar_front/points", lidar_rear="/lidar_rear/points")
    rig = rig.model_copy(update={"tolerance": Tolerance(translation=0.05, rotation=1.0)})
    calibration = calibrate_drive(rig, drive.recording, DriveOptions())
    rear = calibration["lidar_rear"]
    error = se3.difference(rear.T_root_sensor, drive.truth.T_root_sensor["lidar_rear"])
    assert np.linalg.norm(error[:3]) < 0.02
    assert np.degrees(np.linalg.norm(error[3:])) < 0.2
    assert rear.clock_offset == pytest.approx(drive.truth.clock_offsets["lidar_rear"], abs=0.002)
    assert rear.verdict.grade == "good", rear.verdict.reason


ANGLES = np.radians(np.arange(-90, 90, 1.0))


def room_scans(positions: Array, headings: Array, turn: float) -> list[LaserScan]:
    """Scans at 10 Hz in a room of 8 by 6 m, of a scanner that is turned on the robot."""
    scans = []
    for k, ((x, y), heading) in enumerate(zip(positions, headings, strict=True)):
        c, s = np.cos(ANGLES + heading + turn), np.sin(ANGLES + heading + turn)
        with np.errstate(divide="ignore"):
            ranges = np.minimum(
                np.where(c > 0, (4 - x) / c, (-4 - x) / c), np.where(s > 0, (3 - y) / s, (-3 - y) / s)
            )
        scans.append(LaserScan(0.1 * k, "laser", ANGLES, ranges))
    return scans


def test_a_straight_drive_calibrates_nothing_and_says_so() -> None:
    positions = np.stack([np.linspace(-2, 2, 200), np.zeros(200)], axis=1)
    messages = {
        f"/{name}": room_scans(positions, np.zeros(200), turn) for name, turn in (("a", 0.0), ("b", np.pi))
    }
    calibration = calibrate_drive(
        surroundings("lidar2d", a="/a", b="/b"), MessageRecording(messages), DriveOptions()
    )
    assert [sensor.name for sensor in calibration.sensors] == ["a"]
    assert calibration["a"].verdict.grade == "unobservable"
    assert list(calibration.evidence.unconnected) == ["b"]
    assert "the robot turned at a constant rate" in calibration.evidence.unconnected["b"]


def test_a_sensor_with_few_sweeps_has_a_reason() -> None:
    positions = np.stack([np.linspace(-1, 1, 60), np.zeros(60)], axis=1)
    scans = room_scans(positions, np.linspace(0, 2, 60), 0.0)
    recording = MessageRecording({"/a": scans, "/b": scans[:10]})
    calibration = calibrate_drive(surroundings("lidar2d", a="/a", b="/b"), recording, DriveOptions())
    assert calibration.evidence.unconnected == {"b": "it has 10 sweeps with points; a drive needs 50"}


def test_scans_that_were_sent_twice_count_once() -> None:
    """The second copy of a scan is at the same time as the first."""
    phase = np.linspace(0, 6, 150)
    positions = np.stack([1.5 * np.sin(phase), 0.8 * np.sin(1.5 * phase)], axis=1)
    scans = room_scans(positions, 0.5 * np.sin(2 * phase), 0.0)
    recording = MessageRecording({"/a": scans, "/b": [scan for scan in scans for _ in range(2)]})
    calibration = calibrate_drive(surroundings("lidar2d", a="/a", b="/b"), recording, DriveOptions())
    np.testing.assert_allclose(calibration["b"].T_root_sensor, np.eye(4), atol=0.01)


def test_a_stated_pose_that_is_wrong_is_named(tmp_path: Path) -> None:
    """By 50 mm at a stated 5 mm, where the drive itself has a centimetre."""
    phase = np.linspace(0, 6, 150)
    positions = np.stack([1.5 * np.sin(phase), 0.8 * np.sin(1.5 * phase)], axis=1)
    scans = room_scans(positions, 0.5 * np.sin(2 * phase), 0.0)
    transform = {"translation": {"x": 0.05, "y": 0.0, "z": 0.0}, "rotation": {"x": 0, "y": 0, "z": 0, "w": 1}}
    save_yaml(
        tmp_path / "poses.yaml", {"transforms": [{"frame_id": "a", "child_frame_id": "b", "transform": transform}]}
    )
    prior = PriorFile(read_extrinsics(tmp_path / "poses.yaml"), (0.005, 0.01))
    calibration = calibrate_drive(
        surroundings("lidar2d", a="/a", b="/b"), MessageRecording({"/a": scans, "/b": scans}),
        DriveOptions(prior=prior),
    )  # fmt: skip
    assert calibration["b"].verdict.grade == "weak"
    assert "the prior of b disagrees with the drive by" in calibration["b"].verdict.reason


def start(turns: tuple[float, ...], correlation: float = 0.99, inliers: float = 0.8) -> MotionStart:
    return MotionStart(np.eye(4), 0.0, inliers, correlation, 50, np.array(turns))


@pytest.mark.parametrize(
    ("one", "reason"),
    [
        (start((0.1, 0.05, 0.01)), ""),
        (start((0.1,)), ""),
        (start((0.1, 0.05, 0.01), correlation=0.5), "turn rates do not agree"),
        (replace(start((0.5,), correlation=0.1), turn_change=0.02), "turned at a constant rate (± 1.1° in 1.5 s)"),
        (start((0.02, 0.02, 0.01)), "hardly turned"),
        (start((0.1, 0.01, 0.01)), "about one axis only"),
        (start((0.1, 0.05, 0.01), inliers=0.2), "only 20% of its motions"),
        (
            replace(start((0.1, 0.05, 0.01), inliers=6 / 11), motions=11, by_boards=True),
            "only 6 of its 11 motions together with the root agree with one pose, 7 are needed",
        ),
        (replace(start((0.1,)), travel=0.1), "turned about one point only (other motion is 0.10 m in 1.5 s)"),
    ],
)
def test_a_start_that_the_drive_does_not_determine_is_explained(one: MotionStart, reason: str) -> None:
    explained = explain_failure(one, "lidar")
    assert reason in explained
    assert bool(explained) == bool(reason)


def test_cameras_need_boards_in_their_surroundings() -> None:
    content: dict[str, Any] = {
        "root": "camera",
        "target": {"kind": "surroundings"},
        "sensors": {"camera": {"kind": "camera", "topic": "/c"}},
    }
    with pytest.raises(ValueError, match=r"must list the boards in the room that cameras detect \(camera\)"):
        Rig.model_validate(content)
    board = {"size": [0.5, 0.5], "tags": [{"id": 0, "size": 0.3}]}
    rig = Rig.model_validate({**content, "target": {"kind": "surroundings", "boards": [board]}})
    assert len(rig.boards) == 1
    content["sensors"]["camera"]["kind"] = "depth_camera"
    with pytest.raises(ValueError, match=r"must be one of .*gyroscope with surroundings, got depth_camera"):
        Rig.model_validate(content)


def test_options_of_rigs_are_refused_for_drives() -> None:
    rig = surroundings("lidar2d", a="/a", b="/b")
    recording = MessageRecording({"/a": room_scans(np.zeros((1, 2)), np.zeros(1), 0.0)})
    with pytest.raises(InputError, match="must be DriveOptions for this target, got RigOptions"):
        calibrate(rig, recording, RigOptions())


def test_progress_begins_with_each_step() -> None:
    positions = 1.5 * np.stack([np.sin(np.linspace(0, 6, 200)), np.cos(np.linspace(0, 6, 200))], axis=1)
    headings = np.linspace(0, 6, 200) + 0.5 * np.sin(np.linspace(0, 20, 200))
    messages = {f"/{name}": room_scans(positions, headings, turn) for name, turn in (("a", 0.0), ("b", np.pi))}
    steps: list[tuple[str, float]] = []
    calibration = calibrate_drive(
        surroundings("lidar2d", a="/a", b="/b"),
        MessageRecording(messages),
        DriveOptions(),
        lambda step, done: steps.append((step, done)),
    )
    shares = {step: [done for one, done in steps if one == step] for step, _ in steps}
    assert list(shares) == ["reading", "odometry", "adjusting"]
    for step, done in shares.items():
        assert done[0] == 0.0, step
        assert done[-1] == 1.0, step
        assert sorted(done) == done, step
    assert len(shares["reading"]) > 100
    # What the report shows is of the same drive.
    assert [view.sensor for view in calibration.pictures.drive_views] == ["a", "b"]
    assert calibration.pictures.drive_paths[0].times[-1] == pytest.approx(19.9, abs=0.2)


@pytest.mark.slow
def test_a_clock_that_is_hours_off_is_corrected_by_arrivals(tmp_path: Path) -> None:
    off, T = 7351.3, se3.pose(so3.exp(np.array([0.0, 0.0, 3.0])), np.array([-0.8, 0.2, 0.0]))
    with RecordingWriter(tmp_path / "drive") as writer:
        for topic, scans in scan_drive({"front": np.eye(4), "rear": T}, 24.0).items():
            for one in scans:
                stamp = 1e9 + one.stamp
                late = off if topic == "/rear" else 0.0
                writer.write(topic, replace(one, stamp=stamp + late), stamp + 0.02)
    rig = surroundings("lidar2d", front="/front", rear="/rear")
    with open_recording(tmp_path / "drive") as recording:
        found = calibrate_drive(rig, recording, DriveOptions())
    rear = found["rear"]
    assert rear.clock_offset == pytest.approx(off, abs=0.01)
    assert np.linalg.norm(rear.T_root_sensor[:2, 3] - T[:2, 3]) < 0.02
    assert any("the stamps of rear" in one and "were corrected" in one for one in found.evidence.remarks)
