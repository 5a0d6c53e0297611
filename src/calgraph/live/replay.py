"""A recording as a live source: its messages at the pace at which they arrived, or faster."""

import asyncio
from collections.abc import AsyncIterator, Collection, Iterator
from pathlib import Path

from rosbags.interfaces import MessageDefinitionFormat

from calgraph.config.settings import LimitSettings
from calgraph.errors import InputError
from calgraph.live.source import Channel, LiveMessage, Notice, SchemaFormat, make_message
from calgraph.recording import Recording, open_recording
from calgraph.recording.bags import BagRecording
from calgraph.recording.message_types import TypeDefinition, complete_definition
from calgraph.recording.recording import explain_missing_topic

# Time by which a replayed recording may be ahead of the detection before it waits, s: no rest of the board begins
# and ends in it.
_MAX_LEAD = 0.5


class ReplaySource:
    """Replays a recording.

    Args:
        path: anything that :func:`calgraph.recording.open_recording` opens. Messages of bags are given as they are
            stored; others are serialised as ROS 2 does.
        speed: 1 is real time, 5 five times as fast; 0 is as fast as messages are consumed.
        start_after: only messages that arrived later, ns,
        but: or then, on other topics than these; None: on none.
        limits: of what is read.
    """

    def __init__(
        self,
        path: Path,
        *,
        speed: float = 1.0,
        start_after: int = -1,
        but: Collection[str] | None = None,
        limits: LimitSettings = LimitSettings(),
    ) -> None:
        if not 0 <= speed < float("inf"):
            raise InputError(
                f"`speed` {speed:g}: give 1 for real time, 5 for five times as fast, 0 to skip nothing"
            )
        self.max_lead = _MAX_LEAD if speed else 0.0
        self.name = str(path)
        self._path, self._speed, self._limits = path, speed, limits
        self._start_after, self._but = start_after, but

    async def stream(self, topics: Collection[str]) -> AsyncIterator[LiveMessage | Notice]:
        """The messages of the topics wanted; see :meth:`Source.stream`.

        Raises:
            InputError: it is no recording, or has no time that could be replayed.
            RecordingError: it is damaged.
        """
        # Compressed files are unpacked first, which takes seconds.
        with await asyncio.to_thread(open_recording, self._path, self._limits) as recording:
            yield Notice("connected", f"replays {self._path}")
            present = [topic.name for topic in recording.topics]
            for topic in topics:
                if topic not in present:
                    yield Notice("missing", f"{self._path}: {explain_missing_topic(topic, present)}", topic)
            now = asyncio.get_running_loop().time
            first: tuple[float, int] | None = None
            after = self._start_after if self._but is None else self._start_after - 1
            for item in list_messages(recording, set(topics).intersection(present), after):
                if isinstance(item, LiveMessage):
                    if item.arrival == self._start_after and item.channel.topic in (self._but or ()):
                        continue
                    began, first_arrival = first = first or (now(), item.arrival)
                    elapsed = (item.arrival - first_arrival) / 1e9
                    delay = began + elapsed / self._speed - now() if self._speed else 0.0
                    # Where nothing is to be waited for, other tasks of the loop have their turn.
                    await asyncio.sleep(max(0.0, delay))
                yield item
            yield Notice("ended", f"the recording {self._path} is at its end")


def list_messages(recording: Recording, topics: Collection[str], after: int) -> Iterator[LiveMessage | Notice]:
    """The messages that arrived later than a time, ns, and notices of what cannot be read."""
    if isinstance(recording, BagRecording):
        channels: dict[tuple[str, TypeDefinition], Channel | None] = {}
        for raw in recording.raw_messages(topics, after):
            key = (raw.topic, raw.definition)
            if key not in channels:
                channels[key] = _channel(*key)
                if channels[key] is None:
                    yield Notice("missing", _explain_unreadable(*key), raw.topic)
            if channel := channels[key]:
                yield LiveMessage(channel, raw.arrival, raw.data)
        return
    if any(topic.time_base == "pose" for topic in recording.topics):
        raise InputError(
            f"{recording.path}: its files are numbered by pose and have no times to replay: use calgraph calibrate"
        )
    for record in recording.records(topics, max(0, after) / 1e9):
        arrival = round(record.arrival * 1e9)
        if arrival > after:
            yield make_message(record.topic, record.decode(), arrival)


def _channel(topic: str, definition: TypeDefinition) -> Channel | None:
    complete = complete_definition(definition) if definition.is_ros else None
    if complete is None:
        return None
    of_ros2: SchemaFormat = "ros2idl" if complete.format == MessageDefinitionFormat.IDL else "ros2msg"
    return Channel(
        topic,
        complete.name,
        "ros1" if complete.encoding == "ros1" else "cdr",
        "ros1msg" if complete.encoding == "ros1" else of_ros2,
        complete.text,
    )


def _explain_unreadable(topic: str, definition: TypeDefinition) -> str:
    encoding = f"sessions read CDR, and not {definition.encoding}: use calgraph calibrate for this recording"
    why = "its definition is unknown" if definition.is_ros else encoding
    return f"{topic}: messages of type {definition.name} cannot be read: {why}"
