"""Detections from measurements on the board that were segmented outside calgraph: corners, points, beams."""

import numpy as np

from calgraph.boards.board_pose import fit_pose
from calgraph.boards.camera import make_board_corners
from calgraph.boards.detections import BoardCorners, PlanePatch, Segment, to_beams
from calgraph.config import PixelNoise, RangeNoise
from calgraph.errors import InputError, Rejected
from calgraph.geometry import Array, plane
from calgraph.rig.detection.lidar2d import build_segment
from calgraph.rig.detection.line_plane_fit import fit_line, fit_plane
from calgraph.sensors import CameraModel

_SAME_BEAM = 1e-5
"""Directions of beams of several scans that differ by less are counted as one, rad."""


def board_corners_from_pixels(
    corners_board: Array, pixels: Array, camera: CameraModel, noise: PixelNoise | None = None, board: int = 0
) -> BoardCorners | Rejected:
    """The board in a camera image, from printed corners and their pixels.

    Args:
        corners_board: (N, 2) or (N, 3) the corners in the board's frame (x right, y up, z = 0), m; four at least.
        pixels: (N, 2) where they were detected, as measured (distorted), OpenCV's pixel convention.
        camera: the intrinsics.
        noise: of a corner.
        board: index of the board among the rig's boards.

    Returns:
        The detection without outliers, or why the corners determine no pose.

    Raises:
        InputError: the arrays do not fit together, or corners are off the board's plane.
    """
    corners = _check_points("corners_board", corners_board)
    image_points = _check_rows("pixels", pixels, (2,))
    if len(corners) != len(image_points):
        raise InputError(f"pixels: must be as many as corners_board, {len(corners)}, got {len(image_points)}")
    if corners[:, 2].any():
        raise InputError("corners_board: must lie in the board's plane, z = 0")
    mark_corners, mark_pixels = corners[:, None], image_points[:, None]
    pose = fit_pose(np.arange(len(mark_corners)), mark_corners, mark_pixels, camera, (noise or PixelNoise()).pixel)
    return pose if isinstance(pose, Rejected) else make_board_corners(pose, mark_corners, mark_pixels, board)


def plane_patch_from_points(points: Array, noise: RangeNoise | None = None) -> PlanePatch | Rejected:
    """The board in a cloud of a 3-D scanner, from the points on it.

    Args:
        points: (N, 3) on the board, clear of its outline, in the scanner's frame, m; beams start in its origin.
        noise: of a beam.

    Returns:
        The plane by least squares along the beams, without outliers; or why there is none.

    Raises:
        InputError: the array is not (N, 3), or not finite.
    """
    points = _check_rows("points", points, (3,))
    _check_beams(points)
    if len(points) < 4:
        return Rejected(f"a plane needs four points, got {len(points)}")
    noise = noise or RangeNoise()
    ranges, directions = to_beams(points)
    fit = fit_plane(ranges, directions, noise.of_beams(ranges, directions), noise.angle, plane.fit(points))
    if fit is None:
        return Rejected(f"the {len(points)} points lie on no plane, or on one along the beams")
    middle = points[fit.inliers].mean(axis=0)
    center = middle - plane.distance(fit.parameters, middle[None]) * fit.parameters[:3]
    return PlanePatch(fit.parameters, fit.covariance, ranges[fit.inliers], directions[fit.inliers], center)


def segment_from_points(points: Array, noise: RangeNoise | None = None) -> Segment | Rejected:
    """The board in scans of a 2-D scanner, from the ends of the beams on it.

    Args:
        points: (N, 2) or (N, 3) in the scan plane z = 0, of one scan or of several of the same resting board, m.
        noise: of a beam.

    Returns:
        The line by least squares along the beams, without outliers; or why there is none.

    Raises:
        InputError: the array has another shape, or points are off the scan plane.
    """
    points = _check_points("points", points)
    if points[:, 2].any():
        raise InputError("points: must lie in the scan plane, z = 0")
    _check_beams(points)
    ranges, directions = to_beams(points)
    # Angles relative to the middle beam, so that no board lies across the wrap at ±pi.
    middle = float(np.arctan2(*points[:, 1::-1].sum(axis=0)))
    angles = middle + np.angle(np.exp(1j * (np.arctan2(points[:, 1], points[:, 0]) - middle)))
    beams = np.unique(np.round(angles / _SAME_BEAM)) * _SAME_BEAM
    if len(beams) < 3:
        return Rejected(f"a line needs three beams, got {len(beams)}")
    noise = noise or RangeNoise()
    sigmas = (np.full_like(ranges, noise.range), np.full_like(ranges, noise.angle))
    fit = fit_line(angles, ranges, *sigmas, _fit_normal_form(points[:, :2]))
    if fit is None or fit.parameters[1] <= 0:
        return Rejected(f"the ends of the {len(beams)} beams lie on no line, or on one along the beams")
    ends = np.array([angles[fit.inliers].min(), angles[fit.inliers].max()])
    return build_segment(ends, float(np.diff(beams).min()), fit, ranges[fit.inliers], directions[fit.inliers])


def _fit_normal_form(points: Array) -> Array:
    """The total-least-squares line through points (N, 2): angle of its normal away from the origin, distance."""
    middle = points.mean(axis=0)
    normal = np.linalg.eigh((points - middle).T @ (points - middle))[1][:, 0]
    normal = normal if normal @ middle >= 0 else -normal
    return np.array([np.arctan2(normal[1], normal[0]), normal @ middle])


def _check_points(name: str, points: Array) -> Array:
    """Points (N, 3) of points (N, 2) or (N, 3)."""
    rows = _check_rows(name, points, (2, 3))
    return np.column_stack([rows, np.zeros((len(rows), 3 - rows.shape[1]))])


def _check_beams(points: Array) -> None:
    if not points.any(axis=1).all():
        raise InputError("points: lie in the sensor's origin, where no beam ends; leave out what was not measured")


def _check_rows(name: str, values: Array, widths: tuple[int, ...]) -> Array:
    rows = np.asarray(values, dtype=np.float64)
    wanted = " or ".join(f"(N, {width})" for width in widths)
    if rows.ndim != 2 or rows.shape[1] not in widths:
        raise InputError(f"{name}: must have the shape {wanted}, got {rows.shape}")
    if not np.isfinite(rows).all():
        raise InputError(f"{name}: must be finite; leave out what was not measured")
    return rows
