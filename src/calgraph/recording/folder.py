"""Plain folders: ``<sensor>/<seconds>.<png|jpg|pcd|ply|npz|csv>`` beside an optional ``camera_info.yaml``."""

import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any
from zipfile import is_zipfile

import numpy as np
from numpy.typing import NDArray
from ruamel.yaml import YAML

from calgraph.errors import InputError
from calgraph.geometry import Array
from calgraph.recording.camera_info import camera_from_yaml
from calgraph.recording.decoding import mask_out_of_range
from calgraph.recording.digest import hash_file
from calgraph.recording.images import decode_image
from calgraph.recording.limits import check_unpacked_size
from calgraph.recording.pcd import read_pcd
from calgraph.recording.ply import read_ply
from calgraph.recording.point_cloud_columns import cloud_from_columns
from calgraph.recording.record_list import IndexedRecording
from calgraph.recording.recording import check_fetched, wrap_errors
from calgraph.sensors import CameraInfo, Image, LaserScan, Message, MessageDigest, PointCloud, RecordedMessage

CAMERA_INFO = "camera_info.yaml"
_SCAN_COLUMNS = ("stamp", "angle_min", "angle_increment", "time_increment", "ranges")
# Tolerance between the stamp in a scan and that in its file's name, which may be rounded, s.
_STAMP_TOLERANCE = 1e-3


@dataclass(frozen=True)
class _File:
    stamp: float
    topic: str
    path: Path


class FolderRecording(IndexedRecording):
    """A folder with one folder of files per sensor; its topics are the names of those folders.

    A file's name is its stamp and its arrival. A ``camera_info.yaml`` is one message on the topic
    ``<sensor>/camera_info`` that arrives with the sensor's first file.
    """

    def __init__(self, path: Path) -> None:
        files = [file for folder in sorted(path.iterdir()) if folder.is_dir() for file in _files(folder)]
        if not files:
            raise InputError(
                f"{path}: is no recording: it has neither bag files nor folders with files named "
                f"<seconds>.<{'|'.join(suffix[1:] for suffix in _READERS)}>"
            )
        first = {file.topic: file for file in sorted(files, key=lambda file: file.stamp, reverse=True)}
        types = {topic: _kind(file.path) for topic, file in first.items()}
        super().__init__(
            path,
            [RecordedMessage(f.topic, f.stamp, f.stamp, partial(_decode, f), partial(_digest, f)) for f in files],
            types,
        )


def parse_stamp(name: str) -> float | None:
    """The stamp in a file's name without suffix: seconds, or nanoseconds if it has 19 digits; else None."""
    if re.fullmatch(r"\d{19}", name):
        return int(name) / 1e9
    return float(name) if re.fullmatch(r"\d+(\.\d+)?", name) else None


def _files(folder: Path) -> list[_File]:
    files = []
    for path in folder.iterdir():
        suffix = _suffix(path)
        if suffix is None or path.name.startswith("."):
            continue
        stamp = parse_stamp(path.name[: -len(suffix)])
        if stamp is None:
            raise InputError(f"{path}: is not named by its time: <seconds>{suffix} or 19 digits of nanoseconds")
        files.append(_File(stamp, folder.name, path))
    info = folder / CAMERA_INFO
    if files and info.is_file():
        files.append(_File(min(file.stamp for file in files), f"{folder.name}/camera_info", info))
    return files


def _suffix(path: Path) -> str | None:
    name = path.name.lower()
    return next((suffix for suffix in _READERS if name.endswith(suffix)), None)


def _kind(path: Path) -> str:
    """The kind of content of a file, from its name; of an NPZ from its table of contents."""
    if path.name == CAMERA_INFO:
        return "camera_info"
    suffix = _suffix(path)
    if suffix == ".npz":
        check_fetched(path)
        with wrap_errors(path), _open_npz(path) as arrays:
            return "scan" if "ranges" in arrays else "cloud"
    return {".csv": "scan", ".pcd": "cloud", ".pcd.gz": "cloud", ".ply": "cloud"}.get(suffix or "", "image")


def _decode(file: _File) -> Message:
    with wrap_errors(f"{file.path}: topic {file.topic}, stamp {file.stamp:.6f}"):
        check_fetched(file.path)
        if file.path.name == CAMERA_INFO:
            return _camera_info(file.path, file.stamp)
        return _READERS[_suffix(file.path) or ""](file.path, file.stamp)


