"""scene.npz: the pictures of a calibration, for viewers; docs/formats.md describes its members."""

import zipfile
from collections.abc import Mapping, Sequence
from itertools import chain
from pathlib import Path
from typing import Any

import numpy as np

from calgraph.config.settings import LimitSettings
from calgraph.errors import InputError
from calgraph.geometry import Array
from calgraph.io.archive import read_archive, write_archive
from calgraph.io.columns import INDEX, NUMBER, Arrays, Column, Table
from calgraph.result.pictures import (
    KINDS_OF_SENSORS,
    BeamView,
    BoardOutline,
    BoardView,
    DrivePath,
    DriveStart,
    DriveView,
    FloorView,
    Pictures,
    Snapshot,
)

FORMAT = "calgraph-scene/1"
_STRUCTURE = "scene.json"

_SNAPSHOTS = Table("snapshots", {
    "sensor": INDEX, "capture": INDEX, "stamp": NUMBER, "width": INDEX, "height": INDEX,
    "image": Column((), np.uint8, ragged=True), "points": Column((3,), np.float32, ragged=True),
})  # fmt: skip
_OUTLINES = Table("outlines", {"capture": INDEX, "corners": Column((4, 3)), "board": INDEX})
_NO_BOARD = -1
_VIEW = {"sensor": INDEX, "capture": INDEX, "used": Column(dtype=np.bool_)}
# Measurements of the board by cameras and by scanners, each with its residuals.
_CORNERS = Table("corners", {**_VIEW, "seen": Column((2,), ragged=True), "off": Column((2,), ragged=True)})
_BEAMS = Table("beams", {**_VIEW, "seen": Column((3,), ragged=True), "off": Column(ragged=True)})
_FLOOR = Table("floor", {"sensor": INDEX, "background": Column((2,), ragged=True)})
_STATIC = Table("static", {"sensor": INDEX, "points": Column((3,), np.float32, ragged=True)})
_PLAN = Table("plan", {"T_plan_root": Column((4, 4))})
_WALKS = Table("walks", {
    "sensor": INDEX, "positions": Column((2,), ragged=True), "times": Column(ragged=True),
})  # fmt: skip

_RANGES = Table("ranges", {
    "sensor": INDEX, "times": Column(ragged=True), "points": Column((2,), ragged=True),
    "residuals": Column(ragged=True),
})  # fmt: skip
_DRIVEN = Table("drive", {
    "sensor": INDEX, "part": INDEX, "times": Column(ragged=True), "points": Column((3,), np.float32, ragged=True),
    "normals": Column((3,), np.float32, ragged=True), "residuals": Column(ragged=True),
    "shared": Column(dtype=np.bool_, ragged=True),
})  # fmt: skip
_PATHS = Table("paths", {"times": Column(ragged=True), "T_world_root": Column((4, 4), ragged=True)})
_STARTS = Table("starts", {"sensor": INDEX, "T_root_sensor": Column((4, 4)), "clock_offset": NUMBER})


def save_scene(pictures: Pictures, path: Path) -> None:
    """Writes the pictures of a calibration in one step.

    Raises:
        InputError: ``path`` cannot be written.
    """
    names = _sensors_with_pictures(pictures)
    views = [
        {
            **vars(view),
            "seen": view.measured,
            "off": _nan_residuals(view) if view.residuals is None else view.residuals,
        }
        for view in pictures.board_views
    ]
    walks = [
        {"sensor": view.sensor, "positions": positions, "times": times}
        for view in pictures.floor_views
        for positions, times in zip(view.tracks, view.times or map(_nan_times, view.tracks), strict=True)
    ]
    floor_views = [vars(view) for view in pictures.floor_views]
    arrays = (
        _SNAPSHOTS.pack_named(
            [{**vars(s), "image": np.frombuffer(s.image, dtype=np.uint8)} for s in pictures.snapshots], names
        )
        | _OUTLINES.pack([
            {**vars(outline), "board": _NO_BOARD if outline.board is None else outline.board}
            for outline in pictures.board_outlines
        ])
        | _CORNERS.pack_named([view for view in views if view["seen"].shape[1] == 2], names)
        | _BEAMS.pack_named([view for view in views if view["seen"].shape[1] == 3], names)
        | _FLOOR.pack_named(floor_views, names)
        | _WALKS.pack_named(walks, names)
    )  # fmt: skip
    if floor_views:
        arrays |= _STATIC.pack_named(floor_views, names) | _PLAN.pack([{"T_plan_root": pictures.T_plan_root}])
    arrays |= _RANGES.pack_named(list(map(vars, pictures.beam_views)), names)
    if pictures.drive_paths:
        arrays |= _DRIVEN.pack_named(list(map(vars, pictures.drive_views)), names)
        arrays |= _PATHS.pack(list(map(vars, pictures.drive_paths)))
        arrays |= _STARTS.pack_named(list(map(vars, pictures.drive_starts)), names)
    # Pictures are compressed already, and measured points hardly can be.
    content = {"format": FORMAT, "sensors": names}
    write_archive(path, _STRUCTURE, content, arrays, compression=zipfile.ZIP_STORED)


