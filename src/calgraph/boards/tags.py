"""Detection of tags in an image: AprilTags by the AprilTag library, Kalibr's grids and ArUco markers by OpenCV.

The AprilTag library fits straight lines to the edges of tags. Lens distortion bends them: a tag of 36 pixels, 40
degrees off a fisheye's axis, is detected larger by 0.2 pixels, and so nearer by half a per cent. Tags are searched
again in rectified views: the image of a virtual camera without distortion that points at them.
"""

import re
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from calgraph.config import APRILTAGS, DICTIONARIES, FAMILIES, Family, dictionary, marker_count
from calgraph.config.settings import TagSettings
from calgraph.geometry import Array
from calgraph.sensors import CameraModel

Gray = NDArray[np.uint8]

# Steps of sub-pixel refinement end below 1e-3 pixels, a fiftieth of the noise, or after 40.
_CRITERIA = (cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_COUNT, 40, 1e-3)
_STEP = 8
"""The map from view to image is computed every 8 pixels, and interpolated: it is smooth."""


@dataclass(frozen=True, eq=False)
class Marks:
    """Marks detected in one image; an id may occur more than once."""

    ids: NDArray[np.intp]
    """(N,)."""
    pixels: Array
    """(N, k, 2) their corners in the order of :class:`calgraph.boards.printed_boards.Landmarks`."""
    legacy: bool = False
    """Whether they are of a ChArUco board of the layout before OpenCV 4.6."""

    def __len__(self) -> int:
        return len(self.ids)

    def select(self, which: NDArray[np.bool_]) -> "Marks":
        """The marks (N,) marked True."""
        return Marks(self.ids[which], self.pixels[which])

    def __add__(self, other: "Marks") -> "Marks":
        return Marks(np.concatenate([self.ids, other.ids]), np.concatenate([self.pixels, other.pixels]))


def empty_marks(k: int) -> Marks:
    """No marks, of k corners each."""
    return Marks(np.zeros(0, dtype=np.intp), np.zeros((0, k, 2)))


# Minimum decision margin with one corrected bit, and of any tag of tag16h5, grey values: the 30 codes of tag16h5
# occur by chance in photographs.
_MIN_CORRECTED_MARGIN = 15.0
# Margin around predicted tags in the second search, in edges of a tag: the error of a prediction.
_SEARCH_MARGIN = 0.5
# Minimum margin around predicted tags, pixels: a tag's white border must be inside the searched part.
_MIN_SEARCH_MARGIN = 10.0
# Standard deviation of the blur of images that are searched at half their resolution, pixels of these: the value
# that the authors of the AprilTag library recommend for noisy images.
_HALF_RESOLUTION_BLUR = 0.8


