"""The hash of a recording's files: changes with their content, remembered while they do not change."""

import os
import time
from collections.abc import Callable
from pathlib import Path

import pytest

from calgraph.io.cache_folder import CacheFolder
from calgraph.recording import content_hash
from calgraph.recording.content_hash import hash_files


@pytest.fixture
def folder(tmp_path: Path) -> CacheFolder:
    return CacheFolder(tmp_path / "cache")


@pytest.fixture
def recording(tmp_path: Path) -> Path:
    path = tmp_path / "recording"
    (path / "laser").mkdir(parents=True)
    for name, text in (("laser/1.csv", "one"), ("laser/2.csv", "two"), ("metadata.yaml", "")):
        (path / name).write_text(text)
    return path


@pytest.fixture
def read_files(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """Names of the files whose content is read."""
    names: list[str] = []
    original = content_hash._hash_file

    def read(file: Path) -> str:
        names.append(file.name)
        return original(file)

    monkeypatch.setattr(content_hash, "_hash_file", read)
    return names


def make_older(monkeypatch: pytest.MonkeyPatch, seconds: float) -> None:
    """Lets time pass since the files were written."""
    now = time.time() + seconds
    monkeypatch.setattr(time, "time", lambda: now)


CHANGES: dict[str, Callable[[Path], object]] = {
    "a byte of a file": lambda path: (path / "laser/1.csv").write_text("onE"),
    "the name of a file": lambda path: (path / "laser/1.csv").rename(path / "laser/3.csv"),
    "the name of a folder": lambda path: (path / "laser").rename(path / "scanner"),
    "a file more": lambda path: (path / "laser/3.csv").write_text(""),
    "two files exchanged": lambda path: [
        (path / f"laser/{k}.csv").write_text(text) for k, text in ((1, "two"), (2, "one"))
    ],
}


@pytest.mark.parametrize("change", CHANGES)
def test_every_change_changes_the_hash(
    recording: Path, folder: CacheFolder, change: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    make_older(monkeypatch, 100)
    before = hash_files([recording], folder)
    CHANGES[change](recording)
    assert hash_files([recording], folder) != before


def test_a_change_that_keeps_size_and_time_of_modification_changes_the_hash(
    recording: Path, folder: CacheFolder, monkeypatch: pytest.MonkeyPatch
) -> None:
    make_older(monkeypatch, 100)
    file = recording / "laser" / "1.csv"
    state = file.stat()
    before = hash_files([recording], folder)
    file.write_text("uno")
    os.utime(file, ns=(state.st_atime_ns, state.st_mtime_ns))
    assert hash_files([recording], folder) != before


def test_copies_and_moved_recordings_have_the_same_hash(recording: Path, folder: CacheFolder) -> None:
    before = hash_files([recording], folder)
    (recording.parent / "elsewhere").mkdir()
    assert hash_files([recording.rename(recording.parent / "elsewhere" / "recording")], folder) == before


def test_unchanged_files_are_read_once(
    recording: Path, folder: CacheFolder, read_files: list[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    make_older(monkeypatch, 100)
    first = hash_files([recording], folder)
    assert sorted(read_files) == ["1.csv", "2.csv", "metadata.yaml"]
    assert hash_files([recording], folder) == first
    assert len(read_files) == 3


def test_files_of_this_moment_are_read_again(
    recording: Path, folder: CacheFolder, read_files: list[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Their content may change once more before their time does."""
    make_older(monkeypatch, 0)
    hash_files([recording], folder)
    hash_files([recording], folder)
    assert len(read_files) == 6


def test_linked_folders_count_and_circles_of_links_end(recording: Path, folder: CacheFolder) -> None:
    (recording.parent / "other").mkdir()
    (recording.parent / "other" / "1.csv").write_text("one")
    (recording / "linked").symlink_to(recording.parent / "other")
    (recording / "circle").symlink_to(recording)
    before = hash_files([recording], folder)
    (recording.parent / "other" / "1.csv").write_text("two")
    assert hash_files([recording], folder) != before


def test_a_missing_file_is_an_os_error(tmp_path: Path, folder: CacheFolder) -> None:
    with pytest.raises(OSError, match="missing"):
        hash_files([tmp_path / "missing"], folder)
