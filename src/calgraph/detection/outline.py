"""How well a flat patch of points fits a rectangular sheet of known size."""

from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from calgraph.geometry import Array, plane

_COARSE = np.radians(np.arange(0.0, 180.0, 15.0))
_FINE = np.radians(np.arange(-10.0, 11.0, 5.0))
# The outline of a sheet is blurred by noise, mixed pixels and the steps of the turn, m.
_SLACK = 0.03
_RASTER = 12
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
    coarse = max((_place(flat, turn, size) for turn in _COARSE), key=lambda placed: placed[0])
    _, turn, center, share = max((_place(flat, coarse[1] + t, size) for t in _FINE), key=lambda placed: placed[0])
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


def _place(flat: Array, turn: float, size: tuple[float, float]) -> tuple[tuple[float, float], float, Array, float]:
    """The best shift at one turn: ((share inside, minus the area spanned), turn, centre, share inside)."""
    cosine, sine = np.cos(turn), np.sin(turn)
    turned = flat @ np.array([[cosine, -sine], [sine, cosine]])
    keep = np.ones(len(flat), dtype=bool)
    for axis in (0, 1, 0):
        other = 1 - axis
        low, high = turned[keep, other].min(), turned[keep, other].max()
        within = (turned[:, other] >= low) & (turned[:, other] <= high)
        keep = within & _fullest_window(turned[:, axis], within, size[axis] + 2 * _SLACK)
    spanned = np.ptp(turned[keep], axis=0)
    center = 0.5 * (turned[keep].min(axis=0) + turned[keep].max(axis=0))
    share = float(keep.mean())
    return (share, -float(spanned[0] * spanned[1])), turn, center, share


def _fullest_window(values: Array, counted: Array, width: float) -> Array:
    """Which of the values (N,) lie in the window of this width that holds most of the counted ones."""
    ordered = np.sort(values[counted])
    count = np.searchsorted(ordered, ordered + width, side="right") - np.arange(len(ordered))
    start = ordered[int(np.argmax(count))]
    return np.asarray((values >= start) & (values <= start + width))


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
