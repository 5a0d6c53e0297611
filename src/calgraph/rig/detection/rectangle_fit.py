"""Fit of a rectangle of known size to a flat patch of points."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from calgraph.config.settings import DetectionSettings
from calgraph.geometry import Array, measure_lengths, plane

Mask = NDArray[np.bool_]

# Angles of the search for the best rotation, then about it: its error of 2.5° moves the outline by less than the
# blur of outlines.
_COARSE = np.radians(np.arange(0.0, 180.0, 15.0))
_FINE = np.radians(np.arange(-10.0, 11.0, 5.0))
# Points along each side of a rectangle that show its coverage, which is a share of 144.
_RASTER = 12
# Rounding of sums of coordinates, m.
_ROUNDING = 1e-9


@dataclass(frozen=True, eq=False)
class BoardRectangle:
    """A rectangle of known size fitted to a patch."""

    surface: Array
    """(4,) its plane."""
    axes: Array
    """(3, 2) unit vectors along width and height."""
    center: Array
    """(3,) m."""
    size: tuple[float, float]
    """Width and height, m."""
    covered: float
    """Share of the rectangle that is covered by points of the patch."""
    contained: float
    """Share of the patch that the rectangle contains."""

    def coordinates(self, points: Array) -> Array:
        """(N, 2) coordinates of points (N, 3) along the rectangle's axes from its centre, m."""
        return np.asarray((points - self.center) @ self.axes)


SceneBeams = tuple[Array, Array]
"""Ends (N, 3), m, of the beams of a cloud, background included, and their ranges (N,), m."""


def fit_rectangle(
    surface: Array, cells: Array, size: tuple[float, float], reach: float, blur: float
) -> BoardRectangle:
    """Fits the rotation and position of the rectangle that contains most cells.

    Args:
        surface: (4,) plane of the patch.
        cells: (M, 3) points of the patch, evenly spaced, m.
        size: width and height of the rectangle, m.
        reach: distance from a cell up to which the patch continues, m: half the spacing of cells.
        blur: uncertainty of the outline, m.
    """
    basis = plane.tangent_basis(surface[:3])
    origin = cells.mean(axis=0)
    flat = (cells - origin) @ basis
    angle, _, _ = _find_best_placement(flat, _COARSE, size, blur)
    angle, center, share = _find_best_placement(flat, angle + _FINE, size, blur)
    cosine, sine = np.cos(angle), np.sin(angle)
    rotation = np.array([[cosine, -sine], [sine, cosine]])
    axes = basis @ rotation
    rotated = flat @ rotation
    ticks = (np.arange(_RASTER) + 0.5) / _RASTER - 0.5
    raster = np.stack(np.meshgrid(ticks * size[0], ticks * size[1]), axis=-1).reshape(-1, 2) + center
    distance, _ = cKDTree(rotated, balanced_tree=False).query(raster, distance_upper_bound=max(reach, blur))
    middle = origin + axes @ center
    middle = middle - (surface[:3] @ middle + surface[3]) * surface[:3]
    covered = float(np.isfinite(distance).mean())
    return BoardRectangle(surface, axes, middle, size, covered, share)


def _find_best_placement(
    flat: Array, angles: Array, size: tuple[float, float], blur: float
) -> tuple[float, Array, float]:
    """The rotation, of candidates (T,), and position that contain most of the points (M, 2), in the least area.

    Returns:
        The angle, rad, the centre (2,) along the rotated axes, m, and the share of the points contained.
    """
    cosine, sine = np.cos(angles), np.sin(angles)
    rotated = np.stack([np.outer(cosine, flat[:, 0]) + np.outer(sine, flat[:, 1]),
                       np.outer(cosine, flat[:, 1]) - np.outer(sine, flat[:, 0])])  # fmt: skip
    keep = _find_fullest_window(rotated[0], np.ones(rotated.shape[1:], dtype=np.bool_), size[0] + 2 * blur)
    for axis in (1, 0):
        other = rotated[1 - axis]
        low, high = _compute_bounds(other, keep)
        within = (other >= low[:, None]) & (other <= high[:, None])
        keep = within & _find_fullest_window(rotated[axis], within, size[axis] + 2 * blur)
    bounds = np.array([_compute_bounds(along, keep) for along in rotated])
    area = np.prod(bounds[:, 1] - bounds[:, 0], axis=0)
    share = keep.mean(axis=1)
    best = np.lexsort([area, -share])[0]
    return float(angles[best]), bounds[:, :, best].mean(axis=1), float(share[best])


