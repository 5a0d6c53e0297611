"""Lattices of saddle points in an image: the inner corners of checkerboards.

At a corner of four squares brightness has a saddle: its two edges, along which brightness does not change, lead to
its neighbours, at which dark and bright are exchanged. Lattices grow from crosses of five corners (A. Geiger,
F. Moosmann, O. Car, B. Schuster: Automatic camera and range sensor calibration using a single shot, 2012).
"""

from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from calgraph.geometry import Array

Gray = NDArray[np.uint8]
Brightness = NDArray[np.float32]
Indices = NDArray[np.intp]
Places = NDArray[np.complex128]
"""Pixels x + iy: half as many operations as with two numbers each."""


class Saddles(NamedTuple):
    """Saddle points of brightness."""

    points: Array
    """(N, 2) pixels."""
    curvatures: Array
    """(N, 3) second derivatives xx, xy, yy, scaled to a determinant of -1."""


# Standard deviation of the blur before derivatives, pixels: that of a corner in a sharp image, and less than half
# the smallest distance of corners, 3 pixels.
_BLUR = 1.2
# Distance from which pixels do not matter for a blurred one: half of OpenCV's kernel of 11 pixels, and a rounding.
_BLUR_REACH = 7
# Minimum curvature over the median of the image, and in grey values besides: of normal noise, one in a million
# pixels has 7.3 times the median, and a contrast of 3 grey values has 0.3.
_MIN_NOISE_RATIO, _MIN_GRAY_CURVATURE = 8.0, 0.3
# Step between the pixels of which the median is taken: one in 25 is enough for it.
_MEDIAN_STEP = 5
# Maximum sum of the two curvatures over the root of their product: 0 where straight edges cross at any angle, more
# at ends of edges.
_MAX_IMBALANCE = 0.8
# Minimum curvature, in ranges of brightness around the saddle: corners of boards have 0.1 to 0.2.
_MIN_CURVATURE = 0.1
# Half width of the square in which that range is taken, pixels.
_REACH = 3


def _blur(gray: Gray) -> Brightness:
    return np.asarray(cv2.GaussianBlur(gray.astype(np.float32), (0, 0), _BLUR), dtype=np.float32)


def _find_saddles(smooth: Brightness) -> Saddles:
    """Pixels of a blurred image (height, width) that are brightest along one line and darkest along another."""
    # The kernels' sums of weights are 4.
    xx, yy, xy = (cv2.Sobel(smooth, -1, *order, scale=0.25) for order in ((2, 0), (0, 2), (1, 1)))
    # Products by OpenCV: NumPy's take three times as long for images.
    squared = cv2.subtract(cv2.multiply(xy, xy), cv2.multiply(xx, yy))
    least = _MIN_NOISE_RATIO * float(np.median(np.abs(xy[::_MEDIAN_STEP, ::_MEDIAN_STEP]))) + _MIN_GRAY_CURVATURE
    highest = cv2.dilate(squared, np.ones((3, 3), dtype=np.uint8))
    row, column = np.divmod(np.flatnonzero(squared > least**2), smooth.shape[1])
    is_peak = squared[row, column] == highest[row, column]
    row, column = row[is_peak], column[is_peak]
    a, b, c, power = (image[row, column].astype(np.float64) for image in (xx, xy, yy, squared))
    padded = cv2.copyMakeBorder(smooth, _REACH, _REACH, _REACH, _REACH, cv2.BORDER_REPLICATE)
    windows = np.lib.stride_tricks.sliding_window_view(padded, (2 * _REACH + 1, 2 * _REACH + 1))
    around = windows[row, column].astype(np.float64)
    kept = (a + c) ** 2 < _MAX_IMBALANCE**2 * power
    kept &= power > (_MIN_CURVATURE * np.ptp(around, axis=(1, 2))) ** 2
    row, column, a, b, c, power, around = (values[kept] for values in (row, column, a, b, c, power, around))
    # Where the gradient is zero: one step of Newton's method, of at most a pixel.
    gx = 0.5 * (around[:, _REACH, _REACH + 1] - around[:, _REACH, _REACH - 1])
    gy = 0.5 * (around[:, _REACH + 1, _REACH] - around[:, _REACH - 1, _REACH])
    step = np.stack([c * gx - b * gy, a * gy - b * gx], axis=-1) / power[:, None]
    points = np.stack([column, row], axis=-1) + step.clip(-1, 1)
    return Saddles(points, np.stack([a, b, c], axis=-1) / np.sqrt(power)[:, None])


