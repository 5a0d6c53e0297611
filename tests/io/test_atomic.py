"""Files and folders appear whole or not at all."""

import multiprocessing
import os
import signal
import sys
from contextlib import suppress
from pathlib import Path

import pytest

from calgraph.errors import InputError
from calgraph.io.atomic import replace_folder_atomically, temporary_folder, write_atomically, write_text


def names(folder: Path) -> list[str]:
    return sorted(path.name for path in folder.iterdir())


def test_the_file_is_not_there_before_the_block_ends(tmp_path: Path) -> None:
    with write_atomically(tmp_path / "a.txt") as temporary:
        temporary.write_text("new")
        assert not (tmp_path / "a.txt").exists()
    assert (tmp_path / "a.txt").read_text() == "new"
    assert names(tmp_path) == ["a.txt"]


def test_an_error_leaves_the_old_file(tmp_path: Path) -> None:
    write_text(tmp_path / "a.txt", "old")
    with suppress(ZeroDivisionError), write_atomically(tmp_path / "a.txt") as temporary:
        temporary.write_text("half")
        raise ZeroDivisionError
    assert (tmp_path / "a.txt").read_text() == "old"
    assert names(tmp_path) == ["a.txt"]


def test_a_folder_in_the_place_of_the_file_is_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="is a folder, a file is to be written there"):
        write_text(tmp_path, "x")


def test_a_missing_folder_is_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="its folder does not exist"):
        write_text(tmp_path / "none" / "a.txt", "x")


def test_a_new_folder_appears_with_its_files(tmp_path: Path) -> None:
    out = tmp_path / "deep" / "out"
    with replace_folder_atomically(out, "a.txt") as temporary:
        (temporary / "a.txt").write_text("a")
        assert not out.exists()
    assert names(out) == ["a.txt"]
    assert names(out.parent) == ["out"]


def test_an_error_leaves_no_folder(tmp_path: Path) -> None:
    with suppress(ZeroDivisionError), replace_folder_atomically(tmp_path / "out", "a.txt") as temporary:
        (temporary / "a.txt").write_text("a")
        raise ZeroDivisionError
    assert names(tmp_path) == []


def test_files_of_others_in_the_folder_stay(tmp_path: Path) -> None:
    (tmp_path / "out").mkdir()
    (tmp_path / "out" / "mine.txt").write_text("mine")
    (tmp_path / "out" / "a.txt").write_text("old")
    with replace_folder_atomically(tmp_path / "out", "a.txt") as temporary:
        (temporary / "a.txt").write_text("new")
    assert names(tmp_path / "out") == ["a.txt", "mine.txt"]
    assert (tmp_path / "out" / "a.txt").read_text() == "new"


def test_a_folder_inside_replaces_its_namesake_whole(tmp_path: Path) -> None:
    (tmp_path / "out" / "plots").mkdir(parents=True)
    (tmp_path / "out" / "plots" / "stale.png").write_text("x")
    with replace_folder_atomically(tmp_path / "out", "a.txt") as temporary:
        (temporary / "plots").mkdir()
        (temporary / "plots" / "fresh.png").write_text("x")
    assert names(tmp_path / "out" / "plots") == ["fresh.png"]


def test_a_file_in_the_place_of_the_folder_is_refused(tmp_path: Path) -> None:
    write_text(tmp_path / "out", "x")
    with (
        pytest.raises(InputError, match="is a file, a folder is to be written there"),
        replace_folder_atomically(tmp_path / "out", "a.txt"),
    ):
        pass


def write_until_killed(path: Path, folder: bool) -> None:
    """Writes half of the output; then the process is killed as by a system that runs out of memory."""
    with replace_folder_atomically(path, "a.txt") if folder else write_atomically(path) as temporary:
        (temporary / "a.txt" if folder else temporary).write_text("half")
        os.kill(os.getpid(), signal.SIGKILL)


