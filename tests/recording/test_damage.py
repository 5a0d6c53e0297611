"""Recordings with damage that the libraries below read over: found by the fuzzer, benchmarks/fuzz_readers.py."""

import struct
import warnings
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import apsw
import cv2
import numpy as np
import pytest
from rosbags.rosbag2 import StoragePlugin
from rosbags.typesys import Stores, get_typestore

from calgraph.errors import RecordingError
from calgraph.recording import open_recording
from calgraph.recording.content_hash import hash_content
from calgraph.recording.images import decode_image

MakeBag = Callable[..., Path]


@pytest.mark.parametrize(
    ("column", "value"), [("name", None), ("name", b"/scan"), ("type", b"sensor_msgs/msg/LaserScan"), ("type", 3)]
)
def test_names_and_types_of_a_database_are_texts(
    make_bag: MakeBag, ros: SimpleNamespace, column: str, value: Any
) -> None:
    bag = make_bag(("/scan", ros.scan(), 20.0), ("/other", ros.header(), 20.0), storage=StoragePlugin.SQLITE3)
    [file] = bag.glob("*.db3")
    database = apsw.Connection(str(file))
    database.execute("PRAGMA writable_schema = 1")
    database.execute("UPDATE sqlite_master SET sql = replace(sql, 'TEXT NOT NULL', '')")
    database.close()
    database = apsw.Connection(str(file))
    database.execute(f"UPDATE topics SET {column} = ? WHERE id = 1", (value,))
    database.close()
    with pytest.raises(RecordingError, match=r"bag\.db3: "):
        open_recording(file)


def test_an_index_without_one_of_the_topics(make_ros1_bag: MakeBag) -> None:
    store = get_typestore(Stores.ROS1_NOETIC)
    time = store.types["builtin_interfaces/msg/Time"](1, 0)
    header = store.types["std_msgs/msg/Header"](0, time, "a")
    bag = make_ros1_bag(("/a", header, 20.0), ("/b", header, 21.0))
    data = bag.read_bytes()
    # The number of the second topic's connection, in the index at the end of the file.
    number = data.rindex(b"conn=", 0, data.rindex(b"topic=/b") - 12) + 5
    assert data[number : number + 4] == struct.pack("<I", 1)
    bag.write_bytes(data[:number] + struct.pack("<I", 9) + data[number + 4 :])
    with open_recording(bag) as recording:
        assert [record.topic for record in recording.records(["/a"])] == ["/a"]
        assert [record.topic for record in recording.records(["/b"])] == []


@pytest.mark.parametrize(
    ("old", "new"),
    [
        ("message_count: 1\n", "message_count: .inf\n"),
        ("message_count: 1\n", "message_count: !!timestamp 2001\n"),
        ("bag.mcap", "x" * 5000),
        ("bag.mcap", '"\\0"'),
    ],
)
def test_metadata_that_cannot_be_is_damage(make_bag: MakeBag, ros: SimpleNamespace, old: str, new: str) -> None:
    bag = make_bag(("/scan", ros.scan(), 20.0))
    metadata = bag / "metadata.yaml"
    text = metadata.read_text(encoding="utf-8")
    assert old in text
    metadata.write_text(text.replace(old, new), encoding="utf-8")
    with pytest.raises(RecordingError, match=r"metadata\.yaml.*remove or rename it") as error:
        open_recording(bag)
    assert len(str(error.value)) < 1000


def test_a_part_of_a_png_larger_than_the_file_is_refused() -> None:
    data = cv2.imencode(".png", np.arange(48, dtype=np.uint8).reshape(6, 8))[1]
    at = data.tobytes().index(b"IDAT") - 4
    data[at : at + 4] = (0xF0, 0, 0, 0)
    with pytest.raises(ValueError, match="a part of it states 4026531840"):
        decode_image(data)


def test_the_content_after_a_frame_id_that_is_cut_short_is_empty() -> None:
    assert hash_content(b"abc", 5) == hash_content(b"")


@pytest.mark.parametrize(
    ("name", "values"),
    [
        ("ring", np.array([1, np.inf, 1e300, np.nan])),
        ("ring", np.array([1, np.inf, 3e38, np.nan], np.float32)),
        ("time", np.array([0, 1e308, -1e308, 5e-324])),
        ("points", np.full((4, 3), 0x7FA00000, np.uint32).view(np.float32)),
    ],
)
def test_numbers_that_overflow_give_no_warning(tmp_path: Path, name: str, values: np.ndarray[Any, Any]) -> None:
    (tmp_path / "s").mkdir()
    np.savez(tmp_path / "s" / "1.0.npz", **{"points": np.ones((4, 3)), name: values})  # type: ignore[arg-type]
    with open_recording(tmp_path) as recording, warnings.catch_warnings():
        warnings.simplefilter("error")
        for record in recording.records():
            record.decode()


@pytest.mark.parametrize("dtype", ["complex128", "<U3", "datetime64[s]"])
def test_arrays_of_an_npz_are_numbers(tmp_path: Path, dtype: str) -> None:
    (tmp_path / "s").mkdir()
    np.savez(tmp_path / "s" / "1.0.npz", points=np.zeros((1, 3), dtype))
    with open_recording(tmp_path) as recording, pytest.raises(RecordingError, match="points must be numbers, got"):
        [record.decode() for record in recording.records()]
