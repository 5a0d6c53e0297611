"""One module for each kind of sensor on a robot, and the table of all kinds."""

from collections.abc import Mapping

from calgraph.rig.kinds.camera import CAMERA
from calgraph.rig.kinds.depth_camera import DEPTH_CAMERA
from calgraph.rig.kinds.lidar2d import LIDAR2D
from calgraph.rig.kinds.lidar3d import LIDAR3D
from calgraph.rig.kinds.rig_kind import MotionSignature, RigKind
from calgraph.sensors import Message

RIG_KINDS: Mapping[str, RigKind] = {
    "camera": CAMERA, "lidar2d": LIDAR2D, "lidar3d": LIDAR3D, "depth_camera": DEPTH_CAMERA,
}  # fmt: skip
"""By the kind's name in rig.yaml."""
MOTION_SIGNATURES: Mapping[type[Message], MotionSignature] = {
    message: signature for kind in RIG_KINDS.values() for message, signature in kind.motion.items()
}
"""How each type of message shows motion."""

__all__ = ["MOTION_SIGNATURES", "RIG_KINDS", "RigKind"]
