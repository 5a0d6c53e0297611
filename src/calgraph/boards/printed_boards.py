"""Boards with a print: where their marks are, and the search of these in images.

Board frame: origin at the centre of the board, x right, y up for a reader of the print, z out of the face towards
the reader.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from calgraph.boards.board_pose import OUTLIER_SIGMAS
from calgraph.boards.chessboards import CharucoFinder, CheckerboardFinder
from calgraph.boards.tags import (
    Gray,
    GridFinder,
    Marks,
    TagFinder,
    kind_of_dictionary,
    make_tag_finder,
    recognize_dictionary,
)
from calgraph.config import AprilGrid, Board, Charuco, Checkerboard, PixelNoise
from calgraph.config.settings import CameraDetectionSettings
from calgraph.errors import InputError, Rejected
from calgraph.geometry import Array
from calgraph.sensors import CameraModel

Ids = NDArray[np.intp]
Finder = TagFinder | GridFinder | CheckerboardFinder | CharucoFinder

_DARK, _FLAT = 12.0, 4.0
"""Largest 99th percentile of dark images and largest standard deviation of blank ones: only for the message."""
# Unit squares' corners in the order in which they are detected, in the board frame.
_OPENCV_CORNERS = np.array([[-0.5, 0.5], [0.5, 0.5], [0.5, -0.5], [-0.5, -0.5]])
# Kalibr prints its tags upside down compared with how OpenCV draws them.
_KALIBR_CORNERS = -_OPENCV_CORNERS


@dataclass(frozen=True, eq=False)
class Landmarks:
    """The marks on one board. A mark is detected as a whole: a tag with 4 corners, or a single corner."""

    ids: Ids
    """(M,) tag ids; for checkerboards and ChArUco the corner's number, row by row from the top left."""
    corners: Array
    """(M, k, 3) corners of each mark in the board frame, m; k = 4 for tags, clockwise from the top left of the
    tag as OpenCV draws it; k = 1 otherwise."""

    def corners_of(self, ids: Ids) -> Array:
        """Corners (N, k, 3) of the marks ``ids`` (N,), in that order; KeyError if one is not on the board."""
        row = {int(mark): i for i, mark in enumerate(self.ids)}
        return self.corners[[row[int(mark)] for mark in ids]]


def compute_landmarks(board: Board) -> Landmarks:
    """The printed corners of a board, empty if nothing is printed on it."""
    match board.pattern:
        case None:
            return _layout_tags(board)
        case Checkerboard() as p:
            return _layout_lattice(p.columns, p.rows, p.square, p.center)
        case Charuco() as p:
            return _layout_lattice(p.columns - 1, p.rows - 1, p.square, p.center)
        case AprilGrid() as p:
            return _layout_aprilgrid(p)


def select_marks_in_view(board: Board, camera: CameraModel, pixels: Array) -> NDArray[np.bool_]:
    """Which marks (M,) of a board are detected by their corners: those that lie fully in the image.

    Args:
        board: whose marks they are; a checkerboard is recognised by all of its corners only.
        camera: that takes the image.
        pixels: (M, k, 2) of the corners; NaN where the camera's model is not defined.
    """
    in_view = camera.contains(pixels.reshape(-1, 2)).reshape(pixels.shape[:2]).all(axis=1)
    complete = in_view.all() or not isinstance(board.pattern, Checkerboard)
    return np.asarray(in_view & complete, dtype=np.bool_)


def _layout_tags(board: Board) -> Landmarks:
    centers = np.array([tag.center for tag in board.tags]).reshape(-1, 1, 2)
    sizes = np.array([tag.size for tag in board.tags]).reshape(-1, 1, 1)
    return Landmarks(
        np.array([tag.id for tag in board.tags], dtype=np.intp), _append_zero(centers + sizes * _OPENCV_CORNERS)
    )


def _layout_lattice(columns: int, rows: int, square: float, center: tuple[float, float]) -> Landmarks:
    """Inner corners of a chessboard, row by row from the top left."""
    x = (np.arange(columns) - (columns - 1) / 2) * square + center[0]
    y = ((rows - 1) / 2 - np.arange(rows)) * square + center[1]
    corners = np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 1, 2)
    return Landmarks(np.arange(columns * rows), _append_zero(corners))


def _layout_aprilgrid(grid: AprilGrid) -> Landmarks:
    """Kalibr numbers tags from the bottom left, along the rows, upwards."""
    pitch = grid.tag_size * (1 + grid.tag_spacing)
    x = (np.arange(grid.columns) - (grid.columns - 1) / 2) * pitch + grid.center[0]
    y = (np.arange(grid.rows) - (grid.rows - 1) / 2) * pitch + grid.center[1]
    centers = np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 1, 2)
    return Landmarks(
        grid.first_id + np.arange(len(centers)), _append_zero(centers + grid.tag_size * _KALIBR_CORNERS)
    )


def _append_zero(corners: Array) -> Array:
    """Corners (M, k, 2) on the board as points (M, k, 3) with z = 0."""
    return np.concatenate([corners, np.zeros((*corners.shape[:2], 1))], axis=-1)


@dataclass(frozen=True, eq=False)
class PrintedBoard:
    """A board with a print, and the finder of its marks."""

    number: int
    board: Board
    landmarks: Landmarks
    finder: Finder


