"""Copies of rosbags' modules of storage with limits of the chunks of MCAPs, and of YAML in bags; rosbags has none.

Functions of the copies for chunks, QoS profiles and schemas are replaced by ones that do the same within limits,
or for more encodings; nothing else reaches them. rosbags itself stays as it is for others in the process. What
limits refuse, rosbags would refuse later, or never come to an end with.
"""

import bz2
import sys
from collections.abc import Callable, Mapping
from functools import partial
from importlib.util import find_spec, module_from_spec
from pathlib import Path
from typing import TYPE_CHECKING, Any, BinaryIO

import lz4.frame
from rosbags.interfaces import MessageDefinition, MessageDefinitionFormat
from rosbags.rosbag2 import metadata

from calgraph.errors import InputError
from calgraph.io.yaml_reading import parse_yaml

if sys.version_info >= (3, 14):
    from compression import zstd
else:
    from backports import zstd

__all__ = ["DECOMPRESSORS", "storage_mcap", "storage_sqlite3", "unpack_chunk"]

if TYPE_CHECKING:
    from rosbags.rosbag2 import storage_mcap, storage_sqlite3
else:

    def _copy_module(name: str) -> Any:
        spec = find_spec(f"rosbags.rosbag2.{name}")
        module = module_from_spec(spec)
        spec.loader.exec_module(module)
        return module

    storage_mcap, storage_sqlite3 = map(_copy_module, ("storage_mcap", "storage_sqlite3"))

# Values of the QoS profiles of one topic: some 20 for each publisher.
_MAX_QOS_VALUES = 5000


def unpack_chunk(data: bytes, size: int, decompressor: Callable[[], Any]) -> bytes:
    """The content of a compressed chunk, of ``size`` bytes at most, and one byte more if it is larger.

    Raises:
        EOFError: the data are cut short.
    """
    content = b""
    while data and len(content) <= size:
        frame = decompressor()
        content += frame.decompress(data, size + 1 - len(content))
        if not frame.eof and len(content) <= size:
            raise EOFError("a compressed chunk is cut short")
        data = frame.unused_data or b""
    return content


def _parse_qos(text: Any) -> Any:
    """The QoS profiles of a topic, which are YAML."""
    try:
        content = (
            parse_yaml(text, Path("offered_qos_profiles"), _MAX_QOS_VALUES) if isinstance(text, str) else text
        )
    except InputError as error:
        raise ValueError(str(error)) from error
    return metadata.parse_qos(content)


def _read_string(file: BinaryIO) -> str:
    """A text of an MCAP, or a schema, which may be of bytes."""
    return storage_mcap.read_bytes(file).decode(errors="replace")


def _get_msgdef(schema: storage_mcap.Schema | None) -> MessageDefinition:
    """The definition of a type; empty where its language is not of ROS: Foxglove's types are known without."""
    if schema is not None and schema.encoding == "ros1msg":
        return MessageDefinition(MessageDefinitionFormat.MSG, schema.data)
    return _get_ros2_msgdef(schema if schema and schema.encoding in _ROS2_LANGUAGES else None)


_ROS2_LANGUAGES = ("ros2msg", "ros2idl", "omgidl", "")
_get_ros2_msgdef = storage_mcap.get_msgdef
DECOMPRESSORS: Mapping[str, Callable[[], Any]] = {
    "lz4": lz4.frame.LZ4FrameDecompressor,
    "zstd": zstd.ZstdDecompressor,
    "bz2": bz2.BZ2Decompressor,
}
"""By the name of the compression of a chunk, what :func:`unpack_chunk` takes."""
for _name in ("lz4", "zstd"):
    storage_mcap.DECOMPRESSORS[_name] = partial(unpack_chunk, decompressor=DECOMPRESSORS[_name])
for _module in (storage_mcap, storage_sqlite3):
    vars(_module).update(parse_qos=_parse_qos)
vars(storage_mcap).update(read_string=_read_string, get_msgdef=_get_msgdef)
