"""How well a flat patch of points fits a rectangular sheet of known size."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from calgraph.geometry import Array, plane

Mask = NDArray[np.bool_]

_COARSE = np.radians(np.arange(0.0, 180.0, 15.0))
_FINE = np.radians(np.arange(-10.0, 11.0, 5.0))
# The outline of a sheet is blurred by noise, mixed pixels and the steps of the turn, m.
_SLACK = 0.03
_RASTER = 12
# Of sums of coordinates, m.
_ROUNDING = 1e-9
# What lies this far behind the sheet is seen past its edge, m.
_BEHIND = 0.10


@dataclass(frozen=True, eq=False)
class Sheet:
    """A rectangle of known size laid over a patch."""

    surface: Array
    """(4,) its plane."""
    axes: Array
    """(3, 2) unit vectors along width and height."""
    center: Array
    """(3,) m."""
    size: tuple[float, float]
    """Width and height, m."""
    extent: tuple[float, float]
    """What the patch spans along the two axes, m."""
    covered: float
    """Share of the rectangle that lies near points of the patch."""
    inside: float
    """Share of the patch that lies in the rectangle."""

    def coordinates(self, points: Array) -> Array:
        """(N, 2) coordinates of points (N, 3) along the sheet's axes from its centre, m."""
        return np.asarray((points - self.center) @ self.axes)


def lay_sheet(surface: Array, cells: Array, size: tuple[float, float], reach: float) -> Sheet:
    """Turns and shifts a rectangle until it holds as many cells as it can.

    Args:
        surface: (4,) plane of the patch.
        cells: (M, 3) points of the patch, evenly spaced, m.
        size: width and height of the rectangle, m.
        reach: how far from a cell the patch is known to continue, m: half the spacing of cells.

    """
    basis = plane.tangent_basis(surface[:3])
    origin = cells.mean(axis=0)
    flat = (cells - origin) @ basis
    turn, _, _ = _best_placed(flat, _COARSE, size)
    turn, center, share = _best_placed(flat, turn + _FINE, size)
    cosine, sine = np.cos(turn), np.sin(turn)
    rotation = np.array([[cosine, -sine], [sine, cosine]])
    axes = basis @ rotation
    turned = flat @ rotation
    width, height = np.ptp(np.quantile(turned, [0.01, 0.99], axis=0), axis=0) + 2 * reach
    ticks = (np.arange(_RASTER) + 0.5) / _RASTER - 0.5
    raster = np.stack(np.meshgrid(ticks * size[0], ticks * size[1]), axis=-1).reshape(-1, 2) + center
    distance, _ = cKDTree(turned).query(raster, distance_upper_bound=max(reach, 0.03))
    middle = origin + axes @ center
    middle = middle - (surface[:3] @ middle + surface[3]) * surface[:3]
    covered = float(np.isfinite(distance).mean())
    return Sheet(surface, axes, middle, size, (float(width), float(height)), covered, share)


def _best_placed(flat: Array, turns: Array, size: tuple[float, float]) -> tuple[float, Array, float]:
    """The turn, of (T,) to choose from, and the shift that hold most of the points (M, 2), in the least area.

    Returns:
        The turn, rad, the centre (2,) along the turned axes, m, and the share of the points held.

    """
    cosine, sine = np.cos(turns), np.sin(turns)
    turned = np.stack([np.outer(cosine, flat[:, 0]) + np.outer(sine, flat[:, 1]),
                       np.outer(cosine, flat[:, 1]) - np.outer(sine, flat[:, 0])])  # fmt: skip
    keep = np.ones(turned.shape[1:], dtype=np.bool_)
    for axis in (0, 1, 0):
        other = turned[1 - axis]
        low, high = _bounds(other, keep)
        within = (other >= low[:, None]) & (other <= high[:, None])
        keep = within & _fullest_window(turned[axis], within, size[axis] + 2 * _SLACK)
    bounds = np.array([_bounds(along, keep) for along in turned])
    area = np.prod(bounds[:, 1] - bounds[:, 0], axis=0)
    share = keep.mean(axis=1)
    best = np.lexsort([area, -share])[0]
    return float(turns[best]), bounds[:, :, best].mean(axis=1), float(share[best])


def _bounds(values: Array, counted: Mask) -> tuple[Array, Array]:
    """Smallest and largest of the counted values (T, M) in each row."""
    return np.where(counted, values, np.inf).min(axis=1), np.where(counted, values, -np.inf).max(axis=1)


def _fullest_window(values: Array, counted: Mask, width: float) -> Mask:
    """Which of the values (T, M) lie in the window of this width that holds most of the row's counted ones."""
    low = values.min()
    # Rows and what is not counted are set so far apart that one search over all rows sees no window reach across.
    apart = float(values.max() - low) + 2 * width
    ordered = np.sort(np.where(counted, values - low, apart), axis=1)
    rows = 3 * apart * np.arange(len(values))[:, None]
    ends = np.searchsorted((ordered + rows).ravel(), (ordered + rows + width).ravel(), side="right")
    held = np.where(
        ordered < apart, ends.reshape(ordered.shape) - np.arange(ordered.size).reshape(ordered.shape), 0
    )
    start = low + np.take_along_axis(ordered, held.argmax(axis=1)[:, None], axis=1)
    return np.asarray((values >= start - _ROUNDING) & (values <= start + width + _ROUNDING))


def standing_free(sheet: Sheet, scene: Array, thickness: float, frame: float) -> tuple[float, float]:
    """How solid a sheet is and how free it stands, from where the beams through and past it end.

    Args:
        sheet: the rectangle.
        scene: (N, 3) all points of the cloud, background included, m.
        thickness: how far from the plane a point still lies on it, m.
        frame: width of the frame around the sheet to look at, m.

    Returns:
        Of the beams through the sheet that are not stopped before it, the share that it stops; of the beams
        through the frame, the share that does not end on the sheet's plane. 0 to 1; 1 where there are none.

    """
    scene = _towards(sheet, scene, frame)
    facing = scene @ sheet.surface[:3]
    # Ranges relative to where each beam meets the plane; beams that never meet it are left out.
    ratio = np.where(facing < 0, -facing / max(sheet.surface[3], 1e-9), np.inf)
    toward = np.isfinite(ratio) & (ratio > 1e-3)
    hit = scene[toward] / ratio[toward, None]
    excess = np.linalg.norm(scene[toward], axis=1) * (1 - 1 / ratio[toward])
    outside = np.abs(sheet.coordinates(hit)) - 0.5 * np.array(sheet.size)
    margin = outside.max(axis=1)
    on = np.abs(excess) * sheet.surface[3] / np.linalg.norm(hit, axis=1) < thickness
    through = (margin < -_SLACK) & (on | (excess > _BEHIND))
    around = (margin > 2 * _SLACK) & (margin < 2 * _SLACK + frame)
    solid = float(on[through].mean()) if through.any() else 1.0
    free = 1.0 - float(on[around].mean()) if around.any() else 1.0
    return solid, free


def _towards(sheet: Sheet, scene: Array, frame: float) -> Array:
    """The points (N, 3) of the scene in the cone around the sheet and its frame; most others are never near."""
    distance = float(np.linalg.norm(sheet.center))
    radius = 0.5 * float(np.hypot(*sheet.size)) + np.sqrt(2) * (2 * _SLACK + frame)
    if radius >= distance:
        return scene
    squared_cosine = 1 - (radius / distance) ** 2
    along = scene @ (sheet.center / distance)
    ahead = (along > 0) & (along**2 > squared_cosine * np.einsum("ni,ni->n", scene, scene))
    return np.asarray(scene[ahead])
