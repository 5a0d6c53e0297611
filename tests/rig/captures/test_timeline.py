"""What the timeline keeps of a recording."""

import numpy as np

from calgraph.recording import MessageRecording
from calgraph.rig.captures.timeline import build_timeline
from calgraph.sensors import PointCloud


def cloud(stamp: float, points: int) -> PointCloud:
    return PointCloud(stamp, "lidar", np.ones((points, 3)), None, np.linspace(0, 0.1, points))


def test_the_duration_is_that_of_the_first_cloud_with_points() -> None:
    recording = MessageRecording({"/points": [cloud(1, 0), cloud(2, 0), cloud(3, 5), cloud(4, 0)]})
    timeline = build_timeline(recording.records(), 1.0, {"lidar": "/points"}, None)
    times = timeline.sensors["lidar"]
    assert (times.duration, times.frame_id, times.message_type) == (0.1, "lidar", "PointCloud")
    np.testing.assert_array_equal(times.stamps, [1, 2, 3, 4])


def test_clouds_without_points_have_a_type_and_no_duration() -> None:
    recording = MessageRecording({"/points": [cloud(1, 0), cloud(2, 0)]})
    times = build_timeline(recording.records(), 1.0, {"lidar": "/points"}, None).sensors["lidar"]
    assert (times.duration, times.frame_id, times.message_type) == (0.0, "lidar", "PointCloud")
