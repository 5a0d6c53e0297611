"""Predicted observations of board poses near those that a sensor has detected."""

from dataclasses import replace
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from calgraph.geometry import Array, Index, se3
from calgraph.rig.bundle.corner_observations import CornerObservations
from calgraph.rig.bundle.observations import BoardViews
from calgraph.rig.bundle.range_observations import RangeObservations

# Points along each side of a board that represent all beams on it; their weights add up to the number of beams.
_GRID = 7


# Shortest intersection of scan plane and board that is predicted to be detected, as a share of the shorter side.
_MIN_SEGMENT_SHARE = 1 / 3


def predict_observations(
    views: BoardViews,
    kind: str,
    T_detected: Array,
    T_candidate: Array,
    size: tuple[float, float],
) -> BoardViews:
    """Noise-free views of those candidate boards that the sensor is predicted to detect.

    Args:
        views: the views that the sensor has recorded.
        kind: camera, lidar2d or lidar3d.
        T_detected: ``T_sensor_board`` (V, 4, 4) of these views.
        T_candidate: ``T_sensor_board`` (K, 4, 4) of the candidates.
        size: width and height of the board, m.
    """
    visible = np.flatnonzero(_is_in_view(T_detected, T_candidate))
    if isinstance(views, CornerObservations):
        return _predict_corners(views, visible, T_candidate)
    assert isinstance(views, RangeObservations)
    if kind == "lidar2d":
        return _predict_scan_lines(views, visible, T_candidate, size, _MIN_SEGMENT_SHARE)
    return _predict_patches(views, visible, T_detected, T_candidate, size)


# rad (65°); maximum angle between the board normal and the line of sight at which a detection is predicted.
_MAX_PREDICTED_TILT = float(np.radians(65))
# rad (12°); a sensor is predicted to detect boards within this angle of one that it detected.
_MAX_BEARING_CHANGE = float(np.radians(12))
# The same for the ratio of distances: the density of points changes by 1.3² = 1.7, within what detection accepts.
_MAX_DISTANCE_RATIO = 1.3


def _is_in_view(T_detected: Array, T_candidate: Array) -> NDArray[np.bool_]:
    """(K,) which candidates face the sensor, near the bearing and distance of a detected board."""
    detected, center = T_detected[:, :3, 3], T_candidate[:, :3, 3]
    detected_distance, distance = np.linalg.norm(detected, axis=-1), np.linalg.norm(center, axis=-1)
    facing = -np.sum(center * T_candidate[:, :3, 2], axis=-1) > np.cos(_MAX_PREDICTED_TILT) * distance
    same_bearing = center @ detected.T > np.cos(_MAX_BEARING_CHANGE) * distance[:, None] * detected_distance
    same_distance = np.abs(np.log(distance[:, None] / detected_distance)) < np.log(_MAX_DISTANCE_RATIO)
    return np.asarray(facing & np.any(same_bearing & same_distance, axis=-1), dtype=np.bool_)


def _predict_corners(views: CornerObservations, visible: Index, T_candidate: Array) -> CornerObservations:
    """The corners of the view with the most, for boards that lie within the image as a whole."""
    counts = np.diff(views.start, append=len(views.pixels))
    if not len(counts):
        return views
    most = views.select(np.full(len(visible), np.argmax(counts)))
    points = se3.apply(T_candidate[visible], most.printed.nominal.reshape(len(visible), counts.max(), 3))
    pixels = views.camera.project(points.reshape(-1, 3))
    inside = np.all(views.camera.contains(pixels).reshape(points.shape[:2]), axis=1)
    return replace(most, board=visible, pixels=pixels).select(np.flatnonzero(inside))


