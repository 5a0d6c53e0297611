"""One module for each kind of sensor, and the table of all kinds: below it, nothing asks which kinds there are."""

from typing import Annotated, Literal, cast

from pydantic import Field

from calgraph.sensors.kinds.camera import CAMERA, CameraSpec, CameraUncertainty, PixelNoise
from calgraph.sensors.kinds.depth_camera import DEPTH_CAMERA, DepthCameraSpec, DepthCameraUncertainty, DepthNoise
from calgraph.sensors.kinds.gyroscope import GYROSCOPE, GyroscopeSpec
from calgraph.sensors.kinds.lidar2d import LIDAR2D, Lidar2dSpec, Lidar2dUncertainty
from calgraph.sensors.kinds.lidar3d import LIDAR3D, Lidar3dSpec, Lidar3dUncertainty
from calgraph.sensors.kinds.sensor_kind import FLOOR, SensorKind
from calgraph.sensors.kinds.stated import BeamError, OpticalSpec, RangeNoise, RangeUncertainty
from calgraph.sensors.kinds.trajectory import TF_TYPES, TRAJECTORY, TrajectorySpec
from calgraph.sensors.messages import Message

KindName = Literal["camera", "lidar2d", "lidar3d", "depth_camera", "trajectory", "gyroscope", "floor"]
SensorSpec = Annotated[
    CameraSpec | Lidar2dSpec | Lidar3dSpec | DepthCameraSpec | TrajectorySpec | GyroscopeSpec,
    Field(discriminator="kind"),
]
KINDS: dict[str, SensorKind] = {
    kind.name: kind for kind in (LIDAR3D, CAMERA, DEPTH_CAMERA, LIDAR2D, TRAJECTORY, GYROSCOPE, FLOOR)
}
"""All kinds by name, and the floor; the kinds that suit best as the root of a rig come first."""

_KIND_OF_TYPE = {name: kind.name for kind in KINDS.values() if kind.detects != "motion" for name in kind.types}
SENSOR_TYPES = frozenset(_KIND_OF_TYPE)
"""Types of the topics of sensors that detect targets, of ROS and of plain folders."""
_MOTION_KIND_OF_TYPE = {
    name: kind.name for kind in KINDS.values() if kind.detects == "motion" for name in kind.types
}
MOTION_TYPES = frozenset(_MOTION_KIND_OF_TYPE)
"""Types of the topics of kinds that are calibrated in a drive only."""


def recognize_kind(topic_type: str, first: Message | None = None) -> KindName | None:
    """The kind of the sensor that sends messages of a type, from its first message where there is one."""
    claimed = (kind.name for kind in KINDS.values() if first is not None and kind.claims(first))
    return cast("KindName | None", next(claimed, _KIND_OF_TYPE.get(topic_type)))


def motion_kind_of(topic_type: str) -> KindName | None:
    """The kind that is calibrated in a drive only and whose messages are of a type; None of other types."""
    return cast("KindName | None", _MOTION_KIND_OF_TYPE.get(topic_type))


def list_beam_errors(kind: KindName) -> tuple[BeamError, ...]:
    """The systematic errors of a kind's beams, with default priors; none of kinds without beams."""
    uncertainty = KINDS[kind].spec.model_fields["uncertainty"].default
    return uncertainty.beam_errors() if isinstance(uncertainty, RangeUncertainty) else ()


__all__ = [
    "FLOOR", "KINDS", "MOTION_TYPES", "SENSOR_TYPES", "TF_TYPES", "CameraSpec", "CameraUncertainty",
    "DepthCameraSpec", "DepthCameraUncertainty", "DepthNoise", "GyroscopeSpec", "KindName", "Lidar2dSpec",
    "Lidar2dUncertainty",
    "Lidar3dSpec", "Lidar3dUncertainty", "OpticalSpec", "PixelNoise", "RangeNoise", "SensorKind", "SensorSpec",
    "TrajectorySpec",
    "list_beam_errors", "motion_kind_of", "recognize_kind",
]  # fmt: skip