class TagFinder:
    """Finds tags of one family with the AprilTag library; not for concurrent use by several threads.

    Large images are searched at half their resolution, with a light blur; edges are refined at full resolution.
    """

    def __init__(self, family: Family, settings: TagSettings) -> None:
        self.family, self._settings = family, settings
        corrected = _MIN_CORRECTED_MARGIN
        # Least decision margin by the number of corrected bits; tags with more corrections are rejected.
        self._margins = (corrected,) if family == "tag16h5" else (settings.min_decision_margin, corrected)
        self._detector = _make_detector(family)

    def find(self, gray: Gray) -> Marks:
        """All tags of the family in an image (height, width), of the rig's boards or not."""
        return self._decode(gray, coarse=gray.size > self._settings.half_resolution_above)

    def find_within(self, gray: Gray, pixels: Array) -> Marks:
        """Tags at full resolution near their predicted corners (N, 4, 2); small ones too."""
        edge = np.ptp(pixels, axis=(0, 1)).max() / np.sqrt(len(pixels))
        margin = _SEARCH_MARGIN * edge + _MIN_SEARCH_MARGIN
        low = np.maximum(np.floor(pixels.min(axis=(0, 1)) - margin), 0).astype(int)
        high = np.ceil(pixels.max(axis=(0, 1)) + margin).astype(int)
        found = self._decode(gray[low[1] : high[1], low[0] : high[0]], coarse=False)
        return Marks(found.ids, found.pixels + low)

    def _decode(self, gray: Gray, *, coarse: bool) -> Marks:
        # No tag has fewer pixels, and the library fails on such images.
        if min(gray.shape) < 8:
            return empty_marks(4)
        # The library reads these in each search; a second detector would take 25 ms to make.
        options = self._detector.tag_detector_ptr.contents
        options.quad_decimate = 2.0 if coarse else 1.0
        options.quad_sigma = _HALF_RESOLUTION_BLUR if coarse else 0.0
        tags = [
            tag
            for tag in self._detector.detect(np.ascontiguousarray(gray))
            if tag.hamming < len(self._margins) and tag.decision_margin > self._margins[tag.hamming]
        ]
        if not tags:
            return empty_marks(4)
        # The library starts at another corner, in the opposite sense, and has the centre of the first pixel at
        # (0.5, 0.5).
        corners = np.array([tag.corners for tag in tags])[:, [1, 0, 3, 2]] - 0.5
        height, width = gray.shape
        inside = np.asarray(((corners > -0.5) & (corners < np.array([width, height]) - 0.5)).all(axis=(1, 2)))
        return Marks(np.array([tag.tag_id for tag in tags], dtype=np.intp), corners).select(inside)


class ArucoFinder(TagFinder):
    """Finds ArUco markers of one dictionary by OpenCV, at full resolution.

    Moved to saddle points, corners of markers of 60 to 150 pixels are 0.13 pixels off (median); those of OpenCV's
    other refinements, and of none, 0.5.
    """

    def __init__(self, family: Family, settings: TagSettings) -> None:
        self.family, self._settings = family, settings
        parameters = cv2.aruco.DetectorParameters()
        parameters.cornerRefinementMethod = cv2.aruco.CORNER_REFINE_SUBPIX
        self._detector = cv2.aruco.ArucoDetector(dictionary(FAMILIES[family]), parameters)

    def _decode(self, gray: Gray, *, coarse: bool) -> Marks:  # noqa: ARG002
        # OpenCV fails on images of few pixels.
        if min(gray.shape) < 8:
            return empty_marks(4)
        corners, ids, _ = self._detector.detectMarkers(np.ascontiguousarray(gray))
        if not len(corners):
            return empty_marks(4)
        return Marks(np.asarray(ids, dtype=np.intp).ravel(), np.reshape(corners, (-1, 4, 2)).astype(np.float64))


def make_tag_finder(family: Family, settings: TagSettings) -> TagFinder:
    """The finder of a family's tags."""
    return TagFinder(family, settings) if family in APRILTAGS else ArucoFinder(family, settings)


# The largest dictionaries of each kind; smaller ones are their first markers.
_KINDS = tuple(name for name in DICTIONARIES if not name.endswith(("_50", "_100", "_250")))
# Least number of markers of a dictionary in an image of which it is named: one of 36 bits, more of those with
# fewer, which squares of other things resemble.
_LEAST_MARKERS = 2
_CERTAIN_SIZE = 6
# Maximum share of wrong bits in the border of those markers: with OpenCV's 0.35, most dark things are compared
# with all codes.
_MAX_BORDER_ERRORS = 0.1
# Window of the adaptive threshold, pixels: OpenCV's three, 3 to 23, name the same dictionaries in thrice the time.
_THRESHOLD_WINDOW = 13
# Width of an image, pixels, to which larger ones are halved: markers of 40 pixels are still found, in a quarter of
# the time, which each image without a board takes.
_SUFFICIENT_WIDTH = 640


