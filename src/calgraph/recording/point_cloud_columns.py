"""Point clouds from named columns, as PointCloud2, PCD, PLY, NPZ and lines of numbers hold them."""

import logging
import re
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from calgraph.config.settings import LimitSettings
from calgraph.geometry import Array
from calgraph.recording.damage import MAX_RANGE, check_point_count
from calgraph.sensors import PointCloud

_log = logging.getLogger(__name__)

Columns = Mapping[str, NDArray[Any]]

# Livox calls its lasers lines, which are no rings: each measures at all elevations.
_RING_NAMES = ("ring", "channel", "laser_id", "ring_id")
_TIME_NAMES = ("t", "time", "timestamp", "offset_time", "time_offset", "time_stamp")
# Seconds and nanoseconds in two fields, whole numbers each: as sick_scan_xd and others write them.
_TIME_PAIRS = tuple(
    (f"{prefix}sec{plural}", f"{prefix}nsec{plural}")
    for prefix in ("time_", "t_", "timestamp_", "lidar_", "")
    for plural in ("", "s")
)
# PointField.datatype to NumPy's type codes.
_DATATYPES = {1: "i1", 2: "u1", 3: "i2", 4: "u2", 5: "i4", 6: "u4", 7: "f4", 8: "f8"}
# Seconds in one unit of a time column, the most likely first.
_FLOAT_UNITS = (1.0, 1e-3, 1e-6, 1e-9)
_INTEGER_UNITS = (1e-9, 1e-6)
# Plausible durations of a sweep, s, by which the unit of a time column is recognised: a spinning 2-D scanner takes
# up to 20 s, the fastest LiDARs some milliseconds. Units differ by factors of 1000: this is a rule of the format,
# and other bounds between neighbouring units give the same times.
_MAX_SWEEP_DURATION = 20.0
_MIN_SWEEP_DURATION = 1e-3


def columns_from_point_cloud2(message: Any) -> Columns:
    """The coordinates, rings and times of a PointCloud2, one value a point, rows one after the other.

    Raises:
        ValueError: fields, steps and data do not fit together.
    """
    height, width, step = int(message.height), int(message.width), int(message.point_step)
    dtype = points_dtype(message.fields, _DATATYPES, step, big_endian=bool(message.is_bigendian))
    names = dtype.names or ()
    data = np.ascontiguousarray(message.data, dtype=np.uint8)
    row = _row_step(message, len(data))
    if width == 0 or height == 0:
        return {name: np.empty(0, dtype[name]) for name in names}
    points = np.ndarray((height, width), dtype, buffer=data.data, strides=(row, step))
    return {name: points[name].ravel() for name in names}


def points_dtype(
    packed: Iterable[Any], datatypes: Mapping[int, str], step: int, *, big_endian: bool = False
) -> np.dtype[Any]:
    """The layout of a point, of the fields that are read.

    Args:
        packed: all its fields: name, offset in bytes, and ``datatype`` (ROS) or ``type`` (Foxglove).
        datatypes: NumPy's type codes by the number of the type.
        step: size of a point, bytes.
        big_endian: byte order.

    Raises:
        ValueError: a field has an unknown type, or does not fit into the point.
    """
    fields = {field.name: field for field in packed}
    pairs = (name for pair in _TIME_PAIRS for name in pair)
    used = {"x", "y", "z", *_RING_NAMES, *_TIME_NAMES, *pairs}
    names = [name for name in fields if name in used]
    # Called so by ROS, and by Foxglove.
    key = "datatype" if all(hasattr(fields[name], "datatype") for name in names) else "type"
    types = [int(getattr(fields[name], key)) for name in names]
    for name, number in zip(names, types, strict=True):
        if number not in datatypes:
            raise ValueError(f"field {name} has unknown datatype {number}; 1 to 8 are known")
    formats = [(">" if big_endian else "<") + datatypes[number] for number in types]
    offsets = [int(fields[name].offset) for name in names]
    for name, offset, code in zip(names, offsets, formats, strict=True):
        if offset + np.dtype(code).itemsize > step:
            raise ValueError(f"field {name} at offset {offset} does not fit into the point step of {step} bytes")
    return np.dtype({"names": names, "formats": formats, "offsets": offsets, "itemsize": step})


def _row_step(message: Any, size: int) -> int:
    """Bytes from row to row; drivers of unorganised clouds often leave row_step unset or wrong."""
    tight = int(message.width) * int(message.point_step)
    stated = int(message.row_step)
    row = stated if message.height > 1 and stated >= tight else tight
    needed = (int(message.height) - 1) * row + tight
    if size < needed:
        raise ValueError(
            f"cloud has {size} bytes of data, {needed} are needed for "
            f"{message.width} x {message.height} points of {message.point_step} bytes"
        )
    return row


