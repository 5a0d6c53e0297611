"""Several recordings of one pose each."""

from collections.abc import Sequence

import numpy as np
import pytest

from calgraph.recording import MessageRecording, PoseRecordings, Recording, separate_poses
from calgraph.recording.recording import JoinedRecording
from calgraph.sensors import Image

TOPICS = ("/left", "/right")
BLANK = np.zeros((4, 4), dtype=np.uint8)


def pose(stamps: Sequence[float], topics: Sequence[str] = TOPICS) -> Recording:
    """A recording in which every sensor measures at these stamps."""
    return MessageRecording({topic: [Image(stamp, "", BLANK) for stamp in stamps] for topic in topics})


def separated(parts: Sequence[Recording], *, stated: bool = False) -> Recording:
    return separate_poses(JoinedRecording(parts), TOPICS, stated=stated, max_duration=15.0, gap=1.0)


def test_recordings_that_all_begin_at_zero_follow_each_other() -> None:
    found = separated([pose([0.0, 0.5]), pose([0.0, 0.7]), pose([0.0])])
    assert isinstance(found, PoseRecordings)
    stamps = [record.stamp for record in found.records(["/left"])]
    assert np.all(np.diff(stamps) > 0)
    assert len(found.poses) == 3
    for (start, end), count in zip(found.poses, (2, 2, 1), strict=True):
        assert sum(start <= stamp <= end for stamp in stamps) == count
    ends = np.array(found.poses)
    assert np.all(ends[1:, 0] - ends[:-1, 1] > 1.0)


def test_shifted_messages_have_shifted_stamps() -> None:
    found = separated([pose([0.0]), pose([0.0]), pose([0.0])])
    for record in found.records():
        message = record.decode()
        assert isinstance(message, Image)
        assert message.stamp == record.stamp


def test_recordings_at_different_times_keep_their_stamps() -> None:
    found = separated([pose([20.0, 20.5]), pose([0.0, 0.5]), pose([10.0, 11.0])])
    assert isinstance(found, PoseRecordings)
    assert list(found.poses) == [(0.0, 0.5), (10.0, 11.0), (20.0, 20.5)]
    assert [record.stamp for record in found.records(["/left"])] == [0.0, 0.5, 10.0, 11.0, 20.0, 20.5]


def test_only_messages_within_the_window_are_read() -> None:
    found = separated([pose([0.0, 0.5]), pose([0.0, 0.5]), pose([0.0, 0.5])])
    assert isinstance(found, PoseRecordings)
    start, end = found.poses[1]
    assert [record.stamp for record in found.records(["/right"], start, end)] == [start, end]


@pytest.mark.parametrize(
    "parts",
    [
        [pose(range(10)), pose(range(10, 20)), pose(range(20, 30))],
        [pose([0.0, 0.5]), pose([0.0, 0.5])],
        [pose([0.0, 60.0]), pose([100.0, 160.0]), pose([200.0, 260.0])],
        [pose([0.0], ["/left"]), pose([0.0], ["/right"]), pose([0.0], ["/third"])],
    ],
    ids=["parts of one recording", "two", "long ones", "one sensor each"],
)
def test_other_recordings_are_read_as_one(parts: list[Recording]) -> None:
    assert not isinstance(separated(parts), PoseRecordings)


def test_two_recordings_are_poses_if_that_is_stated() -> None:
    assert isinstance(separated([pose([0.0, 0.5]), pose([0.0, 0.5])], stated=True), PoseRecordings)


def test_a_sensor_may_miss_a_pose() -> None:
    found = separated([pose([0.0]), pose([0.0], ["/left"]), pose([0.0]), pose([0.0])])
    assert isinstance(found, PoseRecordings)
    assert len(found.poses) == 4
