"""``calgraph cache``, and the environment variables that the other commands' cache has."""

import os
import re
from pathlib import Path
from typing import Annotated

import typer
from rich.markup import escape

from calgraph.cli.console import console
from calgraph.errors import InputError
from calgraph.io.cache_folder import MAX_BYTES, CacheFolder, default_cache_path
from calgraph.recording import NO_CACHE, RecordingCache

_UNITS = {"MB": 10**6, "GB": 10**9}
_QUANTITY = re.compile(r"(\d{1,6}(?:\.\d{1,6})?)\s*(MB|GB)")


def cache(clear: Annotated[bool, typer.Option("--clear", help="Remove everything from it.")] = False) -> None:
    """Show where detections are kept for later runs, and their size; or remove them.

    Runs on the same recording reuse them, with the same results.
    CALGRAPH_CACHE is another folder, or off. CALGRAPH_CACHE_SIZE is the maximum size, such as 500 MB.
    """
    folder = find_cache()
    output = console()
    if folder is None:
        output.print("The cache is off (CALGRAPH_CACHE).")
        return
    if clear:
        folder.clear()
    count, size = folder.measure()
    output.print(escape(str(folder.path)))
    output.print(f"{count} entries, {size / 1e6:.1f} MB of at most {folder.max_bytes / 1e6:.0f} MB")


def open_cache(*, unused: bool) -> RecordingCache:
    """The cache of a command; one that keeps nothing if it is unused or off."""
    folder = None if unused else find_cache()
    return RecordingCache(folder.path, folder.max_bytes) if folder else NO_CACHE


def find_cache() -> CacheFolder | None:
    """The cache as the environment states it; None if it is off, or if the user has no home.

    Raises:
        InputError: the stated size is malformed.
    """
    stated, size = os.environ.get("CALGRAPH_CACHE", ""), os.environ.get("CALGRAPH_CACHE_SIZE", "")
    quantity = _QUANTITY.fullmatch(size.strip())
    if size and not quantity:
        raise InputError(f"CALGRAPH_CACHE_SIZE: must be a size such as 500 MB or 5 GB, got {size!r}")
    max_bytes = int(float(quantity[1]) * _UNITS[quantity[2]]) if quantity else MAX_BYTES
    if stated == "off":
        return None
    try:
        return CacheFolder(Path(stated) if stated else default_cache_path(), max_bytes)
    except RuntimeError:
        return None