@pytest.mark.parametrize("exists", [False, True])
@pytest.mark.parametrize("folder", [False, True])
def test_what_a_killed_process_left_is_removed_by_the_next(tmp_path: Path, folder: bool, exists: bool) -> None:
    out = tmp_path / "out"
    if exists and folder:
        out.mkdir()
    elif exists:
        out.write_text("old")
    place = out if exists and folder else tmp_path
    process = multiprocessing.get_context("spawn").Process(target=write_until_killed, args=(out, folder))
    process.start()
    process.join(60)
    assert process.exitcode == -signal.SIGKILL
    [left] = [name for name in names(place) if name.endswith(".tmp")]
    # Of a running process, and of a process on another computer.
    running = left.replace(f".{process.pid}.", f".{os.getpid()}.")
    host = left.removeprefix(".out.").partition(".")[0]
    elsewhere = left.replace(host, "0" * len(host))
    for other in (running, elsewhere):
        (place / other).write_text("of another")
    with replace_folder_atomically(out, "a.txt") if folder else write_atomically(out) as temporary:
        (temporary / "a.txt" if folder else temporary).write_text("whole")
    assert ((out / "a.txt") if folder else out).read_text() == "whole"
    assert sorted(name for name in names(place) if name.endswith(".tmp")) == sorted([running, elsewhere])


def kill_before_moving(path: Path, number: int) -> None:
    """Replaces a result by another, and is killed before one of its files is removed or moved."""
    count = 0

    def count_operations(event: str, arguments: tuple[object, ...]) -> None:
        nonlocal count
        if event in ("os.rename", "os.remove") and str(path) in str(arguments[0]):
            count += 1
            if count == number:
                os.kill(os.getpid(), signal.SIGKILL)

    sys.addaudithook(count_operations)
    write_result(path, "new")


def write_result(path: Path, text: str) -> None:
    with replace_folder_atomically(path, "last.txt") as folder:
        for name in ("a.txt", "last.txt", "z.txt"):
            (folder / name).write_text(text)


@pytest.mark.parametrize("number", [1, 2, 3, 4])
def test_a_killed_process_leaves_no_mixture_of_two_results(tmp_path: Path, number: int) -> None:
    out = tmp_path / "out"
    write_result(out, "old")
    process = multiprocessing.get_context("spawn").Process(target=kill_before_moving, args=(out, number))
    process.start()
    process.join(60)
    assert process.exitcode == -signal.SIGKILL
    if (out / "last.txt").exists():
        assert {(out / name).read_text() for name in ("a.txt", "last.txt", "z.txt")} == {"old"}
    write_result(out, "newer")
    assert names(out) == ["a.txt", "last.txt", "z.txt"]


def test_a_pipe_is_written_to(tmp_path: Path) -> None:
    pipe = tmp_path / "pipe"
    os.mkfifo(pipe)
    process = multiprocessing.get_context("spawn").Process(target=write_text, args=(pipe, "content"))
    process.start()
    assert pipe.read_text() == "content"
    process.join(60)
    assert pipe.is_fifo()
    assert names(tmp_path) == ["pipe"]


def test_a_link_stays_and_leads_to_the_new_file(tmp_path: Path) -> None:
    (tmp_path / "folder").mkdir()
    (tmp_path / "folder/file.txt").write_text("old")
    (tmp_path / "link").symlink_to("folder/file.txt")
    write_text(tmp_path / "link", "new")
    assert (tmp_path / "link").is_symlink()
    assert (tmp_path / "folder/file.txt").read_text() == "new"
    assert names(tmp_path / "folder") == ["file.txt"]


def test_a_loop_of_links_is_named(tmp_path: Path) -> None:
    (tmp_path / "link").symlink_to("link")
    with suppress(InputError):  # Python 3.13 replaces it
        write_text(tmp_path / "link", "x")
    assert names(tmp_path) == ["link"]


def test_a_name_that_is_too_long_is_named(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"n+: cannot be written \(File name too long\)"):
        write_text(tmp_path / ("n" * 300), "x")


def leave_temporary_folder() -> None:
    with temporary_folder() as folder:
        (folder / "copy").write_text("x")
        os.kill(os.getpid(), signal.SIGKILL)


def test_temporary_folders_of_killed_processes_are_removed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("TMPDIR", str(tmp_path))
    monkeypatch.setattr("tempfile.tempdir", None)
    process = multiprocessing.get_context("spawn").Process(target=leave_temporary_folder)
    process.start()
    process.join(60)
    assert len(names(tmp_path)) == 1
    with temporary_folder() as folder:
        assert names(tmp_path) == [folder.name]
    assert names(tmp_path) == []


def test_names_that_are_not_utf8_are_written_as_escapes(tmp_path: Path) -> None:
    write_text(tmp_path / "a.txt", os.fsdecode(b"caf\xe9 \xc3\xa9"))
    assert (tmp_path / "a.txt").read_text(encoding="utf-8") == "caf\\udce9 é"
