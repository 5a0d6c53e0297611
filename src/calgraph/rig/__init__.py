"""rig.yaml: the sensors with their noise, the target, and how captures are marked."""

from calgraph.rig.atomic import check_place, replacing, replacing_folder, write_text
from calgraph.rig.draft import FoundTopic, Kind, draft_rig
from calgraph.rig.file import load_rig
from calgraph.rig.markers import FAMILIES, Family, dictionary, marker_count
from calgraph.rig.prints import Print, ink, prints
from calgraph.rig.rig import (
    CameraSpec,
    Capture,
    Intrinsics,
    Lidar2dSpec,
    Lidar3dSpec,
    PixelNoise,
    RangeNoise,
    Rig,
    SensorSpec,
)
from calgraph.rig.target import AprilGrid, Board, Charuco, Checkerboard, Cylinder, People, Tag
from calgraph.rig.writing import save_yaml, yaml_text

__all__ = [
    "FAMILIES", "AprilGrid", "Board", "CameraSpec", "Capture", "Charuco", "Checkerboard", "Cylinder", "Family",
    "FoundTopic", "Intrinsics", "Kind", "Lidar2dSpec", "Lidar3dSpec", "People", "PixelNoise", "Print",
    "RangeNoise", "Rig", "SensorSpec", "Tag", "check_place", "dictionary", "draft_rig", "ink", "load_rig",
    "marker_count", "prints", "replacing", "replacing_folder", "save_yaml", "write_text", "yaml_text",
]  # fmt: skip
