"""The table of export formats."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Literal

from calgraph.config import Rig
from calgraph.errors import InputError
from calgraph.result.calibration import Calibration
from calgraph.result.exports.camera_info import to_camera_infos
from calgraph.result.exports.frames import parent_to_root
from calgraph.result.exports.json_text import to_json
from calgraph.result.exports.kalibr import to_camchain
from calgraph.result.exports.tf import to_launch, to_tf_yaml
from calgraph.result.exports.urdf import to_urdf, update_urdf
from calgraph.result.stated_pose import apply_stated_poses
from calgraph.sensors import CameraModel

Parents = Literal["root", "tree"]


@dataclass(frozen=True)
class _Request:
    """A calibration, and further inputs that some formats need."""

    calibration: Calibration
    rig: Rig | None = None
    cameras: Mapping[str, CameraModel] = field(default_factory=dict)
    urdf: str | None = None


def _urdf(request: _Request) -> str:
    if request.urdf is None:
        return to_urdf(apply_stated_poses(request.calibration))
    return update_urdf(request.calibration, request.urdf)


FORMATS: Mapping[str, Callable[[_Request], str]] = {
    "launch": lambda request: to_launch(apply_stated_poses(request.calibration)),
    "tf": lambda request: to_tf_yaml(apply_stated_poses(request.calibration)),
    "urdf": _urdf,
    "kalibr": lambda request: to_camchain(request.calibration, request.rig, request.cameras),
    "camera_info": lambda request: to_camera_infos(request.calibration, request.rig, request.cameras),
    "json": lambda request: to_json(request.calibration),
}
"""Writers by the name of their format."""


def export(
    calibration: Calibration,
    format: str,
    *,
    rig: Rig | None = None,
    cameras: Mapping[str, CameraModel] | None = None,
    urdf: str | None = None,
    parents: Parents = "root",
) -> str:
    """The calibration as the text of a file of another program.

    A network does not measure height, roll and pitch of its scanners: they are those of rig.yaml, and 0 where it
    states none; in a URDF that is corrected, they remain as they are.

    Args:
        calibration: what to export.
        format: ``launch`` (ROS 2 launch file in Python with static transform publishers), ``tf`` (YAML in the
            layout of tf2_msgs/TFMessage), ``urdf``, ``kalibr`` (camchain), ``camera_info`` (ROS, a document for
            each camera) or ``json`` (the whole result).
        rig: kalibr, camera_info: topics of the cameras, and their intrinsics where rig.yaml states them.
        cameras: kalibr, camera_info: intrinsics by sensor; they take precedence over those of the rig.
        urdf: urdf: text of a URDF whose joints are to be corrected; without it a new one is made.
        parents: launch, tf and new urdf: the parent of every frame is that of the root, or that of the sensor's
            parent in the spanning tree.

    Raises:
        InputError: there is no such format, or this calibration cannot be written in it, with the reason.
    """
    if format not in FORMATS:
        raise InputError(f"there is no export format {format!r}; there are {', '.join(FORMATS)}")
    if parents == "root" and format != "json":
        calibration = parent_to_root(calibration)
    return FORMATS[format](_Request(calibration, rig, cameras or {}, urdf))
