"""Gyroscopes: what rig.yaml states of them. Accelerations of their messages are not used."""

from typing import Literal

from calgraph.sensors.kinds.sensor_kind import LEVEL_AXES, SensorKind
from calgraph.sensors.kinds.stated import MotionSpec
from calgraph.sensors.messages import TurnRate


class GyroscopeSpec(MotionSpec):
    """A gyroscope of the rig; its messages are sensor_msgs/Imu."""

    kind: Literal["gyroscope"] = "gyroscope"


GYROSCOPE = SensorKind(
    name="gyroscope",
    title="gyroscope",
    spec=GyroscopeSpec,
    messages=(TurnRate,),
    types=("sensor_msgs/msg/Imu", "turn_rate"),
    detects="motion",
    axes=LEVEL_AXES,
    shape="axes",
    color="#f08a8a",
    default_name="imu",
    residual="error of turn rates",
    noise_causes="check that its rates are in rad/s",
    error_causes="that its rates are in rad/s",
    correction="true rate = rate - bias",
)
