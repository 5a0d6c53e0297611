"""Sensor messages, independent of file formats: images, corners, scans, clouds; their record in a recording."""

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from calgraph.errors import InputError
from calgraph.geometry import Array
from calgraph.sensors.camera_model import CameraModel


class _Whole:
    """A message that is one measurement, without parts that may be missing."""

    is_empty: ClassVar[bool] = False
    """Whether it holds no measurement, as where data were lost."""
    duration: ClassVar[float] = 0.0
    """Time from its first to its last measurement, s."""


@dataclass(frozen=True, eq=False)
class Image(_Whole):
    """One camera image."""

    stamp: float
    """Header stamp, s."""
    frame_id: str
    """Frame of the header; empty if there is none."""
    pixels: NDArray[np.uint8]
    """(height, width) grey or (height, width, 3) BGR, 8 bits."""
    depth: NDArray[np.float32] | None = None
    """(height, width) of depth images, m along the optical axis, NaN where nothing was measured; the pixels are
    their picture."""
    topic_type: ClassVar[str] = "image"
    """Type of its topic in a plain folder and in memory."""
    measured: ClassVar[str] = "pixels"
    """Field with what was measured."""

    @property
    def content(self) -> str:
        """Its size, in words."""
        if self.depth is not None:
            measured = f", {np.mean(np.isfinite(self.depth)):.0%} with a depth"
            return "{1} x {0} pixels".format(*self.depth.shape) + measured
        color = ", colour" if self.pixels.ndim == 3 else ", grey"
        return "{1} x {0} pixels".format(*self.pixels.shape) + color

    @property
    def gray(self) -> NDArray[np.uint8]:
        """(height, width) grey values."""
        if self.pixels.ndim == 2:
            return self.pixels
        import cv2

        return np.asarray(cv2.cvtColor(self.pixels, cv2.COLOR_BGR2GRAY), dtype=np.uint8)


@dataclass(frozen=True, eq=False)
class DetectedCorners:
    """The corners of one board that another program detected in one camera image."""

    stamp: float
    """Time of the image, s."""
    frame_id: str
    board_points: Array
    """(N, 3) on the board, m: OpenCV's object points, x right and y down from the top left of the pattern."""
    pixels: Array
    """(N, 2) where they were detected, distorted as measured, OpenCV's pixel convention."""
    topic_type: ClassVar[str] = "corners"
    measured: ClassVar[str] = "pixels"
    duration: ClassVar[float] = 0.0

    @property
    def is_empty(self) -> bool:
        """See :class:`_Whole`."""
        return not len(self.pixels)

    @property
    def content(self) -> str:
        """See :class:`Image`."""
        return f"{len(self.pixels)} detected corners"


@dataclass(frozen=True, eq=False)
class LaserScan:
    """One scan of a 2-D scanner in its own plane z = 0, x forward, angles counter-clockwise from x."""

    stamp: float
    """Header stamp: the time of the first beam, s."""
    frame_id: str
    angles: Array
    """(N,) beam angles, rad."""
    ranges: Array
    """(N,) distances, m; NaN or infinite where nothing was measured (out of the stated limits included)."""
    time_increment: float = 0.0
    """Beam k is measured at ``stamp + k * time_increment``, s."""
    topic_type: ClassVar[str] = "scan"
    measured: ClassVar[str] = "ranges"

    def __post_init__(self) -> None:
        """Validates the ranges.

        Raises:
            InputError: a range is zero or negative, as some drivers mark beams without a measurement.
        """
        wrong = np.flatnonzero(np.isfinite(self.ranges) & (self.ranges <= 0))
        if len(wrong):
            beam = int(wrong[0])
            raise InputError(
                f"LaserScan at {self.stamp:.3f} s: beam {beam} has a range of {self.ranges[beam]:g} m; "
                "where nothing was measured it must be NaN or infinite"
            )

    @property
    def valid(self) -> NDArray[np.bool_]:
        """(N,) which beams have a measurement."""
        return np.asarray(np.isfinite(self.ranges))

    @property
    def points(self) -> Array:
        """(N, 3) end points in the scanner's frame (z = 0); NaN where nothing was measured."""
        r = np.where(self.valid, self.ranges, np.nan)
        return np.stack([r * np.cos(self.angles), r * np.sin(self.angles), 0 * r], axis=-1)

    @property
    def is_empty(self) -> bool:
        """See :class:`_Whole`."""
        return not self.valid.any()

    @property
    def content(self) -> str:
        """See :class:`Image`."""
        spread = np.degrees(np.ptp(self.angles)) if len(self.angles) else 0.0
        return f"{len(self.angles)} beams over {spread:.0f}°, {int(self.valid.sum())} with a range"

    @property
    def duration(self) -> float:
        """Time from the first to the last beam, s."""
        return abs(self.time_increment) * max(len(self.angles) - 1, 0)


