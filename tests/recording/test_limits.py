"""Small files that state or unpack to any size are refused before memory is taken; headers are checked."""

import gzip
import io
import struct
import zipfile
import zlib
from pathlib import Path

import cv2
import numpy as np
import pytest
from backports import zstd

from calgraph.errors import RecordingError
from calgraph.recording import open_recording
from calgraph.recording.bag_files import decompress_message
from calgraph.recording.images import decode_image
from calgraph.recording.limits import MAX_IMAGE_PIXELS, MAX_UNPACKED_BYTES
from calgraph.recording.pcd import read_pcd
from calgraph.recording.ply import read_ply

PCD = "FIELDS x y z\nSIZE 4 4 4\nTYPE F F F\nCOUNT 1 1 1\nWIDTH 1\nHEIGHT 1\nPOINTS 1\nDATA binary\n"
PLY_HEADER = (
    "ply\nformat ascii 1.0\nelement vertex 1\nproperty float x\nproperty float y\nproperty float z\nend_header\n"
)
PLY = PLY_HEADER + "1 2 3\n"
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
    with pytest.raises(ValueError, match=f"30000 x 30000 pixels, more than the limit of {MAX_IMAGE_PIXELS}"):
        decode_image(as_array(image))


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
    with gzip.open(path, "wb", compresslevel=1) as file:
        for _ in range(MAX_UNPACKED_BYTES >> 20):
            file.write(bytes(1 << 20))
        file.write(b"1")
    with pytest.raises(ValueError, match="unpacks to more than the limit of 256 MB"):
        read_pcd(path)


def test_lzf_data_are_unpacked_up_to_their_stated_size(tmp_path: Path) -> None:
    header = PCD.replace("binary", "binary_compressed")
    points = MAX_UNPACKED_BYTES // 12 + 1
    many = header.replace("POINTS 1", f"POINTS {points}").encode() + struct.pack("<II", 4, 12 * points)
    (tmp_path / "1.pcd").write_bytes(many + bytes(4))
    with pytest.raises(ValueError, match="unpacks to more than"):
        read_pcd(tmp_path / "1.pcd")


def test_an_npz_is_refused_by_its_table_of_contents(tmp_path: Path) -> None:
    (tmp_path / "s").mkdir()
    header = io.BytesIO()
    shape = (MAX_UNPACKED_BYTES // 24 + 1, 3)
    np.lib.format.write_array_header_1_0(header, {"descr": "<f8", "fortran_order": False, "shape": shape})
    content = header.getvalue() + bytes(MAX_UNPACKED_BYTES + 24)
    with zipfile.ZipFile(tmp_path / "s" / "1.0.npz", "w", zipfile.ZIP_DEFLATED, compresslevel=1) as archive:
        archive.writestr("points.npy", content)
    with open_recording(tmp_path) as recording, pytest.raises(RecordingError, match="unpacks to more than"):
        [record.decode() for record in recording.records()]


def test_a_compressed_message_is_unpacked_up_to_the_limit() -> None:
    assert decompress_message(zstd.compress(b"abc")) == b"abc"
    with pytest.raises(ValueError, match="unpacks to more than"):
        decompress_message(zstd.compress(bytes(MAX_UNPACKED_BYTES + 1)))
    with pytest.raises(ValueError, match="is cut short"):
        decompress_message(zstd.compress(np.random.default_rng(1).bytes(5000))[:-100])


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
