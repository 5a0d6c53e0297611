"""Messages of ROS, and bags of them that rosbags writes: the oracle for what calgraph reads."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from rosbags.convert.converter import migrate_message
from rosbags.rosbag1 import Writer as Writer1
from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin, Writer
from rosbags.typesys import Stores, get_typestore
from rosbags.typesys.store import Typestore

STORE, STORE1 = get_typestore(Stores.ROS2_HUMBLE), get_typestore(Stores.ROS1_NOETIC)


@dataclass(frozen=True)
class Item:
    """A message of a recording."""

    topic: str
    kind: str
    """Its ROS type."""
    arrival: int
    """ns."""
    message: Any
    """The deserialized message; None stands for a topic without messages."""


def write_bag2(
    path: Path,
    items: Sequence[Item],
    storage: StoragePlugin = StoragePlugin.MCAP,
    compression: CompressionMode = CompressionMode.NONE,
) -> Path:
    """Writes a rosbag2 folder."""
    writer = Writer(path, version=8, storage_plugin=storage)
    writer.set_compression(compression, CompressionFormat.ZSTD)
    with writer:
        _write_items(writer, STORE, items, lambda item: STORE.serialize_cdr(item.message, item.kind))
    return path


def write_bag1(path: Path, items: Sequence[Item], compression: Writer1.CompressionFormat | None = None) -> Path:
    """Writes a ROS 1 bag."""
    path = path.with_name(f"{path.name}.bag")
    writer = Writer1(path)
    if compression:
        writer.set_compression(compression)
    with writer:
        _write_items(writer, STORE1, items, serialize_ros1)
    return path


def serialize_ros1(item: Item) -> memoryview:
    """The message as one of ROS 1."""
    message = migrate_message(STORE, STORE1, item.kind, item.kind, {}, item.message)
    return STORE1.serialize_ros1(message, item.kind)


def _write_items(
    writer: Writer | Writer1, store: Typestore, items: Sequence[Item], serialize: Callable[[Item], Any]
) -> None:
    connections: dict[tuple[str, str], Any] = {}
    for item in items:
        key = item.topic, item.kind
        if key not in connections:
            connections[key] = writer.add_connection(*key, typestore=store)
        if item.message is not None:
            writer.write(connections[key], item.arrival, serialize(item))
