"""Models of cameras and scanners, and their messages."""

from calgraph.sensors.camera_model import DISTORTION_NAMES, CameraModel, colorize_points
from calgraph.sensors.cloud_to_scan import SAME_DIRECTION, convert_cloud_to_scan
from calgraph.sensors.messages import (
    CameraInfo,
    DetectedCorners,
    Image,
    LaserScan,
    Measurement,
    Message,
    MessageDigest,
    PointCloud,
    Pose,
    RecordedMessage,
    TransformList,
    Trigger,
    TurnRate,
)
from calgraph.sensors.scan_background import ScanBackground, align_ranges, find_nearest_beams

__all__ = [
    "DISTORTION_NAMES", "SAME_DIRECTION", "CameraInfo", "CameraModel", "DetectedCorners", "Image", "LaserScan",
    "Measurement", "Message", "MessageDigest", "PointCloud", "Pose", "RecordedMessage", "ScanBackground",
    "TransformList", "Trigger", "TurnRate", "align_ranges", "colorize_points", "convert_cloud_to_scan",
    "find_nearest_beams",
]  # fmt: skip
