"""Detections of the board in one capture: a plane patch, a line segment, or printed corners."""

from dataclasses import dataclass, field

import numpy as np

from calgraph.errors import Rejected
from calgraph.geometry import Array, measure_lengths


@dataclass(frozen=True, eq=False)
class PlanePatch:
    """The board detected by a 3-D scanner: a plane and the points on it."""

    plane: Array
    """(4,) unit normal and offset in the sensor frame, oriented towards the sensor (d >= 0)."""
    covariance: Array
    """(3, 3) of the plane in the chart of :func:`calgraph.geometry.plane.retract`."""
    ranges: Array
    """(N,) measured along the beams that end on the board, m."""
    directions: Array
    """(N, 3) unit vectors of these beams, sensor frame."""
    center: Array
    """(3,) centre of the patch, projected on the plane, m."""
    match: float = 1.0
    """Score, 0 to 1, of its outline against a board of the known size."""
    edges: Array = field(default_factory=lambda: np.empty((0, 2, 3)))
    """(M, 2, 3) its edges: unit vectors of the last beam on the board and the first one past it."""
    times: Array = field(default_factory=lambda: np.zeros(0))
    """(N,) when each beam was measured, s after the stamp of its message; empty where that is not known, or of
    several messages."""
    twist: Array = field(default_factory=lambda: np.zeros(6))
    """(6,) velocity of a moving board at the capture's time: of its point at the sensor's origin, m/s, and of its
    rotation, rad/s; sensor frame."""
    motion_variance: Array = field(default_factory=lambda: np.zeros(6))
    """(6,) variances of the displacement and rotation (m², rad²) of a moving board between the measurement and the
    capture's time, as far as its velocity is not known; along the sensor's axes."""

    @property
    def points(self) -> Array:
        """(N, 3) ends of the beams, sensor frame, m."""
        return self.ranges[:, None] * self.directions


@dataclass(frozen=True, eq=False)
class Segment:
    """The board detected by a 2-D scanner: the intersection of the board with the scan plane z = 0."""

    endpoints: Array
    """(2, 3) the outermost beams projected on the fitted line, in order of angle, sensor frame, m."""
    covariance: Array
    """(6, 6) of the two end points, with a tiny variance in z."""
    ranges: Array
    """(N,) measured along the beams that end on the board, m."""
    directions: Array
    """(N, 3) unit vectors of these beams, sensor frame."""
    match: float = 1.0
    """Score, 0 to 1, of its length, straightness and ends against a board of the known size."""
    edges: Array = field(default_factory=lambda: np.empty((0, 2, 3)))
    """(M, 2, 3) its edges: unit vectors of the last beam on the board and the first one past it."""
    times: Array = field(default_factory=lambda: np.zeros(0))
    """(N,) when each beam was measured, s after the stamp of its message; empty where that is not known, or of
    several messages."""
    twist: Array = field(default_factory=lambda: np.zeros(6))
    """(6,) velocity of a moving board at the capture's time: of its point at the sensor's origin, m/s, and of its
    rotation, rad/s; sensor frame."""
    motion_variance: Array = field(default_factory=lambda: np.zeros(6))
    """(6,) variances of the displacement and rotation (m², rad²) of a moving board between the measurement and the
    capture's time, as far as its velocity is not known; along the sensor's axes."""

    @property
    def center(self) -> Array:
        """(3,) the middle of the segment, m."""
        return np.asarray(self.endpoints.mean(axis=0))

    @property
    def points(self) -> Array:
        """(N, 3) ends of the beams, sensor frame, m."""
        return self.ranges[:, None] * self.directions


@dataclass(frozen=True, eq=False)
class BoardCorners:
    """The board detected by a camera."""

    corners_board: Array
    """(N, 3) the printed corners in the board frame (z = 0), m."""
    pixels: Array
    """(N, 2) where they were detected, OpenCV's pixel convention, distorted as measured."""
    T_camera_board: Array
    """(4, 4) from one PnP over all corners."""
    covariance: Array
    """(6, 6) of that pose, in the camera's fixed axes (translation, rotation)."""
    plane: Array
    """(4,) the board's plane in the camera frame, normal towards the reader of the print: the camera, unless it
    looks at the back of the board."""
    plane_covariance: Array
    """(3, 3) of the plane in the chart of :func:`calgraph.geometry.plane.retract`."""
    rms: float
    """Root mean square reprojection error, pixels."""
    board: int = 0
    """Index of the board among the rig's boards."""
    outlier_tags: tuple[int, ...] = ()
    """Ids of the board's tags that were detected, but not where the others imply. Not saved with a problem."""
    legacy: bool = False
    """Whether the ChArUco print is of the layout before OpenCV 4.6. Not saved with a problem."""
    twist: Array = field(default_factory=lambda: np.zeros(6))
    """(6,) velocity of a moving board at the capture's time: of its point at the sensor's origin, m/s, and of its
    rotation, rad/s; sensor frame."""
    motion_variance: Array = field(default_factory=lambda: np.zeros(6))
    """(6,) variances of the displacement and rotation (m², rad²) of a moving board between the measurement and the
    capture's time, as far as its velocity is not known; along the sensor's axes."""

    @property
    def center(self) -> Array:
        """(3,) the centre of the board in the camera frame, m."""
        return self.T_camera_board[:3, 3]


@dataclass(frozen=True)
class InconsistentTags(Rejected):
    """Tags of a board were detected, but no two of them fit together as printed."""

    tags: tuple[int, ...] = ()
    """Their ids."""


Detection = PlanePatch | Segment | BoardCorners

DetectionResult = tuple[Detection, ...] | Rejected
"""Candidates for the board in one capture, the best first, or why there is none."""


def to_beams(points: Array) -> tuple[Array, Array]:
    """Ranges (N,), m, and unit directions (N, 3) of beams from the origin that end at points (N, 3)."""
    ranges = measure_lengths(points)
    return ranges, points / ranges[:, None]


def plane_of(detection: PlanePatch | BoardCorners) -> tuple[Array, Array]:
    """The detected plane (4,) and its covariance (3, 3)."""
    if isinstance(detection, BoardCorners):
        return detection.plane, detection.plane_covariance
    return detection.plane, detection.covariance
