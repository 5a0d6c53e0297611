"""Models of cameras and scanners, and their messages."""

from calgraph.sensors.camera_model import CameraModel
from calgraph.sensors.cloud_to_scan import convert_cloud_to_scan
from calgraph.sensors.messages import CameraInfo, Image, LaserScan, Message, PointCloud, RecordedMessage, Trigger
from calgraph.sensors.point_colors import colorize_points
from calgraph.sensors.scan_background import ScanBackground, find_nearest_beams

__all__ = [
    "CameraInfo",
    "CameraModel",
    "Image",
    "LaserScan",
    "Message",
    "PointCloud",
    "RecordedMessage",
    "ScanBackground",
    "Trigger",
    "colorize_points",
    "convert_cloud_to_scan",
    "find_nearest_beams",
]
