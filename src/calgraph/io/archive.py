"""One JSON object and plain arrays in a ZIP: ``numpy.load`` reads it, and so does any program that knows ZIP."""

import json
import math
import warnings
import zipfile
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from calgraph.errors import InputError
from calgraph.io.atomic import write_atomically
from calgraph.io.git_lfs import POINTER_START, check_git_lfs


def write_archive(
    path: Path,
    member: str,
    content: Mapping[str, Any],
    arrays: Mapping[str, NDArray[Any]],
    *,
    compression: int = zipfile.ZIP_DEFLATED,
) -> None:
    """Writes in one step; the same content gives the same bytes.

    Args:
        path: the file.
        member: name of the JSON object in it.
        content: the object; its key ``format`` names the kind of file and its version.
        arrays: by name; each becomes the member ``<name>.npy``.
        compression: one of zipfile's; ``ZIP_STORED`` where compression does not pay.

    Raises:
        InputError: ``path`` cannot be written.
    """
    with write_atomically(path) as temporary, zipfile.ZipFile(temporary, "w", compression) as archive:
        _add(archive, member, json.dumps(content, ensure_ascii=False, allow_nan=False, indent=1).encode())
        for name, array in arrays.items():
            stream = BytesIO()
            np.lib.format.write_array(stream, array, allow_pickle=False)
            _add(archive, f"{name}.npy", stream.getvalue())


def read_archive(
    path: Path, member: str, format: str, max_unpacked_bytes: int
) -> tuple[dict[str, Any], dict[str, NDArray[Any]]]:
    """The JSON object and the arrays of :func:`write_archive`.

    Args:
        path: the file.
        member: name of the JSON object in it.
        format: the one that is read.
        max_unpacked_bytes: maximum size of all members; checked before memory is taken.

    Raises:
        InputError: the file is missing, is something else, has another format or version, or is damaged.
    """
    if path.is_char_device() or path.is_block_device():
        raise InputError(f"{path}: is a device, and not a file of the format {format}")
    try:
        data = path.read_bytes()
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror or error})") from error
    check_git_lfs(path, data[:POINTER_START])
    with _wrap_damage_errors(path):
        archive = zipfile.ZipFile(BytesIO(data))
    size = sum(entry.file_size for entry in archive.infolist())
    if size > max_unpacked_bytes:
        raise InputError(
            f"{path}: unpacks to {size / 1e6:.0f} MB, more than the limit of {max_unpacked_bytes / 1e6:.0f} MB: "
            "it is damaged, or needs limits.max_archive_bytes in the settings"
        )
    if member not in archive.namelist():
        raise InputError(f"{path}: has no member {member}; it is not a file of the format {format}")
    with _wrap_damage_errors(path, member):
        content = json.loads(archive.read(member))
    given = content.get("format") if isinstance(content, dict) else None
    if given != format:
        shown = "nothing" if given is None else repr(given)
        raise InputError(f"{path}: format: must be {format}, which this calgraph reads, got {shown}")
    return content, dict(_arrays(path, archive))


def _arrays(path: Path, archive: zipfile.ZipFile) -> Iterator[tuple[str, NDArray[Any]]]:
    for name in archive.namelist():
        if name.endswith(".npy"):
            with _wrap_damage_errors(path, name):
                # Whole, as only then the checksum is compared.
                stream = BytesIO(archive.read(name))
                with warnings.catch_warnings():
                    warnings.simplefilter("ignore", UserWarning)  # of headers that Python 2 wrote
                    _check_array_size(stream)
                    array = np.lib.format.read_array(stream, allow_pickle=False)
            yield name.removesuffix(".npy"), array


def _check_array_size(stream: BytesIO) -> None:
    """Raises ValueError if the header states another size than what follows: NumPy allocates before it reads."""
    read_header = {(1, 0): np.lib.format.read_array_header_1_0, (2, 0): np.lib.format.read_array_header_2_0}
    version = np.lib.format.read_magic(stream)
    if version not in read_header:
        raise ValueError(f"version {version} of the array format")
    shape, _, dtype = read_header[version](stream)
    left = stream.getbuffer().nbytes - stream.tell()
    stream.seek(0)
    if not dtype.hasobject and math.prod(shape) * dtype.itemsize != left:
        raise ValueError(f"its header states the shape {shape}, which {left} bytes do not have")


def _add(archive: zipfile.ZipFile, name: str, data: bytes) -> None:
    # Without the time of writing, which ZipInfo sets to 1980, so that equal content gives equal bytes.
    archive.writestr(zipfile.ZipInfo(name), data, archive.compression)


@contextmanager
def _wrap_damage_errors(path: Path, member: str = "") -> Iterator[None]:
    """Converts what zipfile and NumPy raise for damaged bytes, from zlib.error to tokenize.TokenError."""
    try:
        yield
    except InputError:
        raise
    except Exception as error:
        what = f"its member {member} is damaged" if member else "is truncated, damaged, or not a ZIP file"
        raise InputError(f"{path}: {what} ({str(error) or type(error).__name__}); write it again") from error
