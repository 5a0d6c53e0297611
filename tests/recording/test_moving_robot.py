"""Whether a recording is of a robot that drives: simulated drives, and scanners at rest before people."""

from collections.abc import Mapping, Sequence

import numpy as np
import pytest

from calgraph.config import FoundTopic, Kind
from calgraph.recording import MessageRecording
from calgraph.recording.moving_robot import find_moving_robot
from calgraph.sensors import LaserScan, Message, Pose
from calgraph.simulation import STANDARD_RIGS, DriveScenario, simulate_drive
from calgraph.simulation.drive_motion import PathKind

ANGLES = np.radians(np.arange(-135, 135, 0.5))


def list_topics(recording: MessageRecording, kinds: Mapping[str, Kind]) -> list[FoundTopic]:
    counts = {topic.name: topic.count for topic in recording.topics}
    return [FoundTopic(name, "", kind, counts[name]) for name, kind in kinds.items()]


@pytest.mark.parametrize("path", ["ordinary", "planar", "turn_on_spot"])
def test_simulated_drives_are_recognized(path: PathKind) -> None:
    drive = simulate_drive(DriveScenario(2, 15.0, STANDARD_RIGS["two_lidars"], path))
    kinds: dict[str, Kind] = dict.fromkeys(drive.topics.values(), "lidar3d")
    robot = find_moving_robot(drive.recording, list_topics(drive.recording, kinds))
    assert "% of all directions" in robot


def scan_room(times: Sequence[float], x: float, blocked: int) -> list[Message]:
    """Of a room of 8 by 6 m from a place on its axis, in which something that walks covers some beams at 1 m."""
    cos, sin = np.cos(ANGLES), np.sin(ANGLES)
    with np.errstate(divide="ignore"):
        walls = np.minimum(np.maximum((4 - x) / cos, (-4 - x) / cos), np.abs(3 / sin))
    scans: list[Message] = []
    for time in times:
        first = int(40 * time) % (len(ANGLES) - blocked)
        ranges = walls.copy()
        ranges[first : first + blocked] = 1.0
        scans.append(LaserScan(time, "", ANGLES, ranges))
    return scans


@pytest.mark.parametrize("blocked", [20, 80])
def test_people_before_scanners_at_rest_are_no_drive(blocked: int) -> None:
    """Up to a seventh of all beams, which are others each time."""
    times = (np.arange(200) / 10).tolist()
    recording = MessageRecording({"/a": scan_room(times, 0.0, blocked), "/b": scan_room(times, 1.5, blocked)})
    assert not find_moving_robot(recording, list_topics(recording, {"/a": "lidar2d", "/b": "lidar2d"}))


@pytest.mark.parametrize(("count", "drives"), [(20, False), (100, True)])
def test_snapshots_from_several_places_are_no_drive(count: int, drives: bool) -> None:
    """Of a scanner that turns as well."""
    measured = [scan_room([0.0], x, 0)[0] for x in np.linspace(-3, 3, count).tolist()]
    scans: list[Message] = [
        LaserScan(float(k), "", ANGLES, np.roll(one.ranges, 5 * k))
        for k, one in enumerate(measured)
        if isinstance(one, LaserScan)
    ]
    recording = MessageRecording({"/a": scans})
    assert bool(find_moving_robot(recording, list_topics(recording, {"/a": "lidar2d"}))) == drives


@pytest.mark.parametrize(("speed", "moves"), [(0.01, False), (0.2, True)])
def test_poses_without_scanners_show_a_drive(speed: float, moves: bool) -> None:
    poses: list[Message] = [
        Pose(0.1 * k, "", np.array([0.1 * k * speed, 0, 0]), np.array([0.0, 0, 0, 1])) for k in range(200)
    ]
    recording = MessageRecording({"/odom": poses})
    robot = find_moving_robot(recording, [FoundTopic("/odom", "nav_msgs/msg/Odometry", "other", 200)])
    assert robot == ("the poses of /odom move by 4.0 m" if moves else "")
