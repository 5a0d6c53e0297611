"""Atomic output: files are written under a temporary name in the same folder, then renamed."""

import os
import secrets
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from calgraph.errors import InputError


@contextmanager
def write_atomically(path: Path) -> Iterator[Path]:
    """A temporary name beside ``path`` to write to; it becomes ``path`` if the block ends without an error.

    Raises:
        InputError: the folder of ``path`` does not exist or cannot be written to, or ``path`` is a folder.
    """
    check_output_path(path)
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
    return f".{path.name}.{os.getpid()}.{secrets.token_hex(4)}.tmp"


@contextmanager
def _wrap_errors(path: Path) -> Iterator[None]:
    try:
        yield
    except OSError as error:
        raise InputError(f"{path}: cannot be written ({error.strerror or error})") from error
