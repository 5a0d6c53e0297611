"""Plain folders: ``<sensor>/<time or number>.<png|jpg|pcd|ply|npz|csv|...>`` beside a ``camera_info.yaml``."""

import warnings
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, TypeVar
from zipfile import is_zipfile

import numpy as np
from numpy.typing import NDArray

from calgraph.config.settings import LimitSettings
from calgraph.errors import InputError, RecordingError
from calgraph.geometry import Array
from calgraph.io.image_headers import read_image_size
from calgraph.io.yaml_limits import MAX_RIG_VALUES
from calgraph.io.yaml_reading import read_text, read_yaml
from calgraph.recording.camera_info import camera_from_yaml
from calgraph.recording.content_hash import hash_file
from calgraph.recording.damage import check_fetched, check_point_count, check_unpacked_size, wrap_errors
from calgraph.recording.decoding import mask_out_of_range
from calgraph.recording.file_names import FileStamps, NamedFiles, resolve_stamps, split_by_sensor
from calgraph.recording.images import decode_image, decode_png_depths
from calgraph.recording.pcd import read_pcd, read_ply
from calgraph.recording.point_cloud_columns import cloud_from_columns, is_point_table, parse_points
from calgraph.recording.record_list import IndexedRecording
from calgraph.sensors import CameraInfo, Image, LaserScan, Message, MessageDigest, PointCloud, RecordedMessage

CAMERA_INFO = ("camera_info.yaml", "camera_info.yml", "intrinsics.yaml", "intrinsics.yml")
"""Names of files with intrinsics, the preferred first."""
Content = TypeVar("Content")
_SCAN_COLUMNS = ("stamp", "angle_min", "angle_increment", "time_increment", "ranges")
# Tolerance between the stamp in a scan and that in its file's name, which may be rounded, s.
_STAMP_TOLERANCE = 1e-3
# Of the first line of a CSV, bytes: that of a scan has some 60, that of points as many as they have values.
_MAX_HEAD = 1000


@dataclass(frozen=True)
class _File:
    stamp: float
    topic: str
    path: Path
    limits: LimitSettings
    counted: bool = False
    """Whether its name is the number of a pose, and the stamp is not a time."""


@dataclass(frozen=True)
class _Folder:
    """The files of one sensor."""

    topic: str
    info: Path | None
    paths: Mapping[str, Path]
    """By name without suffix."""
    names: NamedFiles


class FolderRecording(IndexedRecording):
    """A folder with one folder of files per sensor, whose name is the topic; or a folder with the sensors' files.

    Of several sensors in one folder the topics are the texts in the names of their files (``left_1``,
    ``right_1``), or the kinds of their content (``image`` and ``cloud``).

    The stamp and arrival of a file follow from its name, see :mod:`calgraph.recording.file_names`. A
    ``camera_info.yaml`` is one message on the topic ``<sensor>/camera_info`` that arrives with the sensor's first
    file. Folders whose names have no clear meaning are no topics: they need not be of the rig.
    """

    def __init__(self, path: Path, limits: LimitSettings) -> None:
        folders, self._unusable = _find_folders(path)
        if not folders:
            raise InputError(
                next(iter(self._unusable.values()), "")
                or f"{path}: is no recording: it has neither bag files nor folders with files named "
                f"<seconds>.<{'|'.join(suffix[1:] for suffix in _READERS)}>, or by the number of the pose"
            )
        stamps = resolve_stamps(folder.names for folder in folders)
        self._counted = {folder.topic: stamped.counted for folder, stamped in zip(folders, stamps, strict=True)}
        files = [file for pair in zip(folders, stamps, strict=True) for file in _list_files(*pair, limits)]
        first = {file.topic: file for file in sorted(files, key=lambda file: file.stamp, reverse=True)}
        types = {topic: _kind(file.path) for topic, file in first.items()}
        super().__init__(
            path,
            [RecordedMessage(f.topic, f.stamp, f.stamp, partial(_decode, f), partial(_digest, f)) for f in files],
            types,
            time_bases={file.topic: "pose" for file in files if file.counted},
            sources=(path,),
        )
        self.divisible = True

    def records(
        self, topics: Collection[str] | None = None, start: float | None = None, end: float | None = None
    ) -> Iterator[RecordedMessage]:
        """The records in order of arrival; see :meth:`Recording.records`.

        Raises:
            InputError: a topic is not in the recording, its names have no clear meaning, or only those of another
                topic are times.
        """
        for topic in topics or ():
            if topic in self._unusable:
                raise InputError(self._unusable[topic])
        topic_by_kind = {self._counted[topic]: topic for topic in topics or () if topic in self._counted}
        if len(topic_by_kind) == 2:
            timed, counted = topic_by_kind[False], topic_by_kind[True]
            raise InputError(
                f"{self.path}: files in {timed} are named by time, those in {counted} by number: name both by "
                "time, or both by the number of the pose"
            )
        return super().records(topics, start, end)


