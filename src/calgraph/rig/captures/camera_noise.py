"""The noise of a camera's corners, estimated from its PnP residuals; rig.yaml states the start value."""

from collections.abc import Mapping, Sequence
from dataclasses import replace

from calgraph.boards.detections import BoardCorners, Detection
from calgraph.config.settings import CameraNoiseSettings


def scale_by_measured_noise(
    detections: Mapping[int, Sequence[Detection]],
    stated: float,
    settings: CameraNoiseSettings = CameraNoiseSettings(),
) -> dict[int, tuple[Detection, ...]]:
    """Scales the covariances of one camera's detections to the noise estimated from all their residuals.

    Args:
        detections: one camera's detections by capture; each covariance is for the larger of the stated noise and
            the RMS of its residuals.
        stated: standard deviation of a corner in x and in y, pixels.
        settings: of the estimate.

    Returns:
        The same detections, each with a covariance for the larger of the estimated noise and the RMS of its
        residuals; unchanged if there are too few corners for an estimate.
    """
    boards = [d for found in detections.values() for d in found if isinstance(d, BoardCorners)]
    freedom = sum(2 * len(d.pixels) - 6 for d in boards)
    if freedom < settings.min_degrees_of_freedom:
        return {capture: tuple(found) for capture, found in detections.items()}
    squares = sum(2 * len(d.pixels) * d.rms**2 for d in boards)
    variance = max(squares / freedom, settings.min_noise**2)

    def rescale(detection: Detection) -> Detection:
        if not isinstance(detection, BoardCorners):
            return detection
        squared_rms = detection.rms**2
        scale = max(variance, squared_rms) / max(stated**2, squared_rms)
        return replace(
            detection, covariance=scale * detection.covariance, plane_covariance=scale * detection.plane_covariance
        )

    return {capture: tuple(map(rescale, found)) for capture, found in detections.items()}
