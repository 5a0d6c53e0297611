"""Memory does not grow with the length of a recording: only stamps are kept of messages, and no content."""

import tracemalloc
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

import apsw
import numpy as np
import pytest
from rosbags.rosbag1 import Writer as Writer1
from rosbags.rosbag2 import StoragePlugin
from rosbags.rosbag2 import Writer as Writer2
from rosbags.typesys import Stores, get_typestore

from calgraph.config import Rig
from calgraph.config.settings import CaptureSettings
from calgraph.parallel.engine import THIS_PROCESS
from calgraph.recording import NO_CACHE, Recording, find_topics, inspect_recording, open_recording
from calgraph.recording.clocks import read_arrivals
from calgraph.recording.input_checks import InputMonitor
from calgraph.recording.writer import serialize_message
from calgraph.rig.captures.capture_mode import recognize_recording
from calgraph.rig.captures.empty_start import resolve_background
from calgraph.rig.captures.timeline_reading import read_rig_timeline
from calgraph.sensors import Image, Message, PointCloud

FORMATS = ("mcap", "unindexed", "db3", "bag")
SHORT, LONG = 40, 200
"""Images and clouds of 0.5 MB a step."""
MAX_GROWTH = 1.2
SQLITE_CACHE = 2**21
"""Bytes of a database's pages, which fill."""
TOPICS = ("/camera/image", "/lidar/points")
RIG = Rig.model_validate(
    {
        "root": "camera",
        "target": {"kind": "board", "size": [1, 1], "tags": [{"id": 0, "size": 0.5, "center": [0, 0]}]},
        "sensors": {
            "camera": {"kind": "camera", "topic": TOPICS[0], "noise": {"pixel": 0.3}},
            "lidar": {"kind": "lidar3d", "topic": TOPICS[1], "noise": {"range": 0.02, "angle": 0.001}},
        },
    }
)


def walk(steps: int) -> Iterable[tuple[str, Message]]:
    """A camera and a LiDAR at 10 Hz, whose views change for one second in two."""
    rng = np.random.default_rng(0)
    images = rng.integers(0, 255, (10, 480, 640), dtype=np.uint8)
    clouds = rng.uniform(-5, 5, (10, 8000, 3))
    for k in range(steps):
        pose = k % 10 if k % 20 < 10 else 0
        yield TOPICS[0], Image(1000 + k / 10, "camera", images[pose])
        yield TOPICS[1], PointCloud(1000 + k / 10, "lidar", clouds[pose])


def write(path: Path, form: str, steps: int) -> Path:
    store = get_typestore(Stores.ROS1_NOETIC if form == "bag" else Stores.ROS2_HUMBLE)
    path.mkdir(parents=True)
    bag = path / "recording.bag" if form == "bag" else path / "recording"
    storage = StoragePlugin.SQLITE3 if form == "db3" else StoragePlugin.MCAP
    writer: Any = Writer1(bag) if form == "bag" else Writer2(bag, version=9, storage_plugin=storage)
    humble = get_typestore(Stores.ROS2_HUMBLE)
    connections: dict[str, Any] = {}
    with writer:
        for topic, message in walk(steps):
            kind, data = serialize_message(humble, message)
            if topic not in connections:
                connections[topic] = writer.add_connection(topic, kind, typestore=store)
            data = humble.cdr_to_ros1(data, kind) if form == "bag" else data
            writer.write(connections[topic], round((message.stamp + 0.01) * 1e9), data)
    if form == "db3":
        with apsw.Connection(str(next(bag.glob("*.db3")))) as database:
            database.execute("DROP INDEX timestamp_idx")
    if form == "unindexed":
        with next(bag.glob("*.mcap")).open("r+b") as file:
            file.seek(9 - 37, 2)  # the offset of the summary, in the footer
            file.write(bytes(8))
    return bag


def inspect(recording: Recording) -> None:
    assert not inspect_recording(recording, lambda _: None).damage
    assert len(find_topics(recording)) == 2
    assert recognize_recording(recording, TOPICS, CaptureSettings())


def read_for_calibration(recording: Recording) -> None:
    assert set(read_arrivals(recording, TOPICS)) == set(TOPICS)
    resolve_background(RIG, recording)
    monitor = InputMonitor(RIG, recording.start)
    timeline = read_rig_timeline(RIG, recording, monitor, NO_CACHE, THIS_PROCESS, lambda *_: None)
    assert all(one.activity.any() for one in timeline.sensors.values())


def measure_peak(path: Path, use: Callable[[Recording], None]) -> float:
    """Bytes that Python and SQLite take at most."""
    tracemalloc.start()
    apsw.memory_high_water(True)
    try:
        with open_recording(path) as recording:
            use(recording)
        return tracemalloc.get_traced_memory()[1] + apsw.memory_high_water()
    finally:
        tracemalloc.stop()


@pytest.fixture(scope="module", params=FORMATS)
def recordings(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    """A short and a long recording of one kind, 20 and 100 MB."""
    folder = tmp_path_factory.mktemp(request.param)
    short, long = (write(folder / str(steps), request.param, steps) for steps in (SHORT, LONG))
    return short, long


@pytest.mark.parametrize("use", [inspect, read_for_calibration])
def test_no_content_of_messages_is_kept(recordings: tuple[Path, Path], use: Callable[[Recording], None]) -> None:
    measure_peak(recordings[0], use)  # imports, and what is made once
    short, long = (measure_peak(path, use) for path in recordings)
    assert long < MAX_GROWTH * short + SQLITE_CACHE
