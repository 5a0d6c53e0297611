import gzip
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from calgraph.recording.pcd import decompress_lzf, read_pcd, read_ply
from calgraph.recording.point_cloud_columns import cloud_from_columns

POINTS = np.array(
    [(1.5, -2, 3, 7, 0.0), (np.nan, np.nan, np.nan, 8, 0.01), (4, 5, 6.25, 300, 0.02)],
    dtype=[("x", "<f4"), ("y", "<f4"), ("z", "<f4"), ("ring", "<u2"), ("time", "<f8")],
)
HEADER = """\
# .PCD v0.7 - Point Cloud Data file format
VERSION 0.7
FIELDS x y z ring time
SIZE 4 4 4 2 8
TYPE F F F U F
COUNT 1 1 1 1 1
WIDTH 3
HEIGHT 1
VIEWPOINT 0 0 0 1 0 0 0
POINTS 3
DATA {kind}
"""


def compress_lzf(data: bytes) -> bytes:
    """A simple compressor: runs of one byte become copies that overlap themselves."""
    out, i = bytearray(), 0
    while i < len(data):
        run = 1
        while i + run < len(data) and data[i + run] == data[i] and run < 265:
            run += 1
        out += bytes([0, data[i]])
        if run >= 4:
            length = run - 1 - 2
            out += bytes([length << 5, 0]) if length < 7 else bytes([7 << 5, length - 7, 0])
            i += run
        else:
            i += 1
    return bytes(out)


def body(kind: str) -> bytes:
    if kind == "ascii":
        return b"\n".join(b" ".join(str(value).encode() for value in point) for point in POINTS.tolist()) + b"\n"
    if kind == "binary":
        return POINTS.tobytes()
    plain = b"".join(POINTS[name].tobytes() for name in POINTS.dtype.names or ())
    packed = compress_lzf(plain)
    return np.array([len(packed), len(plain)], "<u4").tobytes() + packed


def pcd(path: Path, kind: str, header: str = HEADER) -> Path:
    path.write_bytes(header.format(kind=kind).encode() + body(kind))
    return path


KINDS = ["ascii", "binary", "binary_compressed"]


@pytest.mark.parametrize("kind", KINDS)
def test_every_kind_of_pcd_gives_the_same_columns(tmp_path: Path, kind: str) -> None:
    columns = read_pcd(pcd(tmp_path / "1.pcd", kind))
    for name in POINTS.dtype.names or ():
        np.testing.assert_array_equal(columns[name], POINTS[name])


@pytest.mark.parametrize("kind", KINDS)
def test_cloud_of_a_pcd_leaves_out_nan_points(tmp_path: Path, kind: str) -> None:
    cloud = cloud_from_columns(read_pcd(pcd(tmp_path / "1.pcd", kind)), 5.0)
    np.testing.assert_array_equal(cloud.points, [[1.5, -2, 3], [4, 5, 6.25]])
    np.testing.assert_array_equal(cloud.rings, [7, 300])


def test_gzipped_pcd_is_read(tmp_path: Path) -> None:
    path = tmp_path / "1.pcd.gz"
    path.write_bytes(gzip.compress(pcd(tmp_path / "1.pcd", "binary").read_bytes()))
    np.testing.assert_array_equal(read_pcd(path)["ring"], [7, 8, 300])


@pytest.mark.parametrize("kind", KINDS)
def test_fields_of_several_values_are_passed_over(tmp_path: Path, kind: str) -> None:
    dtype = np.dtype([("_", "<f4", (2,)), *[(axis, "<f4") for axis in "xyz"]])
    points = np.zeros(2, dtype)
    for i, axis in enumerate("xyz"):
        points[axis] = [i + 1, i + 10]
    data = {
        "ascii": b"0 0 1 2 3\n0 0 10 11 12\n",
        "binary": points.tobytes(),
        "binary_compressed": np.array([16 * 3 + 16 * 2, 40], "<u4").tobytes()
        + compress_literally(b"".join(points[name].tobytes() for name in ("_", "x", "y", "z"))),
    }[kind]
    header = "FIELDS _ x y z\nSIZE 4 4 4 4\nTYPE F F F F\nCOUNT 2 1 1 1\nWIDTH 2\nHEIGHT 1\nDATA "
    (tmp_path / "1.pcd").write_bytes(f"{header}{kind}\n".encode() + data)
    np.testing.assert_array_equal(read_pcd(tmp_path / "1.pcd")["z"], [3, 12])