def _find_folders(path: Path) -> tuple[list[_Folder], dict[str, str]]:
    """The files of each sensor, and by the names of others with such files why they cannot be used."""
    found: list[_Folder] = []
    unusable: dict[str, str] = {}
    inner = {folder: _list_readable(folder) for folder in sorted(path.iterdir()) if folder.is_dir()}
    by_folder = inner if any(inner.values()) else {path: _list_readable(path)}
    for folder, files in by_folder.items():
        name = folder.resolve().name
        sensors, failed = _split_sensors(files)
        if len(sensors) > 1:
            inside = "" if folder == path else f"{name}/"
            images = [label for label, (paths, _) in sensors.items() if _kind(min(paths.values())) == "image"]
            found += [
                _Folder(f"{inside}{label}", _find_info(folder, label, alone=images == [label]), *content)
                for label, content in sensors.items()
            ]
            unusable |= {f"{inside}{label}": reason for label, reason in failed.items()}
        elif sensors:
            found += [_Folder(name, _find_info(folder, "", alone=True), *one) for one in sensors.values()]
        elif failed:
            unusable[name] = next(iter(failed.values()))
    return found, unusable


def _find_info(folder: Path, label: str, *, alone: bool) -> Path | None:
    """The intrinsics of the images with a label in a folder, or of the only images."""
    names = [*(f"{label}_{name}" for name in CAMERA_INFO), *(CAMERA_INFO if alone else ())]
    return next((folder / name for name in names if (folder / name).is_file()), None)


def _split_sensors(files: Sequence[Path]) -> tuple[dict[str, tuple[dict[str, Path], NamedFiles]], dict[str, str]]:
    """The files of each sensor by name, and what the names state; and why other files cannot be used.

    Both by the text that distinguishes sensors in one folder, or the kind of their content.
    """
    found: dict[tuple[str, str], tuple[dict[str, Path], NamedFiles]] = {}
    failed: dict[str, str] = {}
    first = {suffix: path for path in reversed(files) if (suffix := _suffix(path))}
    kinds = {suffix: _kind(path) for suffix, path in first.items()}
    for kind in dict.fromkeys(kinds.values()):
        of_kind = [path for path in files if kinds[_suffix(path) or ""] == kind]
        paths = {path.name[: -len(_suffix(path) or "")]: path for path in of_kind}
        try:
            if len(paths) < len(of_kind):
                twice = next(path for path in of_kind if path not in paths.values())
                other = paths[twice.name[: -len(_suffix(twice) or "")]]
                raise ValueError(f"{twice.name} and {other.name} have the same name")
            for text, names in split_by_sensor(paths).items():
                found[text, kind] = {name: paths[name] for name in names.values}, names
        except ValueError as error:
            failed[kind] = _explain_names(min(of_kind), error)
    texts = [text for text, _ in found]
    return {
        (text or kind) if texts.count(text) == 1 or not text else f"{text}_{kind}": content
        for (text, kind), content in found.items()
    }, failed


def _explain_names(example: Path, error: ValueError) -> str:
    suffix = _suffix(example)
    return (
        f"{example}: neither the time of the file nor the number of its pose is clear from its name, as {error}; "
        f"name the files of each sensor <seconds>{suffix}, by 19 digits of nanoseconds, or by the number of the "
        f"pose (pose12{suffix})"
    )


