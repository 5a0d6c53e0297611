"""The messages that a live session keeps in memory."""

import numpy as np

from calgraph.config.settings import MessageRingSettings
from calgraph.live.message_ring import MessageRing
from calgraph.sensors import RecordedMessage, Trigger


def make_record(stamp: float, arrival: float | None = None) -> RecordedMessage:
    return RecordedMessage("/scan", stamp, stamp if arrival is None else arrival, lambda: Trigger(stamp))


def make_ring(seconds: float = 10.0, size: int = 1000) -> MessageRing:
    return MessageRing(MessageRingSettings(max_seconds=seconds, max_bytes=size))


def test_old_messages_are_dropped_from_all_sensors() -> None:
    ring = make_ring(seconds=2.0)
    for stamp in np.arange(0.0, 5.0, 0.5).tolist():
        ring.add("a", make_record(stamp), 10)
        ring.add("b", make_record(stamp + 0.25), 10)
    assert ring.select("a", [2.5]) is None
    assert [record.stamp for record in ring.select("a", [3.0, 4.5]) or ()] == [3.0, 4.5]
    # All messages with later stamps are there.
    assert ring.begin == 2.5


def test_messages_take_no_more_memory_than_allowed() -> None:
    ring = make_ring(size=1000)
    for stamp in range(100):
        ring.add("large" if stamp % 2 else "small", make_record(float(stamp)), 300 if stamp % 2 else 10)
        assert ring.size <= 1000
    assert ring.select("large", [95.0, 97.0, 99.0]) is not None
    assert ring.select("large", [93.0]) is None


def test_the_first_of_two_messages_with_one_stamp_counts() -> None:
    ring = make_ring()
    first, second = make_record(1.0, 1.1), make_record(1.0, 1.2)
    ring.add("a", first, 10)
    ring.add("a", second, 10)
    assert ring.select("a", [1.0]) == [first]


def test_no_messages_are_wanted_of_a_sensor_that_measured_none() -> None:
    assert make_ring().select("a", []) == []