def compress_literally(data: bytes) -> bytes:
    return b"".join(bytes([0, value]) for value in data)


def test_real_sweep_has_sixteen_rings(data_dir: Path) -> None:
    columns = read_pcd(data_dir / "acfr-vlp16-checkerboard/pcd_full/pose1_full.pcd.gz")
    assert len(columns["x"]) == 23969
    np.testing.assert_array_equal(np.unique(columns["ring"]), np.arange(16))
    assert (columns["x"][0], columns["z"][0]) == (np.float32(1.373171), np.float32(-0.79871565))


def test_lzf_copies_and_literals_are_undone() -> None:
    # "ab", then 6 bytes from 2 back, then "c".
    assert decompress_lzf(bytes([1]) + b"ab" + bytes([4 << 5, 1, 0]) + b"c", 9) == b"ababababc"


def test_lzf_copy_from_before_the_start_is_an_error() -> None:
    with pytest.raises(ValueError, match="before their start"):
        decompress_lzf(bytes([0]) + b"a" + bytes([1 << 5, 5]), 4)


@pytest.mark.parametrize("kind", ["binary", "binary_compressed"])
def test_pcd_cut_short_is_an_error(tmp_path: Path, kind: str) -> None:
    path = pcd(tmp_path / "1.pcd", kind)
    path.write_bytes(path.read_bytes()[:-10])
    with pytest.raises(ValueError, match="is cut short"):
        read_pcd(path)


def test_ascii_pcd_with_fewer_points_than_stated_is_an_error(tmp_path: Path) -> None:
    path = pcd(tmp_path / "1.pcd", "ascii", HEADER.replace("POINTS 3", "POINTS 4"))
    with pytest.raises(ValueError, match="has 3 points of 5 values, states 4 of 5"):
        read_pcd(path)


@pytest.mark.parametrize(
    ("content", "complaint"),
    [(b"hello", "no DATA line"), (b"DATA ascii\n", "no FIELDS"), (HEADER.format(kind="zip").encode(), "DATA zip")],
)
def test_damaged_pcd_header_is_an_error_with_the_reason(tmp_path: Path, content: bytes, complaint: str) -> None:
    (tmp_path / "1.pcd").write_bytes(content)
    with pytest.raises(ValueError, match=complaint):
        read_pcd(tmp_path / "1.pcd")


PLY_HEADER = """\
ply
format {kind} 1.0
comment made by hand
element vertex 2
property float x
property double y
property float32 z
property uchar ring
element face 1
property list uchar int vertex_indices
end_header
"""


def ply(path: Path, kind: str, header: str = PLY_HEADER) -> Path:
    order = ">" if "big" in kind else "<"
    dtype: np.dtype[Any] = np.dtype(
        [("x", order + "f4"), ("y", order + "f8"), ("z", order + "f4"), ("ring", "u1")]
    )
    rows = [(1.0, 2.5, 3.0, 4), (5.0, 6.0, 7.0, 8)]
    text = "".join(" ".join(str(value) for value in row) + "\n" for row in rows).encode()
    data = text if kind == "ascii" else np.array(rows, dtype).tobytes()
    path.write_bytes(header.format(kind=kind).encode() + data + b"3 0 1 1\n")
    return path


@pytest.mark.parametrize("kind", ["ascii", "binary_little_endian", "binary_big_endian"])
def test_every_kind_of_ply_gives_its_vertices(tmp_path: Path, kind: str) -> None:
    cloud = cloud_from_columns(read_ply(ply(tmp_path / "1.ply", kind)), 5.0)
    np.testing.assert_array_equal(cloud.points, [[1, 2.5, 3], [5, 6, 7]])
    np.testing.assert_array_equal(cloud.rings, [4, 8])


def test_ply_cut_short_is_an_error(tmp_path: Path) -> None:
    path = ply(tmp_path / "1.ply", "binary_little_endian")
    path.write_bytes(path.read_bytes()[:-20])
    with pytest.raises(ValueError, match="is cut short"):
        read_ply(path)


def test_file_that_is_no_ply_is_an_error(tmp_path: Path) -> None:
    (tmp_path / "1.ply").write_text("solid")
    with pytest.raises(ValueError, match="is no PLY file"):
        read_ply(tmp_path / "1.ply")
