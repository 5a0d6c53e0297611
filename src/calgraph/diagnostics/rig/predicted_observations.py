"""What a sensor would measure of further boards, held where it saw boards before."""

from dataclasses import replace
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from calgraph.estimation.rig.observations import BoardViews, CornerObservations, RangeObservations
from calgraph.geometry import Array, Index, se3

# A sensor sees boards within this angle of one it saw, at distances that differ by at most this factor.
_ASIDE, _NEARER = np.radians(12), 1.3
# It sees boards that are turned away from it by up to this, rad.
_TURNED = np.radians(65)
# Points on a board that stand for all beams on it, along each of its sides.
_GRID = 7


def predict_observations(
    views: BoardViews, kind: str, T_seen: Array, T_tried: Array, size: tuple[float, float]
) -> BoardViews:
    """Views of those of the boards tried that the sensor would see; what they measure is exact.

    Args:
        views: what the sensor saw.
        kind: camera, lidar2d or lidar3d.
        T_seen: ``T_sensor_board`` (V, 4, 4) of its views.
        T_tried: ``T_sensor_board`` (K, 4, 4) of the boards to imagine.
        size: width and height of the board, m.
    """
    shown = np.flatnonzero(_is_in_view(T_seen, T_tried))
    if isinstance(views, CornerObservations):
        return _predict_corners(views, shown, T_tried)
    assert isinstance(views, RangeObservations)
    if kind == "lidar2d":
        return _predict_scan_lines(views, shown, T_tried, size)
    return _predict_patches(views, shown, T_seen, T_tried, size)


def _is_in_view(T_seen: Array, T_tried: Array) -> NDArray[np.bool_]:
    """(K,) which boards face the sensor, about where others did."""
    near, center = T_seen[:, :3, 3], T_tried[:, :3, 3]
    far, distance = np.linalg.norm(near, axis=-1), np.linalg.norm(center, axis=-1)
    facing = -np.sum(center * T_tried[:, :3, 2], axis=-1) > np.cos(_TURNED) * distance
    aside = center @ near.T > np.cos(_ASIDE) * distance[:, None] * far
    as_far = np.abs(np.log(distance[:, None] / far)) < np.log(_NEARER)
    return np.asarray(facing & np.any(aside & as_far, axis=-1), dtype=np.bool_)


def _predict_corners(views: CornerObservations, shown: Index, T_tried: Array) -> CornerObservations:
    """All corners that were ever seen at once, of boards that lie in the image as a whole."""
    counts = np.diff(views.start, append=len(views.pixels))
    if not len(counts):
        return views
    most = views.select(np.full(len(shown), np.argmax(counts)))
    points = se3.apply(T_tried[shown], most.corners_board.reshape(len(shown), counts.max(), 3))
    pixels = views.camera.project(points.reshape(-1, 3))
    inside = np.all(views.camera.contains(pixels).reshape(points.shape[:2]), axis=1)
    return replace(most, board=shown, pixels=pixels).select(np.flatnonzero(inside))


def _predict_patches(
    views: RangeObservations, shown: Index, T_seen: Array, T_tried: Array, size: tuple[float, float]
) -> RangeObservations:
    """Beams of a 3-D scanner all over the board, as densely in solid angle as it had them."""
    counts = np.diff(views.start, append=len(views.ranges))
    density = float(np.median(counts / _solid_angle(T_seen, size))) if len(counts) else 0.0
    steps = (np.arange(_GRID) + 0.5) / _GRID - 0.5
    x, y = np.meshgrid(size[0] * steps, size[1] * steps)
    grid = np.column_stack([x.ravel(), y.ravel(), np.zeros(x.size)])
    return _predict_beams(
        views, shown, T_tried, np.tile(grid, (len(shown), 1, 1)), density * _solid_angle(T_tried[shown], size)
    )


def _solid_angle(T_sensor_board: Array, size: tuple[float, float]) -> Array:
    """(V,) sr, of a board that is small before the sensor."""
    center = T_sensor_board[:, :3, 3]
    distance = np.linalg.norm(center, axis=-1)
    return np.asarray(size[0] * size[1] * np.abs(np.sum(center * T_sensor_board[:, :3, 2], axis=-1)) / distance**3)


def _predict_scan_lines(
    views: RangeObservations, shown: Index, T_tried: Array, size: tuple[float, float]
) -> RangeObservations:
    """Beams of a 2-D scanner along its cut through the board, as densely in angle as it had them."""
    ends, length = _intersect_scan_plane(T_tried[shown], size)
    long = length > min(size) / 3
    shown, ends = shown[long], ends[long]
    share = ((np.arange(_GRID) + 0.5) / _GRID)[:, None]
    places = ends[:, :1] + share * (ends[:, 1:] - ends[:, :1])
    bounds = [*views.start, len(views.ranges)]
    spans = [_angular_span(views.directions[a:b]) for a, b in pairwise(bounds)]
    density = float(np.median(np.diff(bounds) / np.maximum(spans, 1e-3))) if spans else 0.0
    edges = se3.apply(T_tried[shown], ends)
    return _predict_beams(
        views, shown, T_tried, places, density * np.array([_angular_span(pair) for pair in edges])
    )


def _intersect_scan_plane(T_sensor_board: Array, size: tuple[float, float]) -> tuple[Array, Array]:
    """Ends (V, 2, 3) of the cuts of a sensor's plane z = 0 through boards, and lengths (V,), 0 if it is none."""
    across = T_sensor_board[:, 2, :2]
    steep = np.maximum(np.linalg.norm(across, axis=-1), 1e-9)[:, None]
    nearest = -T_sensor_board[:, 2, 3:4] * across / steep**2
    along = across[:, ::-1] * [-1, 1] / steep
    half = np.array(size) / 2
    slope = np.where(np.abs(along) < 1e-9, 1e-9, along)
    walls = np.sort(np.stack([(-half - nearest) / slope, (half - nearest) / slope]), axis=0)
    first, last = walls[0].max(axis=-1), walls[1].min(axis=-1)
    length = np.maximum(last - first, 0)
    flat = nearest[:, None] + np.stack([first, first + length], axis=-1)[..., None] * along[:, None]
    return np.concatenate([flat, np.zeros((len(flat), 2, 1))], axis=-1), length


def _angular_span(directions: Array) -> float:
    """The angle in the scan plane that directions (N, 3) cover, rad."""
    x, y = directions[:, :2].sum(axis=0)
    angles = np.arctan2(x * directions[:, 1] - y * directions[:, 0], x * directions[:, 0] + y * directions[:, 1])
    return float(np.ptp(angles))


def _predict_beams(
    views: RangeObservations, shown: Index, T_tried: Array, places: Array, counts: Array
) -> RangeObservations:
    """Beams to places (V, n, 3) on the boards, which stand for ``counts`` (V,) of them."""
    points = se3.apply(T_tried[shown], places).reshape(-1, 3)
    ranges = np.linalg.norm(points, axis=-1)
    each = places.shape[1]
    beams = replace(
        views,
        board=shown,
        start=np.arange(len(shown)) * each,
        directions=points / ranges[:, None],
        ranges=ranges,
        sigma=np.ones(len(ranges)),
    ).update_noise(T_tried[shown], views.noise_scale)
    return replace(beams, sigma=beams.sigma * np.sqrt(each / np.repeat(np.maximum(counts, 1e-6), each)))
