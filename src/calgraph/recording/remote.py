"""Recordings at URLs: copied once to each machine that reads them, by fsspec.

Recordings are read in several passes, by several processes, and by libraries that need files. A copy is found
again as long as the file at the URL is the same; copies that have not been used for a day are removed.
"""

import hashlib
import logging
import os
import shutil
import tempfile
import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from typing import Any
from urllib.parse import urlsplit

from calgraph.config.settings import LimitSettings
from calgraph.errors import CalgraphError, InputError, RecordingError
from calgraph.io.atomic import make_temporary_folder, remove_temporary_folder

_log = logging.getLogger("calgraph")

# What changes with the content of a file; each protocol states some of these.
_VERSION_KEYS = ("ETag", "etag", "md5Hash", "LastModified", "last_modified", "mtime", "created")


@dataclass(frozen=True)
class _RemoteFile:
    path: str
    """In the file system of its URL."""
    size: int | None
    """Bytes; None where the server does not state it."""
    version: str
    """Changes with the content, where the server states anything of it."""


def is_url(path: object) -> bool:
    """Whether something is a URL, and no path."""
    return isinstance(path, str) and "://" in path


def fetch_recording(url: str, limits: LimitSettings) -> Path:
    """The copy of a file or folder on this machine, made if there is none; a local file is not copied.

    Raises:
        InputError: fsspec or the package for the protocol is not installed, or there is nothing at the URL.
        RecordingError: it cannot be read, or the disk has too little space for it.
    """
    with _explained_errors(url):
        system, root = _open_file_system(url, limits)
        if "file" in (system.protocol if isinstance(system.protocol, tuple) else (system.protocol,)):
            return Path(root)
        files = _list_files(system, root)
        if not files:
            raise FileNotFoundError(url)
        name = PurePosixPath(urlsplit(url).path).name or "recording"
        place = _find_place(url) / _hash(repr(sorted((inner, vars(file)) for inner, file in files.items())))
        with _locked(place.parent):
            if not place.exists():
                _remove_unused(place.parents[1], limits)
                _copy(system, url, files, place, name, limits)
            (place / "used").touch()
        return place / "copy" / name


def find_copy(url: str) -> Path | None:
    """The last copy of a URL on this machine, without a look at the URL; None if there is none."""
    copies = sorted(_find_place(url).glob("*/used"), key=lambda used: used.stat().st_mtime)
    return next((copies[-1].parent / "copy").iterdir()) if copies else None


def _open_file_system(url: str, limits: LimitSettings) -> tuple[Any, str]:
    """The file system of a URL, and the path in it; neither remembers what it listed."""
    try:
        import fsspec
    except ImportError as error:
        raise InputError(
            f"{url}: URLs need fsspec, which is not installed: pip install 'calgraph[cluster]'"
        ) from error
    options: dict[str, Any] = {"skip_instance_cache": True, "use_listings_cache": False}
    protocol = url.partition("://")[0]
    if protocol == "s3":
        options["config_kwargs"] = {"connect_timeout": limits.url_timeout, "read_timeout": limits.url_timeout}
    elif protocol in ("http", "https"):
        import aiohttp

        timeout = aiohttp.ClientTimeout(sock_connect=limits.url_timeout, sock_read=limits.url_timeout)
        options["client_kwargs"] = {"timeout": timeout}
    system, root = fsspec.core.url_to_fs(url, **options)
    return system, root


def _list_files(system: Any, root: str) -> dict[str, _RemoteFile]:
    """The file, or all files in the folder, by their paths below it."""
    entry = system.info(root)
    if entry["type"] != "directory":
        return {"": _describe_file(entry)}
    found = {}
    for path, inner in system.find(root, detail=True).items():
        name = path.removeprefix(root).lstrip("/")
        if ".." in PurePosixPath(name).parts:
            raise ValueError(f"the name {name!r} leads out of the folder")
        found[name] = _describe_file(inner)
    return found


def _describe_file(entry: Mapping[str, Any]) -> _RemoteFile:
    version = repr([entry[key] for key in _VERSION_KEYS if entry.get(key) is not None])
    return _RemoteFile(entry["name"], entry.get("size"), version)


def _copy(
    system: Any, url: str, files: Mapping[str, _RemoteFile], place: Path, name: str, limits: LimitSettings
) -> None:
    """Copies files to a folder that appears when it is complete."""
    size = sum(file.size or 0 for file in files.values())
    if shutil.disk_usage(place.parent).free - size < limits.min_free_disk:
        raise RecordingError(
            f"{url}: has {size / 1e6:.0f} MB, more than the space in {place.parents[1]}, of which "
            f"{limits.min_free_disk / 1e6:.0f} MB are left free (limits.min_free_disk); set TMPDIR to a folder "
            "with more space"
        )
    _log.info("%s: copied to this machine, %.1f MB", url, size / 1e6)
    temporary = make_temporary_folder(place)
    try:
        for inner, file in files.items():
            copy = temporary / "copy" / name / inner if inner else temporary / "copy" / name
            copy.parent.mkdir(parents=True, exist_ok=True)
            system.get_file(file.path, str(copy))
            if file.size is not None and copy.stat().st_size != file.size:
                raise ValueError(f"{copy.stat().st_size} of {file.size} bytes were received")
        temporary.rename(place)
    finally:
        remove_temporary_folder(temporary)


def _find_place(url: str) -> Path:
    """The folder of the copies of a URL, which only this user can write to."""
    user = os.getuid() if hasattr(os, "getuid") else os.environ.get("USERNAME", "")
    top = Path(tempfile.gettempdir()) / f"calgraph-recordings-{user}"
    top.mkdir(mode=0o700, exist_ok=True)
    if hasattr(os, "getuid") and top.stat().st_uid != user:
        raise PermissionError(f"{top} belongs to another user")
    place = top / _hash(url)
    place.mkdir(exist_ok=True)
    return place


def _hash(text: str) -> str:
    return hashlib.blake2b(text.encode(), digest_size=16).hexdigest()


def _remove_unused(top: Path, limits: LimitSettings) -> None:
    oldest = time.time() - limits.max_copy_age
    for used in top.glob("*/*/used"):
        if used.stat().st_mtime < oldest:
            shutil.rmtree(used.parent, ignore_errors=True)


@contextmanager
def _locked(folder: Path) -> Iterator[None]:
    """Waits while another process of this machine copies the same URL."""
    try:
        import fcntl
    except ImportError:  # Windows: each process makes a copy, and the first that is complete is used
        yield
        return
    with (folder / "lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        yield


@contextmanager
def _explained_errors(url: str) -> Iterator[None]:
    """Converts errors of fsspec and of the packages for protocols, which raise nearly anything.

    Raises:
        InputError: there is nothing at the URL, or a package is missing.
        RecordingError: it cannot be read.
    """
    try:
        yield
    except CalgraphError:
        raise
    except FileNotFoundError as error:
        raise InputError(f"{url}: does not exist, or its server does not list it") from error
    except ImportError as error:
        raise InputError(f"{url}: its protocol needs a further package ({error})") from error
    except Exception as error:
        reason = " ".join(str(error).split()) or type(error).__name__
        raise RecordingError(
            f"{url}: cannot be read ({reason}); check address, network and credentials"
        ) from error
