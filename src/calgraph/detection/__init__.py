"""Detection of the board in the messages of one capture."""

from calgraph.detection.background_learning import learn_cloud_background, learn_scan_background
from calgraph.detection.board_views import BoardView, BoardViewFinder
from calgraph.detection.camera import CameraDetector, PlaneEstimator
from calgraph.detection.capture_background import CaptureBackground, learn_capture_background
from calgraph.detection.cloud_background import CloudBackground
from calgraph.detection.detections import (
    BoardCorners,
    Detection,
    DetectionResult,
    InconsistentTags,
    PlanePatch,
    Segment,
    plane_of,
    to_beams,
)
from calgraph.detection.from_measurements import (
    board_corners_from_pixels,
    plane_patch_from_points,
    segment_from_points,
)
from calgraph.detection.landmarks import Landmarks, compute_landmarks
from calgraph.detection.lidar2d import find_segments
from calgraph.detection.lidar3d import find_patches

__all__ = [
    "BoardCorners", "BoardView", "BoardViewFinder", "CameraDetector", "CaptureBackground", "CloudBackground",
    "Detection", "DetectionResult", "InconsistentTags", "Landmarks", "PlaneEstimator", "PlanePatch", "Segment",
    "board_corners_from_pixels", "compute_landmarks", "find_patches", "find_segments",
    "learn_capture_background", "learn_cloud_background", "learn_scan_background", "plane_of",
    "plane_patch_from_points", "segment_from_points", "to_beams",
]  # fmt: skip
