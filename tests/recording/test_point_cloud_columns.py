from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from calgraph.recording.point_cloud_columns import cloud_from_columns, columns_from_point_cloud2, to_relative_times
from calgraph.sensors import PointCloud

Array = np.ndarray[Any, Any]
DATATYPES = {"i1": 1, "u1": 2, "i2": 3, "u2": 4, "i4": 5, "u4": 6, "f4": 7, "f8": 8}
EPOCH = 1.7e9


def message(
    columns: dict[str, tuple[str, Array]],
    *,
    height: int = 1,
    order: str = "<",
    gap: int = 0,
    row_padding: int = 0,
    **changes: Any,
) -> SimpleNamespace:
    """A PointCloud2 of columns (name: type code, values), with unused bytes between fields, points and rows."""
    fields, offset = [], gap
    for name, (code, _) in columns.items():
        fields.append(SimpleNamespace(name=name, offset=offset, datatype=DATATYPES[code], count=1))
        offset += np.dtype(code).itemsize + gap
    n = len(next(iter(columns.values()))[1])
    width = n // height
    row = width * offset + row_padding
    data = np.full(height * row, 0xA5, np.uint8)
    for field, (code, values) in zip(fields, columns.values(), strict=True):
        size = np.dtype(code).itemsize
        for i, value in enumerate(values):
            start = i // width * row + i % width * offset + field.offset
            data[start : start + size] = np.frombuffer(np.array(value, order + code).tobytes(), np.uint8)
    content = {
        "height": height, "width": width, "fields": fields, "is_bigendian": order == ">", "point_step": offset,
        "row_step": row, "data": data,
    }  # fmt: skip
    return SimpleNamespace(**{**content, **changes})


def read(cloud: SimpleNamespace, stamp: float = EPOCH) -> PointCloud:
    return cloud_from_columns(columns_from_point_cloud2(cloud), stamp, "lidar")


def xyz(points: Array, code: str = "f4") -> dict[str, tuple[str, Array]]:
    return {axis: (code, points[:, i]) for i, axis in enumerate("xyz")}


@given(
    points=st.lists(st.tuples(*[st.integers(1, 100)] * 3), min_size=1, max_size=12),
    code=st.sampled_from(["i1", "u1", "i2", "u2", "i4", "u4", "f4", "f8"]),
    order=st.sampled_from("<>"),
    gap=st.integers(0, 5),
    row_padding=st.integers(0, 9),
    rows=st.sampled_from([1, 2, 3]),
    ring_code=st.sampled_from([None, "u1", "i1", "u2", "i4", "f4"]),
    names=st.permutations(["x", "y", "z", "ring", "intensity"]),
)
def test_any_layout_gives_its_points(
    points: list[tuple[int, int, int]], code: str, order: str, gap: int, row_padding: int, rows: int,
    ring_code: str | None, names: list[str],
) -> None:  # fmt: skip
    values = np.array(points * rows)
    rings = np.arange(len(values)) % 7
    columns = {**xyz(values, code), "intensity": ("f4", values[:, 0]), "ring": (ring_code or "u1", rings)}
    chosen = {name: columns[name] for name in names if name != "ring" or ring_code}
    cloud = read(message(chosen, height=rows, order=order, gap=gap, row_padding=row_padding))
    np.testing.assert_array_equal(cloud.points, values)
    assert (cloud.rings is None) == (ring_code is None)
    if cloud.rings is not None:
        np.testing.assert_array_equal(cloud.rings, rings)


def test_points_without_return_are_left_out_with_their_rings_and_times() -> None:
    points = np.array([[1, 2, 3], [np.nan, 0, 0], [0, 0, 0], [1, np.inf, 1], [4, 5, 6]])
    columns = {**xyz(points), "ring": ("u2", np.arange(5)), "time": ("f4", np.linspace(0, 0.1, 5))}
    cloud = read(message(columns))
    np.testing.assert_array_equal(cloud.points, [[1, 2, 3], [4, 5, 6]])
    np.testing.assert_array_equal(cloud.rings, [0, 4])
    assert cloud.times is not None
    np.testing.assert_allclose(cloud.times, [0, 0.1], atol=1e-6)


def test_empty_cloud_has_no_points() -> None:
    assert read(message(xyz(np.zeros((1, 3))), width=0, data=np.zeros(0, np.uint8))).points.shape == (0, 3)


