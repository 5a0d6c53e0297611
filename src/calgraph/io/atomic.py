"""Atomic output: files are written under a temporary name in the same folder, then renamed.

A process that is killed (SIGKILL) leaves its temporary file or folder; the next one that writes to the same place
removes it.
"""

import os
import platform
import re
import secrets
import shutil
import zlib
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from calgraph.errors import InputError


@contextmanager
def write_atomically(path: Path) -> Iterator[Path]:
    """A temporary name beside ``path`` to write to; it becomes ``path`` if the block ends without an error.

    Raises:
        InputError: the folder of ``path`` does not exist or cannot be written to, or ``path`` is a folder.
    """
    check_output_path(path)
    _remove_abandoned(path.parent, path.name)
    # Same folder, hence same file system: the rename is atomic.
    temporary = path.parent / _temporary_name(path)
    try:
        with _wrap_errors(path):
            yield temporary
            temporary.replace(path)
    finally:
        temporary.unlink(missing_ok=True)


def check_output_path(path: Path) -> None:
    """Checks, before long work begins, that a file can be written at ``path``.

    Raises:
        InputError: the folder of ``path`` does not exist, or ``path`` is a folder.
    """
    if path.is_dir():
        raise InputError(f"{path}: is a folder, a file is to be written there")
    if not path.parent.is_dir():
        raise InputError(f"{path}: its folder does not exist")


@contextmanager
def replace_folder_atomically(path: Path) -> Iterator[Path]:
    """A temporary folder whose files move into the folder ``path`` if the block ends without an error.

    ``path`` is created if it is missing. Its other files stay; files of the same name are replaced atomically.
    Only the top level is moved: a folder replaces the folder of the same name as a whole.

    Raises:
        InputError: ``path`` is a file, or cannot be made or written to; raised before the block is entered.
    """
    if path.exists() and not path.is_dir():
        raise InputError(f"{path}: is a file, a folder is to be written there")
    with _wrap_errors(path):
        temporary = _make_temporary_folder(path)
    try:
        yield temporary
        with _wrap_errors(path):
            _move_into_place(temporary, path)
    finally:
        shutil.rmtree(temporary, ignore_errors=True)


def write_text(path: Path, text: str) -> None:
    """Writes a whole text file (UTF-8) in one step, as :func:`write_atomically` does."""
    with write_atomically(path) as temporary:
        temporary.write_text(text, encoding="utf-8")


def _make_temporary_folder(path: Path) -> Path:
    """An empty folder on the file system of ``path``: inside it if it exists (it may be a mount point)."""
    if not path.exists():
        path.parent.mkdir(parents=True, exist_ok=True)
    for folder in (path.parent, path):
        _remove_abandoned(folder, path.name)
    temporary = (path if path.exists() else path.parent) / _temporary_name(path)
    temporary.mkdir()
    return temporary


def _move_into_place(temporary: Path, path: Path) -> None:
    if path.exists():
        for entry in sorted(temporary.iterdir()):
            _move(entry, path / entry.name)
    else:
        temporary.rename(path)


def _move(source: Path, target: Path) -> None:
    if target.is_dir() and not target.is_symlink():
        shutil.rmtree(target)
    source.replace(target)


def _temporary_name(path: Path) -> str:
    return f".{path.name}.{_host()}.{os.getpid()}.{secrets.token_hex(4)}.tmp"


def _host() -> str:
    """Distinguishes the computers and containers that share a file system: process numbers hold in one only."""
    try:
        namespace = str(Path("/proc/self/ns/pid").readlink())
    except OSError:
        namespace = ""
    return f"{zlib.crc32(f'{platform.node()} {namespace}'.encode()):08x}"


def _remove_abandoned(folder: Path, name: str) -> None:
    """Removes the temporary files and folders for ``name`` whose process on this computer has ended."""
    pattern = re.compile(rf"\.{re.escape(name)}\.{_host()}\.(\d+)\.[0-9a-f]{{8}}\.tmp")
    try:
        entries = [(entry, found) for entry in folder.iterdir() if (found := pattern.fullmatch(entry.name))]
    except OSError:
        # A folder that is missing or cannot be read is the matter of those who write to it.
        return
    for entry, found in entries:
        if _is_running(int(found[1])):
            continue
        if entry.is_dir() and not entry.is_symlink():
            shutil.rmtree(entry, ignore_errors=True)
        else:
            with suppress(OSError):
                entry.unlink()


def _is_running(pid: int) -> bool:
    """Whether a process exists; taken for granted where the system has no signal that only asks."""
    if os.name != "posix":
        return True
    try:
        os.kill(pid, 0)
    except (ProcessLookupError, OverflowError):
        return False
    except PermissionError:
        # It belongs to another user.
        pass
    return True


@contextmanager
def _wrap_errors(path: Path) -> Iterator[None]:
    try:
        yield
    except OSError as error:
        raise InputError(f"{path}: cannot be written ({error.strerror or error})") from error
