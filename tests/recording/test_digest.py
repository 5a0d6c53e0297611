"""Hashes of samples of messages' content."""

from pathlib import Path

import numpy as np
import pytest

from calgraph.recording.content_hash import hash_array, hash_content, hash_file

DATA = np.random.default_rng(0).integers(0, 256, 10_000, dtype=np.uint8)


@pytest.mark.parametrize("size", [0, 1, 63, 64, 65, 2047, 2048, 2049, 10_000])
def test_bytes_arrays_and_files_with_the_same_content_have_one_hash(size: int, tmp_path: Path) -> None:
    (tmp_path / "file").write_bytes(DATA[:size].tobytes())
    hashes = {hash_content(DATA[:size].tobytes()), hash_array(DATA[:size]), hash_file(tmp_path / "file")}
    assert len(hashes) == 1


def test_every_byte_of_a_small_message_counts() -> None:
    data = DATA[:2000]
    assert len({hash_array(data ^ (np.arange(2000) == k)) for k in range(2000)}) == 2000


def test_bytes_before_the_start_do_not_count() -> None:
    assert hash_content(b"header" + DATA.tobytes(), 6) == hash_content(DATA.tobytes())


def test_noise_anywhere_in_a_large_message_counts() -> None:
    rng = np.random.default_rng(1)
    assert hash_array(DATA.astype(float)) != hash_array(DATA + 1e-3 * rng.normal(size=len(DATA)))


def test_messages_of_different_length_differ() -> None:
    assert hash_array(np.zeros(100_000)) != hash_array(np.zeros(100_001))
