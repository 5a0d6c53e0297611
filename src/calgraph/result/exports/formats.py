"""The table of export formats."""

from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import Literal

from calgraph.config import Rig
from calgraph.errors import InputError
from calgraph.result.calibration import Calibration
from calgraph.result.exports.camera_info import to_camera_infos
from calgraph.result.exports.corrections import to_corrections
from calgraph.result.exports.frames import apply_stated_poses, keep_good_poses, parent_to_root
from calgraph.result.exports.json_text import to_json
from calgraph.result.exports.kalibr import to_camchain
from calgraph.result.exports.tf import to_launch, to_tf_yaml
from calgraph.result.exports.urdf import to_urdf, update_urdf
from calgraph.sensors import CameraModel

Parents = Literal["root", "tree"]


Writer = Callable[[Calibration, Rig | None, Mapping[str, CameraModel], str | None, Mapping[str, str]], str]


FORMATS: Mapping[str, Writer] = {
    "launch": lambda calibration, *_: to_launch(apply_stated_poses(calibration)),
    "tf": lambda calibration, *_: to_tf_yaml(apply_stated_poses(calibration)),
    "urdf": lambda calibration, _rig, _cameras, urdf, joints: (
        to_urdf(apply_stated_poses(calibration)) if urdf is None else update_urdf(calibration, urdf, joints)
    ),
    "kalibr": lambda calibration, rig, cameras, *_: to_camchain(calibration, rig, cameras),
    "camera_info": lambda calibration, rig, cameras, *_: to_camera_infos(calibration, rig, cameras),
    "corrections": lambda calibration, *_: to_corrections(calibration),
    "json": lambda calibration, *_: to_json(calibration),
}
"""Writers by the name of their format."""


def export(
    calibration: Calibration,
    format: str,
    *,
    rig: Rig | None = None,
    cameras: Mapping[str, CameraModel] | None = None,
    urdf: str | None = None,
    joints: Mapping[str, str] | None = None,
    parents: Parents = "root",
    only: Literal["good"] | None = None,
    distance: float | None = None,
) -> str:
    """The calibration as the text of a file of another program.

    A network does not measure height, roll and pitch of its scanners: they are those of rig.yaml, and 0 where it
    states none; in a URDF that is corrected, they remain as they are.

    Args:
        calibration: what to export.
        format: ``launch`` (ROS 2 launch file in Python with static transform publishers), ``tf`` (YAML in the
            layout of tf2_msgs/TFMessage), ``urdf``, ``kalibr`` (camchain), ``camera_info`` (ROS, a document for
            each camera), ``corrections`` (YAML: what data as published are corrected by) or ``json`` (the whole
            result).
        rig: kalibr, camera_info: topics of the cameras, and their intrinsics where rig.yaml states them.
        cameras: kalibr, camera_info: intrinsics by sensor; they take precedence over those of the rig.
        urdf: urdf: text of a URDF whose joints are to be corrected; without it a new one is made.
        joints: urdf: by sensor, the joint of the URDF that gets its pose, instead of the one above its frame. The
            fixed joints between both remain; those of sensors that are not exported are ignored.
        parents: launch, tf and new urdf: the parent of every frame is that of the root, or that of the sensor's
            parent in the spanning tree.
        only: ``good`` leaves out all sensors but the root whose verdict is not good. In the spanning tree, what
            they carry has the nearest exported sensor towards the root as its parent.
        distance: corrections: working distance, m, at which parameters must be determined by the data; the median
            distance of the board if left out.

    Raises:
        InputError: there is no such format, or this calibration cannot be written in it, with the reason.
        CalibrationError: ``only`` leaves nothing but the root.
    """
    if format not in FORMATS:
        raise InputError(f"there is no export format {format!r}; there are {', '.join(FORMATS)}")
    joints = dict(joints or {})
    if only == "good":
        all_names = {*calibration.evidence.unconnected, *(sensor.name for sensor in calibration.sensors)}
        calibration = keep_good_poses(calibration)
        left_out = all_names - {sensor.name for sensor in calibration.sensors}
        joints = {name: joint for name, joint in joints.items() if name not in left_out}
    if parents == "root" and format != "json":
        calibration = parent_to_root(calibration)
    if distance is not None:
        at_distance = {name: replace(one, distance=distance) for name, one in calibration.corrections.items()}
        calibration = replace(calibration, corrections=at_distance)
    return FORMATS[format](calibration, rig, cameras or {}, urdf, joints)
