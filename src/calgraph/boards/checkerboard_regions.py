"""Parts of an image with about as many saddle points of brightness as a checkerboard has corners.

Limits without a formula were chosen by ``benchmarks/checkerboard_recall.py``, seeds 0 to 499.
"""

from collections.abc import Iterator, Sequence
from typing import NamedTuple

import cv2
import numpy as np
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components
from scipy.spatial import KDTree

from calgraph.boards.tags import Gray
from calgraph.geometry import Array

_BLUR = 1.2
"""Standard deviation, pixels, of the blur of reduced images: that of a corner in a sharp one, and less than half
the smallest distance of corners, 3 pixels."""
_MIN_CURVATURE = 0.1
"""Minimum curvature of a saddle, in ranges of brightness around it: corners of boards have 0.1 to 0.2."""
_MIN_NOISE_RATIO, _MIN_GRAY_CURVATURE = 8.0, 0.3
"""Minimum curvature over the median of the image, and in grey values besides: of normal noise, one in a million
pixels has 7.3 times the median, and a contrast of 3 grey values has 0.3."""
_MAX_IMBALANCE = 0.8
"""Maximum sum of the two curvatures over the root of their product: 0 at corners of squares, more at
ends of edges."""
_RANGE_WINDOW = np.ones((7, 7), dtype=np.uint8)
_NEIGHBOURS = 8
"""Neighbours of a saddle that may be corners of the same board: where tilt shortens squares to a third, the two
nearest on either side are in its own row, and two more in the next ones."""
_MAX_LINK = 3.0
"""Maximum distance of saddles of a board, over that of the nearest: squares tilted by 70 degrees."""
_LEAST, _MOST = 0.8, 2.0
"""Saddles of a region over the corners of the board: glare hides some, and what is near the board adds others."""
_GROUPS = 2
"""Groups of saddles that are searched in one reduced image: a board, and something else of as many saddles."""
_MARGIN = 1.5
"""Margin of a region, in squares: the outer squares, and some of the white around them."""
_GAP = 15.0
"""Distance between neighbouring corners to which a region is reduced, pixels: the search takes time
in proportion to pixels, and its filters reach over 5 of them."""
_SAME, _SAME_SCALE = 0.8, 1.25
"""Common part of two regions, of both together, and ratio of their scales, within which they are the same."""


class Region(NamedTuple):
    """A part of an image, and the scale, at most 1, at which to search it.

    ``surplus`` is the absolute logarithm of its saddle points over the corners of the board.
    """

    left: int
    top: int
    right: int
    bottom: int
    scale: float
    surplus: float = 0.0

    def cut(self, gray: Gray) -> Gray:
        """The part of an image (height, width), reduced by the scale."""
        part = gray[self.top : self.bottom, self.left : self.right]
        if self.scale == 1:
            return part
        small = cv2.resize(part, None, fx=self.scale, fy=self.scale, interpolation=cv2.INTER_AREA)
        return np.asarray(small, dtype=np.uint8)


def take_whole(gray: Gray, side: int | None = None) -> Region:
    """The whole image (height, width), reduced to a longer side of at most this many pixels."""
    scale = 1.0 if side is None else min(1.0, side / max(gray.shape))
    return Region(0, 0, gray.shape[1], gray.shape[0], scale)


def find_regions(gray: Gray, corners: int, sides: Sequence[int]) -> Iterator[Region]:
    """Parts of an image (height, width) that may contain a checkerboard with a number of inner corners.

    Saddle points are found in images that are reduced to longer sides of ``sides`` pixels, one after the other.
    """
    found: list[Region] = []
    for side in sides:
        # An image of less than half the side is the same as at the previous side, which did not reduce it.
        if side > 2 * max(gray.shape):
            return
        small = take_whole(gray, side).cut(gray)
        for group in _group_saddles(find_saddles(small), corners):
            region = _enclose(group, gray, small)
            if not any(_overlap(region, other) for other in found):
                found.append(region)
                yield region


