"""Live messages become the records that their recording has."""

import numpy as np
import pytest
from rosbags.typesys import Stores, get_typestore

from calgraph.config.settings import LimitSettings
from calgraph.errors import RecordingError
from calgraph.live.live_rig import make_trigger
from calgraph.live.source import Channel, LiveMessage
from calgraph.sensors import LaserScan, RecordedMessage, Trigger
from live_sessions import make_live_message

SCAN = LaserScan(12.25, "laser", np.linspace(-1, 1, 5), np.array([1.0, 2.0, np.nan, 4.0, 5.0]), 0.001)


def read(message: LiveMessage) -> RecordedMessage:
    return message.read("ws://robot:8765", LimitSettings())


def test_a_message_of_ros_2_has_stamp_and_content() -> None:
    record = read(make_live_message("/scan", SCAN, 12.5))
    assert (record.topic, record.stamp, record.arrival) == ("/scan", 12.25, 12.5)
    scan = record.decode()
    assert isinstance(scan, LaserScan)
    np.testing.assert_allclose(scan.ranges, SCAN.ranges)
    assert scan.frame_id == "laser"


def test_a_message_of_ros_1_has_stamp_and_content() -> None:
    store = get_typestore(Stores.ROS1_NOETIC)
    time = store.types["builtin_interfaces/msg/Time"](sec=7, nanosec=500_000_000)
    header = store.types["std_msgs/msg/Header"](seq=1, stamp=time, frame_id="laser")
    scan = store.types["sensor_msgs/msg/LaserScan"](
        header=header, angle_min=-1.0, angle_max=1.0, angle_increment=1.0, time_increment=0.0, scan_time=0.1,
        range_min=0.1, range_max=30.0, ranges=np.array([1, 2, 3], np.float32), intensities=np.zeros(0, np.float32),
    )  # fmt: skip
    name = "sensor_msgs/msg/LaserScan"
    schema, _ = store.generate_msgdef(name, ros_version=1)
    channel = Channel("/scan", name, "ros1", "ros1msg", schema)
    record = read(LiveMessage(channel, 8 * 10**9, bytes(store.serialize_ros1(scan, name))))
    assert record.stamp == 7.5
    decoded = record.decode()
    assert isinstance(decoded, LaserScan)
    np.testing.assert_array_equal(decoded.ranges, [1, 2, 3])


def test_a_trigger_is_read_with_the_stamp_of_its_capture() -> None:
    stamp = 1_700_000_000.123456
    record = read(make_trigger(stamp, stamp + 2))
    assert record.stamp == pytest.approx(stamp, abs=3e-7)
    assert record.arrival == pytest.approx(stamp + 2, abs=3e-7)
    assert isinstance(record.decode(), Trigger)


def test_a_message_that_is_too_short_names_source_and_topic() -> None:
    message = make_live_message("/scan", SCAN, 12.5)
    with pytest.raises(RecordingError, match=r"^ws://robot:8765: topic /scan, arrival 12\.500000: .*8 bytes"):
        read(LiveMessage(message.channel, message.arrival, message.data[:8]))
