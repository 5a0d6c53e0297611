"""Recordings that calls open where they run."""

import pickle
from dataclasses import replace
from pathlib import Path

import pytest

from calgraph.config.settings import LimitSettings
from calgraph.errors import InputError, RecordingError
from calgraph.recording import MessageRecording, RecordingWriter, open_recordings, refer_to
from calgraph.sensors import Trigger

LIMITS = LimitSettings()


def write(path: Path, stamps: list[float]) -> Path:
    with RecordingWriter(path) as writer:
        for stamp in stamps:
            writer.write("/trigger", Trigger(stamp))
    return path


def test_several_recordings_are_opened_again_by_their_paths(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    write(tmp_path / "a", [1.0, 2.0])
    write(tmp_path / "b", [3.0])
    monkeypatch.chdir(tmp_path)
    with open_recordings(["a", "b"]) as opened:
        reference = pickle.loads(pickle.dumps(refer_to(opened, LIMITS)))  # noqa: S301
    monkeypatch.chdir("/")
    with reference.open() as again:
        assert [record.stamp for record in again.records()] == [1.0, 2.0, 3.0]


def test_messages_in_memory_are_part_of_the_reference() -> None:
    reference = pickle.loads(pickle.dumps(refer_to(MessageRecording({"/t": [Trigger(1.0)]}), LIMITS)))  # noqa: S301
    with reference.open() as again:
        assert [record.stamp for record in again.records()] == [1.0]


def test_another_recording_of_the_same_name_is_refused(tmp_path: Path) -> None:
    with open_recordings([write(tmp_path / "a", [1.0, 2.0])]) as opened:
        reference = refer_to(opened, LIMITS)
    (tmp_path / "a").rename(tmp_path / "old")
    write(tmp_path / "a", [1.0, 3.0])
    with pytest.raises(RecordingError, match="a: is another recording, or was written to while it was read"):
        reference.open()


def test_a_recording_that_another_machine_lacks_is_named_with_it(tmp_path: Path) -> None:
    with open_recordings([write(tmp_path / "a", [1.0, 2.0])]) as opened:
        reference = replace(refer_to(opened, LIMITS), machine="client")
    (tmp_path / "a").rename(tmp_path / "old")
    with pytest.raises(InputError, match=r"a: does not exist.*; on .*: give a path or URL by which all workers"):
        reference.open()
