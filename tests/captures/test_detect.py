from collections.abc import Sequence
from functools import partial

import numpy as np

from calgraph.captures import Hold, Observation, gather, observe, survey, thinned
from calgraph.config import Board, Lidar2dSpec, Rig
from calgraph.detection import Segment
from calgraph.errors import Rejected
from calgraph.sensors import LaserScan, RecordedMessage, Trigger

RIG = Rig(root="laser", target=Board(size=(1, 1)), sensors={"laser": Lidar2dSpec(kind="lidar2d", topic="/scan")})
SEEN = (Segment(np.zeros((2, 3)), np.eye(6), np.zeros((0, 3))),)


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


def test_a_survey_decodes_one_message_of_each_sensor() -> None:
    scanner = Scanner()
    found = survey(scanner.records(), 0.0, {"laser": "/scan"}, None)
    times = found.sensors["laser"]
    assert scanner.decoded == 1
    assert times.frame_id == "laser"
    assert abs(times.duration - 0.02) < 1e-9
    assert abs(times.period - 0.1) < 1e-9


def test_triggers_are_collected() -> None:
    triggers = [RecordedMessage("/go", t, t, partial(Trigger, t)) for t in (3.0, 1.0)]
    np.testing.assert_array_equal(survey(triggers, 0.0, {}, "/go").triggers, [1.0, 3.0])


def test_each_hold_is_searched_in_its_own_messages() -> None:
    holds = [Hold(0, 1.0, 1.2, {"laser": np.array([1.0, 1.1])}), Hold(1, 5.0, 5.1, {"laser": np.array([5.0])})]
    searched: dict[int, list[float]] = {}

    def detect(messages: Sequence[LaserScan]) -> tuple[Segment, ...]:
        searched[len(searched)] = [m.ranges[0] for m in messages]
        return SEEN

    seen = list(observe(Scanner().records(), holds, {"laser": "/scan"}, {"laser": detect}))
    assert [(o.capture, o.found) for o in seen] == [(0, SEEN), (1, SEEN)]
    assert searched == {0: [11.0, 12.0], 1: [51.0]}


def test_a_hold_without_messages_is_a_miss_with_a_reason() -> None:
    (seen,) = observe(
        [], [Hold(0, 1.0, 1.2, {"laser": np.zeros(0)})], {"laser": "/scan"}, {"laser": lambda _messages: SEEN}
    )
    assert isinstance(seen.found, Rejected)
    assert "no message" in seen.found.reason


def test_messages_that_never_come_do_not_lose_those_that_did() -> None:
    hold = Hold(0, 1.0, 1.2, {"laser": np.array([1.0, 77.0])})
    (seen,) = observe(Scanner().records(), [hold], {"laser": "/scan"}, {"laser": lambda _messages: SEEN})
    assert seen.found == SEEN


def test_gathering_sorts_hits_from_misses() -> None:
    timeline = survey(Scanner().records(), 0.0, {"laser": "/scan"}, None)
    observations = [Observation(0, "laser", SEEN), Observation(1, "laser", Rejected("too far"))]
    captured = gather(RIG, timeline, [], observations, cameras={})
    assert captured.detections == {"laser": {0: SEEN}}
    assert captured.misses == {(1, "laser"): "too far"}


def test_thinning_keeps_messages_spread_over_the_hold() -> None:
    (hold,) = thinned([Hold(0, 0.0, 10.0, {"laser": np.linspace(0, 10, 500)})], RIG)
    chosen = hold.stamps["laser"]
    assert len(chosen) == 20
    assert (chosen[0], chosen[-1]) == (0.0, 10.0)