class Lattice(NamedTuple):
    """The inner corners of a checkerboard."""

    places: Array
    """(rows, columns, 2) pixels; those of hidden corners are predicted by their neighbours, and may lie outside of
    the image."""
    is_seen: NDArray[np.bool_]
    """(rows, columns) whether there is a saddle."""


def find_lattice(gray: Gray, rows: int, columns: int) -> Lattice | None:
    """The inner corners of a whole checkerboard, in some orientation.

    Args:
        gray: image (height, width) in which neighbouring corners are 3 pixels apart at least, and sharp.
        rows: number of inner corners in a column.
        columns: in a row.
    """
    smooth = _blur(gray)
    saddles = _find_saddles(smooth)
    if len(saddles.points) < MIN_SEEN * rows * columns:
        return None
    tree = cKDTree(saddles.points)
    tried = np.zeros(len(saddles.points), dtype=np.bool_)
    # The last place is that of index -1, which cells of a lattice without a saddle have.
    places = np.append(_to_places(saddles.points), _NOWHERE)
    for cross in _find_crosses(saddles, tree, (rows > 2) + (columns > 2)):
        if not tried[cross[cross >= 0]].any():
            lattice = _grow_lattice(cross, saddles.curvatures, places, tree, max(rows, columns))
            tried[lattice[lattice >= 0]] = True
            board = _cut_board(places[lattice], smooth, rows, columns)
            if board is not None:
                return board
    return None


# Neighbours of a saddle among which are those of its board: where tilt shortens squares to a third, six are nearer
# than the two in the next rows, and four are as near.
_NEIGHBOURS = 12
# Largest second derivative along the line between neighbours, over that along the bisectors of edges:
# 0 along edges that cross at a right angle, 0.7 where they cross at 45 degrees.
_MAX_EDGE_CURVATURE = 0.85
# Smallest sine of the angle between the two edges of a corner.
_MIN_EDGE_SINE = 0.4
# Maximum distance of a corner from its opposite neighbour's mirror image, over the shorter of the two distances.
_MAX_CROSS_BEND = 0.5
# Product of two saddles' derivatives below which they are of opposite signs: equal ones have 2, crossed ones -2.
_MAX_PRODUCT = -0.5


def _find_crosses(saddles: Saddles, tree: cKDTree, pairs: int) -> Indices:
    """Saddles (M, 5) with neighbours along both edges: the middle, one along each, and those opposite of them.

    Args:
        saddles: of an image.
        tree: of their points.
        pairs: edges along which there must be a neighbour on either side; the index of one that lacks is -1.
    """
    points, curvatures = saddles
    count = min(_NEIGHBOURS + 1, len(points))
    neighbours = tree.query(points, k=count)[1][:, 1:]
    away = points[neighbours] - points[:, None]
    lengths = np.linalg.norm(away, axis=-1)
    along = away / np.maximum(lengths, 1e-9)[..., None]
    off = np.maximum(*(np.abs(_curve_along(one, along)) for one in (curvatures[:, None], curvatures[neighbours])))
    linked = _are_opposite(curvatures[:, None], curvatures[neighbours]) & (off < _MAX_EDGE_CURVATURE)
    row = np.arange(len(points))

    def choose_nearest(allowed: NDArray[np.bool_]) -> tuple[Indices, NDArray[np.bool_]]:
        nearest = np.where(allowed, lengths, np.inf).argmin(axis=1)
        return nearest, allowed[row, nearest]

    def choose_opposite(side: Indices) -> tuple[Indices, NDArray[np.bool_]]:
        bend = np.linalg.norm(away + away[row, side][:, None], axis=-1)
        return choose_nearest(linked & (bend < _MAX_CROSS_BEND * np.minimum(lengths, lengths[row, side][:, None])))

    right, has_right = choose_nearest(linked)
    sines = np.abs(along[..., 0] * along[row, right, 1][:, None] - along[..., 1] * along[row, right, 0][:, None])
    down, has_down = choose_nearest(linked & (sines > _MIN_EDGE_SINE))
    left, has_left = choose_opposite(right)
    up, has_up = choose_opposite(down)
    arms = [
        np.where(has, neighbours[row, arm], -1)
        for arm, has in ((right, has_right), (down, has_down), (left, has_left), (up, has_up))
    ]
    is_cross = has_right & has_down & (has_left.astype(int) + has_up >= pairs)
    return np.stack([row, *arms], axis=-1)[is_cross]


