"""Finding the target in the messages of one capture."""

from calgraph.detection.background import CloudBackground, ScanBackground
from calgraph.detection.detections import BoardCorners, Detection, PlanePatch, Rejected, Segment, plane_of
from calgraph.detection.patches import find_patches
from calgraph.detection.segments import find_segments

__all__ = [
    "BoardCorners", "CloudBackground", "Detection", "PlanePatch", "Rejected", "ScanBackground", "Segment",
    "find_patches", "find_segments", "plane_of",
]  # fmt: skip
