"""From a recording to what every scanner followed."""

from collections.abc import Collection, Iterator
from dataclasses import replace

import pytest

from calgraph.calibrate import NetworkOptions, track_people, track_recording
from calgraph.captures import InputMonitor
from calgraph.config import Lidar2dSpec, People, Rig
from calgraph.recording import MessageRecording
from calgraph.sensors import LaserScan, RecordedMessage
from calgraph.tracking import ScannerTracks
from walking_scenes import World, walk_in_circle

NAMES = ("east", "west", "south")
RIG = Rig(root="east", target=People(), sensors={name: Lidar2dSpec(topic=f"/{name}") for name in NAMES})


class Counted(MessageRecording):
    """Remembers which topics were read."""

    def __init__(self, messages: dict[str, list[LaserScan]]) -> None:
        super().__init__(messages)
        self.read: list[list[str]] = []

    def records(
        self, topics: Collection[str] | None = None, start: float | None = None, end: float | None = None
    ) -> Iterator[RecordedMessage]:
        self.read.append(sorted(topics or ()))
        return super().records(topics, start, end)


@pytest.fixture
def recording() -> Counted:
    scans = World((walk_in_circle(1.5, (3.0, 0.0)),)).simulate_scans(6.0, 0)
    return Counted({f"/{name}": [replace(scan, frame_id=f"{name}_frame") for scan in scans] for name in NAMES})


def test_a_recording_is_read_once(recording: Counted) -> None:
    followed, frames = track_people(RIG, recording, NetworkOptions())
    assert recording.read == [["/east", "/south", "/west"]]
    assert frames == {name: f"{name}_frame" for name in NAMES}
    assert all(isinstance(own, ScannerTracks) for own in followed.values())


def test_a_long_recording_is_read_in_portions_that_the_memory_holds(
    recording: Counted, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(track_recording, "_MAX_SCANS_IN_MEMORY", 200)
    told: list[tuple[str, float]] = []
    followed, _ = track_people(RIG, recording, NetworkOptions(), lambda *step: told.append(step))
    assert recording.read == [["/east", "/west"], ["/south"]]
    assert tuple(followed) == NAMES
    assert [done for step, done in told if step == "tracking"] == pytest.approx([1 / 3, 2 / 3, 1])


def test_scanners_with_the_same_messages_are_found_across_portions(
    recording: Counted, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(track_recording, "_MAX_SCANS_IN_MEMORY", 200)
    monitor = InputMonitor(RIG, recording.start)
    track_people(RIG, recording, NetworkOptions(), monitor=monitor)
    assert [finding.sensors for finding in monitor.findings()] == [("west",), ("south",), ("west", "south")]
