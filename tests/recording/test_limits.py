"""Small files that state or unpack to any size are refused before memory is taken; headers are checked."""

import gzip
import re
import struct
import zlib
from pathlib import Path

import cv2
import numpy as np
import pytest
from backports import zstd

from calgraph.config.settings import LimitSettings
from calgraph.errors import RecordingError
from calgraph.io.image_headers import has_several_scans, read_image_size
from calgraph.recording import open_recording
from calgraph.recording.bag_files import decompress_message
from calgraph.recording.images import decode_image
from calgraph.recording.pcd import read_pcd, read_ply

PCD = "FIELDS x y z\nSIZE 4 4 4\nTYPE F F F\nCOUNT 1 1 1\nWIDTH 1\nHEIGHT 1\nPOINTS 1\nDATA binary\n"
PLY_HEADER = (
    "ply\nformat ascii 1.0\nelement vertex 1\nproperty float x\nproperty float y\nproperty float z\nend_header\n"
)
PLY = PLY_HEADER + "1 2 3\n"
LIMITS = LimitSettings()
TIGHT = LimitSettings(max_unpacked_bytes=2_000_000, max_points=1000, max_image_pixels=100)
LFS = b"version https://git-lfs.github.com/spec/v1\noid sha256:4d7a214614ab\nsize 12345\n"


def as_array(data: bytes) -> np.ndarray:
    return np.frombuffer(data, np.uint8)


def png_header(width: int, height: int) -> bytes:
    fields = b"IHDR" + struct.pack(">IIBBBBB", width, height, 8, 0, 0, 0, 0)
    return b"\x89PNG\r\n\x1a\n" + struct.pack(">I", 13) + fields + struct.pack(">I", zlib.crc32(fields))


def jpeg_of(width: int, height: int) -> bytes:
    """A JPEG whose frame header states another size than it has."""
    data = cv2.imencode(".jpg", np.zeros((17, 19), np.uint8))[1].tobytes()
    true = struct.pack(">HH", 17, 19)
    assert data.count(true) == 1
    return data.replace(true, struct.pack(">HH", height, width))


@pytest.mark.parametrize("image", [png_header(30_000, 30_000), jpeg_of(30_000, 30_000)], ids=["png", "jpeg"])
def test_an_image_of_too_many_pixels_is_refused(image: bytes) -> None:
    with pytest.raises(
        ValueError, match=f"30000 x 30000 pixels, more than the limit of {LIMITS.max_image_pixels}"
    ):
        decode_image(as_array(image))


@pytest.mark.parametrize("suffix", [".png", ".jpg", ".bmp", ".tiff", ".webp"])
@pytest.mark.parametrize("quality", [80, 101])
def test_the_size_of_every_format_is_known_before_it_is_decoded(suffix: str, quality: int) -> None:
    pixels = np.random.default_rng(1).integers(0, 255, (11, 12, 3), np.uint8)
    data = cv2.imencode(suffix, pixels, [cv2.IMWRITE_WEBP_QUALITY, quality])[1]
    assert decode_image(data).shape == (11, 12, 3)
    with pytest.raises(ValueError, match="12 x 11 pixels, more than the limit of 100"):
        decode_image(data, limits=TIGHT)


def test_the_size_of_webp_with_transparency_and_of_big_endian_tiff_is_known() -> None:
    pixels = np.random.default_rng(1).integers(0, 255, (11, 12, 4), np.uint8)
    assert read_image_size(cv2.imencode(".webp", pixels, [cv2.IMWRITE_WEBP_QUALITY, 50])[1].tobytes()) == (12, 11)
    entries = struct.pack(">HHIHH", 256, 3, 1, 12, 0) + struct.pack(">HHII", 257, 4, 1, 11)
    tiff = b"MM\0*" + struct.pack(">IH", 8, 2) + entries
    assert read_image_size(tiff) == (12, 11)


