"""What people get wrong: each mistake ends in one of calgraph's own errors, which says what it is."""

import re
from dataclasses import replace

import numpy as np
import pytest

from calgraph.config import Rig
from calgraph.errors import CalibrationError, InputError
from calgraph.recording import Recording
from calgraph.sensors import Image, LaserScan, Message, PointCloud, RecordedMessage
from calgraph.simulation import CameraOptions, LaserOptions, MultibeamOptions, RigScenario, SpinningOptions
from simulated_rigs import (
    SimulatedRecording,
    alter_messages,
    build_recording,
    calibrate,
    keep_decoded,
    simulate_scenario,
)

pytestmark = pytest.mark.slow

CAMERA, FRONT, CLOUD = "/camera/image_raw/compressed", "/laser_front/scan", "/lidar/points"
SCENARIO = RigScenario(
    camera=CameraOptions(width=320, height=240, texels_per_mm=0.5, rate=2.0),
    laser=LaserOptions(count=1, rate=4.0, resolution=1.0),
    spinning=SpinningOptions(count=0),
    multibeam=MultibeamOptions(count=1, rate=2.0, rings=16, resolution=1.0),
    bearings=(-10, 0, 10),
    radii=(1.8,),
    samples=1,
    clutter=2,
)


@pytest.fixture(scope="module")
def staged_rig() -> tuple[Rig, SimulatedRecording]:
    rig, recording, _ = simulate_scenario(SCENARIO)
    return rig, keep_decoded(recording)


def changed(rig: Rig, path: str, value: object) -> Rig:
    """The rig with one key, as a path of keys, set to a value, or left out for None."""
    content = rig.model_dump(mode="json", exclude_none=True)
    *parents, key = path.split(".")
    place = content
    for parent in parents:
        place = place[parent]
    place[key] = value
    if value is None:
        del place[key]
    return Rig.model_validate(content)


def empty(message: Message) -> Message:
    """The message with nothing measured."""
    match message:
        case LaserScan():
            return replace(message, ranges=np.full_like(message.ranges, np.nan))
        case PointCloud():
            return replace(message, points=np.zeros((0, 3)), rings=None, times=None)
        case Image():
            return replace(message, pixels=np.zeros_like(message.pixels))
    return message


def unstamped(record: RecordedMessage) -> RecordedMessage:
    return replace(record, stamp=0.0)


@pytest.mark.parametrize(
    ("path", "value", "message"),
    [
        ("capture.trigger", "/triger", "did you mean '/trigger'"),
        ("capture.trigger", FRONT, "capture.trigger: /laser_front/scan is the topic of the sensor laser_front"),
        ("capture.background", [500.0, 505.0], r"capture.background: \[500, 505\] s lies after the end"),
        ("sensors.laser_front.topic", "/laser_front/scam", "did you mean '/laser_front/scan'"),
        ("sensors.laser_front.topic", "/camera/camera_info", "has CameraInfo messages"),
        ("sensors.camera.camera_info", "/camera/info", "has no topic '/camera/info'"),
        ("sensors.camera.camera_info", FRONT, "holds no CameraInfo"),
        (
            "sensors.camera",
            {
                "kind": "camera",
                "topic": CAMERA,
                "intrinsics": {"width": 640, "height": 480, "K": [320, 320, 320, 240]},
            },
            "320x240, its intrinsics are for 640x480",
        ),
    ],
)  # fmt: skip
def test_a_rig_that_does_not_fit_its_recording_is_bad_input(
    staged_rig: tuple[Rig, Recording], path: str, value: object, message: str
) -> None:
    rig, recording = staged_rig
    with pytest.raises(InputError, match=message):
        calibrate(changed(rig, path, value), recording)


@pytest.mark.parametrize("topics", [(FRONT,), (FRONT, CLOUD, CAMERA)])
def test_stamps_that_stand_still_are_bad_input(
    staged_rig: tuple[Rig, SimulatedRecording], topics: tuple[str, ...]
) -> None:
    rig, recording = staged_rig
    still = build_recording(unstamped(r) if r.topic in topics else r for r in recording.messages)
    with pytest.raises(InputError, match=r"messages have the header stamp 0\.000 s"):
        calibrate(rig, still)


def test_a_clock_far_from_the_others_is_bad_input(staged_rig: tuple[Rig, SimulatedRecording]) -> None:
    rig, recording = staged_rig
    """Its messages arrive at the times of its stamps, and three moves of the board do not tell the offset."""
    off = build_recording(
        replace(r, stamp=r.stamp + 3600, arrival=r.arrival + 3600) if r.topic == FRONT else r
        for r in recording.messages
    )
    with pytest.raises(InputError, match=r"sensors\.laser_front: its header stamps run from .* clocks differ"):
        calibrate(rig, off)


def test_a_background_window_that_covers_all_triggers_leaves_nothing(
    staged_rig: tuple[Rig, SimulatedRecording],
) -> None:
    rig, recording = staged_rig
    with pytest.raises(CalibrationError, match=r"all 3 messages of /trigger lie .*make"):
        calibrate(changed(rig, "capture.background", [0.0, 60.0]), recording)


def test_a_recording_that_ends_with_the_background_leaves_nothing(
    staged_rig: tuple[Rig, SimulatedRecording],
) -> None:
    rig, recording = staged_rig
    short = build_recording(r for r in recording.messages if r.arrival < recording.start + 3)
    with pytest.raises(
        CalibrationError, match=r"all \d+ sets of frames lie in capture\.background or capture\.exclude"
    ):
        calibrate(changed(rig, "capture.trigger", None), short)


def test_one_sensor_alone_is_not_calibrated(staged_rig: tuple[Rig, SimulatedRecording]) -> None:
    rig, recording = staged_rig
    only = changed(rig, "sensors", {"lidar": rig.model_dump(mode="json", exclude_none=True)["sensors"]["lidar"]})
    with pytest.raises(CalibrationError, match=r"lidar is the only sensor: a rig\.yaml needs at least two"):
        calibrate(only, recording)


def test_sensors_that_see_nothing_each_say_why(staged_rig: tuple[Rig, SimulatedRecording]) -> None:
    rig, recording = staged_rig
    for topic in (FRONT, CLOUD, CAMERA):
        recording = alter_messages(recording, topic, empty)
    calibration = calibrate(rig, recording)
    (root,) = calibration.sensors
    assert (root.name, root.verdict.grade) == (rig.root, "unobservable")
    assert root.verdict.reason == "no other sensor has a pose relative to it"
    assert "detected the board in none of 3 captures" in calibration.evidence.unconnected["camera"]
    assert "too dark" in calibration.evidence.unconnected["camera"]
    assert "the root lidar detected the board in none of 3 captures" in calibration.evidence.unconnected["camera"]


def test_sensors_that_see_nothing_without_trigger_are_named(staged_rig: tuple[Rig, SimulatedRecording]) -> None:
    rig, recording = staged_rig
    for topic in (FRONT, CLOUD, CAMERA):
        recording = alter_messages(recording, topic, empty)
    blind = changed(changed(rig, "capture.trigger", None), "capture.background", None)
    assert set(calibrate(blind, recording).evidence.unconnected) == set(rig.sensors) - {rig.root}


def test_a_board_of_another_size_is_distinguished_from_the_detected_one(
    staged_rig: tuple[Rig, SimulatedRecording],
) -> None:
    rig, recording = staged_rig
    calibration = calibrate(changed(rig, "target.size", [9.0, 9.0]), recording)
    assert re.search(r"the longest is .* m, the board 9 x 9 m", calibration.evidence.unconnected["laser_front"])
