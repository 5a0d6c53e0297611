"""Settings of the detection of the board."""

from calgraph.config.strict_model import StrictModel


class CameraDetectionSettings(StrictModel):
    """The board in an image."""


class Lidar2dDetectionSettings(StrictModel):
    """The board in scans of a 2-D scanner."""


class Lidar3dDetectionSettings(StrictModel):
    """The board in sweeps of a 3-D LiDAR."""


class DetectionSettings(StrictModel):
    """The target in the messages of one capture."""

    camera: CameraDetectionSettings = CameraDetectionSettings()
    lidar2d: Lidar2dDetectionSettings = Lidar2dDetectionSettings()
    lidar3d: Lidar3dDetectionSettings = Lidar3dDetectionSettings()