def find_saddles(gray: Gray) -> Array:
    """Pixels (N, 2) at which brightness has a maximum along one line and a minimum along another."""
    smooth = cv2.GaussianBlur(gray.astype(np.float32), (0, 0), _BLUR)
    # The kernels' sums of weights are 4.
    xx, yy, xy = (cv2.Sobel(smooth, -1, *order, scale=0.25) for order in ((2, 0), (0, 2), (1, 1)))
    squared = xy * xy - xx * yy
    squared[(xx + yy) ** 2 > _MAX_IMBALANCE**2 * squared] = 0
    # Few pixels have a twist: those of corners. The median is that of noise; every ninth pixel is enough for it.
    least = _MIN_NOISE_RATIO * float(np.median(np.abs(xy[::3, ::3]))) + _MIN_GRAY_CURVATURE
    is_peak = squared >= cv2.dilate(squared, np.ones((3, 3), dtype=np.uint8))
    row, column = np.nonzero(is_peak & (squared > least**2))
    brightness = cv2.dilate(smooth, _RANGE_WINDOW) - cv2.erode(smooth, _RANGE_WINDOW)
    sharp = squared[row, column] > (_MIN_CURVATURE * brightness[row, column]) ** 2
    return np.stack([column[sharp], row[sharp]], axis=-1).astype(np.float64)


class _Group(NamedTuple):
    """Neighbouring saddles: first and last pixel (2), medians of the distances to the first and third nearest.

    ``surplus`` is that of a region.
    """

    first: Array
    last: Array
    gap: float
    wide_gap: float
    surplus: float


def _group_saddles(saddles: Array, corners: int) -> list[_Group]:
    """Groups of saddles (N, 2) with about as many as a number of corners, the most similar number first."""
    if len(saddles) < max(_LEAST * corners, _NEIGHBOURS + 1):
        return []
    distances, neighbours = KDTree(saddles).query(saddles, k=_NEIGHBOURS + 1)
    linked = distances[:, 1:] < _MAX_LINK * distances[:, 1:2]
    one = np.repeat(np.arange(len(saddles)), _NEIGHBOURS)[linked.ravel()]
    links = coo_matrix((np.ones(len(one)), (one, neighbours[:, 1:][linked])), shape=(len(saddles),) * 2).tocsr()
    # Both must be near for each other: clutter is less dense than a board, or denser.
    _, label = connected_components(links.minimum(links.T), directed=False)
    groups = []
    for number, count in enumerate(np.bincount(label)):
        if _LEAST * corners <= count <= _MOST * corners:
            own = label == number
            gap, wide_gap = np.median(distances[own][:, [1, 3]], axis=0)
            surplus = abs(float(np.log(count / corners)))
            groups.append(_Group(saddles[own].min(axis=0), saddles[own].max(axis=0), gap, wide_gap, surplus))
    return sorted(groups, key=lambda group: group.surplus)[:_GROUPS]


def _enclose(group: _Group, gray: Gray, small: Gray) -> Region:
    """The region of a group of saddles that were found in a reduced image."""
    ratio = gray.shape[1] / small.shape[1]
    margin = _MARGIN * group.wide_gap
    left, top = np.floor(np.maximum((group.first - margin) * ratio, 0)).astype(int).tolist()
    right, bottom = np.ceil(np.minimum((group.last + margin) * ratio, gray.shape[::-1])).astype(int).tolist()
    return Region(left, top, right, bottom, min(1.0, _GAP / (group.gap * ratio)), group.surplus)


def _overlap(a: Region, b: Region) -> bool:
    """Whether two regions have nearly the same place and scale."""
    width, height = min(a.right, b.right) - max(a.left, b.left), min(a.bottom, b.bottom) - max(a.top, b.top)
    common = max(width, 0) * max(height, 0)
    areas = sum((one.right - one.left) * (one.bottom - one.top) for one in (a, b))
    return common > _SAME * (areas - common) and 1 / _SAME_SCALE < a.scale / b.scale < _SAME_SCALE
