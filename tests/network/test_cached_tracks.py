"""A second run on the recording of a network takes the tracks of scanners from the cache."""

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from shutil import copytree
from typing import Any

import numpy as np
import pytest

from calgraph.config import Lidar2dSpec, Lidar2dUncertainty, People, RangeNoise, Rig
from calgraph.config.settings import ClusterSettings, Settings, TrackingSettings
from calgraph.network.options import NetworkOptions
from calgraph.network.track_recording import track_people
from calgraph.network.tracking.track import ScannerTracks
from calgraph.recording import RecordingCache, RecordingWriter, open_recording
from calgraph.recording.bags import BagRecording
from calgraph.recording.input_checks import InputMonitor
from calgraph.result.finding import Finding
from calgraph.sensors import RecordedMessage
from walking_scenes import World, walk_in_circle

NAMES = ("east", "west", "south")
RIG = Rig(root="east", target=People(), sensors={name: Lidar2dSpec(topic=f"/{name}") for name in NAMES})


@pytest.fixture(scope="module")
def recording(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Three scanners with other noise each, but west and south with the same data; not to be changed."""
    path = tmp_path_factory.mktemp("network") / "recording"
    with RecordingWriter(path) as writer:
        for seed, name in ((0, "east"), (1, "west"), (1, "south")):
            for scan in World((walk_in_circle(1.5, (3.0, 0.0)),)).simulate_scans(6.0, seed):
                writer.write(f"/{name}", replace(scan, frame_id=f"{name}_frame"))
    return path


@pytest.fixture(scope="module")
def filled(recording: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The cache after a run; not to be changed."""
    cache = tmp_path_factory.mktemp("cache")
    track(recording, RIG, cache)
    return cache


@pytest.fixture
def copied(filled: Path, tmp_path: Path) -> Path:
    """A copy of the cache after a run."""
    return Path(copytree(filled, tmp_path / "cache"))


Tracked = tuple[dict[str, object], dict[str, str], tuple[Finding, ...], set[str]]


def track(recording: Path, rig: Rig, cache: Path | None, options: NetworkOptions | None = None) -> Tracked:
    """Positions and noise by scanner, frames, findings, and the scanners that were found in the cache."""
    kept = RecordingCache(cache)
    with open_recording(recording) as opened:
        monitor = InputMonitor(rig, opened.start)
        used = replace(options or NetworkOptions(), cache=kept)
        tracks, frames = track_people(rig, opened, used, monitor=monitor)
    found = {
        name: (one.sigma, [track.positions.tolist() for track in one.tracks])
        if isinstance(one, ScannerTracks)
        else one
        for name, one in tracks.items()
    }
    return dict(found), frames, monitor.findings(), kept.reused


def with_spec(name: str, **changes: object) -> Rig:
    spec = RIG.sensors[name].model_copy(update=changes)
    return RIG.model_copy(update={"sensors": {**RIG.sensors, name: spec}})


def test_tracks_frames_and_findings_are_those_of_a_run_without_it(recording: Path, filled: Path) -> None:
    without, again = track(recording, RIG, None), track(recording, RIG, filled)
    assert (without[3], again[3]) == (set(), set(NAMES))
    assert again[:3] == without[:3]
    assert [list(one) for one in again[:2]] == [list(NAMES)] * 2
    assert ["west and south have the same data" in finding.text for finding in again[2]] == [True]


@pytest.mark.parametrize(
    "rig",
    [
        with_spec("east", uncertainty=Lidar2dUncertainty(range_bias=0.001)),
        RIG.model_copy(update={"root": "west"}),
        RIG.model_copy(update={"sensors": dict(reversed(RIG.sensors.items()))}),
    ],
    ids=["uncertainty", "root", "order"],
)
def test_what_tracks_do_not_depend_on_may_change(recording: Path, filled: Path, rig: Rig) -> None:
    assert track(recording, rig, filled)[3] == set(NAMES)


OTHER_SETTINGS = Settings(tracking=TrackingSettings(clusters=ClusterSettings(max_width=0.9)))


@pytest.mark.parametrize(
    ("rig", "options", "reused"),
    [
        (with_spec("east", noise=RangeNoise(range=0.05)), NetworkOptions(), {"west", "south"}),
        (RIG.model_copy(update={"target": People(axes=(0.3, 0.2))}), NetworkOptions(), set()),
        (RIG.model_copy(update={"settings": OTHER_SETTINGS}), NetworkOptions(), set()),
        (RIG, NetworkOptions(feature="com"), set()),
    ],
    ids=["noise", "target", "settings", "feature"],
)
def test_what_tracks_depend_on_is_tracked_again(
    recording: Path, copied: Path, rig: Rig, options: NetworkOptions, reused: set[str]
) -> None:
    found = track(recording, rig, copied, options)
    assert found[3] == reused
    assert found[:3] == track(recording, rig, None, options)[:3]


def test_a_new_scanner_is_the_only_one_that_is_read(
    recording: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    part = RIG.model_copy(update={"sensors": {name: RIG.sensors[name] for name in NAMES[:2]}})
    track(recording, part, tmp_path)
    original, read = BagRecording.records, set[str]()

    def count(*arguments: Any) -> Iterator[RecordedMessage]:
        for record in original(*arguments):
            read.add(record.topic)
            yield record

    monkeypatch.setattr(BagRecording, "records", count)
    with open_recording(recording) as opened:
        tracks, _ = track_people(RIG, opened, NetworkOptions(cache=RecordingCache(tmp_path)))
    assert read == {"/south"}
    assert tuple(tracks) == NAMES
    assert np.isfinite([one.sigma for one in tracks.values() if isinstance(one, ScannerTracks)]).all()
