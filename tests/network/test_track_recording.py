"""From a recording to what every scanner followed."""

import multiprocessing
from collections.abc import Collection, Iterator, Mapping
from dataclasses import replace
from pathlib import Path

import pytest

from calgraph.config import Cylinder, Lidar2dSpec, People, Rig
from calgraph.config.settings import EstimationSettings, NetworkEstimationSettings, Settings
from calgraph.errors import Rejected
from calgraph.io.records import encode_records
from calgraph.network import track_recording
from calgraph.network.options import NetworkOptions
from calgraph.network.track_recording import forget_unused_beams, track_people
from calgraph.network.tracking.track import ScannerTracks
from calgraph.parallel.engine import Processes
from calgraph.recording import MessageRecording, Recording, RecordingWriter, open_recording
from calgraph.recording.input_checks import InputMonitor
from calgraph.sensors import LaserScan, RecordedMessage
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
        found = super().records(topics, start, end)

        def read() -> Iterator[RecordedMessage]:
            self.read.append(sorted(topics or ()))
            yield from found

        return read()


@pytest.fixture
def recording() -> Counted:
    scans = World((walk_in_circle(1.5, (3.0, 0.0)),)).simulate_scans(6.0, 0)
    return Counted({f"/{name}": [replace(scan, frame_id=f"{name}_frame") for scan in scans] for name in NAMES})


def test_a_short_recording_is_read_once(recording: Counted) -> None:
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
    assert told == [("tracking", pytest.approx(2 / 3)), ("tracking", 1)]


def test_scanners_with_the_same_messages_are_found_across_portions(
    recording: Counted, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(track_recording, "_MAX_SCANS_IN_MEMORY", 200)
    monitor = InputMonitor(RIG, recording.start)
    track_people(RIG, recording, NetworkOptions(), monitor=monitor)
    assert [finding.sensors for finding in monitor.findings()] == [("west",), ("south",), ("west", "south")]


def serialize(found: Mapping[str, ScannerTracks | Rejected]) -> dict[str, tuple[dict[str, object], list[bytes]]]:
    encoded = {name: encode_records(one) for name, one in found.items()}
    return {
        name: (content, [values.tobytes() for values in arrays.values()])
        for name, (content, arrays) in encoded.items()
    }


@pytest.mark.parametrize("jobs", [1, 2])
@pytest.mark.parametrize("in_memory", [True, False])
def test_the_number_of_processes_does_not_change_a_bit(
    recording: Counted, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, jobs: int, in_memory: bool
) -> None:
    with RecordingWriter(tmp_path / "recording") as writer:
        for topic, scans in read_scans(recording).items():
            for scan in scans:
                writer.write(topic, scan)
    with open_recording(tmp_path / "recording") as opened:
        read = MessageRecording(read_scans(opened)) if in_memory else opened
        one_batch, frames = track_people(RIG, read, NetworkOptions())
        monkeypatch.setattr(track_recording, "_MIN_DIVIDED_SCANS", 1)
        found = track_people(RIG, read, NetworkOptions(engine=Processes(jobs)))
    assert serialize(found[0]) == serialize(one_batch)
    assert found[1] == frames
    assert multiprocessing.active_children() == []


def test_limited_memory_does_not_change_a_bit(recording: Counted) -> None:
    network = NetworkEstimationSettings(max_kept_bytes=0)
    limited = RIG.model_copy(update={"settings": Settings(estimation=EstimationSettings(network=network))})
    found, expected = (track_people(rig, recording, NetworkOptions())[0] for rig in (limited, RIG))
    east = found["east"]
    assert isinstance(east, ScannerTracks)
    assert not east.tracks[0].hits.points.flags.writeable  # mapped
    assert serialize(found) == serialize(expected)


@pytest.mark.parametrize(
    ("target", "kept"),
    [(People(), False), (People(height=0.3), True), (People(height=1.0), False), (Cylinder(diameter=0.3), False)],
    ids=["whole bodies", "at legs", "above legs", "cylinder"],
)
def test_beams_are_kept_where_scanners_measure_legs(
    recording: Counted, target: People | Cylinder, kept: bool
) -> None:
    found, _ = track_people(RIG, recording, NetworkOptions())
    tracks = forget_unused_beams(RIG.model_copy(update={"target": target}), {**found, "west": Rejected("none")})
    east = tracks["east"]
    assert isinstance(east, ScannerTracks)
    assert (east.foreground is not None) == kept
    assert tracks["west"] == Rejected("none")


def read_scans(recording: Recording) -> dict[str, list[LaserScan]]:
    scans: dict[str, list[LaserScan]] = {}
    for record in recording.records():
        message = record.decode()
        assert isinstance(message, LaserScan)
        scans.setdefault(record.topic, []).append(message)
    return scans
