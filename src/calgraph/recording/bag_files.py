"""Which files make up a bag, and its metadata.yaml, which is read for numbers of messages, and written."""

import re
import shutil
import struct
import sys
from collections import Counter
from collections.abc import Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path, PurePath
from typing import Any

from rosbags.interfaces import Connection

from calgraph.config.settings import LimitSettings
from calgraph.errors import InputError, RecordingError
from calgraph.io.atomic import temporary_folder
from calgraph.io.text_writing import save_yaml
from calgraph.io.yaml_reading import read_yaml
from calgraph.recording.damage import check_fetched, check_unpacked_size, wrap_errors
from calgraph.recording.recording import TopicInfo

if sys.version_info >= (3, 14):
    from compression import zstd
else:
    from backports import zstd

STORAGE_SUFFIXES = (".mcap", ".db3", ".bag")
_ZSTD_SUFFIXES = (".zstd", ".zst")
_ZSTD_MAGIC = b"\x28\xb5\x2f\xfd"
# Between two looks at the free space.
_COPY_BYTES = 2**24


@dataclass(frozen=True)
class BagFiles:
    """The storage files of a bag."""

    files: tuple[Path, ...]
    """In the order they were recorded."""
    stated: tuple[TopicInfo, ...]
    """Topics as metadata.yaml counts them; empty without one."""


def is_storage(path: Path) -> bool:
    """Whether a file is a bag's storage, by its name."""
    name = path.with_suffix("") if is_compressed(path) else path
    return name.suffix in STORAGE_SUFFIXES


def find_bag_files(path: Path) -> BagFiles | None:
    """The files of the bag at ``path``: one storage file, or a folder of them; None if it is no bag.

    Raises:
        RecordingError: metadata.yaml is damaged or names a file that is missing.
    """
    if path.is_file():
        return BagFiles((path,), ()) if is_storage(path) else None
    if (path / "metadata.yaml").is_file():
        return _from_metadata(path)
    files = sorted(
        (file for file in path.iterdir() if file.is_file() and is_storage(file)),
        key=lambda file: split_numbers(file.name),
    )
    return BagFiles(tuple(files), ()) if files else None


def is_compressed(file: Path) -> bool:
    """Whether a storage file is compressed as a whole, by its name."""
    return file.suffix in _ZSTD_SUFFIXES


def decompress_storage(file: Path, stack: ExitStack, limits: LimitSettings) -> Path:
    """The storage file itself, or an uncompressed copy that lives as long as the stack.

    Raises:
        RecordingError: the file is damaged, or the disk of temporary files has too little space for the copy.
    """
    if not is_compressed(file):
        return file
    folder = stack.enter_context(temporary_folder())
    copy = folder / file.stem
    with (
        wrap_errors(file, "the compressed file is incomplete or damaged: copy it again"),
        zstd.open(file, "rb") as packed,
        copy.open("wb") as plain,
    ):
        while block := packed.read(_COPY_BYTES):
            if shutil.disk_usage(folder).free - len(block) < limits.min_free_disk:
                raise RecordingError(
                    f"{file}: unpacks to more than the space in {folder.parent}, of which "
                    f"{limits.min_free_disk / 1e6:.0f} MB are left free (limits.min_free_disk); set TMPDIR to a "
                    "folder with more space, or unpack the file there with `zstd -d`"
                )
            plain.write(block)
    return copy


def decompress_message(raw: bytes, limits: LimitSettings) -> bytes:
    """A message's bytes without rosbag2's per-message compression.

    Neither CDR nor ROS 1 messages of use here start with zstd's magic number, so this works without metadata.

    Raises:
        ValueError: the message is cut short, or is larger than the limit.
        zstd.ZstdError: it is damaged.
    """
    if raw[:4] != _ZSTD_MAGIC:
        return raw
    decompressor = zstd.ZstdDecompressor()
    plain = decompressor.decompress(raw, limits.max_unpacked_bytes + 1)
    check_unpacked_size(len(plain), limits)
    if not decompressor.eof:
        raise ValueError("a compressed message is cut short")
    return plain