def _list_readable(folder: Path) -> list[Path]:
    """The files of messages in a folder; texts only where there are no others, as they may be notes or labels."""
    # A link that leads nowhere is the file of a message, too, which is to be named when it is read.
    files = [
        path
        for path in sorted(folder.iterdir())
        if _suffix(path)
        and not path.name.startswith(".")
        and (path.is_file() or (path.is_symlink() and not path.exists()))
    ]
    return [path for path in files if _suffix(path) != _TEXT] or files


def _list_files(folder: _Folder, stamped: FileStamps, limits: LimitSettings) -> Iterator[_File]:
    for name, path in folder.paths.items():
        yield _File(stamped.stamps[name], folder.topic, path, limits, stamped.counted)
    if folder.info:
        yield _File(
            min(stamped.stamps.values()), f"{folder.topic}/camera_info", folder.info, limits, stamped.counted
        )


def _suffix(path: Path) -> str | None:
    name = path.name.lower()
    return next((suffix for suffix in _READERS if name.endswith(suffix)), None)


def _kind(path: Path) -> str:
    """The kind of content of a file, from its name; of an NPZ or CSV from its table of contents."""
    suffix = _suffix(path) or ""
    if not suffix:
        return "camera_info"
    if suffix == ".npz":
        check_fetched(path)
        with wrap_errors(path), _open_npz(path) as arrays:
            return "scan" if "ranges" in arrays else "cloud"
    if suffix == ".csv":
        check_fetched(path)
        with path.open("rb") as file:
            return "cloud" if is_point_table(file.readline(_MAX_HEAD).decode(errors="replace")) else "scan"
    return "image" if _READERS[suffix] is _image else "cloud"


def _decode(file: _File) -> Message:
    where = f"{file.path}: topic {file.topic}, stamp {file.stamp:.6f}"
    with wrap_errors(where), np.errstate(all="ignore"):
        check_fetched(file.path)
        if _suffix(file.path) is None:
            return _camera_info(file)
        return _READERS[_suffix(file.path) or ""](file)


def _digest(file: _File) -> MessageDigest:
    with wrap_errors(file.path):
        return MessageDigest("", hash_file(file.path))


def _camera_info(file: _File) -> CameraInfo:
    content = _wrap_input_errors(read_yaml, file.path, MAX_RIG_VALUES)
    return CameraInfo(file.stamp, "", camera_from_yaml(content, _find_image_size(file.path.parent)))


def _find_image_size(folder: Path) -> tuple[int, int] | None:
    """Width and height of the first image in a folder; None without a usable one."""
    image = next((path for path in sorted(folder.iterdir()) if _READERS.get(_suffix(path) or "") is _image), None)
    with suppress(ValueError, OSError):
        return read_image_size(image.read_bytes()) if image else None
    return None


def _wrap_input_errors(read: Callable[..., Content], *arguments: Any) -> Content:
    """What a reader of text files returns; its errors become those of one message of the recording."""
    try:
        return read(*arguments)
    except InputError as error:
        raise RecordingError(str(error)) from error


def _image(file: _File) -> Image:
    data = np.fromfile(file.path, np.uint8)
    depths = decode_png_depths(data, file.limits) if "depth" in file.topic.lower() else None
    return Image(file.stamp, "", decode_image(data, limits=file.limits), depths)


def _cloud(read: Callable[[Path, LimitSettings], Mapping[str, Array]], file: _File) -> PointCloud:
    return cloud_from_columns(read(file.path, file.limits), file.stamp)


@contextmanager
def _open_npz(path: Path) -> Iterator[Any]:
    """NumPy's reader of the members of an NPZ; other files it would take for pickles."""
    # NumPy itself leaves a file open whose table of contents is damaged.
    with path.open("rb") as file:
        if not is_zipfile(file):
            raise ValueError("is damaged or no NPZ file")
        file.seek(0)
        with np.load(file, allow_pickle=False) as arrays:
            yield arrays