def cloud_from_columns(columns: Columns, stamp: float, frame_id: str = "") -> PointCloud:
    """A point cloud from columns (N,) x, y, z and, if there, a ring and a time.

    Points that are not finite, lie in the origin, or are farther than any scanner measures are left out: drivers
    mark beams without a return so.

    Raises:
        ValueError: a coordinate is missing.
    """
    missing = [axis for axis in "xyz" if axis not in columns]
    if missing:
        raise ValueError(f"cloud has no field {', '.join(missing)}, only {', '.join(columns) or 'unknown ones'}")
    x, y, z = (np.asarray(columns[axis], dtype=np.float64) for axis in "xyz")
    near = (np.abs(x) <= MAX_RANGE) & (np.abs(y) <= MAX_RANGE) & (np.abs(z) <= MAX_RANGE)
    kept = np.asarray(near & ((x != 0) | (y != 0) | (z != 0)))
    points = np.stack([x[kept], y[kept], z[kept]], axis=-1)
    ring_name = next((name for name in _RING_NAMES if name in columns), None)
    rings = None if ring_name is None else np.nan_to_num(columns[ring_name][kept], nan=-1).astype(np.int32)
    return PointCloud(stamp, frame_id, points, rings, _find_times(columns, kept, stamp))


def _find_times(columns: Columns, kept: NDArray[np.bool_], stamp: float) -> Array | None:
    """Times of the points (N,) that are marked True, relative to the stamp, s; None where there are none."""
    for seconds, nanoseconds in _TIME_PAIRS:
        if seconds in columns and nanoseconds in columns:
            whole, fraction = (columns[name][kept].astype(np.float64) for name in (seconds, nanoseconds))
            return to_relative_times(whole + 1e-9 * fraction, stamp, (1.0,))
    name = next((name for name in _TIME_NAMES if name in columns), None)
    return None if name is None else to_relative_times(columns[name][kept], stamp)


def to_relative_times(values: NDArray[Any], stamp: float, units: Sequence[float] | None = None) -> Array | None:
    """Times of the points relative to the cloud's stamp, s; None where the column makes no sense.

    Integers are nanoseconds, floats seconds, unless only another unit gives a sweep of sensible length. Values are
    taken as absolute if they are nearer to the stamp than to zero.

    Args:
        values: (N,) a time column in an unknown unit.
        stamp: of the cloud, s.
        units: seconds in one unit, the most likely first; those of integers or floats if left out.
    """
    if len(values) == 0:
        return np.zeros(0)
    if not np.isfinite(values).all():
        return None
    for unit in units or (_INTEGER_UNITS if np.issubdtype(values.dtype, np.integer) else _FLOAT_UNITS):
        times = values.astype(np.float64) * unit
        low, high = times.min(), times.max()
        if _distance_to(stamp, low, high) < _distance_to(0.0, low, high):
            times, low, high = times - stamp, low - stamp, high - stamp
        plausible = max(abs(low), abs(high)) <= _MAX_SWEEP_DURATION
        if plausible and (high == low or high - low >= _MIN_SWEEP_DURATION):
            return times
    _log.debug("times of points between %s and %s make no sense at stamp %s", values.min(), values.max(), stamp)
    return None


def _distance_to(value: float, low: float, high: float) -> float:
    return max(low - value, value - high, 0.0)


_COMMENT = ("#", "//")


def parse_points(text: str, limits: LimitSettings = LimitSettings()) -> Columns:
    """The columns (N,) of a text with one point a line, separated by spaces, commas or semicolons.

    A first line with names (``x y z ring``) states the columns, also as a comment; without one, the first three
    are x, y, z. A first line with one number, as ``.pts`` files have it, is the number of points.

    Raises:
        ValueError: it has no x, y or z, more points than the limit, or a line has other values.
    """
    check_point_count(text.count("\n"), limits)
    lines = [line.strip() for line in text.splitlines() if line.strip()]
    head = _split(lines[0].lstrip("#/")) if lines else []
    names = [] if all(map(_is_number, head)) else [name.strip("\"'").lower() for name in head]
    body = [line for line in lines[bool(names) :] if not line.startswith(_COMMENT)]
    rows = [_split(line) for line in (body[1:] if body and len(_split(body[0])) == 1 else body)]
    width = len(rows[0]) if rows else 3
    if not {"x", "y", "z"} <= set(names):
        names = ["x", "y", "z"]  # of a comment, or without any
    if width < len(names) or any(len(row) != width for row in rows):
        wrong = next((row for row in rows if len(row) != width), rows[0] if rows else [])
        raise ValueError(f"each line must have x, y and z, and as many values as the others, got {wrong[:5]}")
    table = np.array(rows, dtype=np.float64).reshape(-1, width)
    return {name: table[:, i] for i, name in enumerate(names) if names.index(name) == i}


def is_point_table(head: str) -> bool:
    """Whether the first line of a CSV has the names of coordinates, or three numbers or four."""
    words = [word.strip("\"'").lower() for word in _split(head.lstrip("#/"))]
    return {"x", "y", "z"} <= set(words) or (len(words) in (3, 4) and all(map(_is_number, words)))


def _is_number(word: str) -> bool:
    try:
        float(word)
    except ValueError:
        return False
    return True


def _split(line: str) -> list[str]:
    return re.split(r"\s*[,;]\s*|\s+", line.strip().rstrip(",;"))
