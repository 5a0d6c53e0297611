"""Fields of view and arrangements of a rig's sensors before it is recorded: as stated, or usual ones."""

from collections.abc import Mapping
from dataclasses import dataclass
from itertools import islice

import numpy as np
from numpy.typing import NDArray

from calgraph.boards.detections import to_beams
from calgraph.config import CameraSpec, Intrinsics, Rig, SensorSpec
from calgraph.geometry import Array, se3
from calgraph.recording import Recording, convert_images, resolve_intrinsics
from calgraph.recording.sensor_topics import check_sensor_topics
from calgraph.result import ExtrinsicsFile, state_intrinsics
from calgraph.rig.checks.next_best_pose import axes_of
from calgraph.sensors import CameraModel, Image, LaserScan, Message, PointCloud
from calgraph.sensors.beam_pattern import BeamPattern, laser_pattern, multibeam_pattern
from calgraph.sensors.kinds import KINDS
from calgraph.sensors.kinds.depth_camera import convert_depth_image

FieldOfView = CameraModel | BeamPattern

_LENS_FIELD = 70.0
"""Usual horizontal field of view of a lens, degrees: webcams and industrial cameras have 50 to 90."""
_SCAN_FIELD, _SCAN_STEP = 270.0, 0.5
"""Usual field of view and angle between beams of a 2-D scanner, degrees, as of SICK LMS1xx at 50 Hz."""
_RINGS, _HIGHEST_RING, _COLUMN_STEP = 16, 15.0, 0.2
"""Usual 3-D LiDAR: rings, elevation of the outer ones and angle between columns, degrees, as of a VLP-16."""
_IMAGE_SIZES = {"camera": (1280, 960), "depth_camera": (640, 480)}
"""Usual sizes of images by kind, pixels."""
_SPACING = 0.3
"""Distance of neighbouring sensors whose poses are not given, m: robots are 0.3 to 1 m wide."""


@dataclass(frozen=True, eq=False)
class PlannedRig:
    """What is known of a rig before it is recorded."""

    rig: Rig
    """With the priors of intrinsics that are to be estimated."""
    fields: Mapping[str, FieldOfView]
    """By sensor."""
    T_root_sensor: Mapping[str, Array]
    """(4, 4) by sensor, the root first."""
    assumptions: tuple[str, ...] = ()
    """In words, what is assumed instead of stated."""


def describe_rig(rig: Rig, poses: ExtrinsicsFile | None = None, recording: Recording | None = None) -> PlannedRig:
    """The rig with fields of view and poses: those that files state, and usual ones.

    Args:
        rig: sensors and board.
        poses: of all sensors; side by side if left out.
        recording: of the sensors, with any content: the beams of their first messages, and intrinsics.

    Raises:
        InputError: the file of poses lacks a sensor, or the recording does not fit the rig.
    """
    messages: dict[str, Message] = {}
    if recording is not None:
        check_sensor_topics(rig, recording)
        rig, recording = convert_images(resolve_intrinsics(rig, recording), recording)
        recorded = {topic.name for topic in recording.topics}
        for name, topic in rig.topics.items():
            if KINDS[rig.sensors[name].kind].measures_ranges and topic in recorded:
                for record in islice(recording.records([topic]), 1):
                    messages[name] = record.decode()
    fields: dict[str, FieldOfView] = {}
    assumptions, sensors = [], dict(rig.sensors)
    for name, spec in rig.sensors.items():
        if isinstance(message := messages.get(name), LaserScan | PointCloud):
            fields[name] = _pattern_of_message(message)
            continue
        field, assumed = _assume_field(spec)
        fields[name] = field
        assumptions += [f"{name}: {assumed}"] if assumed else []
        if isinstance(spec, CameraSpec) and isinstance(spec.intrinsics, str):
            assert isinstance(field, CameraModel)
            sensors[name] = state_intrinsics(spec, Intrinsics.from_camera(field))
    names = [rig.root, *(name for name in rig.sensors if name != rig.root)]
    if poses is None:
        T_root_sensor = _place_side_by_side(rig, names)
        assumptions.append(f"poses: sensors side by side, {_SPACING} m apart, all facing ahead")
    else:
        frame_ids = {name: spec.frame_id or name for name, spec in rig.sensors.items()}
        root, *_ = frames = [poses.frame_of_sensor(name, frame_ids) for name in names]
        T_root_sensor = {name: poses.transform(root, frame) for name, frame in zip(names, frames, strict=True)}
    return PlannedRig(rig.model_copy(update={"sensors": sensors}), fields, T_root_sensor, tuple(assumptions))