def _are_opposite(one: Array, other: Array) -> NDArray[np.bool_]:
    """Whether saddles with derivatives (..., 3) have dark and bright exchanged."""
    return np.asarray((one * other) @ [1.0, 2.0, 1.0] < _MAX_PRODUCT)


def _curve_along(curvatures: Array, directions: Array) -> Array:
    """Second derivative of saddles (..., 3) along directions (..., 2)."""
    x, y = directions[..., 0], directions[..., 1]
    return curvatures[..., 0] * x * x + 2 * curvatures[..., 1] * x * y + curvatures[..., 2] * y * y


_AROUND = np.array([
    (0, 1), (1, 0), (0, -1), (-1, 0), (1, 1), (1, -1), (-1, -1), (-1, 1), (0, 2), (2, 0), (0, -2), (-2, 0)
])  # fmt: skip
"""Rows and columns of a place's neighbours: the arms of a cross, those between one arm and the next, and those
behind the arms."""
_NEXT_ARM = [1, 2, 3, 0]
# Maximum distance of a saddle from where its neighbours predict it, in distances to the nearest of them.
_MAX_OFFSET = 0.35
# Lines by which a lattice may be longer than the board: what is beside a board adds some saddles.
_MOST_SURPLUS = 3


def _to_places(pixels: Array) -> Places:
    """Places (...) of pixels (..., 2)."""
    return np.ascontiguousarray(pixels).view(np.complex128)[..., 0]


def _to_pixels(places: Places) -> Array:
    """Pixels (..., 2) of places (...)."""
    return np.ascontiguousarray(places).view(np.float64).reshape(*places.shape, 2)


_NOWHERE = complex(np.nan, np.nan)


def _grow_lattice(cross: Indices, curvatures: Array, places: Places, tree: cKDTree, longest: int) -> Indices:
    """Saddles by row and column of the lattice that contains a cross, -1 where there is none.

    Args:
        cross: (5) saddles, -1 where there is none.
        curvatures: (N, 3) of all saddles.
        places: (N + 1,) of all saddles, and NaN.
        tree: of the places.
        longest: number of corners in the longer line of the board.
    """
    width = 2 * (longest + _MOST_SURPLUS + 3) + 1
    around = _AROUND @ [width, 1]
    lattice = np.full(width * width, -1)
    added = lattice.size // 2 + np.append(0, around[:4])
    lattice[added] = cross
    free = np.ones(len(curvatures), dtype=np.bool_)
    free[cross[cross >= 0]] = False
    while True:
        # Where no neighbour is new, there is no saddle again.
        changed = np.zeros(len(lattice), dtype=np.bool_)
        changed[added[:, None] + around] = True
        cell = np.flatnonzero(changed & (lattice < 0))
        beside = lattice[cell[:, None] + around]
        of_beside = places[beside]
        expected = _predict_places(of_beside)
        known = ~np.isnan(expected)
        cell, beside, expected = cell[known], beside[known], expected[known]
        steps = np.abs(of_beside[known, :4] - expected[:, None])
        steps[beside[:, :4] < 0] = np.inf
        nearest = np.arange(len(cell)), steps.argmin(axis=1)
        distance, saddle = tree.query(_to_pixels(expected))
        fits = (distance < _MAX_OFFSET * steps[nearest]) & free[saddle]
        fits &= _are_opposite(curvatures[beside[nearest]], curvatures[saddle])
        # A saddle that is expected at two cells is at the first one.
        saddle, first = np.unique(saddle[fits], return_index=True)
        added = cell[fits][first]
        lattice[added], free[saddle] = saddle, False
        if not len(added) or _is_too_long(lattice.reshape(width, width) >= 0, longest):
            return lattice.reshape(width, width)


