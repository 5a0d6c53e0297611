"""3-D LiDARs: what rig.yaml states of them."""

from typing import Literal

from calgraph.io.quantities import LengthStddev
from calgraph.sensors.kinds.sensor_kind import LEVEL_AXES, SensorKind, foxglove_types
from calgraph.sensors.kinds.stated import RangeUncertainty, ScannerSpec
from calgraph.sensors.messages import PointCloud


class Lidar3dUncertainty(RangeUncertainty):
    """Prior standard deviations of a 3-D LiDAR's systematic errors; 0 means exact."""

    ring_bias: LengthStddev = 0.01
    """m, of each ring beside the common range bias. In a real VLP-16, four of 16 rings were off by -14 to +19
    mm and the others by less."""


class Lidar3dSpec(ScannerSpec):
    """A 3-D LiDAR of the rig."""

    kind: Literal["lidar3d"] = "lidar3d"
    uncertainty: Lidar3dUncertainty = Lidar3dUncertainty()


LIDAR3D = SensorKind(
    name="lidar3d",
    title="3-D LiDAR",
    spec=Lidar3dSpec,
    messages=(PointCloud,),
    types=(
        "sensor_msgs/msg/PointCloud2", "sensor_msgs/msg/PointCloud", "cloud", *foxglove_types("PointCloud"),
        "livox_ros_driver/msg/CustomMsg", "livox_ros_driver2/msg/CustomMsg", "livox_interfaces/msg/CustomMsg",
        "velodyne_msgs/msg/VelodyneScan",
    ),
    detects="plane",
    axes=LEVEL_AXES,
    shape="rings",
    color="#7db7ff",
    default_name="lidar",
    drafted_noise="{range: 0.02, angle: 0.001}",
    residual="distance from the board",
    noise_causes="check its range noise, and that its points are in m",
    error_causes="its range and angle noise, and that its points are in m",
    correction="true range = (range - range bias - bias of its ring) / range scale, in the same direction",
)  # fmt: skip