def _npz(file: _File) -> Message:
    with _open_npz(file.path) as npz:
        check_unpacked_size(sum(member.file_size for member in npz.zip.infolist()), file.limits)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", UserWarning)  # of headers that Python 2 wrote
            arrays = {name: npz[name] for name in npz.files}
    for name, values in arrays.items():
        if values.dtype.kind not in "biuf":
            raise ValueError(f"{name} must be numbers, got {values.dtype.name:.40}")
    if "ranges" in arrays:
        return _scan(arrays, file)
    if "points" not in arrays:
        raise ValueError(f"an NPZ has either points or ranges, this one has {', '.join(arrays) or 'nothing'}")
    points = arrays.pop("points")
    if points.ndim != 2 or points.shape[1] != 3:
        raise ValueError(f"points must have the shape (N, 3), got {points.shape}")
    check_point_count(len(points), file.limits)
    columns = {name: values.ravel() for name, values in arrays.items() if values.size == len(points)}
    return cloud_from_columns({**columns, **dict(zip("xyz", points.T, strict=True))}, file.stamp)


def _points(file: _File) -> PointCloud:
    columns = parse_points(_wrap_input_errors(read_text, file.path), file.limits)
    return cloud_from_columns(columns, file.stamp)


def _csv(file: _File) -> LaserScan | PointCloud:
    if _kind(file.path) == "cloud":
        return _points(file)
    text = _wrap_input_errors(read_text, file.path)
    check_point_count(text.count(","), file.limits)
    lines = [line for line in text.splitlines() if line.strip()]
    names = [name.strip() for name in lines[0].split(",")] if lines else []
    if tuple(names[:5]) != _SCAN_COLUMNS:
        raise ValueError(f"the first line must be {','.join(_SCAN_COLUMNS)}")
    if len(lines) != 2:
        raise ValueError(f"must have one line of values after the names, got {len(lines) - 1}")
    values = np.array([float(cell) if cell.strip() else np.nan for cell in lines[1].split(",")])
    if len(values) < 5:
        raise ValueError(f"must have at least one range, got {len(values)} values")
    return _scan({**dict(zip(_SCAN_COLUMNS[:4], values, strict=False)), "ranges": values[4:]}, file)


def _scan(values: Mapping[str, NDArray[Any]], file: _File) -> LaserScan:
    missing = [name for name in ("angle_min", "angle_increment") if name not in values]
    if missing:
        raise ValueError(f"a scan needs {', '.join(_SCAN_COLUMNS)}; {' and '.join(missing)} is missing")
    given_stamp = _number(values, "stamp", file.stamp)
    if not file.counted and abs(given_stamp - file.stamp) > _STAMP_TOLERANCE:
        raise ValueError(f"its stamp {given_stamp:.6f} is not that of its name")
    check_point_count(np.size(values["ranges"]), file.limits)
    ranges: Array = np.asarray(values["ranges"], dtype=np.float64).ravel()
    angles = _number(values, "angle_min") + _number(values, "angle_increment") * np.arange(
        len(ranges), dtype=np.float64
    )
    increment = _number(values, "time_increment", 0.0)
    return LaserScan(file.stamp, "", angles, mask_out_of_range(ranges, 0.0, np.inf), increment)


def _number(values: Mapping[str, NDArray[Any]], name: str, default: float = np.nan) -> float:
    given = np.asarray(values.get(name, default))
    if given.size != 1 or given.dtype.kind not in "fiu":
        raise ValueError(f"{name} must be one number, got {given.dtype} of shape {given.shape}")
    number = float(given.item())
    if not np.isfinite(number):
        raise ValueError(f"{name} must be a finite number, got {number}")
    return number


_TEXT = ".txt"
_READERS: dict[str, Callable[[_File], Message]] = {
    **dict.fromkeys((".png", ".jpg", ".jpeg", ".bmp", ".tif", ".tiff", ".webp"), _image),
    ".pcd": partial(_cloud, read_pcd),
    ".pcd.gz": partial(_cloud, read_pcd),
    ".ply": partial(_cloud, read_ply),
    ".npz": _npz,
    ".csv": _csv,
    **dict.fromkeys((".xyz", ".pts", ".asc", _TEXT), _points),
}
