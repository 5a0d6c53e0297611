"""What pictures of a calibration show: images and scans, outlines of boards, measurements, floor plans."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from calgraph.errors import InputError
from calgraph.geometry import Array, se3
from calgraph.io.image_headers import read_image_size
from calgraph.result.correction import Correction
from calgraph.sensors import CameraModel, colorize_points
from calgraph.sensors.kinds import KINDS

# Pictures are shrunk before they are kept: damage may state any size.
_MAX_PIXELS = 2**26


@dataclass(frozen=True, eq=False)
class Snapshot:
    """One message of one sensor in one capture."""

    capture: int
    sensor: str
    stamp: float
    """Of the message's header, s."""
    image: bytes = b""
    """JPEG of a camera's picture, as it was measured but for its size; empty of other sensors."""
    width: int = 0
    height: int = 0
    """Of the picture before it was shrunk, px."""
    points: NDArray[np.float32] = field(default_factory=lambda: np.empty((0, 3), dtype=np.float32))
    """(N, 3) of a scan or cloud, thinned, in the sensor's frame, m; none of a camera."""

    @property
    def picture(self) -> NDArray[np.uint8]:
        """(h, w, 3) RGB of a camera's ``image``; (0, 0, 3) where there is none.

        Raises:
            InputError: ``image`` is damaged.
        """
        if not self.image:
            return np.empty((0, 0, 3), dtype=np.uint8)
        import cv2

        try:
            width, height = read_image_size(self.image)
            small = width * height <= _MAX_PIXELS
            bgr = cv2.imdecode(np.frombuffer(self.image, np.uint8), cv2.IMREAD_COLOR) if small else None
        except (ValueError, cv2.error):
            bgr = None
        if bgr is None:
            raise InputError(f"picture of {self.sensor} in capture {self.capture}: is no JPEG; calibrate again")
        return np.asarray(cv2.cvtColor(bgr, cv2.COLOR_BGR2RGB), dtype=np.uint8)


@dataclass(frozen=True, eq=False)
class BoardOutline:
    """The estimated outline of the board in one capture, for pictures."""

    capture: int
    corners: Array
    """(4, 3) corners of the board, or of the detected patch, root frame, m; of a board whose print was detected,
    anticlockwise from the bottom left for a reader of the print."""
    board: int | None = None
    """Index of the board among the rig's boards, where a camera detected its print."""


@dataclass(frozen=True, eq=False)
class BoardView:
    """Measurements of one board by one sensor in one capture, and their residuals under the joint solution."""

    capture: int
    sensor: str
    used: bool
    """Whether the joint solution used it."""
    measured: Array
    """(M, 2) printed corners, px, of a camera; (M, 3) points in the frame of a scanner, m, thinned."""
    residuals: Array | None = None
    """Measured minus predicted by the joint solution: (M, 2) px of a camera; of a scanner (M,) distances from the
    board's plane, m, positive beyond it. None where it was not used, or the estimator has no boards."""


@dataclass(frozen=True, eq=False)
class BeamView:
    """Beams of one scanner of a network on moving objects, with their residuals; thinned."""

    sensor: str
    times: Array
    """(N,) of the beams by the root's clock, s from the start of the recording, ascending."""
    points: Array
    """(N, 2) ends of the beams in the scanner's frame, m."""
    residuals: Array
    """(N,) range measured minus predicted by the joint solution, m."""


@dataclass(frozen=True, eq=False)
class FloorView:
    """Static background and tracks of one scanner of a network; plane coordinates are x and y of the plan."""

    sensor: str
    background: Array
    """(M, 2) static background, thinned, in the plan, m."""
    tracks: tuple[Array, ...]
    """(N, 2) each, positions of a moving object, in the plan, m."""
    times: tuple[Array, ...] = ()
    """(N,) each, times of the positions by the root's clock, s from the start of the recording."""
    points: NDArray[np.float32] = field(default_factory=lambda: np.empty((0, 3), dtype=np.float32))
    """(P, 3) static points of a 3-D LiDAR, thinned, in its frame, m; none of a 2-D scanner."""


@dataclass(frozen=True, eq=False)
class DriveView:
    """Points of one sensor on surfaces in one part of a drive, thinned, with their residuals."""

    sensor: str
    part: int
    """Index of its path."""
    times: Array
    """(N,) by the root's clock, s from the start of the first path."""
    points: NDArray[np.float32]
    """(N, 3) in the sensor's frame, without the errors of its ranges, m."""
    normals: NDArray[np.float32]
    """(N, 3) of the surfaces, away from the sensor, in the world of the part."""
    residuals: Array
    """(N,) distances from the surface, m, positive beyond it."""
    shared: NDArray[np.bool_]
    """(N,) whether another sensor measured the surface, too."""


