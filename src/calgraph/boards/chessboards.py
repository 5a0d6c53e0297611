"""Detection of chessboard corners in an image: plain checkerboards and ChArUco boards, by OpenCV."""

from collections.abc import Iterator, Sequence
from typing import Any, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_matrix
from scipy.spatial import KDTree

from calgraph.boards.tags import Gray, Marks, empty_marks
from calgraph.config import Charuco, Checkerboard, dictionary
from calgraph.geometry import Array
from calgraph.solver.connected_parts import label_parts

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
    label = label_parts(len(saddles), np.transpose(links.minimum(links.T).nonzero()))
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


_CRITERIA = (cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_COUNT, 40, 1e-3)
"""Steps of sub-pixel refinement end below 1e-3 pixels, a fiftieth of the noise, or after 40."""
_MAX_BEND = 0.5
"""Maximum second difference of corners found by saddle points, over the shorter distance between neighbours: a
board at 64 degrees that fills the image has 0.48, and a corner that is off by half a square 1."""
_MAX_SURPLUS = 0.1
"""Largest logarithm of saddle points over corners at which a region contains the board rather than something else:
10 %, chosen by ``benchmarks/checkerboard_recall.py``."""
_MAX_WHOLE = 1_000_000
"""Most pixels of images that are searched as a whole even if a region contains the board: the search then takes no
longer than that of a large region."""


# Maximum second difference of corners found by squares, over the shorter distance between neighbours: wrong
# corners are off by half a square; a board at 45° has 0.19 at 1.4 times its width. Beyond it the search by saddle
# points decides.
_MAX_CHECKERBOARD_BEND = 0.2
# Longer sides, pixels, to which an image is reduced to find where a checkerboard may be, one after the other:
# blurred corners are sharp in small images, those of small squares are apart in large ones. All four take 0.15 s
# for 12 megapixels. What is found is searched in the full image, or reduced to squares of 15 pixels.
_CHECKERBOARD_SIDES = (240, 480, 960, 1920)
# Longer side, pixels, to which an image is reduced for the first search of a checkerboard, by its squares: it
# takes 5 ms to 30 ms, and fails in blurred and shaded images and for small squares, which the search by saddle
# points then takes.
_CHECKERBOARD_FIRST_SIDE = 960


class CheckerboardFinder:
    """Finds a whole checkerboard and identifies its corners.

    The top-left square of the print is dark. Where a half turn swaps colours (columns + rows odd) this fixes the
    orientation; otherwise the print is symmetric, and the end that is up in the image is taken as up. The board's
    plane is the same either way.
    """

    def __init__(self, pattern: Checkerboard) -> None:
        self.pattern = pattern

    def find(self, gray: Gray) -> Marks:
        """All inner corners of the board in an image (height, width), or none."""
        corners = self._find_corners(gray)
        if corners is None:
            return empty_marks(1)
        corners = _orient_corners(gray, corners, self.pattern.columns == self.pattern.rows)
        if corners is None:
            return empty_marks(1)
        return Marks(np.arange(corners.shape[0] * corners.shape[1]), corners.reshape(-1, 1, 2))

    def _find_corners(self, gray: Gray) -> Array | None:
        """Corners (rows, columns, 2) in some orientation, refined in the full image."""
        lattice = self._find_lattice_by_squares(gray)
        if lattice is not None:
            corners = _refine_corners(gray, lattice)
            if _is_regular(corners, _MAX_CHECKERBOARD_BEND):
                return corners
        for region, flags in self._list_searches(gray):
            lattice = self._find_lattice_by_saddles(gray, region, flags)
            if lattice is not None:
                # Refinement fails at blurred corners that are close together; those that were found are good to a
                # fraction of a pixel, too.
                for corners in (_refine_corners(gray, lattice), lattice):
                    if _is_regular(corners, _MAX_BEND):
                        return corners
        return None

    def _list_searches(self, gray: Gray) -> Iterator[tuple[Region, int]]:
        """Parts of an image and flags of searches by saddle points, in the order in which they are tried."""
        regions: list[Region] = []
        corners = self.pattern.columns * self.pattern.rows
        for region in find_regions(gray, corners, _CHECKERBOARD_SIDES):
            regions.append(region)
            yield region, 0
        # Normalisation loses boards where all around them is dark or glares, and finds those of low contrast or
        # partly in shadow; it may also find other things.
        for region in regions:
            yield region, cv2.CALIB_CB_NORMALIZE_IMAGE
        # Saddles of a board may be in no group, as where much of it is in shadow.
        noticed = any(region.surplus < _MAX_SURPLUS for region in regions)
        if not noticed or gray.size <= _MAX_WHOLE:
            yield take_whole(gray, _CHECKERBOARD_FIRST_SIDE), 0

    def _find_lattice_by_squares(self, gray: Gray) -> Array | None:
        """Corners (rows, columns, 2) between dark quadrilaterals.

        It fails in more images than the search by saddles: blurred, shaded, or with squares of few pixels.
        """
        whole = take_whole(gray, _CHECKERBOARD_FIRST_SIDE)
        small = whole.cut(gray)
        flags = cv2.CALIB_CB_ADAPTIVE_THRESH | cv2.CALIB_CB_NORMALIZE_IMAGE
        found, corners = cv2.findChessboardCorners(small, self._shape, flags=flags)
        return self._to_lattice(corners, whole, small) if found else None

    def _find_lattice_by_saddles(self, gray: Gray, region: Region, flags: int) -> Array | None:
        """Corners (rows, columns, 2) at saddle points of brightness in a part of an image."""
        small = region.cut(gray)
        # It draws random numbers: with the same seed, an image has the same corners in every run and process.
        cv2.setRNGSeed(0)
        found, corners = cv2.findChessboardCornersSB(small, self._shape, flags=flags)
        return self._to_lattice(corners, region, small) if found else None

    @property
    def _shape(self) -> tuple[int, int]:
        return self.pattern.columns, self.pattern.rows

    def _to_lattice(self, corners: NDArray[Any], region: Region, small: Gray) -> Array:
        """Corners (N, 1, 2) found in a reduced part, as (rows, columns, 2) in the full image."""
        lattice = np.reshape(corners, (self.pattern.rows, self.pattern.columns, 2)).astype(np.float64)
        ratio = np.array([region.right - region.left, region.bottom - region.top]) / small.shape[::-1]
        return np.asarray((lattice + 0.5) * ratio - 0.5 + (region.left, region.top))


