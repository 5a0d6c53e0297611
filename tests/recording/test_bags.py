import pickle
import shutil
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import lz4.frame
import numpy as np
import pytest
from rosbags.rosbag1 import Writer as Writer1
from rosbags.rosbag2 import CompressionMode, StoragePlugin
from rosbags.rosbag2.storage_mcap import McapWriter
from rosbags.typesys import Stores, get_typestore

from calgraph.errors import InputError, RecordingError
from calgraph.recording import open_recording, open_recordings
from calgraph.sensors import LaserScan, RecordedMessage, Trigger

MakeBag = Callable[..., Path]
ReadAll = Callable[[Path], list[RecordedMessage]]

SCANNERS = "two-static-2d-lidars-moving-object"
SAMPLES = {
    "talker": 20,
    "convert_b": 75,
    "cdr_test": 7,
    "test_bag_for_seek": 5,
    "bag_with_topics_and_service_events": 10,
    "multiple_files": 3177,
}


@pytest.fixture
def three_scans(make_bag: MakeBag, ros: SimpleNamespace) -> Path:
    return make_bag(*(("/scan", ros.scan(header=ros.header(10.0 + i)), 10.5 + i) for i in range(3)))


def scans(path: Path) -> list[tuple[str, float, float, LaserScan]]:
    with open_recording(path) as recording:
        return [
            (record.topic, record.stamp, record.arrival, scan)
            for record in recording.records()
            if isinstance(scan := record.decode(), LaserScan)
        ]


def test_records_can_be_decoded_in_another_process(three_scans: Path) -> None:
    with open_recording(three_scans) as recording:
        for record in recording.records():
            here = record.decode()
            there = pickle.loads(pickle.dumps(record.decode))()  # noqa: S301 (made here)
            assert isinstance(here, LaserScan)
            assert (there.stamp, there.frame_id) == (here.stamp, here.frame_id)
            np.testing.assert_array_equal(there.ranges, here.ranges)


@pytest.mark.parametrize("converted", ["derived_rosbag2_sqlite3", "derived_rosbag2_mcap"])
def test_converted_bags_hold_what_the_ros1_bag_holds(data_dir: Path, converted: str) -> None:
    original, copy = scans(data_dir / SCANNERS / "scans_demo.bag"), scans(data_dir / SCANNERS / converted)
    assert len(original) == len(copy) == 661
    for (*envelope, scan), (*other_envelope, other) in zip(original, copy, strict=True):
        assert envelope == other_envelope
        assert scan.frame_id == other.frame_id
        np.testing.assert_array_equal(scan.ranges, other.ranges)
        np.testing.assert_array_equal(scan.angles, other.angles)


def test_real_scans_have_the_documented_geometry(data_dir: Path) -> None:
    _, _, _, scan = scans(data_dir / SCANNERS / "scans_demo.bag")[0]
    assert scan.ranges.shape == (726,)
    np.testing.assert_allclose(np.rad2deg(scan.angles[[0, -1]]), [-135, 119.9], atol=0.05)
    assert np.nanmax(scan.ranges) <= 5.6


@pytest.mark.parametrize("storage", ["mcap", "sqlite3"])
@pytest.mark.parametrize("sample", SAMPLES)
def test_every_message_of_irregular_rosbag2_folders_is_read(
    data_dir: Path, storage: str, sample: str, read_all: ReadAll
) -> None:
    assert len(read_all(data_dir / "rosbag2-reader-samples" / storage / sample)) == SAMPLES[sample]


@pytest.mark.parametrize("storage", StoragePlugin)
@pytest.mark.parametrize("compression", [CompressionMode.NONE, CompressionMode.FILE, CompressionMode.MESSAGE])
def test_compressed_bags_are_read(
    make_bag: MakeBag,
    ros: SimpleNamespace,
    read_all: ReadAll,
    storage: StoragePlugin,
    compression: CompressionMode,
) -> None:
    path = make_bag(("/scan", ros.scan(), 13.0), storage=storage, compression=compression)
    scan = read_all(path)[0].decode()
    assert isinstance(scan, LaserScan)
    np.testing.assert_array_equal(scan.ranges, [1, 2, 3, 4, 5])