def recognize_dictionary(gray: Gray) -> str | None:
    """The smallest dictionary that has the most markers in an image (height, width), by its name in ``family``."""
    while gray.shape[1] >= 2 * _SUFFICIENT_WIDTH:
        gray = np.asarray(cv2.pyrDown(gray), dtype=np.uint8)
    parameters = cv2.aruco.DetectorParameters()
    parameters.maxErroneousBitsInBorderRate = _MAX_BORDER_ERRORS
    parameters.adaptiveThreshWinSizeMin = parameters.adaptiveThreshWinSizeMax = _THRESHOLD_WINDOW
    # Else dark things without contrast, which are most, pass as markers whose bits are all 0.
    parameters.minOtsuStdDev = 0.0
    detector = cv2.aruco.ArucoDetector([dictionary(name) for name in _KINDS], parameters)
    corners, ids, _, kinds = detector.detectMarkersMultiDict(gray)
    if not len(corners):
        return None
    counts = np.bincount(np.ravel(kinds).astype(int))
    best, found = int(counts.argmax()), np.ravel(ids)[np.ravel(kinds) == counts.argmax()]
    if counts[best] < _LEAST_MARKERS and dictionary(_KINDS[best]).markerSize < _CERTAIN_SIZE:
        return None
    kind = kind_of_dictionary(_KINDS[best])
    name = next(n for n in DICTIONARIES if kind_of_dictionary(n) == kind and marker_count(n) > found.max())
    return next((family for family, one in FAMILIES.items() if one == name), name)


def kind_of_dictionary(name: str) -> str:
    """What dictionaries have in common that differ in their number of markers only; ``name`` may be a family's."""
    return re.sub("_(50|100|250|1000)$", "", FAMILIES.get(name, name))


# Half widths of the windows in which corners of Kalibr's tags are moved to saddle points, in edges of a tag: the
# first one contains the error of OpenCV's quadrilateral, an eighth, and not the next saddle at 0.2.
_SADDLE_WINDOWS = (0.14, 0.07)


class GridFinder:
    """Finds the tags of Kalibr's grids, which have borders two bits wide and squares at their corners."""

    def __init__(self, family: Family) -> None:
        self.family = family
        parameters = cv2.aruco.DetectorParameters()
        parameters.markerBorderBits = 2
        self._detector = cv2.aruco.ArucoDetector(dictionary(FAMILIES[family]), parameters)

    def find(self, gray: Gray) -> Marks:
        """All tags in an image (height, width), with corners refined as the saddle points they are."""
        corners, ids, _ = self._detector.detectMarkers(gray)
        if not len(corners):
            return empty_marks(4)
        pixels = np.array([_refine_saddles(gray, np.reshape(c, (4, 2))) for c in corners])
        return Marks(np.asarray(ids, dtype=np.intp).ravel(), pixels)


def _make_detector(family: Family) -> Any:
    from pupil_apriltags import Detector

    detector = Detector(families=family, nthreads=1)
    # Its destructor frees its families and then uses them, which corrupts the heap: it is left without any.
    detector.tag_families.clear()
    return detector


def _refine_saddles(gray: Gray, corners: NDArray[np.float32]) -> Array:
    """Corners (4, 2) moved to the saddle points next to them.

    OpenCV's quadrilateral may be off by 3 % of its circumference, an eighth of an edge, where the squares touch
    it; the next saddle point is at least 0.2 edges away. Half widths of windows are in edges.
    """
    edge = np.linalg.norm(corners - np.roll(corners, 1, axis=0), axis=1).min()
    refined = corners.reshape(4, 1, 2).astype(np.float32)
    for share in _SADDLE_WINDOWS:
        reach = max(2, round(share * edge))
        cv2.cornerSubPix(gray, refined, (reach, reach), (-1, -1), _CRITERIA)
    return np.asarray(refined[:, 0], dtype=np.float64)


@dataclass(frozen=True, eq=False)
class RectifiedView:
    """A piece of an image, resampled."""

    image: Gray
    """(height, width)."""
    camera: CameraModel
    """The camera that took the image."""
    R_camera_view: Array
    """(3, 3) rotation of the camera without distortion."""
    focal: float
    """Its focal length, pixels."""
    corner: Array
    """(2,) the centre of the view's first pixel on its plane z = 1."""

    def to_image(self, pixels: Array) -> Array:
        """Maps pixels (..., 2) of the view to the image."""
        return _project_to_image(pixels, self.camera, self.R_camera_view, self.focal, self.corner)