def load_scene(path: Path, limits: LimitSettings = LimitSettings()) -> Pictures:
    """The pictures that :func:`save_scene` wrote.

    Raises:
        InputError: the file is missing, is something else, or is damaged; the message names it.
    """
    content, arrays = read_archive(path, _STRUCTURE, FORMAT, limits.max_archive_bytes)
    try:
        names = _names(content)
        snapshots = tuple(
            Snapshot(**row | {"image": row["image"].tobytes()}) for row in _SNAPSHOTS.unpack_named(arrays, names)
        )
        outlines = tuple(
            BoardOutline(**row | {"board": None if row["board"] == _NO_BOARD else row["board"]})
            for row in _OUTLINES.unpack(arrays)
        )
        views = _board_views(arrays, names)
        floor, T_plan_root = _floor(arrays, names)
        beams = _beam_views(arrays, names)
        drive = _drive(arrays, names)
    except InputError as error:
        raise InputError(f"{path}: {error}") from error
    return Pictures(snapshots, outlines, views, floor, beams, *drive, T_plan_root)


def _sensors_with_pictures(pictures: Pictures) -> list[str]:
    """The sensors that have pictures, in order."""
    of_sensors = (getattr(pictures, kind) for kind in KINDS_OF_SENSORS)
    return list(dict.fromkeys(one.sensor for one in chain.from_iterable(of_sensors)))


def _nan_residuals(view: BoardView) -> Array:
    """In place of the residuals of a view that was not used."""
    return np.full(view.measured.shape if view.measured.shape[1] == 2 else len(view.measured), np.nan)


def _nan_times(positions: Array) -> Array:
    return np.full(len(positions), np.nan)


def _names(content: Mapping[str, Any]) -> list[str]:
    names = content.get("sensors")
    if not isinstance(names, list) or not all(isinstance(name, str) for name in names):
        raise InputError(f"sensors: must be a list of names, got {names!r}")
    return names


def _board_views(arrays: Arrays, names: Sequence[str]) -> tuple[BoardView, ...]:
    views = []
    for table in (_CORNERS, _BEAMS):
        for row in table.unpack_named(arrays, names):
            if len(row["off"]) != len(row["seen"]):
                raise InputError(f"{table.name}/off: each view must have as many as {table.name}/seen")
            unknown = len(row["off"]) > 0 and np.isnan(row["off"]).all()
            residuals = None if unknown else row["off"]
            views.append(BoardView(row["capture"], row["sensor"], row["used"], row["seen"], residuals))
    return tuple(sorted(views, key=lambda view: (view.capture, view.sensor)))


def _floor(arrays: Arrays, names: Sequence[str]) -> tuple[tuple[FloorView, ...], Array]:
    """With ``T_plan_root``; identity in a file from before 3-D LiDARs in networks."""
    static: dict[str, dict[str, Any]] = {}
    T_plan_root = np.eye(4)
    if f"{_PLAN.name}/T_plan_root" in arrays:
        static = {row["sensor"]: {"points": row["points"]} for row in _STATIC.unpack_named(arrays, names)}
        if len(plans := _PLAN.unpack(arrays)) != 1:
            raise InputError(f"plan/T_plan_root: must be one pose, got {len(plans)}")
        T_plan_root = plans[0]["T_plan_root"]
    walks: dict[str, list[dict[str, Any]]] = {name: [] for name in names}
    for walk in _WALKS.unpack_named(arrays, names):
        if len(walk["times"]) != len(walk["positions"]):
            raise InputError("walks/times: each walk must have as many as positions")
        walks[walk["sensor"]].append(walk)
    views = tuple(
        FloorView(
            **row,
            **static.get(row["sensor"], {}),
            tracks=tuple(walk["positions"] for walk in walks[row["sensor"]]),
            times=tuple(walk["times"] for walk in walks[row["sensor"]]),
        )
        for row in _FLOOR.unpack_named(arrays, names)
    )
    return views, T_plan_root


def _beam_views(arrays: Arrays, names: Sequence[str]) -> tuple[BeamView, ...]:
    """None in a file from before residuals of networks were kept."""
    if f"{_RANGES.name}/sensor" not in arrays:
        return ()
    views = tuple(BeamView(**row) for row in _RANGES.unpack_named(arrays, names))
    for view in views:
        if not len(view.times) == len(view.points) == len(view.residuals):
            raise InputError("ranges/residuals: each scanner must have as many as times and points")
    return views


def _drive(
    arrays: Arrays, names: Sequence[str]
) -> tuple[tuple[DriveView, ...], tuple[DrivePath, ...], tuple[DriveStart, ...]]:
    """None in the file of a rig or a network."""
    if f"{_PATHS.name}/times" not in arrays:
        return (), (), ()
    paths = tuple(DrivePath(**row) for row in _PATHS.unpack(arrays))
    views = tuple(DriveView(**row) for row in _DRIVEN.unpack_named(arrays, names))
    for path in paths:
        if len(path.times) != len(path.T_world_root):
            raise InputError("paths/T_world_root: each path must have as many as times")
    for view in views:
        if len({len(view.times), len(view.points), len(view.normals), len(view.residuals), len(view.shared)}) > 1:
            raise InputError("drive/points: each sensor must have as many as times, normals, residuals and shared")
        if not 0 <= view.part < len(paths):
            raise InputError(f"drive/part: must be an index of the {len(paths)} paths, got {view.part}")
    return views, paths, tuple(DriveStart(**row) for row in _STARTS.unpack_named(arrays, names))
