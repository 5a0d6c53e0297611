"""Poses given in a file, as priors with covariances, too: a calibration.yaml, a URDF, or transforms of tf."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from calgraph.errors import InputError
from calgraph.geometry import Array, se3, so3
from calgraph.geometry.so3 import from_roll_pitch_yaw
from calgraph.io.yaml_reading import read_documents, read_text
from calgraph.result.calibration import Calibration
from calgraph.result.calibration_reading import UNIT_TOLERANCE, load_calibration
from calgraph.result.exports.urdf_text import frames_from_joints, read_joints
from calgraph.result.frame_tree import MAX_DISTANCE, FrameLink, FrameTree

_SHAPE = "needs the frame's parent (frame_id or parent), child_frame_id, translation and rotation"


@dataclass(frozen=True, eq=False)
class ExtrinsicsFile:
    """The frames in a file, to which sensors are matched by frame_id or by name."""

    path: Path
    tree: FrameTree
    aliases: Mapping[str, str] = field(default_factory=dict)
    """Other names of frames."""
    calibration: Calibration | None = None
    """The file's content, where it is a calibration and has covariances."""

    def frames_of_sensors(self, frame_ids: Mapping[str, str]) -> dict[str, str]:
        """The frames of the sensors that the file contains, matched by frame_id, else by the sensor's name.

        Args:
            frame_ids: by sensor.

        Raises:
            InputError: it contains none of them, or two sensors match one frame.
        """
        frame_by_name = dict(self.aliases) | {frame: frame for frame in self.tree.frames}
        found = {
            name: frame_by_name[alias]
            for name, frame_id in frame_ids.items()
            for alias in [next((a for a in (frame_id.lstrip("/"), name) if a in frame_by_name), None)]
            if alias is not None
        }
        if not found:
            raise InputError(
                f"{self.path}: has none of the sensors' frames {_join_sorted(frame_ids.values())}, "
                f"nor their names {_join_sorted(frame_ids)}; it has {_join_sorted(frame_by_name)}"
            )
        for name, frame in found.items():
            same = [other for other, its in found.items() if its == frame]
            if same[0] != name:
                raise InputError(
                    f"{self.path}: {' and '.join(same)} are both its frame {frame!r}; give them different "
                    "frame_ids in rig.yaml"
                )
        return found

    def frame_of_sensor(self, name: str, frame_ids: Mapping[str, str]) -> str:
        """The frame of one sensor.

        Raises:
            InputError: the file does not contain it.
        """
        found = self.frames_of_sensors(frame_ids)
        if name not in found:
            raise InputError(
                f"{self.path}: has no frame {frame_ids[name]!r}, nor one called {name} as the sensor is; "
                f"it has {_join_sorted({*self.tree.frames, *self.aliases})}"
            )
        return found[name]

    def transform(self, a: str, b: str) -> Array:
        """``T_a_b`` (4, 4) of two frames.

        Raises:
            InputError: nothing connects them, or something movable is between them.
        """
        return self.tree.transform(a, b)

    def covariance(self, a: str, b: str) -> Array:
        """Covariance (6, 6) of ``T_a_b`` in the fixed axes of a; zero where the file has no covariances."""
        if self.calibration is None or not self.calibration.has_correlations:
            return np.zeros((6, 6))
        return self.calibration.covariance(a, b)


def read_extrinsics(path: Path) -> ExtrinsicsFile:
    """Reads poses from a calibration.yaml, a URDF, or a YAML file with transforms of tf.

    The latter is a list of transforms, or a mapping whose key ``transforms`` is one, as messages of
    tf2_msgs/TFMessage are printed; several of them may follow each other. Each transform has ``header.frame_id``
    (or ``frame_id``, ``parent``) and ``child_frame_id`` (or ``child``), and, below ``transform`` or beside them,
    ``translation`` (x, y, z; m) and ``rotation``: a quaternion (x, y, z, w), or ``roll, pitch, yaw``, rad; these
    may also be called ``rpy``.

    Raises:
        InputError: the file is none of these, or its content is invalid; the message names the location.
    """
    if path.is_fifo():
        raise InputError(f"{path}: is a pipe, and its content is read more than once: write it to a file first")
    if path.suffix in (".urdf", ".xml", ".xacro") or read_text(path).lstrip("\ufeff \t\r\n").startswith("<"):
        return _read_urdf(path)
    documents = read_documents(path)
    if len(documents) == 1 and isinstance(documents[0], dict) and "format" in documents[0]:
        return _read_calibration(path)
    return _read_transforms(path, documents)


def _read_calibration(path: Path) -> ExtrinsicsFile:
    found = load_calibration(path)
    links = {s.name: FrameLink(found.root, s.T_root_sensor) for s in found.sensors if s.name != found.root}
    frame_ids = [sensor.frame_id.lstrip("/") for sensor in found.sensors]
    aliases = {f: s.name for f, s in zip(frame_ids, found.sensors, strict=True) if f and frame_ids.count(f) == 1}
    return ExtrinsicsFile(path, FrameTree(str(path), links), aliases, found)


def _read_urdf(path: Path) -> ExtrinsicsFile:
    try:
        tree = frames_from_joints(read_joints(read_text(path)), str(path))
    except InputError as error:
        raise InputError(f"{path}: {error}") from error
    return ExtrinsicsFile(path, tree)


