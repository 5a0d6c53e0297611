import multiprocessing
import os
from collections.abc import Sequence
from functools import partial

import numpy as np
import pytest

from calgraph.boards.detections import Segment
from calgraph.config import Board, CameraSpec, Checkerboard, Lidar2dSpec, Rig
from calgraph.errors import RecordingError, Rejected
from calgraph.parallel.engine import Processes
from calgraph.recording import MessageRecording
from calgraph.rig.captures.detect import SensorCapture, collect_detections
from calgraph.rig.captures.hold_messages import search_holds
from calgraph.rig.captures.holds import Hold, limit_messages
from calgraph.rig.captures.sensor_detection import detect_in_hold
from calgraph.rig.captures.timeline import build_timeline
from calgraph.sensors import Image, LaserScan, RecordedMessage, Trigger

RIG = Rig(root="laser", target=Board(size=(1, 1)), sensors={"laser": Lidar2dSpec(kind="lidar2d", topic="/scan")})
SEGMENTS = (Segment(np.zeros((2, 3)), np.eye(6), np.zeros(0), np.zeros((0, 3))),)


class Scanner:
    """A 2-D scanner at 10 Hz whose messages count how often they are decoded."""

    def __init__(self, topic: str = "/scan") -> None:
        self.topic, self.decoded = topic, 0

    def records(self, count: int = 100) -> list[RecordedMessage]:
        return [
            RecordedMessage(self.topic, 0.1 * i, 0.1 * i + 0.02, partial(self._decode, i)) for i in range(count)
        ]

    def _decode(self, i: int) -> LaserScan:
        self.decoded += 1
        return LaserScan(0.1 * i, "laser", np.zeros(11), np.full(11, i + 1.0), 0.002)


def test_timeline_decodes_one_message_of_each_sensor() -> None:
    scanner = Scanner()
    timeline = build_timeline(scanner.records(), 0.0, {"laser": "/scan"}, None)
    times = timeline.sensors["laser"]
    assert scanner.decoded == 1
    assert times.frame_id == "laser"
    assert abs(times.duration - 0.02) < 1e-9
    assert abs(times.period - 0.1) < 1e-9


def test_images_take_no_time() -> None:
    images = [
        RecordedMessage("/image", t, t, partial(Image, t, "c", np.zeros((2, 2), np.uint8))) for t in (2.0, 1.0)
    ]
    times = build_timeline(images, 0.0, {"camera": "/image"}, None).sensors["camera"]
    assert (times.duration, times.frame_id, times.message_type) == (0.0, "c", "Image")
    np.testing.assert_array_equal(times.stamps, [1.0, 2.0])


def test_triggers_are_collected() -> None:
    triggers = [RecordedMessage("/go", t, t, partial(Trigger, t)) for t in (3.0, 1.0)]
    np.testing.assert_array_equal(build_timeline(triggers, 0.0, {}, "/go").triggers, [1.0, 3.0])


def test_each_hold_is_searched_in_the_messages_of_that_hold() -> None:
    holds = [Hold(0, 1.0, 1.2, {"laser": np.array([1.0, 1.1])}), Hold(1, 5.0, 5.1, {"laser": np.array([5.0])})]
    searched: dict[int, list[float]] = {}

    def detect(messages: Sequence[LaserScan]) -> tuple[Segment, ...]:
        searched[len(searched)] = [m.ranges[0] for m in messages]
        return SEGMENTS

    result = list(search_holds(detect_in_hold, {"laser": detect}, Scanner().records(), holds, {"laser": "/scan"}))
    assert [(o.capture, o.detections) for o in result] == [(0, SEGMENTS), (1, SEGMENTS)]
    assert searched == {0: [11.0, 12.0], 1: [51.0]}


def test_hold_without_messages_is_rejected_with_a_reason() -> None:
    (result,) = search_holds(
        detect_in_hold,
        {"laser": lambda _messages: SEGMENTS},
        [],
        [Hold(0, 1.0, 1.2, {"laser": np.zeros(0)})],
        {"laser": "/scan"},
    )
    assert isinstance(result.detections, Rejected)
    assert "no message" in result.detections.reason


def test_missing_messages_do_not_drop_received_ones() -> None:
    hold = Hold(0, 1.0, 1.2, {"laser": np.array([1.0, 77.0])})
    (result,) = search_holds(
        detect_in_hold, {"laser": lambda _messages: SEGMENTS}, Scanner().records(), [hold], {"laser": "/scan"}
    )
    assert result.detections == SEGMENTS


def find_in_process(messages: Sequence[LaserScan]) -> Rejected:
    """Names the process and what it searched."""
    return Rejected(f"{os.getpid()}: {messages[0].ranges[0]:g}")


