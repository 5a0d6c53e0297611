"""Definitions and messages that would take any time or memory are refused, and are not parsed to the end."""

import struct

import pytest
from rosbags.interfaces import MessageDefinitionFormat

from calgraph.errors import RecordingError
from calgraph.recording.damage import MAX_ARRAY, MAX_DEFINITION, MAX_PARTS, MAX_TEXTS_BYTES
from calgraph.recording.decoding import decode
from calgraph.recording.message_types import MessageType, TypeDefinition, make_message_type

LINE = "=" * 80
HEADER = (
    f"\n{LINE}\nMSG: std_msgs/Header\nbuiltin_interfaces/Time stamp\nstring frame_id\n"
    f"{LINE}\nMSG: builtin_interfaces/Time\nint32 sec\nuint32 nanosec\n"
)
PART = f"\n{LINE}\nMSG: a/Part\nuint8 x\n"
EMPTY = f"\n{LINE}\nMSG: a/Part\n"


def parse(text: str, name: str = "a/msg/T", *, ros1: bool = False) -> MessageType:
    return make_message_type(TypeDefinition(name, MessageDefinitionFormat.MSG, text, "ros1" if ros1 else "cdr"))


@pytest.mark.parametrize("field", ["a/Part[1000000000] parts", "string[1000000000] texts", "a/Part[1001] parts"])
def test_long_arrays_of_messages_and_texts_are_not_understood(field: str) -> None:
    assert parse(f"{field}\n{PART}").store is None


def test_arrays_of_numbers_and_short_ones_are_understood() -> None:
    assert parse(f"uint8[1000000] numbers\na/Part[{MAX_ARRAY}] parts\n{PART}").store is not None


def test_an_array_inside_a_part_is_checked() -> None:
    assert parse(f"a/Part[] parts\n\n{LINE}\nMSG: a/Part\nstring[9999] texts\n").store is None


def test_a_long_definition_is_not_parsed() -> None:
    text = "uint8 x # " + "a" * MAX_DEFINITION + "\n"
    assert parse(text.replace("a" * 99, "")).store is not None
    assert parse(text).store is None
    # A sensor's message is then read as ROS defines it.
    assert parse(text, "sensor_msgs/msg/LaserScan").header == "header"


@pytest.mark.parametrize("ros1", [False, True])
def test_any_number_of_empty_parts_is_refused(ros1: bool) -> None:
    kind = parse(f"std_msgs/Header header\na/Part[] parts\n{EMPTY}{HEADER}", "sensor_msgs/msg/Image", ros1=ros1)
    start = (b"" if ros1 else b"\x00\x01\x00\x00") + struct.pack("<iI", 1, 2) + struct.pack("<I", 4) + b"abc\0"
    few, many = struct.pack("<I", 2), struct.pack("<I", 2**32 - 1)
    parts = b"" if ros1 else b"\0" * 2
    with pytest.raises(RecordingError, match="no attribute 'data'"):
        decode(kind, start + few + parts, 1.0, "a")
    parts = b"" if ros1 else b"\0" * (MAX_PARTS + 10)
    count = many if ros1 else struct.pack("<I", MAX_PARTS + 10)
    with pytest.raises(RecordingError, match=f"more than the limit of {MAX_PARTS} messages: it is damaged"):
        decode(kind, start + count + parts, 1.0, "a")


def test_the_limit_is_of_one_message() -> None:
    kind = parse(f"std_msgs/Header header\na/Part[] parts\n{PART}{HEADER}")
    raw = (
        b"\x00\x01\x00\x00"
        + bytes(8)
        + struct.pack("<I", 4)
        + b"abc\0"
        + struct.pack("<I", 40_000)
        + bytes(40_000)
    )
    for _ in range(4):
        assert len(kind.deserialize(raw).parts) == 40_000


def test_a_large_message_with_a_list_of_texts_is_refused() -> None:
    kind = parse(f"a/Part[] parts\n\n{LINE}\nMSG: a/Part\nstring[] texts\n")
    with pytest.raises(Exception, match="a message with a list of texts has"):
        kind.deserialize(b"\x00\x01\x00\x00" + bytes(MAX_TEXTS_BYTES))
