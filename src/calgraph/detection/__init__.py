"""Finding the target in the messages of one capture."""

from calgraph.detection.detections import BoardCorners, Detection, PlanePatch, Rejected, Segment, plane_of

__all__ = ["BoardCorners", "Detection", "PlanePatch", "Rejected", "Segment", "plane_of"]
