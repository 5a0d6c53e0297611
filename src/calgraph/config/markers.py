"""AprilTags and ArUco markers, by family and as bitmaps."""

from functools import cache
from typing import Literal

import cv2
import numpy as np

from calgraph.geometry import Array

Family = Literal["tag36h11", "tag25h9", "tag16h5"]

FAMILIES: dict[Family, str] = {
    "tag36h11": "DICT_APRILTAG_36h11",
    "tag25h9": "DICT_APRILTAG_25h9",
    "tag16h5": "DICT_APRILTAG_16h5",
}
"""OpenCV's dictionary of each family of AprilTags."""
DICTIONARIES = (
    *(f"DICT_{n}X{n}_{count}" for n in (4, 5, 6, 7) for count in (50, 100, 250, 1000)),
    "DICT_ARUCO_ORIGINAL", "DICT_APRILTAG_16h5", "DICT_APRILTAG_25h9", "DICT_APRILTAG_36h10",
    "DICT_APRILTAG_36h11", "DICT_ARUCO_MIP_36h12",
)  # fmt: skip
"""OpenCV's names."""


@cache
def dictionary(name: str) -> cv2.aruco.Dictionary:
    """OpenCV's dictionary of one of the names in ``DICTIONARIES``."""
    return cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, name))


def marker_count(name: str) -> int:
    """How many markers a dictionary has; they are numbered from 0."""
    return len(dictionary(name).bytesList)


def marker_bitmap(name: str, number: int, border: int = 1) -> Array:
    """A marker upright as OpenCV draws it: (n, n), a value for each module, 0 black and 1 white.

    The black border, ``border`` modules wide, is part of it.
    """
    edge = dictionary(name).markerSize + 2 * border
    image = cv2.aruco.generateImageMarker(dictionary(name), number, edge, borderBits=border)
    return np.asarray(image, dtype=np.float64) / 255
