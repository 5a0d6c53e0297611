"""The last messages of all sensors, undecoded, within a budget of memory."""

from collections import deque
from collections.abc import Sequence
from typing import NamedTuple

from calgraph.config.settings import MessageRingSettings
from calgraph.sensors import RecordedMessage


class _Kept(NamedTuple):
    sensor: str
    record: RecordedMessage
    size: int


class MessageRing:
    """Keeps the messages of the last seconds; the oldest of all sensors are dropped first."""

    def __init__(self, settings: MessageRingSettings) -> None:
        self._settings = settings
        self._kept: deque[_Kept] = deque()
        self._by_stamp: dict[tuple[str, float], RecordedMessage] = {}
        self.size = 0
        """Bytes of the messages that are kept."""
        self._dropped: dict[str, float] = {}

    def add(self, sensor: str, record: RecordedMessage, size: int) -> None:
        """Keeps a message of ``size`` bytes, and drops old ones."""
        self._kept.append(_Kept(sensor, record, size))
        self.size += size
        # Of messages with one stamp the first is used, as in recordings.
        self._by_stamp.setdefault((sensor, record.stamp), record)
        oldest = record.arrival - self._settings.max_seconds
        while self._kept and (self.size > self._settings.max_bytes or self._kept[0].record.arrival < oldest):
            dropped = self._kept.popleft()
            self.size -= dropped.size
            key = dropped.sensor, dropped.record.stamp
            if self._by_stamp.get(key) is dropped.record:
                del self._by_stamp[key]
            self._dropped[dropped.sensor] = dropped.record.stamp

    @property
    def begin(self) -> float:
        """Messages with later stamps have not been dropped, s."""
        return max(self._dropped.values(), default=float("-inf"))

    def select(self, sensor: str, stamps: Sequence[float]) -> list[RecordedMessage] | None:
        """The messages of a sensor with these stamps; None if one was dropped."""
        found = [self._by_stamp.get((sensor, stamp)) for stamp in stamps]
        present = [record for record in found if record is not None]
        return present if len(present) == len(found) else None