class CharucoFinder:
    """Finds the chessboard corners of a ChArUco board whose neighbouring markers are visible.

    Before OpenCV 4.6, a board with an even number of rows had a white square with a marker at the top left. Boards
    of that layout are still sold: they are recognised by their markers, which are next to other corners.
    """

    def __init__(self, pattern: Charuco) -> None:
        shape = (pattern.columns, pattern.rows)
        ids = pattern.first_id + np.arange(pattern.columns * pattern.rows // 2)
        self._detectors = []
        for legacy in (False, True) if pattern.rows % 2 == 0 else (False,):
            board = cv2.aruco.CharucoBoard(
                shape, pattern.square, pattern.marker, dictionary(pattern.dictionary), ids.astype(np.int32)
            )
            board.setLegacyPattern(legacy)
            self._detectors.append(cv2.aruco.CharucoDetector(board))

    def find(self, gray: Gray) -> Marks:
        """Inner corners in an image (height, width), each with its number."""
        for detector in self._detectors:
            # OpenCV's type stubs lack that it returns None where it finds nothing.
            found: tuple[Any, ...] = detector.detectBoard(gray)
            corners, ids, _, markers = found
            if ids is not None:
                return Marks(
                    np.asarray(ids, dtype=np.intp).ravel(),
                    np.reshape(corners, (-1, 1, 2)).astype(np.float64),
                    legacy=detector is not self._detectors[0],
                )
            if markers is None:
                break
        return empty_marks(1)


def _is_regular(lattice: Array, max_bend: float) -> bool:
    """Whether each corner (rows, columns, 2) is near the middle of its neighbours, in distances between these."""
    for axis in (0, 1):
        steps = np.diff(lattice, axis=axis)
        bends = np.linalg.norm(np.diff(steps, axis=axis), axis=-1)
        lengths = np.linalg.norm(steps, axis=-1)
        shorter = np.minimum(np.delete(lengths, 0, axis), np.delete(lengths, -1, axis))
        if (bends > max_bend * shorter).any():
            return False
    return True


# Half width of the window of sub-pixel refinement, in squares of the checkerboard: at half a square, it reaches
# the next corner.
_CHECKERBOARD_WINDOW = 0.35
# Maximum half width of the window of sub-pixel refinement, pixels: larger ones are slow and bend with the lens.
_MAX_CHECKERBOARD_WINDOW = 12


def _refine_corners(gray: Gray, lattice: Array) -> Array:
    """Corners (rows, columns, 2) refined to sub-pixel accuracy in the full image."""
    gaps = [np.linalg.norm(np.diff(lattice, axis=axis), axis=-1).min() for axis in (0, 1)]
    # A window of fewer pixels than two to each side holds no edge.
    reach = int(np.clip(_CHECKERBOARD_WINDOW * min(gaps), 2, _MAX_CHECKERBOARD_WINDOW))
    start = lattice.reshape(-1, 1, 2).astype(np.float32)
    return np.reshape(cv2.cornerSubPix(gray, start, (reach, reach), (-1, -1), _CRITERIA), lattice.shape).astype(
        np.float64
    )


def _orient_corners(gray: Gray, lattice: Array, square: bool) -> Array | None:
    """The corners (rows, columns, 2) row by row from the top left of the print."""
    orientations = [lattice, lattice[::-1], lattice[:, ::-1], lattice[::-1, ::-1]]
    if square:
        orientations += [np.swapaxes(turn, 0, 1) for turn in orientations]
    # In an image (y down) the print's right and down are right-handed; its mirror images are not.
    unmirrored = [turn for turn in orientations if _compute_handedness(turn) > 0]
    if not unmirrored:
        return None
    dark_first = [turn for turn in unmirrored if _first_square_is_dark(gray, turn)]
    upright = [-(turn[-1] - turn[0]).mean(axis=0)[1] for turn in dark_first or unmirrored]
    return (dark_first or unmirrored)[int(np.argmin(upright))]


def _compute_handedness(lattice: Array) -> float:
    right, down = (lattice[:, -1] - lattice[:, 0]).mean(axis=0), (lattice[-1] - lattice[0]).mean(axis=0)
    return float(right[0] * down[1] - right[1] * down[0])


def _first_square_is_dark(gray: Gray, lattice: Array) -> bool:
    """Whether the squares of the same colour as the top-left one are the dark ones."""
    middles = 0.25 * (lattice[:-1, :-1] + lattice[1:, :-1] + lattice[:-1, 1:] + lattice[1:, 1:])
    column, row = np.rint(middles).astype(int).reshape(-1, 2).T
    values = gray[row.clip(0, gray.shape[0] - 1), column.clip(0, gray.shape[1] - 1)].astype(np.float64)
    # The inner square next to the first corner is on a diagonal with the top-left one.
    same = np.indices(middles.shape[:2]).sum(axis=0).ravel() % 2 == 0
    if same.all():
        return True
    return bool(values[same].mean() < values[~same].mean())