def test_bytes_between_the_segments_of_a_jpeg_do_not_hide_its_size() -> None:
    data = jpeg_of(30_000, 30_000)
    with pytest.raises(ValueError, match="30000 x 30000 pixels"):
        decode_image(as_array(data[:2] + b"ab\xff\x00\xff\xd0\xff" + data[2:]))


def test_a_progressive_jpeg_has_a_third_of_the_pixels() -> None:
    """Its decoder keeps all coefficients: one of 2**28 pixels would take 2.4 GB."""
    pixels = np.random.default_rng(1).integers(0, 255, (11, 12, 3), np.uint8)
    limits = LimitSettings(max_image_pixels=3 * 131)
    for progressive in (0, 1):
        data = cv2.imencode(".jpg", pixels, [cv2.IMWRITE_JPEG_PROGRESSIVE, progressive])[1]
        assert decode_image(data).shape == (11, 12, 3)
        assert has_several_scans(data.tobytes()) == progressive
        if progressive:
            with pytest.raises(
                ValueError, match="12 x 11 pixels, more than the limit of 131 in a progressive JPEG"
            ):
                decode_image(data, limits=limits)
        else:
            assert decode_image(data, limits=limits).shape == (11, 12, 3)


def test_a_jpeg_of_one_scan_for_each_colour_counts_as_progressive() -> None:
    data = cv2.imencode(".jpg", np.zeros((11, 12, 3), np.uint8))[1].tobytes()
    scan = data.index(b"\xff\xda")
    assert data[scan + 4] == 3
    assert has_several_scans(data[: scan + 4] + b"\x01" + data[scan + 5 :])


@pytest.mark.parametrize("suffix", [".ppm", ".gif", ".hdr", ".ras"])
def test_formats_of_unknown_size_are_refused(suffix: str) -> None:
    pixels = np.zeros((11, 12, 3), np.float32 if suffix == ".hdr" else np.uint8)
    with pytest.raises(ValueError, match=r"cannot be decoded .*: it is no PNG, JPEG, TIFF, BMP or WebP"):
        decode_image(cv2.imencode(suffix, pixels)[1])


def test_images_below_the_limit_are_left_to_the_decoder() -> None:
    with pytest.raises(ValueError, match="cannot be decoded"):
        decode_image(as_array(png_header(16_384, 16_384)))
    assert decode_image(as_array(jpeg_of(19, 17))).shape == (17, 19)


@pytest.mark.parametrize("cut", range(2, 40))
def test_a_jpeg_cut_short_is_an_error(cut: int) -> None:
    with pytest.raises(ValueError, match="cannot be decoded"):
        decode_image(as_array(jpeg_of(19, 17)[:cut]))


def test_a_gzipped_cloud_is_unpacked_up_to_the_limit(tmp_path: Path) -> None:
    path = tmp_path / "1.pcd.gz"
    path.write_bytes(gzip.compress(bytes(TIGHT.max_unpacked_bytes + 1)))
    with pytest.raises(ValueError, match=r"unpacks to more than the limit of 2 MB: .* limits\.max_unpacked"):
        read_pcd(path, TIGHT)


def test_lzf_data_are_unpacked_up_to_their_stated_size(tmp_path: Path) -> None:
    header = PCD.replace("binary", "binary_compressed")
    points = 1000
    many = header.replace("POINTS 1", f"POINTS {points}").encode() + struct.pack("<II", 4, 12 * points)
    (tmp_path / "1.pcd").write_bytes(many + bytes(4))
    with pytest.raises(ValueError, match="unpacks to more than"):
        read_pcd(tmp_path / "1.pcd", LimitSettings(max_unpacked_bytes=12 * points - 1))


def write_npz(path: Path, points: int) -> None:
    path.parent.mkdir()
    np.savez_compressed(path, points=np.zeros((points, 3)))