@pytest.mark.parametrize("algorithm", ["zstd", "lz4"])
def test_compressed_chunks_of_mcap_files_are_read(
    make_bag: MakeBag, ros: SimpleNamespace, monkeypatch: pytest.MonkeyPatch, algorithm: str
) -> None:
    """The compressions that MCAP specifies; rosbags itself writes the first only."""
    start = McapWriter.__init__

    def start_with_lz4(writer: McapWriter, path: Path, mode: CompressionMode) -> None:
        start(writer, path, mode)
        writer.compression, writer.compressor = "lz4", lz4.frame.compress

    if algorithm == "lz4":
        monkeypatch.setattr(McapWriter, "__init__", start_with_lz4)
    path = make_bag(*(("/scan", ros.scan(), 13.0 + i) for i in range(50)), compression=CompressionMode.STORAGE)
    data = next(path.glob("*.mcap")).read_bytes()
    assert (algorithm.encode() in data, len(data) < 50 * 100) == (True, True)
    found = scans(path)
    assert [arrival for _, _, arrival, _ in found] == [13.0 + i for i in range(50)]
    np.testing.assert_array_equal(found[-1][3].ranges, [1, 2, 3, 4, 5])


@pytest.mark.parametrize("compression", Writer1.CompressionFormat)
def test_compressed_chunks_of_ros_1_bags_are_read(
    make_ros1_bag: MakeBag, compression: Writer1.CompressionFormat
) -> None:
    types = get_typestore(Stores.ROS1_NOETIC).types
    header = types["std_msgs/msg/Header"](
        seq=0, stamp=types["builtin_interfaces/msg/Time"](12, 500_000_000), frame_id="l"
    )
    content = types["sensor_msgs/msg/LaserScan"](
        header,
        -0.5,
        0.5,
        0.25,
        1e-3,
        0.1,
        0.5,
        8.0,
        np.array([1, 2, 3, 4, 5], np.float32),
        np.zeros(0, np.float32),
    )
    path = make_ros1_bag(*(("/scan", content, 13.0 + i) for i in range(50)), compression=compression)
    assert f"compression={compression.name.lower()}".encode() in path.read_bytes()
    found = scans(path)
    assert [(stamp, arrival) for _, stamp, arrival, _ in found] == [(12.5, 13.0 + i) for i in range(50)]
    np.testing.assert_array_equal(found[-1][3].ranges, [1, 2, 3, 4, 5])


def test_storage_file_alone_is_a_recording(three_scans: Path, read_all: ReadAll) -> None:
    assert len(read_all(three_scans / "bag.mcap")) == 3


def test_split_files_without_metadata_are_read_in_natural_order(
    make_bag: MakeBag, ros: SimpleNamespace, tmp_path: Path, read_all: ReadAll
) -> None:
    folder = tmp_path / "split"
    folder.mkdir()
    for number in (2, 10, 9):
        bag = make_bag(("/scan", ros.scan(), float(number)), name=f"part{number}")
        shutil.move(bag / f"part{number}.mcap", folder / f"split_{number}.mcap")
    assert [record.arrival for record in read_all(folder)] == [2.0, 9.0, 10.0]


def test_stamp_is_the_headers_and_arrival_the_recorders(three_scans: Path, read_all: ReadAll) -> None:
    assert [(record.stamp, record.arrival) for record in read_all(three_scans)] == [
        (10.0, 10.5),
        (11.0, 11.5),
        (12.0, 12.5),
    ]


def test_message_without_header_is_stamped_by_its_arrival(
    make_bag: MakeBag, ros: SimpleNamespace, read_all: ReadAll
) -> None:
    path = make_bag(("/trigger", ros.types["std_msgs/msg/Empty"](), 3.25))
    assert read_all(path)[0].stamp == 3.25


def test_unset_header_stamp_is_replaced_by_the_arrival(
    make_bag: MakeBag, ros: SimpleNamespace, read_all: ReadAll
) -> None:
    path = make_bag(("/scan", ros.scan(header=ros.header(0.0)), 3.25))
    assert read_all(path)[0].stamp == 3.25


def test_any_message_with_a_header_is_a_trigger_at_its_stamp(
    make_bag: MakeBag, ros: SimpleNamespace, read_all: ReadAll
) -> None:
    point = ros.types["geometry_msgs/msg/Point"](0.0, 0.0, 0.0)
    message = ros.types["geometry_msgs/msg/PointStamped"](header=ros.header(7.5), point=point)
    trigger = read_all(make_bag(("/clicked", message, 9.0)))[0].decode()
    assert isinstance(trigger, Trigger)
    assert trigger.stamp == 7.5


