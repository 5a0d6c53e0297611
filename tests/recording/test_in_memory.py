"""Messages at hand, read like a recording."""

import numpy as np
import pytest

from calgraph.errors import InputError
from calgraph.recording import MessageRecording, TopicInfo
from calgraph.sensors import LaserScan, PointCloud


def scan(stamp: float) -> LaserScan:
    return LaserScan(stamp, "laser", np.zeros(3), np.ones(3))


def cloud(stamp: float) -> PointCloud:
    return PointCloud(stamp, "lidar", np.ones((2, 3)))


MESSAGES = MessageRecording({"scan": [scan(3.0), scan(1.0)], "points": [cloud(2.0)], "silent": []})


def test_messages_come_in_order_of_their_stamps() -> None:
    assert [(r.topic, r.stamp) for r in MESSAGES.records()] == [("scan", 1.0), ("points", 2.0), ("scan", 3.0)]


def test_each_record_decodes_to_its_own_message() -> None:
    assert [record.decode().stamp for record in MESSAGES.records()] == [1.0, 2.0, 3.0]


def test_topics_and_times_are_those_of_the_messages() -> None:
    assert MESSAGES.topics == (TopicInfo("points", "cloud", 1), TopicInfo("scan", "scan", 2))
    assert (MESSAGES.start, MESSAGES.end) == (1.0, 3.0)


def test_windows_and_topics_select() -> None:
    assert [r.stamp for r in MESSAGES.records(["scan"], start=2.0)] == [3.0]


def test_unknown_topic_is_an_error() -> None:
    with pytest.raises(InputError, match="has no topic 'scans'"):
        MESSAGES.records(["scans"])


def test_no_messages_are_an_error() -> None:
    with pytest.raises(InputError, match="no messages"):
        MessageRecording({"scan": []})
