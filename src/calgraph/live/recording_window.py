"""An interval of a recording, read as a whole recording."""

from collections.abc import Collection, Iterator
from dataclasses import replace
from math import ceil
from pathlib import Path

from calgraph.recording import Recording
from calgraph.recording.recording import ClosedOnExit
from calgraph.sensors import RecordedMessage


class RecordingWindow(ClosedOnExit):
    """The messages of a recording that arrived in an interval; it stays open when the window is closed.

    Args:
        recording: the whole.
        start: first arrival, s.
        end: last arrival, s.
    """

    def __init__(self, recording: Recording, start: float, end: float) -> None:
        self._recording = recording
        self.path: Path = recording.path
        # What is computed from a window is not kept: its files have other messages, too.
        self.sources: tuple[Path, ...] = ()
        self.start, self.end = start, end
        self.last_arrival = start
        """Of the messages that were read so far, s."""
        share = (end - start) / max(recording.end - recording.start, 1e-9)
        self.topics = tuple(replace(topic, count=ceil(topic.count * share)) for topic in recording.topics)

    def records(
        self, topics: Collection[str] | None = None, start: float | None = None, end: float | None = None
    ) -> Iterator[RecordedMessage]:
        """The messages in order of arrival; see :meth:`calgraph.recording.Recording.records`."""
        first = self.start if start is None else max(start, self.start)
        last = self.end if end is None else min(end, self.end)
        for record in self._recording.records(topics, first, last):
            self.last_arrival = max(self.last_arrival, record.arrival)
            yield record
