"""The floor as the root of a network: no sensor, but a frame that poses are stated in."""

from calgraph.io.strict_model import StrictModel
from calgraph.sensors.kinds.sensor_kind import LEVEL_AXES, SensorKind

FLOOR = SensorKind(
    name="floor",
    title="floor",
    spec=StrictModel,
    messages=(),
    types=(),
    detects="nothing",
    axes=LEVEL_AXES,
    shape="axes",
    color="#a8a8a8",
    default_name="floor",
)
