"""Trajectories that other programs estimate: wheel odometry, inertial navigation, visual-inertial odometry."""

from typing import Literal

from pydantic import model_validator

from calgraph.io.strict_model import invalid
from calgraph.sensors.kinds.sensor_kind import LEVEL_AXES, SensorKind
from calgraph.sensors.kinds.stated import MotionSpec, Name
from calgraph.sensors.messages import Pose, TransformList

TF_TYPES = ("tf2_msgs/msg/TFMessage", "tf/msg/tfMessage")
"""Types of messages with poses of several frames."""


class TrajectorySpec(MotionSpec):
    """The trajectory of a frame of the rig, by another program."""

    kind: Literal["trajectory"] = "trajectory"
    parent: Name | None = None
    """On a topic of tf, the frame in which ``frame_id``, which is needed then, moves, such as ``odom``."""

    @model_validator(mode="after")
    def _pair_of_frames(self) -> "TrajectorySpec":
        if self.parent is not None and self.frame_id is None:
            raise invalid("parent", "needs frame_id, the frame that moves in it")
        return self


TRAJECTORY = SensorKind(
    name="trajectory",
    title="trajectory",
    spec=TrajectorySpec,
    messages=(Pose, TransformList),
    types=(
        "nav_msgs/msg/Odometry", "geometry_msgs/msg/PoseStamped", "geometry_msgs/msg/PoseWithCovarianceStamped",
        "geometry_msgs/msg/TransformStamped", *TF_TYPES, "trajectory", "transforms",
    ),
    detects="motion",
    axes=LEVEL_AXES,
    shape="axes",
    color="#e8e08a",
    default_name="odometry",
    residual="error of motions",
    noise_causes="check that its poses are in m and of one frame",
    error_causes="that its poses are in m and of one frame",
    correction="true path length = path length / path scale",
    states_frame=False,
)  # fmt: skip