@dataclass(frozen=True, eq=False)
class DrivePath:
    """The trajectory of the root in one part of a drive."""

    times: Array
    """(K,) by the root's clock, s from the start of the first path."""
    T_world_root: Array
    """(K, 4, 4); z of the world is about upwards, x along most of the walls."""


@dataclass(frozen=True, eq=False)
class DriveStart:
    """What the joint solution of a drive started from."""

    sensor: str
    T_root_sensor: Array
    """(4, 4)."""
    clock_offset: float
    """The sensor's clock minus the root's, s."""


KINDS_OF_SENSORS = ("snapshots", "board_views", "floor_views", "beam_views", "drive_views", "drive_starts")
"""Fields of :class:`Pictures` that are of one sensor each."""


@dataclass(frozen=True, eq=False)
class Pictures:
    """What pictures of a calibration show, kept in scene.npz; empty in a result read back without it."""

    snapshots: tuple[Snapshot, ...] = ()
    """Images, scans and clouds of captures."""
    board_outlines: tuple[BoardOutline, ...] = ()
    board_views: tuple[BoardView, ...] = ()
    floor_views: tuple[FloorView, ...] = ()
    """Static background and tracks of each connected scanner of a network."""
    beam_views: tuple[BeamView, ...] = ()
    """Beams of each scanner that took part in the joint solution of a network."""
    drive_views: tuple[DriveView, ...] = ()
    """Points of each sensor that took part in the joint solution of a drive, by part."""
    drive_paths: tuple[DrivePath, ...] = ()
    """By part of a drive."""
    drive_starts: tuple[DriveStart, ...] = ()
    """Of the sensors but the root."""
    T_plan_root: Array = field(default_factory=lambda: np.eye(4))
    """(4, 4) pose of the root in the plan of a network, where z is up and the floor is at 0; identity for 2-D
    scanners, whose root is level."""

    def of_sensor(self, name: str) -> "Pictures":
        """The pictures without those of other sensors; boards, trajectories and the plan remain."""
        own: dict[str, Any] = {
            kind: tuple(one for one in getattr(self, kind) if one.sensor == name) for kind in KINDS_OF_SENSORS
        }
        return replace(self, **own)


def correct_pictures(pictures: Pictures, corrections: Mapping[str, Correction]) -> Pictures:
    """The pictures with the corrected points of scanners; residuals of board views remain."""
    learned = {name: one.learned() for name, one in corrections.items() if KINDS[one.kind].measures_ranges}

    def correct(sensor: str, points: NDArray[Any]) -> NDArray[Any]:
        return learned[sensor].correct(points).astype(points.dtype) if sensor in learned else points

    snapshots = (replace(one, points=correct(one.sensor, one.points)) for one in pictures.snapshots)
    views = (replace(one, measured=correct(one.sensor, one.measured)) for one in pictures.board_views)
    return replace(pictures, snapshots=tuple(snapshots), board_views=tuple(views))


def colorize_from_snapshots(
    x_root: Array,
    snapshots: Sequence[Snapshot],
    cameras: Mapping[str, CameraModel],
    T_root_sensor: Mapping[str, Array],
) -> tuple[NDArray[np.uint8], NDArray[np.bool_]]:
    """The colours of points in simultaneous images; of each point, from the first image that shows it.

    Args:
        x_root: (N, 3) in the root's frame, m.
        snapshots: of any sensors; images of cameras without intrinsics or pose are skipped.
        cameras: intrinsics by camera.
        T_root_sensor: (4, 4) by sensor.

    Returns:
        Red, green and blue (N, 3), 0 where the point is in no image; and whether it is in one (N,).
    """
    colors, is_colored = np.zeros((len(x_root), 3), dtype=np.uint8), np.zeros(len(x_root), dtype=np.bool_)
    for s in snapshots:
        if s.image and s.sensor in cameras and s.sensor in T_root_sensor:
            x_camera = se3.apply(se3.inverse(T_root_sensor[s.sensor]), x_root)
            camera_colors, is_visible = colorize_points(x_camera, cameras[s.sensor], s.picture)
            colors[is_visible & ~is_colored] = camera_colors[is_visible & ~is_colored]
            is_colored |= is_visible
    return colors, is_colored
