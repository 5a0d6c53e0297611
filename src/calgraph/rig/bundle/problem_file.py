"""Reading and writing a problem, to the last bit; docs/formats.md describes the file's members."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from calgraph.config import Rig
from calgraph.config.settings import LimitSettings
from calgraph.errors import InputError, Rejected
from calgraph.geometry import Array
from calgraph.graph.pairwise_estimate import PairwiseEstimate
from calgraph.graph.spanning_tree import SpanningTree
from calgraph.io.archive import read_archive, write_archive
from calgraph.io.columns import INDEX, NUMBER, Arrays, Column, Table
from calgraph.io.strict_model import StrictModel
from calgraph.io.yaml_reading import validate_content
from calgraph.result.finding import Finding
from calgraph.rig.bundle.problem import Problem, SolverOptions, check_problem
from calgraph.rig.captures.detect import CaptureSet
from calgraph.rig.captures.detection_tables import pack_detections, unpack_detections
from calgraph.rig.captures.holds import Hold
from calgraph.rig.pairs.board_pair import PairwiseEstimates, select_successful
from calgraph.sensors import CameraModel

FORMAT = "calgraph-problem/2"
_STRUCTURE = "problem.json"

_HOLDS = Table("holds", {"index": INDEX, "start": NUMBER, "end": NUMBER})
_STAMPS = Table("stamps", {"hold": INDEX, "sensor": INDEX, "stamps": Column(ragged=True)})
_CAMERAS = Table("cameras", {
    "width": INDEX, "height": INDEX, "K": Column((3, 3)), "distortion": Column(ragged=True),
})  # fmt: skip
_ESTIMATES = Table("estimates", {
    "T_a_b": Column((4, 4)), "information": Column((6, 6)), "matches": Column((3,), np.int64, ragged=True),
    "inliers": Column((), np.bool_, ragged=True), "residuals": Column(ragged=True),
    "rival": NUMBER, "excess": NUMBER,
})  # fmt: skip
_TREE = Table("tree", {"sensor": INDEX, "T_root_sensor": Column((4, 4))})


class _Miss(StrictModel):
    capture: int
    sensor: str
    reason: str


class _Finding(StrictModel):
    text: str
    sensors: tuple[str, ...]


class _Pair(StrictModel):
    sensors: tuple[str, str]
    rejected: str | None = None
    """Why there is no estimate; pairs without it are in the order of the rows of the table of estimates."""


class _Structure(StrictModel):
    """The JSON member: everything but arrays."""

    format: str
    rig: Rig
    solver: SolverOptions
    sensors: tuple[str, ...]
    """Names; tables refer to sensors by their index here."""
    start: float
    frames: dict[str, str]
    cameras: dict[str, Literal["pinhole", "fisheye"]]
    """Model by name; in the order of the rows of the table of cameras."""
    misses: tuple[_Miss, ...]
    pairs: tuple[_Pair, ...]
    parents: dict[str, str]
    """Parent by sensor in the spanning tree."""
    findings: tuple[_Finding, ...] = ()
    """What does not fit the rig in the recording; files of version 0.1 have none."""


def save_problem(problem: Problem, path: Path | str) -> None:
    """Writes a problem, to the last bit, in one step.

    Raises:
        InputError: ``path`` cannot be written.
    """
    content, arrays = _encode(problem)
    write_archive(Path(path), _STRUCTURE, content, arrays)


def load_problem(path: Path | str, limits: LimitSettings = LimitSettings()) -> Problem:
    """Reads what :func:`save_problem` wrote.

    Raises:
        InputError: the file is missing, is not a problem, has another version, is truncated, damaged or
            inconsistent; the message names the member and the allowed values.
    """
    path = Path(path)
    content, arrays = read_archive(path, _STRUCTURE, FORMAT, limits.max_archive_bytes)
    structure = validate_content(_Structure, content, path / _STRUCTURE)
    try:
        problem = _decode(structure, arrays)
        check_problem(problem)
    except InputError as error:
        raise InputError(f"{path}: {error}") from error
    return problem


def round_trip(problem: Problem) -> Problem:
    """The problem as read back from a file.

    Values are equal, but the memory layout of arrays may change the last bit of results. Snapshots are kept.
    """
    content, arrays = _encode(problem)
    again = _decode(_Structure.model_validate(content), arrays)
    return replace(again, captures=replace(again.captures, snapshots=problem.captures.snapshots))


def _encode(problem: Problem) -> tuple[dict[str, Any], dict[str, NDArray[Any]]]:
    captured, tree = problem.captures, problem.tree
    number = {name: i for i, name in enumerate(captured.detections)}
    content = {
        "format": FORMAT,
        "rig": problem.rig.to_plain(),
        "solver": problem.solver.model_dump(mode="json"),
        "sensors": list(number),
        "start": captured.start,
        "frames": dict(captured.frames),
        "cameras": {name: camera.model for name, camera in captured.cameras.items()},
        "misses": [
            {"capture": i, "sensor": name, "reason": why} for (i, name), why in captured.rejections.items()
        ],
        "pairs": [
            {"sensors": names} | ({"rejected": pair.reason} if isinstance(pair, Rejected) else {})
            for names, pair in problem.pairs.items()
        ],
        "parents": dict(tree.parents),
        "findings": [{"text": finding.text, "sensors": finding.sensors} for finding in captured.findings],
    }
    arrays = (
        _HOLDS.pack([vars(hold) for hold in captured.holds])
        | _STAMPS.pack([
            {"hold": i, "sensor": number[name], "stamps": stamps}
            for i, hold in enumerate(captured.holds) for name, stamps in hold.stamps.items()
        ])
        | _CAMERAS.pack([vars(camera) for camera in captured.cameras.values()])
        | _ESTIMATES.pack([
            {**vars(e), "rival": e.alternative_pose_angle, "excess": e.normalized_rms}
            for e in select_successful(problem.pairs)
        ])
        | _TREE.pack([{"sensor": number[name], "T_root_sensor": T} for name, T in tree.T_root_sensor.items()])
    )  # fmt: skip
    return content, arrays | pack_detections(captured.detections)


def _decode(structure: _Structure, arrays: Arrays) -> Problem:
    sensors = structure.sensors
    captured = CaptureSet(
        start=structure.start,
        frames=structure.frames,
        holds=_holds(sensors, arrays),
        detections=unpack_detections(arrays, sensors),
        rejections={(miss.capture, miss.sensor): miss.reason for miss in structure.misses},
        cameras=_cameras(structure, arrays),
        findings=tuple(Finding(finding.text, finding.sensors) for finding in structure.findings),
    )
    poses = {row["sensor"]: row["T_root_sensor"] for row in _TREE.unpack_named(arrays, sensors)}
    tree = SpanningTree(structure.rig.root, structure.parents, poses)
    return Problem(structure.rig, captured, _pairs(structure, arrays), tree, structure.solver)


def _holds(sensors: Sequence[str], arrays: Arrays) -> tuple[Hold, ...]:
    holds = [Hold(**row, stamps={}) for row in _HOLDS.unpack(arrays)]
    stamps: list[dict[str, Array]] = [{} for _ in holds]
    for row in _STAMPS.unpack_named(arrays, sensors):
        if not 0 <= row["hold"] < len(holds):
            raise InputError(f"stamps/hold: must be below the {len(holds)} holds, got {row['hold']}")
        stamps[row["hold"]][row["sensor"]] = row["stamps"]
    return tuple(replace(hold, stamps=by_sensor) for hold, by_sensor in zip(holds, stamps, strict=True))


def _cameras(structure: _Structure, arrays: Arrays) -> dict[str, CameraModel]:
    rows = _unpack_exactly(_CAMERAS, arrays, len(structure.cameras), "cameras")
    return {
        name: CameraModel(model, **row) for (name, model), row in zip(structure.cameras.items(), rows, strict=True)
    }


def _pairs(structure: _Structure, arrays: Arrays) -> PairwiseEstimates:
    estimate_count = sum(pair.rejected is None for pair in structure.pairs)
    rows = iter(_unpack_exactly(_ESTIMATES, arrays, estimate_count, "pairs that are not rejected"))
    return {
        pair.sensors: _estimate(pair.sensors, **next(rows)) if pair.rejected is None else Rejected(pair.rejected)
        for pair in structure.pairs
    }


def _estimate(sensors: tuple[str, str], *, rival: float, excess: float, **fields: Any) -> PairwiseEstimate:
    return PairwiseEstimate(*sensors, **fields, alternative_pose_angle=rival, normalized_rms=excess)


def _unpack_exactly(table: Table, arrays: Arrays, count: int, what: str) -> list[dict[str, Any]]:
    rows = table.unpack(arrays)
    if len(rows) != count:
        raise InputError(f"{table.name}: must have a row for each of the {count} {what}, has {len(rows)}")
    return rows
