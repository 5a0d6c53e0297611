"""How each kind of sensor is used in a drive: one module for each kind of source, and the table of them."""

from collections.abc import Mapping

from calgraph.drive.sources.camera import CAMERA_SOURCE
from calgraph.drive.sources.gyroscope import GYROSCOPE_SOURCE
from calgraph.drive.sources.lidar import LIDAR_SOURCE
from calgraph.drive.sources.source import Reader, Source, SourceKind
from calgraph.drive.sources.trajectory import TRAJECTORY_SOURCE

SOURCES: Mapping[str, SourceKind] = {
    "lidar2d": LIDAR_SOURCE,
    "lidar3d": LIDAR_SOURCE,
    "camera": CAMERA_SOURCE,
    "trajectory": TRAJECTORY_SOURCE,
    "gyroscope": GYROSCOPE_SOURCE,
}
"""By kind of sensor, as rig.yaml states it."""

__all__ = ["SOURCES", "Reader", "Source", "SourceKind"]