def test_an_npz_is_refused_by_its_table_of_contents(tmp_path: Path) -> None:
    write_npz(tmp_path / "s" / "1.0.npz", 100_000)
    with open_recording(tmp_path, TIGHT) as recording, pytest.raises(RecordingError, match="unpacks to more than"):
        [record.decode() for record in recording.records()]


def test_a_compressed_message_is_unpacked_up_to_the_limit() -> None:
    assert decompress_message(zstd.compress(b"abc"), TIGHT) == b"abc"
    with pytest.raises(ValueError, match="unpacks to more than"):
        decompress_message(zstd.compress(bytes(TIGHT.max_unpacked_bytes + 1)), TIGHT)
    with pytest.raises(ValueError, match="is cut short"):
        decompress_message(zstd.compress(np.random.default_rng(1).bytes(5000))[:-100], TIGHT)


def test_a_compressed_file_leaves_space_on_the_disk(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    temporary = tmp_path / "temporary"
    temporary.mkdir()
    monkeypatch.setattr("tempfile.tempdir", str(temporary))
    (tmp_path / "a.mcap.zstd").write_bytes(zstd.compress(bytes(1000)))
    message = rf"a\.mcap\.zstd: unpacks to more than the space in {re.escape(str(temporary))}, .* set TMPDIR"
    with pytest.raises(RecordingError, match=message):
        open_recording(tmp_path / "a.mcap.zstd", LimitSettings(min_free_disk=2**60))
    assert list(temporary.iterdir()) == []


@pytest.mark.parametrize("name", ["metadata.yaml", "s/camera_info.yaml"])
def test_yaml_beside_messages_has_limits(tmp_path: Path, name: str) -> None:
    write_npz(tmp_path / "s" / "1.0.npz", 1)
    (tmp_path / name).write_text("a0: &a0 [x, x, x, x]\n" + "".join(
        f"a{i}: &a{i} [{', '.join([f'*a{i - 1}'] * 10)}]\n" for i in range(1, 9)
    ))  # fmt: skip
    with (
        pytest.raises(RecordingError, match=f"{name}, line .*: has more than"),
        open_recording(tmp_path) as recording,
    ):
        [record.decode() for record in recording.records(["s/camera_info"])]


def beams(count: int) -> str:
    return f"stamp,angle_min,angle_increment,time_increment,ranges\n1.0,0,0.1,0,{','.join(['1'] * count)}\n"


@pytest.mark.parametrize(
    ("name", "content"),
    [
        ("1.0.pcd", PCD.replace("POINTS 1", "POINTS 1001").encode() + bytes(12 * 1001)),
        ("1.0.ply", PLY.replace("vertex 1", "vertex 1001").encode() + b"1 2 3\n" * 1000),
        ("1.0.csv", beams(1001).encode()),
    ],
)
def test_a_file_of_too_many_points_is_refused(tmp_path: Path, name: str, content: bytes) -> None:
    (tmp_path / "s").mkdir()
    (tmp_path / "s" / name).write_bytes(content)
    message = r"s/1\.0\..*: has 1\d\d\d points, more than the limit of 1000: .* limits\.max_points"
    with open_recording(tmp_path, TIGHT) as recording, pytest.raises(RecordingError, match=message):
        [record.decode() for record in recording.records()]


def test_an_npz_of_too_many_points_is_refused(tmp_path: Path) -> None:
    write_npz(tmp_path / "s" / "1.0.npz", 1001)
    with open_recording(tmp_path, TIGHT) as recording, pytest.raises(RecordingError, match="has 1001 points"):
        [record.decode() for record in recording.records()]


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("POINTS 1", "POINTS -1", "POINTS of the PCD header must be 0 or more"),
        ("POINTS 1\n", "", ""),
        ("WIDTH 1\nHEIGHT 1\nPOINTS 1\n", "WIDTH -2\nHEIGHT -1\n", "WIDTH and HEIGHT of the PCD header must be 0"),
        ("WIDTH 1\nHEIGHT 1\nPOINTS 1\n", "", "WIDTH of the PCD header must be whole numbers"),
        ("POINTS 1", "POINTS " + 5000 * "9", "POINTS of the PCD header must be whole numbers, got '9{40}'$"),
        ("F F F", "X F F", "field x has TYPE X, SIZE 4 and COUNT 1; known are F"),
        ("SIZE 4", "SIZE 3", "field x has TYPE F, SIZE 3"),
        ("COUNT 1", "COUNT 0", "field x has TYPE F, SIZE 4 and COUNT 0"),
        ("COUNT 1", "COUNT 99999", "a point has 400004 bytes, more than the limit of 65536"),
        ("FIELDS x y z", "FIELDS x y", "must have 2 values, as FIELDS has"),
        ("DATA binary", "DATA", "DATA  ?is unknown; ascii, binary"),
        (
            "POINTS 1\nDATA binary",
            "POINTS 1000\nDATA ascii",
            "is cut short: 12 bytes of points, states 1000 points",
        ),
    ],
)
def test_an_impossible_pcd_header_is_named(tmp_path: Path, old: str, new: str, message: str) -> None:
    assert old in PCD
    (tmp_path / "1.pcd").write_bytes(PCD.replace(old, new, 1).encode() + bytes(12))
    if message:
        with pytest.raises(ValueError, match=message):
            read_pcd(tmp_path / "1.pcd")
    else:
        assert len(read_pcd(tmp_path / "1.pcd")["x"]) == 1


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("vertex 1", "vertex -1", "must be vertex and its number, got 'vertex -1'"),
        ("vertex 1", "vertex", "must be vertex and its number, got 'vertex'"),
        ("element vertex 1", "element", "must be vertex and its number, got ''"),
        ("vertex 1", "vertex 1000", "is cut short: 6 bytes of vertices, states 1000"),
        ("format ascii 1.0\n", "", "PLY format of no name is unknown"),
        ("float x", "quad x", "a type and different names, got quad x"),
        ("float y", "float x", "a type and different names, got x, x, z"),
        ("property float x", "property", "a type and different names, got "),
        ("end_header\n1 2 3\n", "end_header", "is cut short: 0 bytes"),
    ],
)
def test_an_impossible_ply_header_is_named(tmp_path: Path, old: str, new: str, message: str) -> None:
    assert old in PLY
    (tmp_path / "1.ply").write_text(PLY.replace(old, new, 1))
    with pytest.raises(ValueError, match=message):
        read_ply(tmp_path / "1.ply")