@dataclass(frozen=True, eq=False)
class PointCloud:
    """One sweep of a 3-D scanner: finite points only, in the order of the message."""

    stamp: float
    """Header stamp, s."""
    frame_id: str
    points: Array
    """(N, 3), m, no NaN."""
    rings: NDArray[np.int32] | None = None
    """(N,) index of the laser (ring) that measured each point; None if the message has no rings."""
    times: Array | None = None
    """(N,) time of each point relative to ``stamp``, s; None if the message has no times."""
    topic_type: ClassVar[str] = "cloud"
    measured: ClassVar[str] = "points"

    @property
    def is_empty(self) -> bool:
        """See :class:`_Whole`."""
        return not len(self.points)

    @property
    def content(self) -> str:
        """See :class:`Image`."""
        rings = f", {len(np.unique(self.rings))} rings" if self.rings is not None else ""
        return f"{len(self.points)} points{rings}{', with times' if self.times is not None else ''}"

    @property
    def duration(self) -> float:
        """Time between the first and the last point, s; 0 where the points have no times."""
        return float(np.ptp(self.times)) if self.times is not None and len(self.times) else 0.0


@dataclass(frozen=True, eq=False)
class CameraInfo:
    """Intrinsics from a recording."""

    stamp: float
    frame_id: str
    camera: CameraModel
    topic_type: ClassVar[str] = "camera_info"

    @property
    def content(self) -> str:
        """See :class:`Image`."""
        camera = self.camera
        return (
            f"{camera.model}, {camera.width} x {camera.height}, {len(camera.distortion)} distortion coefficients"
        )


@dataclass(frozen=True, eq=False)
class Pose(_Whole):
    """The pose of a frame that moves, as another program estimates it."""

    stamp: float
    """Header stamp, s."""
    frame_id: str
    """The frame that moves; empty if the message states none."""
    position: Array
    """(3,) in a world that the program chose, m."""
    quaternion: Array
    """(4,) x, y, z, w of the rotation to that world, as the message states it: perhaps not of unit length."""
    topic_type: ClassVar[str] = "trajectory"
    measured: ClassVar[str] = "position"
    content: ClassVar[str] = "a pose"


@dataclass(frozen=True, eq=False)
class TransformList(_Whole):
    """Poses of frames in others, of tf."""

    stamp: float
    poses: tuple[Pose, ...]
    """With separate stamps."""
    parents: tuple[str, ...]
    """The frame in which each pose is."""
    frame_id: ClassVar[str] = ""
    topic_type: ClassVar[str] = "transforms"
    measured: ClassVar[str] = "positions"

    @property
    def positions(self) -> Array:
        """(N, 3) m."""
        return np.array([pose.position for pose in self.poses]).reshape(-1, 3)

    @property
    def content(self) -> str:
        """See :class:`Image`."""
        return f"{len(self.poses)} transforms"


@dataclass(frozen=True, eq=False)
class TurnRate(_Whole):
    """The turn rate that a gyroscope measures."""

    stamp: float
    """Header stamp, s."""
    frame_id: str
    rate: Array
    """(3,) about its axes, rad/s."""
    topic_type: ClassVar[str] = "turn_rate"
    measured: ClassVar[str] = "rate"
    content: ClassVar[str] = "a turn rate"


@dataclass(frozen=True)
class Trigger:
    """A message that marks the start of a capture; only its time matters."""

    stamp: float
    frame_id: ClassVar[str] = ""
    topic_type: ClassVar[str] = "trigger"
    content: ClassVar[str] = ""


Measurement = Image | DetectedCorners | LaserScan | PointCloud
"""What a sensor sends."""
Message = Measurement | Pose | TransformList | TurnRate | CameraInfo | Trigger


@dataclass(frozen=True)
class MessageDigest:
    """What is read of a message without decoding it."""

    frame_id: str
    """Frame of its header; empty if it states none."""
    content: int
    """Hash of samples of its content without the header: equal for equal content."""


@dataclass(frozen=True, eq=False)
class RecordedMessage:
    """A message of a recording, decoded on demand."""

    topic: str
    """Topic, or folder name in a plain folder."""
    stamp: float
    """Header stamp, or arrival time where the message has no header, s."""
    arrival: float
    """Time at which the recorder wrote it, s."""
    decode: Callable[[], Message] = field(repr=False)
    """Decodes the message; raises RecordingError naming topic and stamp if its content is unusable. Several worker
    processes require that it can be pickled."""
    digest: Callable[[], MessageDigest] | None = field(default=None, repr=False)
    """Reads its frame, and hashes its content; None where the source does not support it."""
