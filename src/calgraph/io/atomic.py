"""Atomic output: files are written under a temporary name in the same folder, then renamed.

A process that is killed (SIGKILL) leaves its temporary file or folder; the next one that writes to the same place
removes it. Other signals that end the program remove it first. Devices and pipes, such as /dev/stdout, are written
to; symbolic links stay, and lead to the new file.
"""

import os
import platform
import re
import secrets
import shutil
import tempfile
import zlib
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from functools import partial
from pathlib import Path

from calgraph.errors import InputError
from calgraph.io.termination import add_cleanup, remove_cleanup


@contextmanager
def write_atomically(path: Path) -> Iterator[Path]:
    """A temporary name beside ``path`` to write to; it becomes ``path`` if the block ends without an error.

    Raises:
        InputError: the folder of ``path`` does not exist or cannot be written to, or ``path`` is a folder.
    """
    check_output_path(path)
    if path.exists() and not path.is_file():
        with _write_to_device(path) as temporary:
            yield temporary
        return
    target = follow_links(path) if path.is_symlink() else path
    _remove_abandoned(target.parent, target.name)
    # Same folder, hence same file system: the rename is atomic.
    temporary = target.parent / _temporary_name(target)
    add_cleanup(temporary, partial(temporary.unlink, missing_ok=True))
    try:
        with _wrap_errors(path):
            yield temporary
            temporary.replace(target)
    finally:
        temporary.unlink(missing_ok=True)
        remove_cleanup(temporary)


@contextmanager
def _write_to_device(path: Path) -> Iterator[Path]:
    """A temporary name, of which the file is copied to a device or pipe: these cannot be replaced."""
    with temporary_folder() as folder:
        temporary = folder / "output"
        with _wrap_errors(path):
            yield temporary
            with temporary.open("rb") as file, path.open("wb") as device:
                shutil.copyfileobj(file, device)


def follow_links(path: Path) -> Path:
    """The absolute path without links.

    Raises:
        InputError: its links lead in a loop.
    """
    try:
        return path.resolve()
    except (OSError, RuntimeError) as error:
        # The latter is how Python before 3.13 reports a loop.
        raise InputError(f"{path}: is a link that leads nowhere") from error


def check_output_path(path: Path) -> None:
    """Checks, before long work begins, that a file can be written at ``path``.

    Raises:
        InputError: the folder of ``path`` does not exist, or ``path`` is a folder.
    """
    with _wrap_errors(path):
        if path.is_dir():
            raise InputError(f"{path}: is a folder, a file is to be written there")
        if not path.parent.is_dir():
            raise InputError(f"{path}: its folder does not exist")


@contextmanager
def replace_folder_atomically(path: Path, last: str) -> Iterator[Path]:
    """A temporary folder whose files move into the folder ``path`` if the block ends without an error.

    ``path`` is created if it is missing. Its other files stay; files of the same name are replaced atomically.
    Only the top level is moved: a folder replaces the folder of the same name as a whole.

    Args:
        path: the folder.
        last: name of the file or folder that marks a complete result. An earlier one is removed before, and the
            new one is moved after all others: a process that is killed leaves no mixture of results that has it.

    Raises:
        InputError: ``path`` is a file, or cannot be made or written to; raised before the block is entered.
    """
    with _wrap_errors(path):
        if path.exists() and not path.is_dir():
            raise InputError(f"{path}: is a file, a folder is to be written there")
        temporary = make_temporary_folder(path)
    try:
        yield temporary
        with _wrap_errors(path):
            _move_into_place(temporary, path, last)
    finally:
        remove_temporary_folder(temporary)


def write_text(path: Path, text: str) -> None:
    r"""Writes a whole text file (UTF-8) in one step, as :func:`write_atomically` does.

    Bytes of file names that are not UTF-8 are written as escapes: \udce9.
    """
    with write_atomically(path) as temporary:
        temporary.write_text(text, encoding="utf-8", errors="backslashreplace")


@contextmanager
def temporary_folder() -> Iterator[Path]:
    """An empty folder for temporary files that is removed in the end.

    Raises:
        InputError: the system's folder for temporary files cannot be written to.
    """
    place = Path(tempfile.gettempdir()) / "calgraph"
    with _wrap_errors(place.parent):
        _remove_abandoned(place.parent, place.name)
        folder = place.parent / _temporary_name(place)
        add_cleanup(folder, partial(shutil.rmtree, folder, ignore_errors=True))
        folder.mkdir(mode=0o700)
    try:
        yield folder
    finally:
        remove_temporary_folder(folder)


def make_temporary_folder(path: Path) -> Path:
    """An empty folder on the file system of ``path``: inside it if it exists (it may be a mount point).

    Those that killed processes left for the same path are removed. :func:`remove_temporary_folder` removes it.
    """
    if not path.exists():
        path.parent.mkdir(parents=True, exist_ok=True)
    for folder in (path.parent, path):
        _remove_abandoned(folder, path.name)
    temporary = (path if path.exists() else path.parent) / _temporary_name(path)
    add_cleanup(temporary, partial(shutil.rmtree, temporary, ignore_errors=True))
    temporary.mkdir()
    return temporary


def remove_temporary_folder(folder: Path) -> None:
    """Removes what :func:`make_temporary_folder` made, unless it was renamed."""
    shutil.rmtree(folder, ignore_errors=True)
    remove_cleanup(folder)


def _move_into_place(temporary: Path, path: Path, last: str) -> None:
    if not path.exists():
        temporary.rename(path)
        return
    _remove(path / last)
    for entry in sorted(temporary.iterdir(), key=lambda entry: (entry.name == last, entry.name)):
        target = path / entry.name
        if target.is_dir() or entry.is_dir():
            _remove(target)
        entry.replace(target)


def _remove(path: Path) -> None:
    if path.is_dir() and not path.is_symlink():
        shutil.rmtree(path)
    else:
        path.unlink(missing_ok=True)


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