def _digest(file: _File) -> MessageDigest:
    return MessageDigest("", hash_file(file.path))


def _camera_info(path: Path, stamp: float) -> CameraInfo:
    content = YAML(typ="safe").load(path.read_text(encoding="utf-8"))
    if not isinstance(content, dict):
        raise ValueError("must hold the keys of a CameraInfo")
    return CameraInfo(stamp, "", camera_from_yaml(content))


def _image(path: Path, stamp: float) -> Image:
    return Image(stamp, "", decode_image(np.fromfile(path, np.uint8)))


def _pcd(path: Path, stamp: float) -> PointCloud:
    return cloud_from_columns(read_pcd(path), stamp)


def _ply(path: Path, stamp: float) -> PointCloud:
    return cloud_from_columns(read_ply(path), stamp)


def _open_npz(path: Path) -> Any:
    """NumPy's reader of the members of an NPZ; other files it would take for pickles."""
    if not is_zipfile(path):
        raise ValueError("is damaged or no NPZ file")
    return np.load(path, allow_pickle=False)


def _npz(path: Path, stamp: float) -> Message:
    with _open_npz(path) as file:
        check_unpacked_size(sum(member.file_size for member in file.zip.infolist()))
        arrays = {name: file[name] for name in file.files}
    if "ranges" in arrays:
        return _scan(arrays, stamp)
    if "points" not in arrays:
        raise ValueError(f"an NPZ has either points or ranges, this one has {', '.join(arrays) or 'nothing'}")
    points = arrays.pop("points")
    if points.ndim != 2 or points.shape[1] != 3:
        raise ValueError(f"points must have the shape (N, 3), got {points.shape}")
    columns = {name: values.ravel() for name, values in arrays.items() if values.size == len(points)}
    return cloud_from_columns({**columns, **dict(zip("xyz", points.T, strict=True))}, stamp)


def _csv(path: Path, stamp: float) -> LaserScan:
    lines = [line for line in path.read_text(encoding="utf-8").splitlines() if line.strip()]
    names = [name.strip() for name in lines[0].split(",")] if lines else []
    if tuple(names[:5]) != _SCAN_COLUMNS:
        raise ValueError(f"the first line must be {','.join(_SCAN_COLUMNS)}")
    if len(lines) != 2:
        raise ValueError(f"must have one line of values after the names, got {len(lines) - 1}")
    values = np.array([float(cell) if cell.strip() else np.nan for cell in lines[1].split(",")])
    if len(values) < 5:
        raise ValueError(f"must have at least one range, got {len(values)} values")
    return _scan({**dict(zip(_SCAN_COLUMNS[:4], values, strict=False)), "ranges": values[4:]}, stamp)


def _scan(values: Mapping[str, NDArray[Any]], stamp: float) -> LaserScan:
    missing = [name for name in ("angle_min", "angle_increment") if name not in values]
    if missing:
        raise ValueError(f"a scan needs {', '.join(_SCAN_COLUMNS)}; {' and '.join(missing)} is missing")
    given_stamp = _number(values, "stamp", stamp)
    if abs(given_stamp - stamp) > _STAMP_TOLERANCE:
        raise ValueError(f"its stamp {given_stamp:.6f} is not that of its name")
    ranges: Array = np.asarray(values["ranges"], dtype=np.float64).ravel()
    angles = _number(values, "angle_min") + _number(values, "angle_increment") * np.arange(
        len(ranges), dtype=np.float64
    )
    increment = _number(values, "time_increment", 0.0)
    return LaserScan(stamp, "", angles, mask_out_of_range(ranges, 0.0, np.inf), increment)


def _number(values: Mapping[str, NDArray[Any]], name: str, default: float = np.nan) -> float:
    given = np.asarray(values.get(name, default))
    if given.size != 1 or given.dtype.kind not in "fiu":
        raise ValueError(f"{name} must be one number, got {given.dtype} of shape {given.shape}")
    number = float(given.item())
    if not np.isfinite(number):
        raise ValueError(f"{name} must be a finite number, got {number}")
    return number


_READERS: dict[str, Callable[[Path, float], Message]] = {
    ".png": _image,
    ".jpg": _image,
    ".jpeg": _image,
    ".pcd": _pcd,
    ".pcd.gz": _pcd,
    ".ply": _ply,
    ".npz": _npz,
    ".csv": _csv,
}
