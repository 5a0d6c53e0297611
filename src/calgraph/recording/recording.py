"""The interface of a recording: topics, and their messages in order of arrival."""

import difflib
import heapq
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, replace
from pathlib import Path
from types import TracebackType
from typing import Literal, Protocol, Self, TypeVar

from calgraph.errors import InputError, RecordingError
from calgraph.sensors import RecordedMessage

TimeBase = Literal["clock", "start", "pose"]


class Arrived(Protocol):
    """What arrived at some time."""

    @property
    def arrival(self) -> float:
        """In the unit of the other entries of a merge."""


_Entry = TypeVar("_Entry", bound=Arrived)


@dataclass(frozen=True)
class TopicInfo:
    """One topic of a recording."""

    name: str
    """Topic, or folder name in a plain folder."""
    type: str
    """ROS type name such as ``sensor_msgs/msg/LaserScan``; in a plain folder ``image``, ``corners``, ``scan``,
    ``cloud`` or ``camera_info``."""
    count: int
    """How many messages the recording states to have."""
    time_base: TimeBase = "clock"
    """What stamps state: the time of a clock, s after the start of this recording, or the number of a pose."""


class Recording(Protocol):
    """An open recording; a context manager that closes its files at the end."""

    @property
    def path(self) -> Path:
        """The file or folder."""

    @property
    def sources(self) -> tuple[Path, ...]:
        """All files and folders that messages are read from; empty for messages in memory."""

    @property
    def opened_from(self) -> tuple[str, ...]:
        """Absolute paths, and URLs, by which :func:`open_recordings` opens it again; empty where it cannot."""

    @property
    def divisible(self) -> bool:
        """Whether opening it again and reading a part takes little time beside reading all of it."""

    @property
    def topics(self) -> tuple[TopicInfo, ...]:
        """All topics, sorted by name."""

    @property
    def start(self) -> float:
        """Arrival of the first message, s."""

    @property
    def end(self) -> float:
        """Arrival of the last message, s."""

    def records(
        self, topics: Collection[str] | None = None, start: float | None = None, end: float | None = None
    ) -> Iterator[RecordedMessage]:
        """The messages in order of arrival, as a stream.

        A record carries its undecoded bytes until it is dropped: keep stamps rather than records.

        Args:
            topics: names of the topics wanted; all if left out.
            start: only messages that arrived at this time or later, s.
            end: only messages that arrived at this time or earlier, s.

        Raises:
            InputError: a topic is not in the recording.
            RecordingError: the file is damaged, or holds fewer messages than it states (noticed at the end of a
                pass without start and end).
        """

    def close(self) -> None:
        """Closes the files."""

    def __enter__(self) -> Self: ...

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None: ...


class ClosedOnExit:
    """A context manager that closes itself at the end.

    Attributes:
        opened_from: see :attr:`Recording.opened_from`.
        divisible: see :attr:`Recording.divisible`.
    """

    opened_from: tuple[str, ...] = ()
    divisible: bool = False

    def close(self) -> None:
        """Does nothing, where no file stays open."""

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *exception: object) -> None:
        self.close()


class JoinedRecording(ClosedOnExit):
    """Several recordings read as one, merged by arrival time."""

    def __init__(self, recordings: Sequence[Recording], path: Path | None = None) -> None:
        self.parts = tuple(recordings)
        self.path = path or self.parts[0].path
        sources = [part.sources for part in self.parts]
        self.sources = tuple(path for paths in sources for path in paths) if all(sources) else ()
        self.divisible = all(part.divisible for part in self.parts)
        self.topics = merge_topics(topic for part in self.parts for topic in part.topics)
        self.start = min(part.start for part in self.parts)
        self.end = max(part.end for part in self.parts)

    def records(
        self, topics: Collection[str] | None = None, start: float | None = None, end: float | None = None
    ) -> Iterator[RecordedMessage]:
        """The messages of all parts; see :meth:`Recording.records`."""
        wanted = select_topics(self.path, self.topics, topics)
        return merge_by_arrival(
            (part.start, part.records(wanted & {topic.name for topic in part.topics}, start, end))
            for part in self.parts
        )

    def close(self) -> None:
        """Closes every part, even if closing one of them fails."""
        with ExitStack() as stack:
            for part in self.parts:
                stack.callback(part.close)


def merge_topics(topics: Iterable[TopicInfo]) -> tuple[TopicInfo, ...]:
    """One entry a name, sorted, with the counts added up; a name with several types keeps the first."""
    joined: dict[str, TopicInfo] = {}
    for topic in topics:
        before = joined.get(topic.name, replace(topic, count=0))
        joined[topic.name] = replace(before, count=before.count + topic.count)
    return tuple(joined[name] for name in sorted(joined))


def select_topics(path: Path, present: Sequence[TopicInfo], wanted: Collection[str] | None) -> set[str]:
    """The names of the topics to read.

    Raises:
        InputError: a wanted topic is not present.
    """
    names = [topic.name for topic in present]
    for name in wanted or ():
        if name not in names:
            raise InputError(f"{path}: {explain_missing_topic(name, names)}")
    return set(names if wanted is None else wanted)


def explain_missing_topic(name: str, present: Sequence[str]) -> str:
    """That a topic is missing, with the most similar one of those that are present, and all of these."""
    close = difflib.get_close_matches(name, present, n=1)
    hint = f"; did you mean {close[0]!r}?" if close else "."
    return f"has no topic {name!r}{hint} Its topics are: {', '.join(present) or 'none'}"


def merge_by_arrival(sources: Iterable[tuple[float, Iterable[_Entry]]]) -> Iterator[_Entry]:
    """Merges streams that are each in order, opening each only when its start (in the unit of arrivals) has come.

    Thus the first chunks of many split files are not all in memory together.
    """
    streams = list(sources)
    if len(streams) == 1:
        return iter(streams[0][1])

    def lazily(start: float, records: Iterable[_Entry]) -> Iterator[tuple[float, _Entry | None]]:
        yield start, None
        for record in records:
            yield record.arrival, record

    merged = heapq.merge(*(lazily(start, records) for start, records in streams), key=lambda entry: entry[0])
    return (record for _, record in merged if record is not None)


def check_message_counts(
    where: Path, records: Iterable[RecordedMessage], stated: Mapping[str, int], *, cause: str
) -> Iterator[RecordedMessage]:
    """Passes records on, and raises at the end if a topic had fewer of them than stated.

    Raises:
        RecordingError: fewer messages than stated, naming the topics.
    """
    missing = dict(stated)
    for record in records:
        missing[record.topic] -= 1
        yield record
    short = [f"{topic}: {stated[topic] - n} of {stated[topic]}" for topic, n in missing.items() if n > 0]
    if short:
        raise RecordingError(f"{where}: holds fewer messages than it states ({', '.join(short)}); {cause}")
