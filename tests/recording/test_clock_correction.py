"""Stamps by one clock."""

from collections.abc import Mapping

import numpy as np
import pytest

from calgraph.recording import ClockCorrectedRecording, MessageRecording, Recording
from calgraph.recording.record_list import IndexedRecording
from calgraph.sensors import Image

BLANK = np.zeros((2, 2), dtype=np.uint8)
OFFSETS = {"b": -2.5}


def in_memory() -> MessageRecording:
    """Messages whose arrivals are their stamps."""
    return MessageRecording({topic: [Image(stamp, "", BLANK) for stamp in (1.0, 2.0, 3.0)] for topic in "ab"})


def as_videos() -> Recording:
    """The same, with stamps that count from the start of each topic."""
    recording = in_memory()
    records = list(recording.records())
    types = {topic.name: topic.type for topic in recording.topics}
    return IndexedRecording(recording.path, records, types, time_bases={"a": "start", "b": "start"})


def stamps(
    recording: Recording, start: float | None = None, end: float | None = None
) -> Mapping[str, list[float]]:
    found: dict[str, list[float]] = {"a": [], "b": []}
    for record in recording.records(start=start, end=end):
        assert record.decode().stamp == record.stamp
        found[record.topic].append(record.stamp)
    return found


def test_offsets_are_subtracted_from_stamps() -> None:
    corrected = ClockCorrectedRecording(in_memory(), OFFSETS)
    assert stamps(corrected) == {"a": [1.0, 2.0, 3.0], "b": [3.5, 4.5, 5.5]}


def test_arrivals_of_messages_stay() -> None:
    corrected = ClockCorrectedRecording(in_memory(), OFFSETS)
    assert (corrected.start, corrected.end) == (1.0, 3.0)
    assert [(record.topic, record.arrival) for record in corrected.records(start=2.0, end=2.0)] == [
        ("a", 2.0),
        ("b", 2.0),
    ]


def test_arrivals_of_videos_are_their_stamps_and_stay_in_order() -> None:
    corrected = ClockCorrectedRecording(as_videos(), OFFSETS)
    records = list(corrected.records())
    assert [record.arrival for record in records] == [1.0, 2.0, 3.0, 3.5, 4.5, 5.5]
    assert [record.stamp for record in records] == [record.arrival for record in records]
    assert stamps(corrected, start=3.0, end=4.5) == {"a": [3.0], "b": [3.5, 4.5]}
    assert corrected.start <= 1.0
    assert corrected.end == pytest.approx(5.5)
