"""Detection of chessboard corners in an image: plain checkerboards and ChArUco boards, by OpenCV."""

from collections.abc import Iterator
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from calgraph.boards.checkerboard_regions import Region, find_regions, take_whole
from calgraph.boards.tags import Gray, Marks, empty_marks
from calgraph.config import Charuco, Checkerboard, dictionary
from calgraph.geometry import Array

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
    """Finds the chessboard corners of a ChArUco board whose neighbouring markers are visible."""

    def __init__(self, pattern: Charuco) -> None:
        shape = (pattern.columns, pattern.rows)
        ids = pattern.first_id + np.arange(pattern.columns * pattern.rows // 2)
        board = cv2.aruco.CharucoBoard(
            shape, pattern.square, pattern.marker, dictionary(pattern.dictionary), ids.astype(np.int32)
        )
        self._detector = cv2.aruco.CharucoDetector(board)

    def find(self, gray: Gray) -> Marks:
        """Inner corners in an image (height, width), each with its number."""
        # OpenCV's type stubs lack that it returns None where it finds nothing.
        found: tuple[Any, ...] = self._detector.detectBoard(gray)
        corners, ids = found[:2]
        if ids is None:
            return empty_marks(1)
        return Marks(np.asarray(ids, dtype=np.intp).ravel(), np.reshape(corners, (-1, 1, 2)).astype(np.float64))


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