def test_ros1_camera_info_with_capital_matrices_is_read(make_ros1_bag: MakeBag, read_all: ReadAll) -> None:
    types = get_typestore(Stores.ROS1_NOETIC).types
    header = types["std_msgs/msg/Header"](7, types["builtin_interfaces/msg/Time"](100, 500_000_000), "cam")
    info = types["sensor_msgs/msg/CameraInfo"](
        header=header, height=480, width=640, distortion_model="plumb_bob", D=np.zeros(5),
        K=np.array([500.0, 0, 320, 0, 510, 240, 0, 0, 1]), R=np.eye(3).ravel(), P=np.zeros(12), binning_x=0,
        binning_y=0, roi=types["sensor_msgs/msg/RegionOfInterest"](0, 0, 0, 0, False),
    )  # fmt: skip
    record = read_all(make_ros1_bag(("/info", info, 101.0)))[0]
    assert record.stamp == 100.5
    assert record.decode().camera.K[1, 1] == 510  # type: ignore[union-attr]


def test_only_the_topics_asked_for_are_read(make_bag: MakeBag, ros: SimpleNamespace) -> None:
    path = make_bag(("/a", ros.scan(), 1.0), ("/b", ros.scan(), 2.0))
    with open_recording(path) as recording:
        assert [record.topic for record in recording.records(["/b"])] == ["/b"]


def test_topic_that_is_not_there_names_the_nearest(three_scans: Path) -> None:
    with open_recording(three_scans) as recording, pytest.raises(InputError, match="did you mean '/scan'"):
        recording.records(["/scam"])


def test_start_and_end_are_included(three_scans: Path) -> None:
    with open_recording(three_scans) as recording:
        assert [r.arrival for r in recording.records(start=11.5, end=recording.end)] == [11.5, 12.5]


def test_start_and_end_hold_at_the_resolution_of_epoch_stamps(data_dir: Path) -> None:
    with open_recording(data_dir / SCANNERS / "derived_rosbag2_mcap") as recording:
        arrivals = [record.arrival for record in recording.records()]
        assert [r.arrival for r in recording.records(start=arrivals[100], end=arrivals[200])] == arrivals[100:201]


def test_topics_have_type_and_count(three_scans: Path) -> None:
    with open_recording(three_scans) as recording:
        assert [(t.name, t.type, t.count) for t in recording.topics] == [("/scan", "sensor_msgs/msg/LaserScan", 3)]


@pytest.mark.parametrize("stated", [4, 40])
def test_fewer_messages_than_metadata_states_is_an_error(three_scans: Path, stated: int) -> None:
    metadata = three_scans / "metadata.yaml"
    metadata.write_text(metadata.read_text().replace("message_count: 3", f"message_count: {stated}"))
    with open_recording(three_scans) as recording, pytest.raises(RecordingError, match=f"/scan: 3 of {stated}"):
        list(recording.records())


def test_part_of_a_recording_is_not_held_against_its_count(three_scans: Path) -> None:
    with open_recording(three_scans) as recording:
        assert len(list(recording.records(start=12.0))) == 1


def test_missing_split_file_is_named(three_scans: Path) -> None:
    (three_scans / "bag.mcap").unlink()
    with pytest.raises(RecordingError, match=r"names bag\.mcap, which is missing"):
        open_recording(three_scans)


def test_damaged_metadata_is_an_error_with_advice(three_scans: Path) -> None:
    (three_scans / "metadata.yaml").write_text("rosbag2_bagfile_information: [")
    with pytest.raises(RecordingError, match="remove or rename it"):
        open_recording(three_scans)


def test_unmerged_sqlite_log_is_noticed(make_bag: MakeBag, ros: SimpleNamespace) -> None:
    path = make_bag(("/scan", ros.scan(), 13.0), storage=StoragePlugin.SQLITE3)
    (path / "bag.db3-wal").write_bytes(b"pages")
    with pytest.raises(RecordingError, match="wal_checkpoint"):
        open_recording(path)


@pytest.mark.parametrize(
    ("file", "advice", "kept"),
    [
        *(("scans_demo.bag", "rosbag reindex", kept) for kept in (0.001, 0.4, 0.999)),
        *(("derived_rosbag2_mcap/derived_rosbag2_mcap.mcap", "mcap recover", kept) for kept in (0.001, 0.4)),
        *(
            ("derived_rosbag2_sqlite3/derived_rosbag2_sqlite3.db3", "recover", kept)
            for kept in (0.001, 0.4, 0.999)
        ),
    ],
)
def test_truncated_file_is_an_error_with_advice(
    data_dir: Path, tmp_path: Path, file: str, advice: str, kept: float, read_all: ReadAll
) -> None:
    whole = (data_dir / SCANNERS / file).read_bytes()
    cut = tmp_path / Path(file).name
    cut.write_bytes(whole[: int(len(whole) * kept)])
    with pytest.raises(RecordingError, match=advice):
        read_all(cut)


