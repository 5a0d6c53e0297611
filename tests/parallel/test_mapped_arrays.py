"""Values beyond a limit have arrays in temporary files."""

import gc
import tempfile
from pathlib import Path

import numpy as np
import pytest

from calgraph.errors import CalibrationError
from calgraph.parallel.mapped_arrays import ArrayMemory

MEGABYTE = 2**20


class Owner:
    """Of a value."""


def make_value(number: int, size: int = MEGABYTE) -> dict[str, object]:
    rng = np.random.default_rng(number)
    return {"number": number, "parts": (rng.normal(size=(size // 16, 2)), np.arange(3))}


def assert_equal(value: dict[str, object], expected: dict[str, object]) -> None:
    np.testing.assert_equal(value, expected)


def anonymous_bytes() -> int:
    """The memory of this process that is in no file."""
    (line,) = (line for line in Path("/proc/self/status").read_text().splitlines() if line.startswith("RssAnon"))
    return 1024 * int(line.split()[1])


def test_values_within_the_limit_are_the_same_objects() -> None:
    memory, value = ArrayMemory(3 * MEGABYTE), make_value(0)
    assert memory.limit(value) is value
    assert memory.keep(value, Owner()) is value


@pytest.mark.parametrize("number", [0, 1])
def test_values_beyond_the_limit_are_equal(number: int) -> None:
    assert_equal(ArrayMemory(MEGABYTE // 2).limit(make_value(number)), make_value(number))
    assert_equal(ArrayMemory(MEGABYTE // 2).keep(make_value(number), Owner()), make_value(number))


def test_mapped_arrays_outlive_what_kept_them() -> None:
    value = ArrayMemory(0).keep(make_value(3), Owner())
    gc.collect()
    assert_equal(value, make_value(3))


def test_mapped_arrays_cannot_be_changed() -> None:
    array = ArrayMemory(0).limit(np.zeros(10))
    with pytest.raises(ValueError, match="read-only"):
        array[0] = 1.0


@pytest.mark.skipif(not Path("/proc/self/status").exists(), reason="needs Linux")
def test_memory_does_not_grow_beyond_the_limit() -> None:
    memory, before = ArrayMemory(8 * MEGABYTE), anonymous_bytes()
    owners = [Owner() for _ in range(50)]
    kept = [memory.keep(make_value(number, 4 * MEGABYTE), owner) for number, owner in enumerate(owners)]
    assert anonymous_bytes() - before < 20 * MEGABYTE
    assert_equal(kept[40], make_value(40, 4 * MEGABYTE))


def test_memory_of_values_that_are_gone_is_free_again() -> None:
    memory = ArrayMemory(MEGABYTE + 100)
    owner = Owner()
    memory.keep(make_value(0), owner)
    second, third = make_value(1), make_value(2)
    assert memory.keep(second, Owner()) is not second
    del owner
    assert memory.keep(third, Owner()) is third


def test_a_folder_for_temporary_files_that_cannot_be_written_is_named(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path / "missing"))
    with pytest.raises(CalibrationError, match=r"missing: 80 bytes .* TMPDIR, or raise `estimation"):
        ArrayMemory(0).limit(np.zeros(10))
