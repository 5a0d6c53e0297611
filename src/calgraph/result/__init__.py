"""The calibration found: poses, covariances, evidence; and its files for other programs."""

from calgraph.result.calibration import BoardOutline, Calibration, CaptureRow, Edge, SensorPose, Verdict

__all__ = ["BoardOutline", "Calibration", "CaptureRow", "Edge", "SensorPose", "Verdict"]
