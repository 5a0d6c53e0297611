"""Detection of chessboard corners in an image: of checkerboards by saddle points, of ChArUco boards by OpenCV."""

from collections.abc import Sequence
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from calgraph.boards.saddle_lattices import MIN_SEEN, find_lattice, is_whole_board
from calgraph.boards.tags import Gray, Marks, empty_marks
from calgraph.config import Charuco, Checkerboard, dictionary
from calgraph.geometry import Array

_CRITERIA = (cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_COUNT, 40, 1e-3)
"""Steps of sub-pixel refinement end below 1e-3 pixels, a fiftieth of the noise, or after 40."""
_MAX_BEND = 0.5
"""Maximum second difference of corners found by saddle points, over the shorter distance between neighbours: a
board at 64 degrees that fills the image has 0.48, and a corner that is off by half a square 1."""

# Smallest distance of corners in the image in which they are found, pixels: below, rows are confused.
_MIN_GAP = 3.0
# Smallest distance of corners, pixels, in the image in which it is decided whether they are a whole board: its rim
# and its margin are not blurred with the squares.
_CLEAR_GAP = 16.0
# Longest side of the largest image that is searched, pixels: in an image of 4000 pixels, squares of 6.3 pixels are
# reduced to the smallest distance, and smaller ones are of boards too far away to locate well.
_LARGEST_SIDE = 1920
# Shorter side, pixels, above which images are halved: blurred corners are sharp in small images, which take a
# millisecond each.
_SMALLEST_SIDE = 120


class CheckerboardFinder:
    """Finds a whole checkerboard and identifies its corners.

    The top-left square of the print is dark. Where a half turn swaps colours (columns + rows odd) this fixes the
    orientation; otherwise the print is symmetric, and the end that is up in the image is taken as up. The board's
    plane is the same either way.
    """

    def __init__(self, pattern: Checkerboard) -> None:
        self.pattern = pattern

    def find(self, gray: Gray) -> Marks:
        """The inner corners of a whole board in an image (height, width) but for hidden ones, or none."""
        corners = self._find_corners(gray)
        if corners is None:
            return empty_marks(1)
        corners = _orient_corners(gray, corners, self.pattern.columns == self.pattern.rows)
        if corners is None:
            return empty_marks(1)
        number = np.flatnonzero(corners[..., 2])
        return Marks(number, corners.reshape(-1, 1, 3)[number, :, :2])

    def _find_corners(self, gray: Gray) -> Array | None:
        """Corners (rows, columns, 3) in some orientation, refined in the full image, with 1 at visible ones."""
        images = _reduce(gray)
        for small in reversed(images):
            found = find_lattice(small, self.pattern.rows, self.pattern.columns)
            if found is None or _measure_gap(found.places) < _MIN_GAP:
                continue
            lattice = _rescale(found.places, small, gray)
            if (lattice < 0).any() or (lattice > np.array(gray.shape[::-1]) - 1).any():
                continue
            corners, is_refined = _refine_corners(gray, lattice)
            is_seen = found.is_seen & is_refined
            if is_seen.mean() < MIN_SEEN or not _is_regular(corners):
                corners, is_seen = lattice, found.is_seen
            if _is_regular(corners) and _is_bounded([gray, *images], corners):
                return np.dstack([corners, is_seen])
        return None


def _is_bounded(images: Sequence[Gray], corners: Array) -> bool:
    """Whether corners (rows, columns, 2) of the largest image, the first, are those of a whole board."""
    for image in reversed(images):
        places = _rescale(corners, images[0], image)
        if _measure_gap(places) >= _CLEAR_GAP:
            break
    return is_whole_board(image, places)


def _rescale(pixels: Array, source: Gray, target: Gray) -> Array:
    """Pixels (..., 2) of an image in another one that shows the same."""
    return np.asarray((pixels + 0.5) * target.shape[::-1] / source.shape[::-1] - 0.5)


def _reduce(gray: Gray) -> list[Gray]:
    """An image (height, width), reduced to the largest side that is searched, and its halves, smallest last."""
    scale = min(1.0, _LARGEST_SIDE / max(gray.shape))
    images = [gray]
    if scale < 1:
        images = [
            np.asarray(cv2.resize(gray, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA), dtype=np.uint8)
        ]
    while min(images[-1].shape) > _SMALLEST_SIDE:
        half = cv2.resize(images[-1], None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA)
        images.append(np.asarray(half, dtype=np.uint8))
    return images


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


def _is_regular(lattice: Array) -> bool:
    """Whether each corner (rows, columns, 2) is near the middle of its neighbours, in distances between these."""
    for axis in (0, 1):
        steps = np.diff(lattice, axis=axis)
        bends = np.linalg.norm(np.diff(steps, axis=axis), axis=-1)
        lengths = np.linalg.norm(steps, axis=-1)
        shorter = np.minimum(np.delete(lengths, 0, axis), np.delete(lengths, -1, axis))
        if (bends > _MAX_BEND * shorter).any():
            return False
    return True


# Half width of the window of sub-pixel refinement, in squares of the checkerboard: at half a square, it reaches
# the next corner.
_CHECKERBOARD_WINDOW = 0.35
# Maximum half width of the window of sub-pixel refinement, pixels: larger ones are slow and bend with the lens.
_MAX_CHECKERBOARD_WINDOW = 12

# Largest step of refinement, in squares: it fails in glare, at shadows, and at blurred corners that are close
# together. Where it fails at most corners, as in blur, those that were found are good to a fraction of a pixel.
_MAX_REFINEMENT = 0.25


def _refine_corners(gray: Gray, lattice: Array) -> tuple[Array, NDArray[np.bool_]]:
    """Corners (rows, columns, 2) refined to sub-pixel accuracy in the full image, and where that succeeds."""
    # A window of fewer pixels than two to each side holds no edge.
    reach = int(np.clip(_CHECKERBOARD_WINDOW * _measure_gap(lattice), 2, _MAX_CHECKERBOARD_WINDOW))
    start = lattice.reshape(-1, 1, 2).astype(np.float32)
    refined = np.reshape(cv2.cornerSubPix(gray, start, (reach, reach), (-1, -1), _CRITERIA), lattice.shape)
    succeeds = np.linalg.norm(refined - lattice, axis=-1) < _MAX_REFINEMENT * _measure_gap(lattice)
    return np.where(succeeds[..., None], refined, lattice).astype(np.float64), succeeds


def _measure_gap(lattice: Array) -> float:
    """Shortest distance of neighbouring corners (rows, columns, 2), pixels."""
    return min(float(np.linalg.norm(np.diff(lattice, axis=axis), axis=-1).min()) for axis in (0, 1))


def _orient_corners(gray: Gray, lattice: Array, square: bool) -> Array | None:
    """The corners (rows, columns, 3), of which two are pixels, row by row from the top left of the print."""
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
    lattice = lattice[..., :2]
    middles = 0.25 * (lattice[:-1, :-1] + lattice[1:, :-1] + lattice[:-1, 1:] + lattice[1:, 1:])
    column, row = np.rint(middles).astype(int).reshape(-1, 2).T
    values = gray[row.clip(0, gray.shape[0] - 1), column.clip(0, gray.shape[1] - 1)].astype(np.float64)
    # The inner square next to the first corner is on a diagonal with the top-left one.
    same = np.indices(middles.shape[:2]).sum(axis=0).ravel() % 2 == 0
    if same.all():
        return True
    return bool(values[same].mean() < values[~same].mean())