@pytest.mark.parametrize("row_step", [0, 7, 10**6])
def test_wrong_row_step_of_a_single_row_does_not_matter(row_step: int) -> None:
    points = np.arange(1.0, 10).reshape(3, 3)
    np.testing.assert_array_equal(read(message(xyz(points), row_step=row_step)).points, points)


def test_too_few_bytes_are_an_error_with_both_numbers() -> None:
    cloud = message(xyz(np.ones((4, 3))))
    cloud.data = cloud.data[:40]
    with pytest.raises(ValueError, match="has 40 bytes of data, 48 are needed for 4 x 1 points of 12 bytes"):
        read(cloud)


def test_field_outside_the_point_is_an_error() -> None:
    with pytest.raises(ValueError, match="field z at offset 8 does not fit into the point step of 10 bytes"):
        read(message(xyz(np.ones((4, 3))), point_step=10))


def test_cloud_without_height_coordinate_is_an_error_that_lists_its_fields() -> None:
    columns = xyz(np.ones((4, 3)))
    del columns["z"]
    with pytest.raises(ValueError, match="has no field z, only x, y"):
        read(message(columns))


SWEEP = np.linspace(0, 0.1, 11)


def times(values: Array, stamp: float) -> Array:
    found = to_relative_times(values, stamp)
    assert found is not None
    return found


@pytest.mark.parametrize("stamp", [EPOCH, 5.0])
@pytest.mark.parametrize(
    "column",
    [
        pytest.param(lambda _: SWEEP.astype(np.float32), id="seconds"),
        pytest.param(lambda stamp: SWEEP + stamp, id="absolute seconds"),
        pytest.param(lambda _: (SWEEP * 1e9).astype(np.uint32), id="nanoseconds"),
        pytest.param(lambda stamp: ((SWEEP + stamp) * 1e9).astype(np.uint64), id="absolute nanoseconds"),
        pytest.param(lambda stamp: (SWEEP + stamp) * 1e9, id="absolute nanoseconds as floats"),
        pytest.param(lambda _: (SWEEP * 1e6).astype(np.uint32), id="microseconds"),
        pytest.param(lambda _: (SWEEP * 1e6).astype(np.float32), id="microseconds as floats"),
    ],
)
def test_times_in_any_unit_are_relative_seconds(column: Any, stamp: float) -> None:
    np.testing.assert_allclose(times(column(stamp), stamp), SWEEP, atol=1e-6)


def test_times_before_the_stamp_are_negative() -> None:
    np.testing.assert_allclose(times(SWEEP - 0.1, EPOCH), SWEEP - 0.1)


def test_times_of_a_sweep_of_several_seconds_are_relative_even_early_in_a_simulation() -> None:
    slow = np.linspace(0, 6, 7)
    np.testing.assert_allclose(times(slow, 3.0), slow)


@pytest.mark.parametrize("values", [np.array([0, 1e5, 1e30]), np.array([0.0, np.nan]), np.array([7e8, 7e8 + 1])])
def test_times_that_make_no_sense_are_left_out(values: Array) -> None:
    assert to_relative_times(values, EPOCH) is None


@pytest.mark.parametrize("names", [("time_sec", "time_nsec"), ("lidar_sec", "lidar_nsec"), ("secs", "nsecs")])
@pytest.mark.parametrize("start", [EPOCH, 0.0])
def test_times_in_seconds_and_nanoseconds_are_one_time(names: tuple[str, str], start: float) -> None:
    """The second changes within the sweep; the fields are absolute, or relative to the stamp."""
    times = np.array([0.95, 0.975, 1.0, 1.05])
    seconds, fraction = np.divmod(times, 1.0)
    columns = {names[0]: ("u4", seconds + start), names[1]: ("u4", np.round(1e9 * fraction))}
    cloud = read(message({**xyz(np.ones((4, 3))), **columns}), EPOCH if start else 0.0)
    assert cloud.times is not None
    np.testing.assert_allclose(cloud.times, times, atol=1e-6)


def test_nanoseconds_alone_are_no_time_of_two_fields() -> None:
    cloud = read(message({**xyz(np.ones((2, 3))), "time_nsec": ("u4", np.array([0, 10**8]))}))
    assert cloud.times is None


def test_points_farther_than_any_scanner_measures_are_left_out() -> None:
    x = np.array([1.0, 1e30, -1e30, np.nan, np.inf, 9e4])
    cloud = cloud_from_columns({"x": x, "y": np.ones(6), "z": np.ones(6)}, EPOCH)
    np.testing.assert_array_equal(cloud.points[:, 0], [1.0, 9e4])