@pytest.mark.parametrize("suffix", [".bag", ".mcap", ".db3"])
def test_damaged_bytes_never_raise_anything_but_our_error(
    data_dir: Path, tmp_path: Path, rng: np.random.Generator, suffix: str, read_all: ReadAll
) -> None:
    source = next((data_dir / SCANNERS).rglob(f"*{suffix}")).read_bytes()
    refused = 0
    for trial in range(10):
        spoiled = bytearray(source)
        for position in rng.integers(0, len(spoiled), 200):
            spoiled[position] ^= 0xFF
        path = tmp_path / f"{trial}{suffix}"
        path.write_bytes(spoiled)
        try:
            for record in read_all(path):
                record.decode()
        except RecordingError:
            refused += 1
    # The rest hides in bytes that no reader looks at.
    assert refused >= 9


def test_empty_file_is_an_error(tmp_path: Path) -> None:
    (tmp_path / "empty.mcap").touch()
    with pytest.raises(RecordingError, match="is empty"):
        open_recording(tmp_path / "empty.mcap")


def test_missing_path_is_an_error(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="does not exist"):
        open_recording(tmp_path / "nothing")


def test_other_file_is_an_error_that_lists_the_formats(tmp_path: Path) -> None:
    (tmp_path / "notes.txt").write_text("hello")
    with pytest.raises(InputError, match=r"\.mcap, \.db3 or \.bag"):
        open_recording(tmp_path / "notes.txt")


def scan_at(ros: SimpleNamespace, stamp: float) -> Any:
    return ros.scan(header=ros.header(stamp))


def test_several_recordings_are_one_in_order_of_arrival(make_bag: MakeBag, ros: SimpleNamespace) -> None:
    late = make_bag(("/a", scan_at(ros, 5.0), 5.0), ("/a", scan_at(ros, 7.0), 7.0), name="late")
    early = make_bag(("/a", scan_at(ros, 1.0), 1.0), ("/b", scan_at(ros, 6.0), 6.0), name="early")
    with open_recordings([late, early]) as recording:
        assert [(r.topic, r.arrival) for r in recording.records()] == [
            ("/a", 1.0),
            ("/a", 5.0),
            ("/b", 6.0),
            ("/a", 7.0),
        ]


def test_several_recordings_add_up_their_counts(make_bag: MakeBag, ros: SimpleNamespace) -> None:
    paths = [make_bag(("/a", scan_at(ros, t), t), name=f"at_{t}") for t in (5.0, 6.0)]
    with open_recordings(paths) as recording:
        assert [(topic.name, topic.count) for topic in recording.topics] == [("/a", 2)]


def test_topic_of_only_one_of_several_recordings_is_found(make_bag: MakeBag, ros: SimpleNamespace) -> None:
    paths = [make_bag((topic, ros.scan(), 5.0), name=topic[1:]) for topic in ("/a", "/b")]
    with open_recordings(paths) as recording:
        assert [record.topic for record in recording.records(["/b"])] == ["/b"]


def test_a_digest_has_the_frame_and_depends_on_the_content_alone(
    make_bag: MakeBag, ros: SimpleNamespace, read_all: ReadAll
) -> None:
    other = np.array([1, 2, 3, 4, 6], np.float32)
    path = make_bag(
        ("/scan", ros.scan(), 1.0),
        ("/scan", ros.scan(header=ros.header(9.0, "another_laser")), 2.0),
        ("/scan", ros.scan(ranges=other), 3.0),
    )
    first, moved, changed = (record.digest() for record in read_all(path) if record.digest)
    assert (first.frame_id, moved.frame_id) == ("sensor", "another_laser")
    assert first.content == moved.content
    assert first.content != changed.content


def test_a_digest_of_ros1_has_the_frame_and_depends_on_the_content_alone(
    make_ros1_bag: MakeBag, read_all: ReadAll
) -> None:
    types = get_typestore(Stores.ROS1_NOETIC).types

    def image(frame_id: str, value: int) -> object:
        stamp = types["builtin_interfaces/msg/Time"](100, value)
        return types["sensor_msgs/msg/CompressedImage"](
            types["std_msgs/msg/Header"](value, stamp, frame_id), "jpeg", np.full(5000, value, np.uint8)
        )

    bag = make_ros1_bag(
        ("/a", image("left", 1), 1.0), ("/b", image("right_eye", 1), 2.0), ("/c", image("", 2), 3.0)
    )
    left, right, changed = (record.digest() for record in read_all(bag) if record.digest)
    assert (left.frame_id, right.frame_id, changed.frame_id) == ("left", "right_eye", "")
    assert left.content == right.content
    assert left.content != changed.content
