"""Models of cameras and scanners, and the messages they send."""

from calgraph.sensors.camera import CameraModel
from calgraph.sensors.messages import CameraInfo, Image, LaserScan, Message, PointCloud, Record, Trigger

__all__ = ["CameraInfo", "CameraModel", "Image", "LaserScan", "Message", "PointCloud", "Record", "Trigger"]