def check_sqlite(file: Path) -> None:
    """Checks what SQLite itself reads over: a file cut short in its last pages, or messages still in its log.

    Source: "Database File Format", section 1.3, sqlite.org.

    Raises:
        RecordingError: the log of the database has not been merged.
        ValueError: the file is shorter than it states.
    """
    log = file.with_name(f"{file.name}-wal")
    if log.is_file() and log.stat().st_size > 0:
        raise RecordingError(
            f"{file}: its last messages are still in {log.name}; merge them with "
            f"`sqlite3 {file.name} 'PRAGMA wal_checkpoint(TRUNCATE)'`"
        )
    with file.open("rb") as opened:
        header = opened.read(100)
    if len(header) < 100:
        raise ValueError(f"has {len(header)} bytes, too few for a database")
    page_size, change, pages, pages_of_change = struct.unpack(">16xH6x2I60xI4x", header)
    # A page of 65536 bytes is written as 1; the number of pages holds only for the change it was written at.
    stated = (65536 if page_size == 1 else page_size) * pages
    if change == pages_of_change and file.stat().st_size < stated:
        raise ValueError(f"has {file.stat().st_size} bytes, states {stated}")


def _from_metadata(folder: Path) -> BagFiles:
    metadata_path = folder / "metadata.yaml"
    advice = "remove or rename it to read the storage files without it"
    check_fetched(metadata_path)
    try:
        content = read_yaml(metadata_path)
        metadata: Mapping[str, Any] = content["rosbag2_bagfile_information"]
        files = tuple(folder / PurePath(name).name for name in metadata["relative_file_paths"])
        counted = metadata.get("topics_with_message_count") or ()
        topics = [(entry["topic_metadata"], entry["message_count"]) for entry in counted]
        stated = tuple(TopicInfo(str(topic["name"]), str(topic["type"]), int(count)) for topic, count in topics)
    except InputError as error:
        raise RecordingError(f"{error}; {advice}") from error
    except (LookupError, TypeError, AttributeError, ValueError, ArithmeticError) as error:
        reason = " ".join(str(error).split())
        raise RecordingError(f"{metadata_path}: is not the metadata of a rosbag2 ({reason}); {advice}") from error
    for file in files:
        if not _is_file(file):
            raise RecordingError(
                f"{metadata_path}: names {file.name:.255}, which is missing in {folder}; {advice}"
            )
    return BagFiles(files, stated)


def _is_file(path: Path) -> bool:
    try:
        return path.is_file()
    except OSError:  # names that the file system does not allow
        return False


def split_numbers(text: str) -> list[tuple[int, str]]:
    """A key by which part_2 comes before part_10."""
    return [(int(part), "") if part.isdecimal() else (-1, part) for part in re.split(r"(\d+)", text)]


METADATA = "metadata.yaml"
# Of the format of metadata.yaml, as ROS 2 Iron and later write and read it.
_METADATA_VERSION = 8


@dataclass(frozen=True)
class RecordedFile:
    """An MCAP of a recording."""

    path: Path
    start: int
    """Arrival of its first message, ns; likewise the last."""
    end: int
    connections: tuple[Connection, ...]

    @property
    def count(self) -> int:
        """Messages."""
        return sum(connection.msgcount for connection in self.connections)


def write_metadata(folder: Path, files: Sequence[RecordedFile]) -> None:
    """Writes metadata.yaml, which the tools of ROS 2 expect.

    Raises:
        InputError: it cannot be written.
    """
    start, end = min(file.start for file in files), max(file.end for file in files)
    counts: Counter[tuple[str, str, str]] = Counter()
    for file in files:
        for connection in file.connections:
            counts[connection.topic, connection.msgtype, connection.digest] += connection.msgcount
    content = {
        "version": _METADATA_VERSION,
        "storage_identifier": "mcap",
        "duration": {"nanoseconds": end - start},
        "starting_time": {"nanoseconds_since_epoch": start},
        "message_count": counts.total(),
        "topics_with_message_count": [
            {
                "topic_metadata": {
                    "name": topic,
                    "type": message_type,
                    "serialization_format": "cdr",
                    "offered_qos_profiles": "",
                    "type_description_hash": digest,
                },
                "message_count": count,
            }
            for (topic, message_type, digest), count in sorted(counts.items())
        ],
        "compression_format": "",
        "compression_mode": "",
        "relative_file_paths": [file.path.name for file in files],
        "files": [
            {
                "path": file.path.name,
                "starting_time": {"nanoseconds_since_epoch": file.start},
                "duration": {"nanoseconds": file.end - file.start},
                "message_count": file.count,
            }
            for file in files
        ],
        "custom_data": None,
        "ros_distro": "",
    }
    save_yaml(folder / METADATA, {"rosbag2_bagfile_information": content})