def _place_side_by_side(rig: Rig, names: list[str]) -> dict[str, Array]:
    """``T_root_sensor`` (4, 4) by sensor, in the order of the names, from left to right in that of rig.yaml."""
    T_body_sensor = {
        name: se3.pose(axes_of(spec.kind), np.array([0.0, -_SPACING * i, 0.0]))
        for i, (name, spec) in enumerate(rig.sensors.items())
    }
    return {name: se3.inverse(T_body_sensor[rig.root]) @ T_body_sensor[name] for name in names}


def _assume_field(spec: SensorSpec) -> tuple[FieldOfView, str]:
    """The stated field of view of a sensor, or the usual one of its kind, and the latter in words."""
    if spec.kind == "lidar2d":
        text = f"{_SCAN_FIELD:g}° with a beam every {_SCAN_STEP:g}°"
        return laser_pattern(np.radians(_SCAN_FIELD), np.radians(_SCAN_STEP), 0.0), text
    if spec.kind == "lidar3d":
        elevations = np.radians(np.linspace(-_HIGHEST_RING, _HIGHEST_RING, _RINGS))
        text = f"{_RINGS} rings up to ±{_HIGHEST_RING:g}° with a column every {_COLUMN_STEP:g}°"
        return multibeam_pattern(elevations, np.radians(_COLUMN_STEP), 0.0), text
    if stated := spec.stated_intrinsics:
        camera, text = stated.to_camera(), ""
    else:
        width, height = _IMAGE_SIZES[spec.kind]
        f = 0.5 * width / np.tan(np.radians(_LENS_FIELD / 2))
        K = np.array([[f, 0.0, 0.5 * width], [0.0, f, 0.5 * height], [0.0, 0.0, 1.0]])
        camera = CameraModel("pinhole", width, height, K, np.zeros(0))
        text = f"{width} x {height} pixels, {_LENS_FIELD:g}° wide"
    if spec.kind == "camera":
        return camera, text
    depth = Image(
        0.0, "", np.zeros((0, 0), dtype=np.uint8), np.ones((camera.height, camera.width), dtype=np.float32)
    )
    return _pattern_of_message(convert_depth_image(depth, camera)), text


def _pattern_of_message(message: LaserScan | PointCloud) -> BeamPattern:
    """The beams that a message measured; those of a cloud without rings have no neighbours."""
    rings: NDArray[np.int32] | None = None
    if isinstance(message, LaserScan):
        angles, rings = message.angles, np.zeros(len(message.angles), dtype=np.int32)
        directions = np.column_stack([np.cos(angles), np.sin(angles), np.zeros(len(angles))])
    else:
        directions, rings = to_beams(message.points)[1], message.rings
        angles = np.arctan2(directions[:, 1], directions[:, 0])
    neighbours = np.arange(len(angles))
    if rings is not None:
        order = np.lexsort((angles, rings))
        next_in_ring = rings[order[1:]] == rings[order[:-1]]
        neighbours[order[:-1][next_in_ring]] = order[1:][next_in_ring]
    zeros = np.zeros(len(angles))
    return BeamPattern(np.zeros((1, 3)), directions, np.zeros_like(directions), zeros, neighbours, angles, rings)
