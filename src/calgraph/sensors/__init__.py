"""Models of cameras and scanners, and the messages they send."""

from calgraph.sensors.camera_model import CameraModel
from calgraph.sensors.cloud_to_scan import scan_of_cloud
from calgraph.sensors.messages import CameraInfo, Image, LaserScan, Message, PointCloud, Record, Trigger
from calgraph.sensors.point_colors import painted
from calgraph.sensors.scan_background import ScanBackground, nearest_beam

__all__ = [
    "CameraInfo",
    "CameraModel",
    "Image",
    "LaserScan",
    "Message",
    "PointCloud",
    "Record",
    "ScanBackground",
    "Trigger",
    "nearest_beam",
    "painted",
    "scan_of_cloud",
]
