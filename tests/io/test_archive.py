"""Archives are refused by what they state, before memory is taken."""

import zipfile
from pathlib import Path

import numpy as np
import pytest

from calgraph.errors import InputError
from calgraph.io.archive import read_archive, write_archive
from calgraph.io.yaml_reading import read_yaml

LFS = "version https://git-lfs.github.com/spec/v1\noid sha256:4d7a214614ab\nsize 12345\n"


LIMIT = 10**6


def test_an_archive_larger_than_the_limit_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "a.npz"
    write_archive(path, "a.json", {"format": "a/1"}, {"zeros": np.zeros(100_000)})
    assert path.stat().st_size < 5000
    assert len(read_archive(path, "a.json", "a/1", LIMIT)[1]["zeros"]) == 100_000
    with pytest.raises(InputError, match=r"a\.npz: unpacks to 1 MB, more than the limit of 0 MB"):
        read_archive(path, "a.json", "a/1", 400_000)


def test_a_member_that_states_more_than_memory_is_damaged(tmp_path: Path) -> None:
    path = tmp_path / "a.npz"
    write_archive(path, "a.json", {"format": "a/1"}, {})
    with zipfile.ZipFile(path, "a") as archive, archive.open("b.npy", "w") as member:
        header = {"descr": "<f8", "fortran_order": False, "shape": (1 << 50,)}
        np.lib.format.write_array_header_1_0(member, header)
    with pytest.raises(InputError, match=r"its member b\.npy is damaged"):
        read_archive(path, "a.json", "a/1", LIMIT)


def test_an_array_header_that_is_no_python_is_damaged(tmp_path: Path) -> None:
    path = tmp_path / "a.npz"
    write_archive(path, "a.json", {"format": "a/1"}, {})
    with zipfile.ZipFile(path, "a") as archive:
        archive.writestr("b.npy", b"\x93NUMPY\x01\x00\x05\x00{'a'\n")
    with pytest.raises(InputError, match=r"its member b\.npy is damaged"):
        read_archive(path, "a.json", "a/1", LIMIT)


def test_git_lfs_pointers_are_named(tmp_path: Path) -> None:
    (tmp_path / "a").write_text(LFS)
    with pytest.raises(InputError, match="is a Git LFS pointer"):
        read_archive(tmp_path / "a", "a.json", "a/1", LIMIT)
    with pytest.raises(InputError, match="is a Git LFS pointer"):
        read_yaml(tmp_path / "a")


@pytest.mark.skipif(not Path("/dev/zero").exists(), reason="the system has no /dev/zero")
def test_devices_are_not_read_because_they_may_never_end() -> None:
    with pytest.raises(InputError, match="is a device"):
        read_archive(Path("/dev/zero"), "a.json", "a/1", LIMIT)


def test_arrays_that_python_2_wrote_are_read(tmp_path: Path) -> None:
    """NumPy warns of the L of their integers, which pytest takes for an error."""
    path = tmp_path / "a.npz"
    write_archive(path, "a.json", {"format": "a/1"}, {})
    header = b"{'descr': '<f8', 'fortran_order': False, 'shape': (1L,), }".ljust(117) + b"\n"
    with zipfile.ZipFile(path, "a") as archive:
        archive.writestr("b.npy", b"\x93NUMPY\x01\x00v\x00" + header + np.ones(1).tobytes())
    assert read_archive(path, "a.json", "a/1", LIMIT)[1]["b"].tolist() == [1.0]
