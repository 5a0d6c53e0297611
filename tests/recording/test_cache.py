"""Results by recording, program and arguments: found again exactly when all of them are the same."""

import logging
import subprocess
import sys
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from calgraph.geometry import Array
from calgraph.recording import MessageRecording, Recording, RecordingCache, RecordingWriter, open_recording
from calgraph.recording import cache as caches
from calgraph.recording.recording import JoinedRecording
from calgraph.sensors import LaserScan

KIND = "numbers/1"
INPUTS: Mapping[str, Any] = {"topic": "/scan", "stamps": np.array([1.0, 2.0]), "noise": 0.02}


@dataclass(frozen=True, eq=False)
class Numbers:
    first: int
    values: Array


def scan(stamp: float) -> LaserScan:
    return LaserScan(stamp, "laser", np.linspace(-1, 1, 10), np.full(10, 3 + stamp))


def write_recording(path: Path, *stamps: float) -> Path:
    with RecordingWriter(path) as writer:
        for stamp in stamps:
            writer.write("/scan", scan(stamp))
    return path


@pytest.fixture
def recording(tmp_path: Path) -> Iterator[Recording]:
    with open_recording(write_recording(tmp_path / "recording", 1.0, 2.0)) as opened:
        yield opened


def write(cache: RecordingCache, recording: Recording, inputs: Mapping[str, Any] = INPUTS) -> None:
    cache.write(recording, KIND, inputs, Numbers(0, np.arange(3.0)))


def read(path: Path, recording: Recording, inputs: Mapping[str, Any] = INPUTS, kind: str = KIND) -> object:
    """What a later run finds."""
    found = RecordingCache(path).read(recording, kind, inputs, (Numbers,))
    return found and found.values.tolist()


def test_a_later_run_finds_the_result(recording: Recording, tmp_path: Path) -> None:
    write(RecordingCache(tmp_path / "cache"), recording)
    assert read(tmp_path / "cache", recording) == [0.0, 1.0, 2.0]


@pytest.mark.parametrize(
    "change", [{"topic": "/other"}, {"stamps": np.array([1.0, 2.5])}, {"noise": 0.03}, {"more": None}], ids=str
)
def test_other_arguments_find_nothing(recording: Recording, tmp_path: Path, change: Mapping[str, Any]) -> None:
    write(RecordingCache(tmp_path / "cache"), recording)
    assert read(tmp_path / "cache", recording, {**INPUTS, **change}) is None


def test_another_kind_finds_nothing(recording: Recording, tmp_path: Path) -> None:
    write(RecordingCache(tmp_path / "cache"), recording)
    assert read(tmp_path / "cache", recording, kind="numbers/2") is None


def test_another_recording_finds_nothing(recording: Recording, tmp_path: Path) -> None:
    write(RecordingCache(tmp_path / "cache"), recording)
    with open_recording(write_recording(tmp_path / "later" / "recording", 1.0, 3.0)) as other:
        assert read(tmp_path / "cache", other) is None


def test_another_version_of_a_library_finds_nothing(
    recording: Recording, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    write(RecordingCache(tmp_path / "cache"), recording)
    monkeypatch.setattr(caches, "version", lambda library: "99" if library == "opencv-python-headless" else "1")
    assert read(tmp_path / "cache", recording) is None


def test_no_package_that_reads_recordings_may_change_unnoticed() -> None:
    """Sources of later packages are no part of the key: nothing that detects or tracks may import them."""
    code = (
        "import sys, calgraph.rig.captures.sensor_detection, calgraph.network.tracking.track_scanner\n"
        "print(*sys.modules)"
    )
    run = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    imported = [name.replace(".", "/") for name in run.stdout.split() if name.startswith("calgraph.")]
    assert {"calgraph/rig/detection", "calgraph/boards", "calgraph/sensors"} <= set(imported)
    later = tuple(f"calgraph/{room}" for room in caches.LATER_ROOMS)
    assert [name for name in imported if name.startswith(later)] == []


def test_a_result_that_cannot_be_decoded_is_removed(recording: Recording, tmp_path: Path) -> None:
    cache = RecordingCache(tmp_path / "cache")
    write(cache, recording)

    assert cache.read(recording, KIND, INPUTS, types=()) is None
    assert read(tmp_path / "cache", recording) is None


def test_without_a_folder_nothing_is_kept(recording: Recording) -> None:
    cache = RecordingCache(None)
    write(cache, recording)
    assert cache.read(recording, KIND, INPUTS, (Numbers,)) is None


def test_messages_in_memory_are_not_kept(recording: Recording, tmp_path: Path) -> None:
    """Their content is not hashed; neither are recordings that contain some."""
    cache = RecordingCache(tmp_path / "cache")
    memory = MessageRecording({"/scan": [scan(1.0)]})
    for one in (memory, JoinedRecording([recording, memory])):
        write(cache, one)
        assert cache.read(one, KIND, INPUTS, (Numbers,)) is None
    assert not (tmp_path / "cache").exists()


def test_the_result_of_a_recording_that_is_being_written_is_not_kept(recording: Recording, tmp_path: Path) -> None:
    cache = RecordingCache(tmp_path / "cache")
    assert cache.read(recording, KIND, INPUTS, (Numbers,)) is None
    with (recording.path / "recording.mcap").open("ab") as file:
        file.write(b"more")
    write(cache, recording)
    assert cache.read(recording, KIND, INPUTS, (Numbers,)) is None


def test_a_folder_that_cannot_be_written_to_is_one_remark(
    recording: Recording, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    (tmp_path / "file").write_text("")
    cache = RecordingCache(tmp_path / "file" / "cache")
    with caplog.at_level(logging.WARNING):
        for _ in range(3):
            assert cache.read(recording, KIND, INPUTS, (Numbers,)) is None
            write(cache, recording)
    assert [record.message.partition(":")[0] for record in caplog.records] == ["the cache is not used"]
