"""Files that appear whole or not at all: written beside their place under another name, then renamed."""

import os
import secrets
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from calgraph.errors import InputError


@contextmanager
def replacing(path: Path) -> Iterator[Path]:
    """A temporary name beside ``path`` to write to; it becomes ``path`` if the block ends without an error.

    Raises:
        InputError: the folder of ``path`` does not exist or cannot be written to, or ``path`` is a folder.

    """
    if path.is_dir():
        raise InputError(f"{path}: is a folder, a file is to be written there")
    if not path.parent.is_dir():
        raise InputError(f"{path}: its folder does not exist")
    # Same folder, hence same file system: the rename is then one step for everybody who looks.
    temporary = _beside(path)
    try:
        yield temporary
        temporary.replace(path)
    except PermissionError as error:
        raise InputError(f"{path}: cannot be written ({error.strerror})") from error
    finally:
        temporary.unlink(missing_ok=True)


@contextmanager
def replacing_folder(path: Path) -> Iterator[Path]:
    """A temporary folder whose files move into the folder ``path`` if the block ends without an error.

    ``path`` is made if it is missing. Its other files stay; files of the same name are replaced, each in one
    step. Only the top level is moved: a folder replaces the folder of its name whole.

    Raises:
        InputError: ``path`` is a file, or cannot be made or written to.

    """
    if path.exists() and not path.is_dir():
        raise InputError(f"{path}: is a file, a folder is to be written there")
    temporary = _beside(path)
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        temporary.mkdir()
        yield temporary
        if path.exists():
            for entry in sorted(temporary.iterdir()):
                _move(entry, path / entry.name)
        else:
            temporary.rename(path)
    except PermissionError as error:
        raise InputError(f"{path}: cannot be written ({error.strerror})") from error
    finally:
        shutil.rmtree(temporary, ignore_errors=True)


def write_text(path: Path, text: str) -> None:
    """Writes a whole text file (UTF-8) in one step, as :func:`replacing` does."""
    with replacing(path) as temporary:
        temporary.write_text(text, encoding="utf-8")


def _move(source: Path, target: Path) -> None:
    if target.is_dir() and not target.is_symlink():
        shutil.rmtree(target)
    source.replace(target)


def _beside(path: Path) -> Path:
    return path.parent / f".{path.name}.{os.getpid()}.{secrets.token_hex(4)}.tmp"
