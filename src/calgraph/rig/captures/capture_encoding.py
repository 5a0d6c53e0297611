"""The captures of one sensor as a JSON object and arrays, to the last bit."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from calgraph.boards.detections import BoardCorners, Detection, InconsistentTags
from calgraph.errors import Rejected
from calgraph.io.columns import INDEX, NUMBER, Arrays, Column, Table
from calgraph.result import Snapshot
from calgraph.rig.captures.detect import SensorCapture
from calgraph.rig.captures.detection_tables import pack_detections, unpack_detections

_SNAPSHOTS = Table("snapshots", {
    "position": INDEX, "stamp": NUMBER, "width": INDEX, "height": INDEX,
    "image": Column((), np.uint8, ragged=True), "points": Column((3,), np.float32, ragged=True),
})  # fmt: skip


def encode_captures(captures: Sequence[SensorCapture]) -> tuple[dict[str, Any], Arrays]:
    """The captures of one sensor, which are numbered in their order."""
    found: dict[int, tuple[Detection, ...]] = {}
    content: dict[str, Any] = {"captures": [one.capture for one in captures], "rejected": [], "outlier_tags": []}
    for position, one in enumerate(captures):
        if isinstance(one.detections, Rejected):
            tags = one.detections.tags if isinstance(one.detections, InconsistentTags) else None
            content["rejected"].append([position, one.detections.reason, tags])
        else:
            found[position] = one.detections
            outliers = [board.outlier_tags if isinstance(board, BoardCorners) else () for board in one.detections]
            if any(outliers):
                content["outlier_tags"].append([position, outliers])
    snapshots = [
        {**vars(one.snapshot), "position": position, "image": np.frombuffer(one.snapshot.image, np.uint8)}
        for position, one in enumerate(captures)
        if one.snapshot
    ]
    return content, _SNAPSHOTS.pack(snapshots) | pack_detections({"": found})


def decode_captures(sensor: str, content: Mapping[str, Any], arrays: Arrays) -> tuple[SensorCapture, ...]:
    """The captures of a sensor from what :func:`encode_captures` gives.

    Raises:
        InputError: a column is missing, or its values do not fit the others.
        KeyError: a key is missing.
    """
    numbers = content["captures"]
    found = unpack_detections(arrays, [""])[""]
    rejected = {
        position: Rejected(reason) if tags is None else InconsistentTags(reason, tuple(tags))
        for position, reason, tags in content["rejected"]
    }
    for position, outliers in content["outlier_tags"]:
        found[position] = tuple(
            replace(board, outlier_tags=tuple(tags)) if tags and isinstance(board, BoardCorners) else board
            for board, tags in zip(found[position], outliers, strict=True)
        )
    snapshots = {
        row["position"]: Snapshot(
            numbers[row["position"]],
            sensor,
            row["stamp"],
            row["image"].tobytes(),
            row["width"],
            row["height"],
            row["points"],
        )
        for row in _SNAPSHOTS.unpack(arrays)
    }
    return tuple(
        SensorCapture(number, sensor, rejected.get(k) or found.get(k, ()), snapshots.get(k))
        for k, number in enumerate(numbers)
    )
