"""Views that determine intrinsics best: spread over the image, over distances and over tilts."""

from collections.abc import Sequence

import numpy as np

from calgraph.config.settings import IntrinsicsSettings
from calgraph.geometry import Array
from calgraph.rig.detection.board_views import BoardView

_MIN_WIDTH_RATIO = 0.05
"""Corners whose extents have a smaller ratio are on one line, which determines no pose."""


def choose_views(views: Sequence[BoardView], settings: IntrinsicsSettings) -> list[BoardView]:
    """The views that determine a pose; of too many, those that differ most from each other.

    The first one chosen has the most corners, and each further one is the farthest from all before it.

    Args:
        views: all, of images of one size.
        settings: the number of views, and of their corners.
    """
    usable = [view for view in views if _determines_pose(view, settings.min_corners)]
    if len(usable) <= settings.max_views:
        return usable
    features = np.array([_describe_view(view) for view in usable])
    chosen = [int(np.argmax([len(view.flat_pixels) for view in usable]))]
    distance = np.linalg.norm(features - features[chosen[0]], axis=1)
    while len(chosen) < settings.max_views:
        chosen.append(int(np.argmax(distance)))
        distance = np.minimum(distance, np.linalg.norm(features - features[chosen[-1]], axis=1))
    return [usable[i] for i in sorted(chosen)]


def _determines_pose(view: BoardView, min_corners: int) -> bool:
    if len(view.flat_corners) < min_corners:
        return False
    for points in (view.flat_corners[:, :2], view.flat_pixels):
        singular_values = np.linalg.svd(points - points.mean(axis=0), compute_uv=False)
        if singular_values[1] < _MIN_WIDTH_RATIO * singular_values[0]:
            return False
    return True


def _describe_view(view: BoardView) -> Array:
    """(5,) place of the corners in the image, logarithm of their scale, and change of scale along both axes.

    The affine part of the map from the board to the image, its scale and anisotropy: all in units of order one.
    """
    corners, pixels = view.flat_corners[:, :2], view.flat_pixels
    width = view.size[0]
    A = np.linalg.lstsq(np.column_stack([corners, np.ones(len(corners))]), pixels, rcond=None)[0][:2] / width
    u, s, _ = np.linalg.svd(A)
    stretch = u @ np.diag(np.log(np.maximum(s, 1e-9))) @ u.T
    return np.concatenate([
        2 * pixels.mean(axis=0) / width,
        [0.5 * np.trace(stretch), stretch[0, 0] - stretch[1, 1], 2 * stretch[0, 1]],
    ])  # fmt: skip
