"""The noise of a camera's corners, estimated from its PnP residuals; rig.yaml states the start value."""

from collections.abc import Mapping, Sequence
from dataclasses import replace

from calgraph.boards.detections import BoardCorners, Detection

# Minimum degrees of freedom of an estimate: its relative standard deviation is 1 / sqrt(2 x 24) = 14 %.
_MIN_DEGREES_OF_FREEDOM = 24
# Minimum noise of a corner, px: errors of the distortion model shift all corners of a board, which the residuals
# of one PnP do not show; corners of the AprilTag library scatter by 0.05 to 0.1 px.
_MIN_NOISE = 0.05


def scale_by_measured_noise(
    detections: Mapping[int, Sequence[Detection]],
    stated: float,
) -> dict[int, tuple[Detection, ...]]:
    """Scales the covariances of one camera's detections to the noise estimated from all their residuals.

    Args:
        detections: one camera's detections by capture; each covariance is for the larger of the stated noise and
            the RMS of its residuals.
        stated: standard deviation of a corner in x and in y, pixels.

    Returns:
        The same detections, each with a covariance for the larger of the estimated noise and the RMS of its
        residuals; unchanged if there are too few corners for an estimate.
    """
    boards = [d for found in detections.values() for d in found if isinstance(d, BoardCorners)]
    freedom = sum(2 * len(d.pixels) - 6 for d in boards)
    if freedom < _MIN_DEGREES_OF_FREEDOM:
        return {capture: tuple(found) for capture, found in detections.items()}
    squares = sum(2 * len(d.pixels) * d.rms**2 for d in boards)
    variance = max(squares / freedom, _MIN_NOISE**2)

    def rescale(detection: Detection) -> Detection:
        if not isinstance(detection, BoardCorners):
            return detection
        squared_rms = detection.rms**2
        scale = max(variance, squared_rms) / max(stated**2, squared_rms)
        return replace(
            detection, covariance=scale * detection.covariance, plane_covariance=scale * detection.plane_covariance
        )

    return {capture: tuple(map(rescale, found)) for capture, found in detections.items()}
