"""Detections as tables of arrays, to the last bit; docs/formats.md describes the columns."""

from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from calgraph.boards.detections import BoardCorners, Detection, PlanePatch, Segment, to_beams
from calgraph.errors import InputError
from calgraph.io.columns import INDEX, NUMBER, Arrays, Column, Table

_PLACE = {"sensor": INDEX, "capture": INDEX, "candidate": INDEX}
_BEAMS = {"ranges": Column(ragged=True), "directions": Column((3,), ragged=True)}
_POINTS = {"points": Column((3,), ragged=True), **_BEAMS}
"""Beams, and their end points for other programs: they are not read where there are ranges and directions."""
DETECTIONS: Mapping[type[Detection], Table] = {
    PlanePatch: Table("planes", {
        **_PLACE,
        "plane": Column((4,)), "covariance": Column((3, 3)), **_POINTS,
        "center": Column((3,)), "match": NUMBER, "edges": Column((2, 3), ragged=True),
    }),
    Segment: Table("segments", {
        **_PLACE,
        "endpoints": Column((2, 3)), "covariance": Column((6, 6)), **_POINTS,
        "match": NUMBER, "edges": Column((2, 3), ragged=True),
    }),
    BoardCorners: Table("corners", {
        **_PLACE,
        "corners_board": Column((3,), ragged=True), "pixels": Column((2,), ragged=True),
        "T_camera_board": Column((4, 4)), "covariance": Column((6, 6)),
        "plane": Column((4,)), "plane_covariance": Column((3, 3)), "rms": NUMBER, "board": INDEX,
    }),
}  # fmt: skip

_MOTIONS = Table("motions", {**_PLACE, "twist": Column((6,))})
"""Velocities of moving boards; files of boards at rest have none."""
_MOTION_VARIANCES = Table("motion_variances", {**_PLACE, "motion_variance": Column((6,))})
"""Of moving boards whose velocities are uncertain."""
_BEAM_TIMES = Table("beam_times", {**_PLACE, "times": Column(ragged=True)})
"""Times of the beams of single messages; files without them have none."""
_OPTIONAL = (_MOTIONS, "twist"), (_MOTION_VARIANCES, "motion_variance"), (_BEAM_TIMES, "times")


def pack_detections(detections: Mapping[str, Mapping[int, Sequence[Detection]]]) -> dict[str, NDArray[Any]]:
    """The columns of detections, given by sensor and capture."""
    number = {name: i for i, name in enumerate(detections)}
    placed = [
        ({"sensor": number[name], "capture": capture, "candidate": k}, detection)
        for name, by_capture in detections.items()
        for capture, found in by_capture.items()
        for k, detection in enumerate(found)
    ]
    arrays: dict[str, NDArray[Any]] = {}
    for kind, table in DETECTIONS.items():
        of_kind = [(place, one) for place, one in placed if isinstance(one, kind)]
        arrays |= table.pack(
            [{**place, **vars(one), "points": getattr(one, "points", None)} for place, one in of_kind]
        )
    for table, field in _OPTIONAL:
        values = [(place, getattr(one, field, np.zeros(0))) for place, one in placed]
        rows = [{**place, field: value} for place, value in values if np.any(value)]
        arrays |= table.pack(rows) if rows else {}
    return arrays


def unpack_detections(arrays: Arrays, sensors: Sequence[str]) -> dict[str, dict[int, tuple[Detection, ...]]]:
    """The detections of columns, by sensor and capture.

    Args:
        arrays: what :func:`pack_detections` gives.
        sensors: the names of the sensors, which the columns have by number.

    Raises:
        InputError: a column is missing, or its values do not fit the others.
    """
    detections: dict[str, dict[int, tuple[Detection, ...]]] = {name: {} for name in sensors}
    optional: dict[tuple[str, int, int], dict[str, Any]] = {}
    for table, field in _OPTIONAL:
        if any(name.startswith(f"{table.name}/") for name in arrays):
            for row in table.unpack_named(arrays, sensors):
                optional.setdefault((row["sensor"], row["capture"], row["candidate"]), {})[field] = row[field]
    for kind, table in DETECTIONS.items():
        for row in _unpack_rows(table, arrays, sensors):
            sensor, capture, candidate = row.pop("sensor"), row.pop("capture"), row.pop("candidate")
            by_capture = detections[sensor]
            row.update(optional.get((sensor, capture, candidate), {}))
            before = by_capture.get(capture, ())
            if candidate != len(before):
                raise InputError(
                    f"{table.name}/candidate: must count each sensor's detections in a capture from 0, "
                    f"got {candidate} after {len(before)} of capture {capture}"
                )
            by_capture[capture] = (*before, kind(**row))
    return detections


def _unpack_rows(table: Table, arrays: Arrays, sensors: Sequence[str]) -> Iterator[dict[str, Any]]:
    """Rows of a table of detections; in files of version 0.1 beams are stated by their end points alone."""
    older = "points" in table.columns and not any(f"{table.name}/{field}" in arrays for field in _BEAMS)
    kept = {field: column for field, column in table.columns.items() if not (older and field in _BEAMS)}
    for row in Table(table.name, kept).unpack_named(arrays, sensors):
        points = row.pop("points", None)
        if older:
            row |= dict(zip(_BEAMS, to_beams(points), strict=True))
        if points is not None and not len(points) == len(row["ranges"]) == len(row["directions"]):
            raise InputError(
                f"{table.name}/ranges.rows: must be those of {table.name}/points and {table.name}/directions"
            )
        yield row
