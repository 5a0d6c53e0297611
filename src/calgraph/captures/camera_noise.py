"""The noise of a camera's corners as its images show it: what rig.yaml states is a start value."""

from collections.abc import Mapping, Sequence
from dataclasses import replace

from calgraph.detection import BoardCorners, Detection

# Corners are not trusted beyond this, whatever their residuals say: distortion bends a whole board at once, px.
_FLOOR = 0.05
# Residuals beyond the pose's six unknowns from which their size is known to about a fifth.
_ENOUGH = 24


def with_measured_noise(
    seen: Mapping[int, Sequence[Detection]], stated: float
) -> dict[int, tuple[Detection, ...]]:
    """A camera's detections with covariances for the noise that all of its residuals show together.

    Args:
        seen: one camera's detections by capture, each with a covariance for the larger of the stated noise and of
            its own residuals.
        stated: standard deviation of a corner in x and in y, pixels.

    Returns:
        The same detections, each with a covariance for the larger of the measured noise and of its own residuals;
        unchanged if there are too few corners to measure it.
    """
    boards = [d for found in seen.values() for d in found if isinstance(d, BoardCorners)]
    freedom = sum(2 * len(d.pixels) - 6 for d in boards)
    if freedom < _ENOUGH:
        return {capture: tuple(found) for capture, found in seen.items()}
    squares = sum(2 * len(d.pixels) * d.rms**2 for d in boards)
    variance = max(squares / freedom, _FLOOR**2)

    def rescaled(detection: Detection) -> Detection:
        if not isinstance(detection, BoardCorners):
            return detection
        own = detection.rms**2
        scale = max(variance, own) / max(stated**2, own)
        return replace(
            detection, covariance=scale * detection.covariance, plane_covariance=scale * detection.plane_covariance
        )

    return {capture: tuple(map(rescaled, found)) for capture, found in seen.items()}
