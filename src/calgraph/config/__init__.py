"""rig.yaml: the sensors with their noise, the target, and how captures are marked."""

from calgraph.config.board_print import PrintedBitmap, black_rectangles, printed_bitmaps
from calgraph.config.draft import FoundBackground, FoundTopic, Kind, draft_rig, explain_unused, find_triggers
from calgraph.config.fleet_config import ChangeRules, FleetConfig, load_fleet
from calgraph.config.rig_config import Capture, CaptureMode, Rig, load_rig
from calgraph.config.target import (
    APRILTAGS,
    DICTIONARIES,
    FAMILIES,
    AprilGrid,
    Board,
    BoardUncertainty,
    Charuco,
    Checkerboard,
    Cylinder,
    Family,
    People,
    Surroundings,
    Tag,
    Tolerance,
    dictionary,
    marker_count,
)
from calgraph.sensors.kinds import (
    CameraSpec,
    CameraUncertainty,
    DepthCameraSpec,
    Lidar2dSpec,
    Lidar2dUncertainty,
    Lidar3dSpec,
    Lidar3dUncertainty,
    PixelNoise,
    RangeNoise,
    SensorSpec,
)
from calgraph.sensors.kinds.stated import Intrinsics

__all__ = [
    "APRILTAGS", "DICTIONARIES", "FAMILIES",
    "AprilGrid", "Board", "BoardUncertainty", "CameraSpec", "CameraUncertainty", "Capture",
    "CaptureMode", "ChangeRules", "Charuco", "Checkerboard", "Cylinder", "DepthCameraSpec", "Family",
    "FleetConfig", "FoundBackground", "FoundTopic", "Intrinsics", "Kind", "Lidar2dSpec",
    "Lidar2dUncertainty", "Lidar3dSpec", "Lidar3dUncertainty", "People", "PixelNoise", "PrintedBitmap",
    "RangeNoise", "Rig", "SensorSpec", "Surroundings", "Tag", "Tolerance", "black_rectangles", "dictionary",
    "draft_rig", "explain_unused", "find_triggers", "load_fleet", "load_rig", "marker_count", "printed_bitmaps",
]  # fmt: skip
