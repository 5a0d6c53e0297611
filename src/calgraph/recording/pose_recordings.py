"""Several short recordings, each of one pose of the board."""

from collections.abc import Collection, Iterator, Sequence
from itertools import pairwise

from calgraph.recording.recording import JoinedRecording, Recording, select_topics
from calgraph.recording.takes import shift_record
from calgraph.sensors import RecordedMessage


class PoseRecordings(JoinedRecording):
    """Recordings of one pose each, one after the other.

    Stamps and arrival times of recordings that overlap, for example because all begin at 0, are shifted so that
    the recordings follow each other in the given order.
    """

    def __init__(self, recordings: Sequence[Recording], topics: Collection[str], gap: float) -> None:
        """Reads the stamps of the topics (not the content of messages).

        Args:
            recordings: in order.
            topics: of the sensors.
            gap: least time between two recordings, s.
        """
        super().__init__(recordings)
        # What is read with shifted stamps is not what another run reads from the same files.
        self.sources = ()
        # All stamps are read before the shifts are known; and each of these recordings is short.
        self.divisible = False
        spans = [_find_span(part, topics) for part in recordings]
        ordered = sorted(span for span in spans if span)
        apart = all(b[0] - a[1] > gap for a, b in pairwise(ordered))
        self.poses: list[tuple[float, float]] = []
        self._offsets: list[float] = []
        for span in spans:
            offset = 0.0
            if span and not apart and self.poses:
                offset = self.poses[-1][1] + 2 * gap - span[0]
            if span:
                self.poses.append((span[0] + offset, span[1] + offset))
            self._offsets.append(offset)
        self.poses.sort()
        parts = list(zip(self.parts, self._offsets, strict=True))
        self.start = min(part.start + offset for part, offset in parts)
        self.end = max(part.end + offset for part, offset in parts)

    def records(
        self, topics: Collection[str] | None = None, start: float | None = None, end: float | None = None
    ) -> Iterator[RecordedMessage]:
        """The messages of all parts, one part after the other; see :meth:`Recording.records`."""
        wanted = select_topics(self.path, self.topics, topics)
        return self._read_parts(wanted, start, end)

    def _read_parts(self, wanted: set[str], start: float | None, end: float | None) -> Iterator[RecordedMessage]:
        parts = zip(self.parts, self._offsets, strict=True)
        for part, offset in sorted(parts, key=lambda one: one[0].start + one[1]):
            present = wanted & {topic.name for topic in part.topics}
            window = (None if limit is None else limit - offset for limit in (start, end))
            for record in part.records(present, *window):
                yield shift_record(record, offset, offset) if offset else record


def separate_poses(
    recording: Recording, topics: Collection[str], *, stated: bool, max_duration: float, gap: float
) -> Recording:
    """The recording as one of :class:`PoseRecordings` if it consists of recordings of one pose each.

    These are short and measured by several sensors. Without a statement they are also at least three, and no parts
    of one recording: pauses lie between them, or they overlap.

    Args:
        recording: as opened.
        topics: of the sensors.
        stated: whether rig.yaml states snapshots.
        max_duration: maximum duration of the recording of one pose, s.
        gap: time between two recordings, s, above which they are not parts of one.
    """
    if not isinstance(recording, JoinedRecording):
        return recording
    parts = recording.parts
    if len(parts) < (2 if stated else 3) or any(part.end - part.start > max_duration for part in parts):
        return recording
    measured = [{topic.name for topic in part.topics if topic.count and topic.name in topics} for part in parts]
    several = 2 * sum(len(names) > 1 for names in measured) >= len(parts)
    # Recordings of different sensors at one time, by several computers, have no topic in common.
    if not several or not all(names & measured[0] for names in measured):
        return recording
    ordered = sorted((part.start, part.end) for part in parts)
    consecutive = any(a[0] < b[0] and 0 <= b[0] - a[1] <= gap for a, b in pairwise(ordered))
    return recording if consecutive and not stated else PoseRecordings(parts, topics, gap)


def _find_span(recording: Recording, topics: Collection[str]) -> tuple[float, float] | None:
    """First and last stamp of the topics, s; None without messages."""
    present = {topic.name for topic in recording.topics} & set(topics)
    stamps = [record.stamp for record in recording.records(present)]
    return (min(stamps), max(stamps)) if stamps else None