def _is_too_long(is_saddle: NDArray[np.bool_], longest: int) -> bool:
    """Whether a lattice has more lines than that of a board with a number of corners in its longer line."""
    return bool(np.ptp(np.nonzero(is_saddle), axis=1).max() >= longest + _MOST_SURPLUS)


def _predict_places(around: Places) -> Places:
    """Where their neighbours (M, 12) put places (M,), NaN if they do not.

    Three neighbours are corners of a parallelogram with it, which perspective bends less than the line of two.
    """
    arms = around[:, :4]
    turns, lines = arms + arms[:, _NEXT_ARM] - around[:, 4:8], 2 * arms - around[:, 8:]
    by_turns = _average_known(turns)
    unknown = np.isnan(by_turns)
    by_turns[unknown] = _average_known(lines[unknown])
    return by_turns


def _average_known(guesses: Places) -> Places:
    """Means (M,) of those of guesses (M, 4) that are not NaN."""
    known = ~np.isnan(guesses)
    count = known.sum(axis=1)
    total = np.sum(guesses, axis=1, where=known)
    return np.asarray(np.where(count, total / np.maximum(count, 1), _NOWHERE))


# Smallest shares of corners with a saddle, as glare hides some, and of those between four squares: boards in glare
# have 0.93, and holes in a sheet, whose lattices have gaps, 0.9.
MIN_SEEN, _MIN_SHARE = 0.8, 0.92
# Share that is exceeded by both in every line of the board, and in no line beside it: shifted by a line, a board
# would have fewer corners.
_LINE_SHARE = 0.5


def _cut_board(places: Places, smooth: Brightness, rows: int, columns: int) -> Lattice | None:
    """The part (rows, columns) of a lattice that is a checkerboard, none if it is not whole or of a larger one.

    At the rim of a board are saddles that continue its lattice, but no corners of four squares.

    Args:
        places: (M, M) of saddles, NaN where there is none.
        smooth: image in which they are.
        rows: number of inner corners in a column.
        columns: in a row.
    """
    is_saddle = ~np.isnan(places)
    if is_saddle.sum() < MIN_SEEN * rows * columns or _is_too_long(is_saddle, max(rows, columns)):
        return None
    # Every line of a board has saddles. Of what is beside it, one line matters, and the next one for its squares.
    row, column = np.nonzero(is_saddle)
    part = slice(row.min() - 2, row.max() + 3), slice(column.min() - 2, column.max() + 3)
    places, is_saddle = _complete(places[part]), is_saddle[part]
    is_corner = _are_between_squares(places, smooth)
    for turn in ((0, 1), (1, 0)):
        corners, saddles = is_corner.transpose(turn), is_saddle.transpose(turn)
        if (np.subtract(corners.shape, 2) < (rows, columns)).any():
            continue
        windows = np.lib.stride_tricks.sliding_window_view(corners[1:-1, 1:-1], (rows, columns))
        count = windows.sum(axis=(2, 3))
        top, left = np.add(np.unravel_index(count.argmax(), count.shape), 1)
        down, right = slice(top, top + rows), slice(left, left + columns)
        seen = saddles[down, right]
        if (
            seen.mean() >= MIN_SEEN
            and _find_weakest_line(seen) > _LINE_SHARE
            and _is_bounded(corners[top - 1 : top + rows + 1, left - 1 : left + columns + 1])
        ):
            return Lattice(_to_pixels(places.transpose(turn)[down, right]), seen)
    return None