def _predict_patches(
    views: RangeObservations, visible: Index, T_detected: Array, T_candidate: Array, size: tuple[float, float]
) -> RangeObservations:
    """Beams of a 3-D scanner over the whole board, of the density in solid angle of its recorded views."""
    counts = np.diff(views.start, append=len(views.ranges))
    density = float(np.median(counts / _solid_angle(T_detected, size))) if len(counts) else 0.0
    steps = (np.arange(_GRID) + 0.5) / _GRID - 0.5
    x, y = np.meshgrid(size[0] * steps, size[1] * steps)
    grid = np.column_stack([x.ravel(), y.ravel(), np.zeros(x.size)])
    return _predict_beams(
        views,
        visible,
        T_candidate,
        np.tile(grid, (len(visible), 1, 1)),
        density * _solid_angle(T_candidate[visible], size),
    )


def _solid_angle(T_sensor_board: Array, size: tuple[float, float]) -> Array:
    """(V,) sr, for a board that is small relative to its distance."""
    center = T_sensor_board[:, :3, 3]
    distance = np.linalg.norm(center, axis=-1)
    return np.asarray(size[0] * size[1] * np.abs(np.sum(center * T_sensor_board[:, :3, 2], axis=-1)) / distance**3)


def _predict_scan_lines(
    views: RangeObservations, visible: Index, T_candidate: Array, size: tuple[float, float], min_share: float
) -> RangeObservations:
    """Beams of a 2-D scanner along its intersection with the board, of the angular density of its views."""
    ends, length = _intersect_scan_plane(T_candidate[visible], size)
    detected = length > min_share * min(size)
    visible, ends = visible[detected], ends[detected]
    fraction = ((np.arange(_GRID) + 0.5) / _GRID)[:, None]
    points = ends[:, :1] + fraction * (ends[:, 1:] - ends[:, :1])
    bounds = [*views.start, len(views.ranges)]
    spans = [_angular_span(views.directions[a:b]) for a, b in pairwise(bounds)]
    density = float(np.median(np.diff(bounds) / np.maximum(spans, 1e-3))) if spans else 0.0
    edges = se3.apply(T_candidate[visible], ends)
    return _predict_beams(
        views, visible, T_candidate, points, density * np.array([_angular_span(pair) for pair in edges])
    )


def _intersect_scan_plane(T_sensor_board: Array, size: tuple[float, float]) -> tuple[Array, Array]:
    """Ends (V, 2, 3) of the intersections of boards with a sensor's plane z = 0, and lengths (V,), or 0."""
    gradient = T_sensor_board[:, 2, :2]
    steepness = np.maximum(np.linalg.norm(gradient, axis=-1), 1e-9)[:, None]
    nearest = -T_sensor_board[:, 2, 3:4] * gradient / steepness**2
    along = gradient[:, ::-1] * [-1, 1] / steepness
    half = np.array(size) / 2
    slope = np.where(np.abs(along) < 1e-9, 1e-9, along)
    crossings = np.sort(np.stack([(-half - nearest) / slope, (half - nearest) / slope]), axis=0)
    first, last = crossings[0].max(axis=-1), crossings[1].min(axis=-1)
    length = np.maximum(last - first, 0)
    flat = nearest[:, None] + np.stack([first, first + length], axis=-1)[..., None] * along[:, None]
    return np.concatenate([flat, np.zeros((len(flat), 2, 1))], axis=-1), length


def _angular_span(directions: Array) -> float:
    """The angle in the scan plane that directions (N, 3) cover, rad."""
    x, y = directions[:, :2].sum(axis=0)
    angles = np.arctan2(x * directions[:, 1] - y * directions[:, 0], x * directions[:, 0] + y * directions[:, 1])
    return float(np.ptp(angles))


def _predict_beams(
    views: RangeObservations, visible: Index, T_candidate: Array, points_board: Array, counts: Array
) -> RangeObservations:
    """Beams to points (V, n, 3) of the boards, weighted as ``counts`` (V,) beams."""
    points = se3.apply(T_candidate[visible], points_board).reshape(-1, 3)
    ranges = np.linalg.norm(points, axis=-1)
    each = points_board.shape[1]
    beams = views.with_beams(visible, np.arange(len(visible)) * each, points / ranges[:, None], ranges)
    beams = beams.update_noise(T_candidate[visible], views.noise_scale)
    return replace(beams, sigma=beams.sigma * np.sqrt(each / np.repeat(np.maximum(counts, 1e-6), each)))
