"""Boards in the images of a camera whose intrinsics are not known: their marks, and no pose."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from calgraph.boards.detections import BoardCorners
from calgraph.boards.printed_boards import (
    PrintedBoard,
    average_marks,
    explain_exposure,
    explain_missing,
    make_printed_boards,
    select_grays,
)
from calgraph.boards.tags import Gray, Marks
from calgraph.config import Board, PixelNoise
from calgraph.config.settings import CameraDetectionSettings
from calgraph.errors import InputError, Rejected
from calgraph.geometry import Array
from calgraph.sensors import DetectedCorners, Image, Message


@dataclass(frozen=True, eq=False)
class ImageMarks:
    """All that was found in one image."""

    stamp: float
    """Of the image, s."""
    size: tuple[int, int]
    """Its width and height, pixels."""
    marks: tuple[Marks, ...]
    """Of each finder, in the order of the boards."""


@dataclass(frozen=True, eq=False)
class BoardView:
    """One board in the images of one capture: M marks with k corners each."""

    ids: NDArray[np.intp]
    """(M,)."""
    corners: Array
    """(M, k, 3) in the board's frame, m."""
    pixels: Array
    """(M, k, 2) where they were detected."""
    size: tuple[int, int]
    """Width and height of the image, pixels."""
    board: int = 0
    """Index of the board among the rig's boards."""

    @classmethod
    def from_corners(cls, detection: BoardCorners, size: tuple[int, int]) -> "BoardView":
        """The view of the corners that a pose was fitted to."""
        ids = np.arange(len(detection.pixels))
        return cls(ids, detection.corners_board[:, None], detection.pixels[:, None], size, detection.board)

    @property
    def flat_corners(self) -> Array:
        """(N, 3) corners of all marks, m."""
        return self.corners.reshape(-1, 3)

    @property
    def flat_pixels(self) -> Array:
        """(N, 2) where they were detected."""
        return self.pixels.reshape(-1, 2)


class BoardViewFinder:
    """Finds the marks of a rig's boards in images; built once per camera, and used from one thread.

    Args:
        boards: the rig's boards; those without a print are not detected.
        noise: of the corners.
        settings: of the detection.
    """

    def __init__(self, boards: Sequence[Board], noise: PixelNoise, settings: CameraDetectionSettings) -> None:
        self._boards, self._noise, self._settings = boards, noise, settings
        self._printed = make_printed_boards(boards, settings)
        self._finders = tuple(dict.fromkeys(one.finder for one in self._printed))

    def __reduce__(self) -> tuple[Any, ...]:
        # The finders of libraries cannot be pickled; another process makes them again.
        return BoardViewFinder, (self._boards, self._noise, self._settings)

    def find(self, messages: Sequence[Message]) -> tuple[BoardView, ...] | Rejected:
        """Every board in the images of one capture, or why there is none; see :meth:`search`."""
        found = self.search(messages)
        if isinstance(found, Rejected):
            return found
        boards = [self._combine(printed, found) for printed in self._printed]
        if views := tuple(one for one in boards if isinstance(one, BoardView)):
            return views
        grays = [message.gray for message in messages if isinstance(message, Image)]
        searched = select_grays(self._printed, grays)
        reasons = [
            one.reason or explain_missing(printed, self._marks_of(printed, found[0]), searched[printed.finder][0])
            for printed, one in zip(self._printed, boards, strict=True)
            if isinstance(one, Rejected)
        ]
        return Rejected("; ".join(reasons) + explain_exposure(grays))

    def search(self, messages: Sequence[Message]) -> tuple[ImageMarks, ...] | Rejected:
        """The marks in each image of one capture.

        Raises:
            InputError: the messages are corners that another program detected.
        """
        if any(isinstance(message, DetectedCorners) for message in messages):
            raise InputError(
                "sensors: detected corners do not state the size of the images: state the intrinsics of their "
                "cameras"
            )
        images = [message for message in messages if isinstance(message, Image)]
        if not images:
            return Rejected("no image in this capture")
        found = tuple(self._search(image.stamp, image.gray) for image in images)
        if len({one.size for one in found}) > 1:
            return Rejected("the images of one capture differ in size")
        return found

    def combine(self, found: Sequence[ImageMarks]) -> list[BoardView]:
        """Every board in the images of one capture, in which it rests; corners of several images are averaged."""
        boards = [self._combine(printed, found) for printed in self._printed]
        return [one for one in boards if isinstance(one, BoardView)]

    def _search(self, stamp: float, gray: Gray) -> ImageMarks:
        height, width = gray.shape
        searched = select_grays(self._printed, [gray])
        return ImageMarks(stamp, (width, height), tuple(finder.find(one) for finder, (one,) in searched.items()))

    def _marks_of(self, printed: PrintedBoard, found: ImageMarks) -> Marks:
        return found.marks[self._finders.index(printed.finder)]

    def _combine(self, printed: PrintedBoard, found: Sequence[ImageMarks]) -> BoardView | Rejected:
        """The view of one board; without a reason if it has no marks in any image."""
        of_board = [_select_unique(self._marks_of(printed, image), printed) for image in found]
        detected = [marks for marks in of_board if len(marks)]
        if not detected:
            return Rejected("")
        marks = average_marks(detected, self._noise)
        if isinstance(marks, Rejected):
            return marks
        corners = printed.landmarks.corners_of(marks.ids)
        return BoardView(marks.ids, corners, marks.pixels, found[0].size, printed.number)


def _select_unique(marks: Marks, printed: PrintedBoard) -> Marks:
    """The marks of a board whose id was detected once: which of several is right needs a pose."""
    ids, count = np.unique(marks.ids, return_counts=True)
    return marks.select(np.isin(marks.ids, np.intersect1d(ids[count == 1], printed.landmarks.ids)))