def is_whole_board(gray: Gray, places: Array) -> bool:
    """Whether places (rows, columns, 2) in an image are corners of four squares, and those beside are not."""
    around = _complete(np.pad(_to_places(places), 2, constant_values=_NOWHERE))
    # Only what is around the board is blurred.
    left, top = (max(int(side.min() - _BLUR_REACH), 0) for side in (around.real, around.imag))
    right, bottom = (max(int(side.max() + _BLUR_REACH), 0) for side in (around.real, around.imag))
    smooth = _blur(gray[top:bottom, left:right])
    return _is_bounded(_are_between_squares(around - complex(left, top), smooth)[1:-1, 1:-1])


def _is_bounded(is_corner: NDArray[np.bool_]) -> bool:
    """Whether places (rows, columns) are corners but in the first and last lines, except for a few in glare."""
    board = is_corner[1:-1, 1:-1]
    beside = is_corner[[0, -1], 1:-1].mean(axis=1).max(), is_corner[1:-1, [0, -1]].mean(axis=0).max()
    return bool(board.mean() >= _MIN_SHARE and _find_weakest_line(board) > _LINE_SHARE >= max(beside))


def _find_weakest_line(is_there: NDArray[np.bool_]) -> float:
    """Smallest share of places (rows, columns) in a row or a column at which something is."""
    return float(min(is_there.mean(axis=axis).min() for axis in (0, 1)))


# Distances from a corner along both edges at which the brightness of its squares is taken, in squares: outer ones
# may be cropped to a half. Beside a corner, or where no squares are, brightness at some of them differs.
_WITHIN_SQUARE = (0.2, 0.3, 0.4)
# Smallest difference between the darker of two bright squares at a corner and the brighter of the two dark ones,
# over that of all four: 0 or less at the rim of a board in front of any background, 0.2 where a shadow ends.
_MIN_CONTRAST = 0.1


def _are_between_squares(places: Places, smooth: Brightness) -> NDArray[np.bool_]:
    """Which places (rows, columns) are corners of four squares, dark and bright in turn; none at the ends."""
    middle = places[1:-1, 1:-1]
    up, down = places[:-2, 1:-1] - middle, places[2:, 1:-1] - middle
    left, right = places[1:-1, :-2] - middle, places[1:-1, 2:] - middle
    diagonals = np.stack([up + left, down + right, up + right, down + left])
    within = middle + np.multiply.outer(_WITHIN_SQUARE, diagonals).swapaxes(0, 1)
    within = within.reshape(-1, middle.shape[1])
    x, y = within.real.astype(np.float32), within.imag.astype(np.float32)
    values = cv2.remap(smooth, x, y, cv2.INTER_LINEAR, None, cv2.BORDER_REPLICATE).reshape(
        2, -1, *middle.shape[:2]
    )
    # The squares of one diagonal are the dark ones at every other corner.
    parity = np.indices(middle.shape[:2]).sum(axis=0) % 2 == 0
    one, other = np.where(parity, values, values[::-1])
    least = _MIN_CONTRAST * np.ptp(values, axis=(0, 1))
    ways = [bright.min(axis=0) - dark.max(axis=0) > least for bright, dark in ((one, other), (other, one))]
    return np.pad(max(ways, key=np.count_nonzero), 1)


def _complete(places: Places) -> Places:
    """Places (rows, columns) of corners, with those that are NaN predicted by their neighbours."""
    padded = np.pad(places, 2, constant_values=_NOWHERE)
    around, flat = _AROUND @ [padded.shape[1], 1], padded.ravel()
    inner = np.zeros(padded.shape, dtype=np.bool_)
    inner[2:-2, 2:-2] = True
    cell = np.flatnonzero(inner.ravel() & np.isnan(flat))
    while len(cell):
        predicted = _predict_places(flat[cell[:, None] + around])
        flat[cell] = predicted
        cell = cell[np.isnan(predicted)]
    return padded[2:-2, 2:-2]
