"""A folder of results by key: limits, damage, other files, and folders that cannot be written to."""

import os
import time
from pathlib import Path

import numpy as np
import pytest

from calgraph.errors import InputError
from calgraph.io.cache_folder import CacheFolder, default_cache_path

FORMAT = "numbers/1"


def key(digit: str) -> str:
    return digit * 64


def write(folder: CacheFolder, digit: str, count: int = 1000) -> None:
    folder.write(key(digit), FORMAT, {"name": digit}, {"numbers": np.arange(count, dtype=np.float64)})


def age(folder: CacheFolder, digit: str, seconds: float) -> None:
    """Makes an entry older."""
    stamp = time.time() - seconds
    os.utime(folder.path / f"{key(digit)}.npz", (stamp, stamp))


def present(folder: CacheFolder) -> str:
    return "".join(sorted(file.name[0] for file in folder.path.glob("*.npz")))


@pytest.fixture
def folder(tmp_path: Path) -> CacheFolder:
    return CacheFolder(tmp_path / "new" / "cache", max_bytes=30_000)


def test_an_entry_is_read_as_it_was_written(folder: CacheFolder) -> None:
    assert folder.read(key("a"), FORMAT) is None
    write(folder, "a")
    found = folder.read(key("a"), FORMAT)
    assert found is not None
    assert found[0]["name"] == "a"
    np.testing.assert_array_equal(found[1]["numbers"], np.arange(1000.0))


def test_the_folder_is_the_users_alone(folder: CacheFolder) -> None:
    write(folder, "a")
    assert folder.path.stat().st_mode & 0o077 == 0


def test_entries_that_were_used_least_recently_are_removed_beyond_the_limit(folder: CacheFolder) -> None:
    for seconds, digit in ((300, "a"), (200, "b"), (100, "c")):
        write(folder, digit)
        age(folder, digit, seconds)
    folder.read(key("a"), FORMAT)
    write(folder, "d")
    assert present(folder) == "acd"
    count, size = folder.measure()
    assert count == 3
    assert size <= 30_000


def test_an_entry_larger_than_the_limit_is_not_kept(folder: CacheFolder) -> None:
    write(folder, "a", 10_000)
    assert folder.measure() == (0, 0)


@pytest.mark.parametrize("damage", ["truncated", "of another key", "of another format", "empty"])
def test_a_damaged_or_foreign_entry_is_none_and_is_removed(folder: CacheFolder, damage: str) -> None:
    write(folder, "a")
    file = folder.path / f"{key('a')}.npz"
    if damage == "truncated":
        file.write_bytes(file.read_bytes()[:-100])
    elif damage == "of another key":
        write(folder, "b")
        (folder.path / f"{key('b')}.npz").replace(file)
    elif damage == "empty":
        file.write_bytes(b"")
    assert folder.read(key("a"), "other/1" if damage == "of another format" else FORMAT) is None
    assert not file.exists()


def test_clear_removes_entries_and_leaves_other_files(folder: CacheFolder) -> None:
    write(folder, "a")
    (folder.path / "notes.npz").write_bytes(b"mine")
    (folder.path / f".{key('b')}.npz.host.1.0.tmp").write_bytes(b"unfinished")
    folder.clear()
    assert [file.name for file in folder.path.iterdir()] == ["notes.npz"]


def test_unfinished_files_of_killed_processes_are_removed_when_they_are_old(folder: CacheFolder) -> None:
    write(folder, "a")
    old, new = (folder.path / f".{key(digit)}.npz.host.1.0.tmp" for digit in "bc")
    for file in (old, new):
        file.write_bytes(b"unfinished")
    os.utime(old, (0, 0))
    write(folder, "d")
    assert new.exists()
    assert not old.exists()


def test_a_folder_that_cannot_be_made_is_an_input_error(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(InputError, match="cannot be written"):
        write(CacheFolder(tmp_path / "file" / "cache"), "a")
    assert CacheFolder(tmp_path / "file" / "cache").measure() == (0, 0)


def test_the_platforms_folder_is_used(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setattr("sys.platform", "linux")
    monkeypatch.setenv("HOME", str(tmp_path))
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "xdg"))
    assert default_cache_path() == tmp_path / "xdg" / "calgraph"
    monkeypatch.setenv("XDG_CACHE_HOME", "relative")
    assert default_cache_path() == tmp_path / ".cache" / "calgraph"
    monkeypatch.setattr("sys.platform", "darwin")
    assert default_cache_path() == tmp_path / "Library" / "Caches" / "calgraph"
    monkeypatch.setattr("sys.platform", "win32")
    monkeypatch.setenv("LOCALAPPDATA", str(tmp_path / "local"))
    assert default_cache_path() == tmp_path / "local" / "calgraph" / "Cache"