def make_printed_boards(boards: Sequence[Board], settings: CameraDetectionSettings) -> tuple[PrintedBoard, ...]:
    """The boards with a print, and their finders; boards with tags of one family share a finder.

    Inverted prints are detected in inverted images, by other finders.
    """
    shared: dict[tuple[type, str, bool], TagFinder | GridFinder] = {}
    board_of_tag: dict[tuple[type, str, int], int] = {}
    printed = []
    for number, board in enumerate(boards):
        marks = compute_landmarks(board)
        if not len(marks.ids):
            continue
        finder: Finder
        match board.pattern:
            case Checkerboard() as pattern:
                finder = CheckerboardFinder(pattern)
            case Charuco() as pattern:
                finder = CharucoFinder(pattern)
            case None | AprilGrid():
                kind = TagFinder if board.pattern is None else GridFinder
                key = kind, board.family, board.inverted
                if key not in shared:
                    shared[key] = (
                        make_tag_finder(board.family, settings.tags)
                        if board.pattern is None
                        else GridFinder(board.family)
                    )
                finder = shared[key]
                for mark in marks.ids.tolist():
                    other = board_of_tag.setdefault((kind, board.family, mark), number)
                    if other != number:
                        raise InputError(
                            f"target: boards {other} and {number} both have tag {mark} of {board.family}"
                        )
        printed.append(PrintedBoard(number, board, marks, finder))
    return tuple(printed)


def select_grays(printed: Sequence[PrintedBoard], grays: Sequence[Gray]) -> Mapping[Finder, Sequence[Gray]]:
    """The images that each finder searches: for inverted prints with black and white exchanged."""
    exchanged = [255 - gray for gray in grays] if any(one.board.inverted for one in printed) else grays
    return {one.finder: exchanged if one.board.inverted else grays for one in printed}


# Minimum noise of a corner, pixels, in the test whether the board moved between images (by OUTLIER_SIGMAS of it):
# 1 px of motion is accepted, as averaging halves its effect.
_MIN_MOTION_NOISE = 0.2


def average_marks(marks_by_image: Sequence[Marks], noise: PixelNoise) -> Marks | Rejected:
    """Every mark's mean over the images, unless the board moved; those of one image as they are."""
    if len(marks_by_image) == 1:
        return marks_by_image[0]
    tolerance = OUTLIER_SIGMAS * max(noise.pixel, _MIN_MOTION_NOISE)
    ids = np.unique(np.concatenate([marks.ids for marks in marks_by_image]))
    pixels = np.full((len(marks_by_image), len(ids), *marks_by_image[0].pixels.shape[1:]), np.nan)
    for row, marks in zip(pixels, marks_by_image, strict=True):
        row[np.searchsorted(ids, marks.ids)] = marks.pixels
    center = np.nanmedian(pixels, axis=0)
    deviation = np.linalg.norm(pixels - center, axis=-1)
    shift = np.array([np.nanmedian(one) for one in deviation])
    if shift.max() > tolerance:
        return Rejected(f"board moved between images: its corners by {2 * shift.max():.1f} px")
    # A mark that jumps while the board rests is a false detection in that image.
    pixels[(deviation > tolerance).any(axis=-1)] = np.nan
    steady = np.isfinite(pixels).all(axis=(2, 3)).any(axis=0)
    if not steady.any():
        return Rejected(f"board moved between images: its corners by up to {2 * np.nanmax(deviation):.1f} px")
    return Marks(ids[steady], np.nanmean(pixels[:, steady], axis=0))


def explain_missing(printed: PrintedBoard, found: Marks, gray: Gray) -> str:
    """The reason why a board was not detected in an image (height, width), of what was found in it."""
    match printed.board.pattern:
        case Checkerboard() as pattern:
            return f"checkerboard of {pattern.columns}x{pattern.rows} inner corners not found"
        case Charuco() as pattern:
            reason = (
                f"no corner of the {pattern.columns}x{pattern.rows} ChArUco board of {pattern.dictionary} found"
            )
            return reason + _name_other_dictionary(gray, pattern.dictionary)
    expected = _format_ids(printed.landmarks.ids.tolist())
    if not len(found):
        reason = f"no tag of family {printed.board.family} found; {expected} expected"
        stated = printed.board.family if isinstance(printed.finder, TagFinder) else None
        return reason + (_name_other_dictionary(gray, stated) if stated else "")
    others = _format_ids(np.unique(found.ids).tolist())
    are = "is" if others.startswith("id ") else "are"
    return f"only {others} detected, which {are} not on the board; {expected} expected"


def _name_other_dictionary(gray: Gray, stated: str) -> str:
    """What follows a reason if an image has markers of another dictionary than the stated one."""
    found = recognize_dictionary(gray)
    if found is None or kind_of_dictionary(found) == kind_of_dictionary(stated):
        return ""
    return f"; the markers in the image are of {found}: correct rig.yaml"


def _format_ids(ids: Sequence[int]) -> str:
    if len(ids) > 2 and list(ids) == list(range(ids[0], ids[-1] + 1)):
        return f"ids {ids[0]} to {ids[-1]}"
    return ("id " if len(ids) == 1 else "ids ") + ", ".join(map(str, ids))


def explain_exposure(grays: Sequence[Gray]) -> str:
    """Why images without any detection are unusable: too dark, or blank; otherwise empty."""
    values = np.arange(256)
    # Percentile and deviation of a histogram take a fifth of the time that those of the pixels do; so do few rows.
    counts = [cv2.calcHist([gray[::8]], [0], None, [256], [0, 256]).ravel().astype(np.float64) for gray in grays]
    brightest = max(float(values[np.searchsorted(np.cumsum(n), 0.99 * n.sum())]) for n in counts)
    if brightest < _DARK:
        return f" (the image is too dark: 99 % of it below grey value {brightest:.0f})"
    means = [np.average(values, weights=n) for n in counts]
    if max(np.average((values - m) ** 2, weights=n) for m, n in zip(means, counts, strict=True)) < _FLAT**2:
        return " (the image is blank)"
    return ""