def is_undistorted(camera: CameraModel) -> bool:
    """Whether straight lines are straight in the camera's images."""
    return camera.model == "pinhole" and not camera.distortion.any()


# Tangent of the largest angle between a corner and the axis of a rectified view (76°): beyond it the view is
# stretched more than tenfold towards its edge.
_MAX_VIEW_TANGENT = 4.0
# Resolution of a rectified view over that of the image: resampling at 1 blurs edges by about half a pixel.
_VIEW_SCALE = 1.5
# Margin around the tags in a rectified view, in edges of the largest tag: its white border and the error of the
# prediction.
_VIEW_MARGIN = 0.4
# Maximum number of pixels along an edge of a rectified view: bounds memory and time.
_MAX_VIEW_SIZE = 2000


def rectify_view(gray: Gray, camera: CameraModel, corners: Array) -> RectifiedView | None:
    """Resamples the image of tags; None if they span too wide an angle for one view.

    Args:
        gray: image (height, width).
        camera: its intrinsics.
        corners: (M, 4, 3) approximate corners of the tags, camera frame, m.
    """
    points = corners.reshape(-1, 3)
    R_camera_view = _compute_look_at(points.mean(axis=0))
    local = points @ R_camera_view
    flat = local[:, :2] / local[:, 2:]
    if (local[:, 2] <= 0).any() or np.abs(flat).max() > _MAX_VIEW_TANGENT:
        return None
    edges = _edge_lengths(flat.reshape(-1, 4, 2))
    focal = _VIEW_SCALE * float(np.median(_edge_lengths(camera.project(points).reshape(-1, 4, 2)) / edges))
    margin = _VIEW_MARGIN * edges.max()
    low, high = flat.min(axis=0) - margin, flat.max(axis=0) + margin
    focal = min(focal, _MAX_VIEW_SIZE / (high - low).max())
    width, height = np.ceil(focal * (high - low)).astype(int) + 1
    nodes = np.stack(np.meshgrid(_grid_nodes(width), _grid_nodes(height)), axis=-1)
    sparse = _project_to_image(nodes, camera, R_camera_view, focal, low)
    down, across = _interpolation_weights(height), _interpolation_weights(width)
    x, y = ((down @ np.nan_to_num(sparse[..., k], nan=-1e4) @ across.T).astype(np.float32) for k in (0, 1))
    image = cv2.remap(gray, x, y, cv2.INTER_LINEAR)
    return RectifiedView(np.asarray(image, dtype=np.uint8), camera, R_camera_view, focal, low)


def _compute_look_at(point: Array) -> Array:
    """Rotation (3, 3) from a frame whose z axis points at a point, with y downwards where possible."""
    z = point / np.linalg.norm(point)
    x = np.cross([0.0, 1.0, 0.0] if abs(z[1]) < 0.9 else [0.0, 0.0, -1.0], z)
    x /= np.linalg.norm(x)
    return np.column_stack([x, np.cross(z, x), z])


def _project_to_image(
    pixels: Array, camera: CameraModel, R_camera_view: Array, focal: float, corner: Array
) -> Array:
    flat = (corner + pixels / focal).reshape(-1, 2)
    rays = np.column_stack([flat, np.ones(len(flat))]) @ R_camera_view.T
    return camera.project(rays).reshape(pixels.shape)


def _edge_lengths(quads: Array) -> Array:
    """(M, 4) lengths of the edges of quadrilaterals (M, 4, 2)."""
    return np.asarray(np.linalg.norm(quads - np.roll(quads, 1, axis=1), axis=-1))


def _grid_nodes(length: int) -> Array:
    return np.arange(0.0, length + _STEP, _STEP)


def _interpolation_weights(length: int) -> Array:
    """(length, nodes) weights of linear interpolation between the nodes."""
    distance = np.abs(np.arange(length)[:, None] - _grid_nodes(length)) / _STEP
    return np.asarray(np.clip(1 - distance, 0, None))