def hold_at(index: int) -> Hold:
    return Hold(index, float(index), index + 0.5, {"laser": np.array([float(index), index + 0.25])})


def scans_of(holds: Sequence[Hold]) -> list[LaserScan]:
    return [
        LaserScan(stamp, "laser", np.zeros(3), np.full(3, stamp), 0.0)
        for hold in holds
        for stamp in hold.stamps["laser"]
    ]


@pytest.mark.parametrize("jobs", [1, 3])
def test_messages_in_memory_are_searched_by_processes_in_order(jobs: int) -> None:
    holds = [hold_at(index) for index in range(1, 41)]
    recording = MessageRecording({"/scan": scans_of(holds)})
    done: list[float] = []
    found = list(
        search_holds(
            detect_in_hold, {"laser": find_in_process}, recording.records(), holds, {"laser": "/scan"},
            engine=Processes(jobs), progress=done.append,
        )
    )  # fmt: skip
    reasons = [result.detections.reason.split(": ") for result in found if isinstance(result.detections, Rejected)]
    assert [result.capture for result in found] == list(range(1, 41))
    assert [float(searched) for _, searched in reasons] == list(range(1, 41))
    assert done == list(range(1, 41))
    processes = {int(process) for process, _ in reasons}
    assert (processes == {os.getpid()}) == (jobs == 1)
    assert len(processes) <= jobs


def read_undamaged(scan: LaserScan) -> LaserScan:
    if scan.stamp > 30:
        raise RecordingError(f"/scan: stamp {scan.stamp:.2f}: is damaged")
    return scan


@pytest.mark.parametrize("jobs", [1, 3])
def test_the_first_damaged_message_is_reported_by_any_number_of_processes(jobs: int) -> None:
    holds = [hold_at(index) for index in range(1, 41)]
    records = [
        RecordedMessage("/scan", scan.stamp, scan.stamp, partial(read_undamaged, scan)) for scan in scans_of(holds)
    ]
    results = search_holds(
        detect_in_hold, {"laser": find_in_process}, records, holds, {"laser": "/scan"}, engine=Processes(jobs)
    )
    assert [next(results).capture for _ in range(1, 30)] == list(range(1, 30))
    with pytest.raises(RecordingError, match=r"^/scan: stamp 30\.25: is damaged$"):
        next(results)
    assert multiprocessing.active_children() == []


def test_detections_and_rejections_are_sorted() -> None:
    timeline = build_timeline(Scanner().records(), 0.0, {"laser": "/scan"}, None)
    sensor_captures = [SensorCapture(0, "laser", SEGMENTS), SensorCapture(1, "laser", Rejected("too far"))]
    captured = collect_detections(RIG, timeline, [], sensor_captures, cameras={})
    assert captured.detections == {"laser": {0: SEGMENTS}}
    assert captured.rejections == {(1, "laser"): "too far"}


def test_limited_messages_are_spread_over_the_hold() -> None:
    (hold,) = limit_messages([Hold(0, 0.0, 10.0, {"laser": np.linspace(0, 10, 500)})], RIG)
    chosen = hold.stamps["laser"]
    assert len(chosen) == 20
    assert (chosen[0], chosen[-1]) == (0.0, 10.0)


def make_camera_rig() -> Rig:
    """Two cameras."""
    pattern = Checkerboard(kind="checkerboard", columns=5, rows=6, square=0.1)
    return Rig(
        root="camera",
        target=Board(size=(1, 1), pattern=pattern),
        sensors={name: CameraSpec(kind="camera", topic=f"/{name}") for name in ("camera", "camera_2")},
    )


@pytest.mark.parametrize("start", np.arange(0.0, 1 / 3, 0.02).tolist())
def test_cameras_that_expose_together_give_images_of_the_same_times(start: float) -> None:
    names = ("camera", "camera_2")
    times = np.arange(start, 10, 1 / 3)
    stamps = {name: t[(t > 4.0) & (t < 5.0)] for name, t in zip(names, (times, times + 0.02), strict=True)}
    (hold,) = limit_messages([Hold(0, 4.0, 5.0, stamps)], make_camera_rig())
    first, second = (hold.stamps[name] for name in names)
    assert len(first) == 2
    np.testing.assert_allclose(second - first, 0.02)


def test_cameras_that_measure_one_after_the_other_keep_two_images_each() -> None:
    stamps = {"camera": np.array([4.0, 4.2, 4.4]), "camera_2": np.array([4.6, 4.7, 4.8, 4.9])}
    (hold,) = limit_messages([Hold(0, 4.0, 5.0, stamps)], make_camera_rig())
    assert [len(hold.stamps[name]) for name in stamps] == [2, 2]