def _compute_bounds(values: Array, counted: Mask) -> tuple[Array, Array]:
    """Smallest and largest of the counted values (T, M) in each row."""
    return np.where(counted, values, np.inf).min(axis=1), np.where(counted, values, -np.inf).max(axis=1)


def _find_fullest_window(values: Array, counted: Mask, width: float) -> Mask:
    """The values (T, M) in the window of this width that contains most of the counted ones of each row."""
    low = values.min()
    # Rows, and values that do not count, are offset by more than a window, so that one search serves all rows.
    separation = float(values.max() - low) + 2 * width
    ordered = np.sort(np.where(counted, values - low, separation), axis=1)
    row = np.arange(len(values))
    offset = ordered + 3 * separation * row[:, None]
    ends = np.searchsorted(offset.ravel(), (offset + width).ravel(), side="right")
    counts = np.where(
        ordered < separation, ends.reshape(ordered.shape) - np.arange(ordered.size).reshape(ordered.shape), 0
    )
    start = low + ordered[row, counts.argmax(axis=1)][:, None]
    return np.asarray((values >= start - _ROUNDING) & (values <= start + width + _ROUNDING))


# Uncertainty of the outline of a patch, m: noise, mixed pixels, and steps of 5° of its rotation.
OUTLINE_BLUR = 0.03


def measure_solidity_and_isolation(
    rectangle: BoardRectangle, scene: SceneBeams, thickness: float, frame: float, settings: DetectionSettings
) -> tuple[float, float]:
    """Shares of the beams through a rectangle that end on it, and of those around it that do not.

    Args:
        rectangle: the candidate.
        scene: all beams of the cloud.
        thickness: a point lies on the plane up to this distance from it, m.
        frame: width of the frame around the rectangle to evaluate, m.
        settings: of the detection.

    Returns:
        Solidity: of the beams through the rectangle that do not end before it, the share that ends on it.
        Isolation: of the beams through the frame, the share that does not end on the rectangle's plane. Both are
        0 to 1, and 1 where there are no beams.
    """
    blur = OUTLINE_BLUR
    points, ranges = _crop_to_cone(rectangle, scene, 2 * blur + frame)
    facing = points @ rectangle.surface[:3]
    # Ranges relative to the intersection with the plane; beams that do not intersect it are left out.
    ratio = np.where(facing < 0, -facing / max(rectangle.surface[3], 1e-9), np.inf)
    intersects = np.isfinite(ratio) & (ratio > 1e-3)
    intersections = points[intersects] / ratio[intersects, None]
    excess = ranges[intersects] * (1 - 1 / ratio[intersects])
    distance_outside = np.abs(rectangle.coordinates(intersections)) - 0.5 * np.array(rectangle.size)
    margin = distance_outside.max(axis=1)
    on_plane = np.abs(excess) * rectangle.surface[3] / measure_lengths(intersections) < thickness
    through = (margin < -blur) & (on_plane | (excess > settings.scanner.min_depth_jump))
    around = (margin > 2 * blur) & (margin < 2 * blur + frame)
    solidity = float(on_plane[through].mean()) if through.any() else 1.0
    isolation = 1.0 - float(on_plane[around].mean()) if around.any() else 1.0
    return solidity, isolation


def _crop_to_cone(rectangle: BoardRectangle, scene: SceneBeams, frame: float) -> tuple[Array, Array]:
    """The points (N, 3) of the scene in the cone around the rectangle and its frame, and their ranges (N,)."""
    points, ranges = scene
    distance = float(np.linalg.norm(rectangle.center))
    radius = 0.5 * float(np.hypot(*rectangle.size)) + np.sqrt(2) * frame
    if radius >= distance:
        return points, ranges
    cosine = np.sqrt(1 - (radius / distance) ** 2)
    inside = np.flatnonzero(points @ (rectangle.center / distance) > cosine * ranges)
    return points.take(inside, axis=0), ranges[inside]
