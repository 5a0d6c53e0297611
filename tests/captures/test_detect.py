from collections.abc import Sequence
from functools import partial

import numpy as np

from calgraph.captures import (
    Hold,
    SensorCapture,
    build_timeline,
    collect_detections,
    detect_in_holds,
    limit_messages,
)
from calgraph.config import Board, Lidar2dSpec, Rig
from calgraph.detection import Segment
from calgraph.errors import Rejected
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

    result = list(detect_in_holds(Scanner().records(), holds, {"laser": "/scan"}, {"laser": detect}))
    assert [(o.capture, o.detections) for o in result] == [(0, SEGMENTS), (1, SEGMENTS)]
    assert searched == {0: [11.0, 12.0], 1: [51.0]}


def test_hold_without_messages_is_rejected_with_a_reason() -> None:
    (result,) = detect_in_holds(
        [], [Hold(0, 1.0, 1.2, {"laser": np.zeros(0)})], {"laser": "/scan"}, {"laser": lambda _messages: SEGMENTS}
    )
    assert isinstance(result.detections, Rejected)
    assert "no message" in result.detections.reason


def test_missing_messages_do_not_drop_received_ones() -> None:
    hold = Hold(0, 1.0, 1.2, {"laser": np.array([1.0, 77.0])})
    (result,) = detect_in_holds(
        Scanner().records(), [hold], {"laser": "/scan"}, {"laser": lambda _messages: SEGMENTS}
    )
    assert result.detections == SEGMENTS


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