@pytest.mark.parametrize(
    "name", ["s/1.0.png", "s/1.0.npz", "s/1.0.pcd.gz", "s/1.0.csv", "a.mcap", "a.db3", "a.bag.zstd"]
)
def test_git_lfs_pointers_are_named_with_the_command(tmp_path: Path, name: str) -> None:
    path = tmp_path / name
    path.parent.mkdir(exist_ok=True)
    path.write_bytes(LFS)
    message = rf"{name}: is a Git LFS pointer, .* run `git lfs pull`"
    with pytest.raises(RecordingError, match=message), open_recording(tmp_path) as recording:
        [record.decode() for record in recording.records()]


def test_texts_of_libraries_are_put_into_a_sentence(tmp_path: Path) -> None:
    (tmp_path / "s").mkdir()
    (tmp_path / "s" / "1.0.png").write_bytes(cv2.imencode(".png", np.zeros((4, 4), np.uint8))[1].tobytes())
    (tmp_path / "s" / "camera_info.yaml").write_text("width: 4\nheight: 4\nK: {rows: 3}\n")
    with open_recording(tmp_path) as recording:
        [record] = recording.records(["s/camera_info"])
    with pytest.raises(RecordingError, match=r"damaged or not of its stated format \(KeyError: 'data'\)"):
        record.decode()