def _read_transforms(path: Path, documents: list[Any]) -> ExtrinsicsFile:
    links: dict[str, FrameLink] = {}
    for where, entry in _list_entries(path, documents):
        child, link = _parse_transform(where, entry)
        before = links.get(child)
        if before and before.parent != link.parent:
            raise InputError(f"{where}: {child!r} has two parents, {before.parent!r} and {link.parent!r}")
        links[child] = link
    if not links:
        raise InputError(f"{path}: has no transforms; {_SHAPE}")
    return ExtrinsicsFile(path, FrameTree(str(path), links))


def _list_entries(path: Path, documents: list[Any]) -> list[tuple[str, Any]]:
    """All transforms, each with its location in the file."""
    entries = []
    for content in documents:
        listed = content.get("transforms") if isinstance(content, dict) else content
        if not isinstance(listed, list):
            raise InputError(
                f"{path}: must be a calibration.yaml (with the key format), a URDF, or a list of transforms, "
                "which may be below the key transforms"
            )
        entries += [(f"{path}: transforms[{i}]", entry) for i, entry in enumerate(listed)]
    return entries


def _parse_transform(where: str, entry: Any) -> tuple[str, FrameLink]:
    """The child frame, and the link to its parent."""
    if not isinstance(entry, dict):
        raise InputError(f"{where}: must be a mapping, it {_SHAPE}")
    flat = entry | _mapping(entry, "header") | _mapping(entry, "transform")
    parent, child = (
        next((flat[key].lstrip("/") for key in keys if isinstance(flat.get(key), str)), "")
        for keys in (("frame_id", "parent_frame_id", "parent"), ("child_frame_id", "child"))
    )
    if not parent or not child or "translation" not in flat:
        raise InputError(f"{where}: {_SHAPE}; it has {_join_sorted(flat)}")
    t = _parse_numbers(f"{where}: translation", flat["translation"], "x y z")
    return child, FrameLink(parent, se3.pose(_parse_rotation(where, flat), t))


def _mapping(entry: dict[Any, Any], key: str) -> dict[Any, Any]:
    part = entry.get(key)
    return part if isinstance(part, dict) else {}


def _parse_rotation(where: str, flat: dict[Any, Any]) -> Array:
    given = flat.get("rpy", flat.get("rotation"))
    if "rpy" in flat or (isinstance(given, dict | list) and len(given) == 3):
        return from_roll_pitch_yaw(*_parse_numbers(f"{where}: rotation", given, "roll pitch yaw"))
    q = _parse_numbers(f"{where}: rotation", given, "x y z w")
    length = float(np.linalg.norm(q))
    if abs(length - 1) > UNIT_TOLERANCE:
        raise InputError(
            f"{where}: rotation: must be a quaternion x, y, z, w of length 1, its length is {length:.4g}"
        )
    return so3.from_quaternion(q)


def _parse_numbers(where: str, given: Any, names: str) -> Array:
    """Numbers that are given in order, or by name."""
    values = [given.get(name) for name in names.split()] if isinstance(given, dict) else given
    good = isinstance(values, list) and len(values) == len(names.split())
    if not good or not all(isinstance(v, int | float) and abs(v) <= MAX_DISTANCE for v in values):
        raise InputError(
            f"{where}: must be the numbers {names.replace(' ', ', ')}, of {MAX_DISTANCE:g} or less, "
            f"got {repr(given)[:60]}"
        )
    return np.array(values, dtype=np.float64)


def _join_sorted(names: Any) -> str:
    return ", ".join(sorted(map(str, names))) or "none"


# Of a prior along and about any axis, m² and rad²: a picometre, and the circumference of the Earth. Others are
# poses that are exact or unknown; their inverses overflow.
_MIN_VARIANCE, _MAX_VARIANCE = 1e-24, 1e15


@dataclass(frozen=True, eq=False)
class PriorFile:
    """A file whose poses are priors of all sensors in it."""

    poses: ExtrinsicsFile
    stddev: tuple[float, float] | None = None
    """Of every coordinate of a position (m) and of every rotation (rad), 0 and 0 for exact poses; None for the
    covariances in the file."""

    def state_pose(self, name: str, root: str, frame: str) -> tuple[Array, Array]:
        """``T_root_sensor`` (4, 4) of a sensor's frame in another, and its covariance (6, 6) in the axes of that.

        Raises:
            InputError: the file does not state one of them.
        """
        if self.stddev is None:
            covariance = self.poses.covariance(root, frame)
        else:
            covariance = np.diag(np.repeat(np.square(self.stddev), 3))
        if not has_inverse(covariance):
            raise InputError(
                f"{self.poses.path}: states no covariance of {name}: give standard deviations in m and "
                "degrees, both above 0, or 0 0 for poses that are exact"
            )
        return self.poses.transform(root, frame), covariance


def has_inverse(covariance: Array) -> bool:
    """Whether a covariance (6, 6), m and rad, weights a prior with finite numbers."""
    if not (np.abs(covariance) <= _MAX_VARIANCE).all():
        return False
    return bool(np.linalg.eigvalsh(covariance)[0] >= _MIN_VARIANCE)
