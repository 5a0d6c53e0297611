"""What a source notices about topics: those that are missing, gaps between stamps, and silence."""

import math
from collections import deque
from collections.abc import Callable, Collection, Iterator
from dataclasses import dataclass, replace

from calgraph.config.settings import ConnectionSettings
from calgraph.live.source import Channel, LiveMessage, Notice, NoticeKind, clean_text
from calgraph.sensors.kinds import SENSOR_TYPES


@dataclass
class _Topic:
    """The state of one topic."""

    last_time: float
    """Of its last message, or of the subscription; s of the caller's clock."""
    intervals: deque[int]
    """Between the last stamps of a sensor, ns."""
    received: bool = False
    silent: bool = False
    last_stamp: int | None = None


# Number of last messages of a sensor whose stamps state its usual interval: their median.
_USUAL_INTERVALS = 20
# Minimum ratio of a time between two stamps to the usual interval for the messages between to count as lost:
# drivers skip single ones without any fault.
_GAP_RATIO = 3.5
# Minimum time between two such stamps, s: stamps of fast sensors vary by the scheduling of computers.
_MIN_GAP = 0.05


class TopicWatch:
    """Watches the topics that a source is subscribed to, and collects its notices.

    Only of sensors, which measure at a constant rate, it knows how many messages are missing.

    Args:
        topics: wanted.
        settings: of connections.
        now: when the source began, s; all times are of one clock.
        explain_missing: states why a topic that is wanted is not there.
    """

    def __init__(
        self,
        topics: Collection[str],
        settings: ConnectionSettings,
        now: float,
        explain_missing: Callable[[str], str],
    ) -> None:
        self._wanted, self._settings, self._explain_missing = topics, settings, explain_missing
        self._discovery_end = now + settings.discovery_time
        self._topics: dict[str, _Topic] = {}
        self._waiting: dict[tuple[NoticeKind, str | None], Notice] = {}
        self._given: dict[tuple[NoticeKind, str | None], float] = {}

    def note(self, notice: Notice) -> None:
        """Adds a notice; of several of a kind and topic, the first text is given, and the sum of their counts."""
        key = notice.kind, notice.topic
        first = self._waiting.get(key)
        self._waiting[key] = replace(first, count=first.count + notice.count) if first else notice

    def take_notices(self, now: float, present: Collection[str]) -> Iterator[Notice]:
        """The notices by now; one of a kind and topic in ``notice_interval``.

        Args:
            now: s.
            present: topics that are served.
        """
        if now >= self._discovery_end:
            self._discovery_end = math.inf
            for topic in self._wanted:
                if topic not in present:
                    self.note(Notice("missing", self._explain_missing(topic), topic))
        self._note_silent(now)
        for key in list(self._waiting):
            if now - self._given.get(key, -math.inf) >= self._settings.notice_interval:
                self._given[key] = now
                notice = self._waiting.pop(key)
                yield replace(notice, text=clean_text(notice.text))

    def start(self, channel: Channel, now: float) -> None:
        """Watches a topic from now on."""
        self._topics[channel.topic] = _Topic(now, deque(maxlen=_USUAL_INTERVALS))

    def stop(self, topic: str) -> None:
        """Does not watch a topic any more."""
        self._topics.pop(topic, None)

    def observe(self, message: LiveMessage, now: float) -> None:
        """Takes note of a message, and of messages that are missing before it."""
        topic = self._topics[message.channel.topic]
        topic.last_time, topic.received, topic.silent = now, True, False
        if message.channel.type not in SENSOR_TYPES:
            return
        stamp, before = message.read_stamp() or message.arrival, topic.last_stamp
        topic.last_stamp = stamp
        if before is None or stamp <= before:
            return
        usual = self._usual_interval(topic)
        topic.intervals.append(stamp - before)
        if usual is None or stamp - before < max(_GAP_RATIO * usual, _MIN_GAP * 1e9):
            return
        missing = round((stamp - before) / usual) - 1
        name = message.channel.topic
        text = (
            f"{name}: {missing} messages are missing: none for {(stamp - before) / 1e9:.2f} s, where one each "
            f"{usual / 1e9:.3f} s is usual. The sensor, the network or the server dropped them"
        )
        self.note(Notice("lost", text, name, missing))

    def _note_silent(self, now: float) -> None:
        """Adds the topics that have become silent: those without any message, and sensors that stopped."""
        for name, topic in self._topics.items():
            usual = self._usual_interval(topic)
            regular = not topic.received or usual is not None
            limit = max(self._settings.silence, _GAP_RATIO * (usual or 0) / 1e9)
            if regular and not topic.silent and now - topic.last_time >= limit:
                topic.silent = True
                self.note(Notice("missing", f"{name}: no message for {now - topic.last_time:.0f} s", name))

    def _usual_interval(self, topic: _Topic) -> int | None:
        """The usual time between two stamps, ns; None where it is not known or not constant.

        One interval may be longer, by messages that are missing.
        """
        if len(topic.intervals) < _USUAL_INTERVALS:
            return None
        ordered = sorted(topic.intervals)
        median = ordered[len(ordered) // 2]
        return median if ordered[-2] < _GAP_RATIO * median else None
