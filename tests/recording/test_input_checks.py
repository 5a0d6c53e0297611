"""Checks of the messages of a recording: frames, topics with the same data, intrinsics that change."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from calgraph.config import Board, CameraSpec, Lidar2dSpec, Rig, Tag
from calgraph.errors import RecordingError
from calgraph.recording import MessageRecording, Recording, RecordingWriter, find_camera_infos, open_recording
from calgraph.recording.input_checks import InputMonitor
from calgraph.result.finding import Finding
from calgraph.sensors import CameraInfo, CameraModel, LaserScan, Message, RecordedMessage

START = 100.0
CAMERA = CameraModel(
    "pinhole", 640, 480, np.array([[500.0, 0, 320], [0, 510, 240], [0, 0, 1]]), np.array([0.1, -0.2, 0.001, 0.002])
)
RIG = Rig(
    root="front",
    target=Board(size=(1, 1), tags=(Tag(id=0, size=0.3),)),
    sensors={
        "front": Lidar2dSpec(topic="/front"),
        "left": Lidar2dSpec(topic="/left"),
        "rear": Lidar2dSpec(topic="/rear"),
    },
)
WITH_CAMERA = RIG.model_copy(
    update={"sensors": {**RIG.sensors, "camera": CameraSpec(topic="/image", camera_info="/info")}}
)


def scans(frame_id: str, seed: int, count: int = 20, beams: int = 1000) -> list[LaserScan]:
    ranges = np.random.default_rng(seed).uniform(1, 9, (count, beams)).astype(np.float32).astype(np.float64)
    angles = np.linspace(-1, 1, beams)
    return [LaserScan(START + 0.5 * k, frame_id, angles, row) for k, row in enumerate(ranges)]


def three_scanners() -> dict[str, Sequence[Message]]:
    return {f"/{name}": scans(f"{name}_link", seed) for seed, name in enumerate(RIG.sensors)}


def reframed(messages: Sequence[Message], frame_id: str) -> list[LaserScan]:
    return [replace(message, frame_id=frame_id) for message in messages if isinstance(message, LaserScan)]


def infos(*cameras: CameraModel) -> list[CameraInfo]:
    return [CameraInfo(START + k, "camera_link", camera) for k, camera in enumerate(cameras)]


def recorded(folder: Path, messages: Mapping[str, Sequence[Message]]) -> Recording:
    """A rosbag2 of the messages."""
    with RecordingWriter(folder / "recording") as writer:
        for topic, sent in messages.items():
            for message in sent:
                writer.write(topic, message)
    return open_recording(folder / "recording")


Check = Callable[..., tuple[Finding, ...]]


@pytest.fixture(params=["bag", "memory"])
def findings(request: pytest.FixtureRequest, tmp_path: Path) -> Check:
    """Checks messages, read from a bag or at hand, and passes every record on."""

    def check(messages: Mapping[str, Sequence[Message]], rig: Rig = RIG) -> tuple[Finding, ...]:
        recording = recorded(tmp_path, messages) if request.param == "bag" else MessageRecording(messages)
        with recording:
            monitor = InputMonitor(rig, recording.start, find_camera_infos(rig, recording))
            passed = list(monitor.observe(recording.records()))
        assert len(passed) == sum(map(len, messages.values()))
        return monitor.findings()

    return check


def with_frame(frame_id: str) -> Rig:
    left = RIG.sensors["left"].model_copy(update={"frame_id": frame_id})
    return RIG.model_copy(update={"sensors": {**RIG.sensors, "left": left}})


# frames


@pytest.mark.parametrize("frame_id", ["left_link", "/left_link"])
def test_sensors_with_their_stated_frames_pass(findings: Check, frame_id: str) -> None:
    assert findings(three_scanners(), with_frame(frame_id)) == ()


def test_a_frame_that_differs_from_rig_yaml_is_remarked(findings: Check) -> None:
    (finding,) = findings(three_scanners(), with_frame("laser_left"))
    assert finding.text.startswith("messages of left state the frame left_link, rig.yaml states laser_left: ")
    assert finding.sensors == ()


def test_a_frame_that_changes_is_remarked_with_its_time(findings: Check) -> None:
    messages = three_scanners()
    messages["/left"] = [*messages["/left"][:12], *reframed(messages["/left"][12:], "rear_link")]
    (finding,) = findings(messages)
    assert finding.text.startswith("messages of left state the frame left_link, and rear_link from 6.0 s on: ")


# topics with the same data


def test_a_topic_that_repeats_another_makes_both_weak(findings: Check) -> None:
    """With another name of the frame, as of a second driver, and without every fourth message."""
    messages = three_scanners()
    messages["/rear"] = reframed([m for k, m in enumerate(messages["/left"]) if k % 4], "the_other_laser")
    (finding,) = findings(messages)
    assert finding.text.startswith("left and rear have the same data, 100 % of their messages are identical: ")
    assert finding.sensors == ("left", "rear")


def test_of_the_root_and_its_repetition_the_repetition_is_weak(findings: Check) -> None:
    messages = three_scanners()
    messages["/rear"] = messages["/front"]
    (finding,) = findings(messages)
    assert finding.sensors == ("rear",)


@pytest.mark.parametrize(("shared", "found"), [(10, 0), (11, 1)])
def test_half_of_the_messages_must_be_identical(findings: Check, shared: int, found: int) -> None:
    messages = three_scanners()
    messages["/rear"] = [*reframed(messages["/left"][:shared], "rear_link"), *messages["/rear"][shared:]]
    assert len(findings(messages)) == found


@pytest.mark.parametrize(("different", "found"), [(2, 0), (3, 1)])
def test_scanners_that_repeat_one_message_are_not_the_same(findings: Check, different: int, found: int) -> None:
    messages = three_scanners()
    repeated = [replace(m, stamp=START + k) for k in range(10) for m in scans("", 5, different)]
    assert len(findings(messages | {"/left": repeated, "/rear": repeated})) == found


def test_copied_files_are_the_same_data(tmp_path: Path) -> None:
    for name in RIG.sensors:
        (tmp_path / name).mkdir()
    for k, scan in enumerate(scans("", 0, 4, beams=5000)):
        for name, change in (("front", 0.0), ("left", 0.1), ("rear", 0.1)):
            np.savez(
                tmp_path / name / f"{100 + k}.npz", angle_min=0, angle_increment=0.001, ranges=scan.ranges + change
            )
    (tmp_path / "rear" / "104.csv").write_bytes(b"")
    sensors = {name: Lidar2dSpec(topic=name) for name in RIG.sensors}
    monitor = InputMonitor(RIG.model_copy(update={"sensors": sensors}), START)
    with open_recording(tmp_path) as recording:
        list(monitor.observe(recording.records()))
    assert [finding.sensors for finding in monitor.findings()] == [("left", "rear")]


# intrinsics


def changed(**values: object) -> CameraModel:
    return replace(CAMERA, **values)  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("after", "words"),
    [
        (changed(K=CAMERA.K * [[1.02], [1], [1]]), "fx 500 to 510 pixels"),
        (changed(K=np.array([[500.0, 0, 320], [0, 510, 244], [0, 0, 1]])), "cy 240 to 244 pixels"),
        (
            changed(distortion=np.array([0.1, -0.2, 0.001, 0.003])),
            "distortion [0.1, -0.2, 0.001, 0.002] to [0.1, -0.2, 0.001, 0.003]",
        ),
        (changed(distortion=np.zeros(0)), "distortion [0.1, -0.2, 0.001, 0.002] to []"),
        (changed(width=320, height=240), "pinhole, 640 x 480 pixels to pinhole, 320 x 240 pixels"),
    ],
)
def test_intrinsics_that_change_make_the_camera_weak(findings: Check, after: CameraModel, words: str) -> None:
    messages = three_scanners() | {"/info": infos(CAMERA, CAMERA, after, CAMERA, after)}
    (finding,) = findings(messages, WITH_CAMERA)
    assert finding.text.startswith(f"the intrinsics of camera on /info change at 2.0 s ({words}), ")
    assert finding.sensors == ("camera",)


def test_intrinsics_of_the_root_concern_all_others(findings: Check) -> None:
    messages = three_scanners() | {"/info": infos(CAMERA, changed(K=CAMERA.K * [[1.02], [1], [1]]))}
    (finding,) = findings(messages, WITH_CAMERA.model_copy(update={"root": "camera"}))
    assert finding.sensors == ("front", "left", "rear")


@pytest.mark.parametrize(
    "after", [CAMERA, changed(K=CAMERA.K * (1 + 1e-6)), changed(distortion=CAMERA.distortion * (1 + 1e-6))]
)
def test_intrinsics_that_differ_by_rounding_pass(findings: Check, after: CameraModel) -> None:
    assert findings(three_scanners() | {"/info": infos(CAMERA, after, CAMERA)}, WITH_CAMERA) == ()


def test_intrinsics_that_become_unusable_are_a_change() -> None:
    def fail() -> Message:
        raise RecordingError("K has no focal lengths")

    usable, other = MessageRecording({"/info": infos(CAMERA, changed(width=641))}).records()
    unusable = RecordedMessage("/info", START + 5, START + 5, fail, other.digest)
    monitor = InputMonitor(WITH_CAMERA, START, {"camera": "/info"})
    list(monitor.observe([usable, unusable]))
    (finding,) = monitor.findings()
    assert "change at 5.0 s (to values that cannot be used)" in finding.text


def test_constant_intrinsics_are_decoded_once() -> None:
    decoded = []

    def decode() -> Message:
        decoded.append(1)
        return infos(CAMERA)[0]

    records = MessageRecording({"/info": infos(*[CAMERA] * 50)}).records()
    monitor = InputMonitor(WITH_CAMERA, START, {"camera": "/info"})
    assert len(list(monitor.observe(replace(record, decode=decode) for record in records))) == 50
    assert len(decoded) == 1


def test_records_without_digest_pass() -> None:
    records = [replace(record, digest=None) for record in MessageRecording(three_scanners()).records()]
    monitor = InputMonitor(with_frame("other"), START)
    assert list(monitor.observe(records)) == records
    assert monitor.findings() == ()
