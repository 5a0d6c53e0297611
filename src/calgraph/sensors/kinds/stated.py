"""What rig.yaml states of sensors of several kinds: clocks, noise and prior standard deviations."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Annotated, Any, Literal, NoReturn, Self

import numpy as np
from pydantic import Discriminator, Field, Strict, Tag, model_validator

from calgraph.geometry import Array
from calgraph.io.quantities import MAX_PIXELS, AngleSigma, LengthStddev, PixelSigma, RangeSigma, Ratio, TimeStddev
from calgraph.io.strict_model import StrictModel, invalid, limit_to
from calgraph.sensors.camera_model import CameraModel

# The largest sensors have 20,000 pixels a side, and the longest lenses focal lengths of some 100,000.
PixelCount = Annotated[int, Strict(), Field(ge=1, le=65_536)]
PixelLength = Annotated[float, Strict(), Field(gt=0, allow_inf_nan=False), limit_to(1e6, "pixels")]
Coefficient = Annotated[float, Strict(), Field(ge=-1e6, le=1e6, allow_inf_nan=False)]


class Intrinsics(StrictModel):
    """A camera's intrinsics, as :class:`calgraph.sensors.CameraModel` explains them."""

    model: Literal["pinhole", "fisheye"] = "pinhole"
    """``fisheye`` is OpenCV's equidistant model."""
    width: PixelCount
    """Pixels."""
    height: PixelCount
    """Pixels."""
    K: tuple[PixelLength, PixelLength, Coefficient, Coefficient]
    """fx, fy, cx, cy, pixels."""
    distortion: tuple[Coefficient, ...] = ()
    """OpenCV's coefficients: k1 k2 p1 p2 [k3 [k4 k5 k6]], or k1 to k4 for fisheye; none for no distortion."""
    estimated_from_views: Annotated[int, Strict(), Field(ge=1)] | None = None
    """Number of views of the recording that they were estimated from; left out where they are stated."""
    model_error: PixelSigma | None = None
    """RMS displacement of pixels that the model of the lens does not have, estimated with them."""

    @model_validator(mode="after")
    def _known_length(self) -> "Intrinsics":
        lengths = (0, 4) if self.model == "fisheye" else (0, 4, 5, 8)
        if len(self.distortion) not in lengths:
            allowed = f"{', '.join(map(str, lengths[:-1]))} or {lengths[-1]}"
            raise invalid("distortion", f"{self.model} has {allowed} coefficients, got {len(self.distortion)}")
        return self

    @classmethod
    def from_camera(
        cls, camera: CameraModel, estimated_from_views: int | None = None, model_error: float = 0.0
    ) -> "Intrinsics":
        """The intrinsics of a camera model; an error of the model of 0 is left out."""
        return cls(
            model=camera.model,
            width=camera.width,
            height=camera.height,
            K=(*camera.focal.tolist(), *camera.principal_point.tolist()),
            distortion=tuple(camera.distortion.tolist()),
            estimated_from_views=estimated_from_views,
            model_error=min(model_error, MAX_PIXELS) or None,
        )

    def to_camera(self) -> CameraModel:
        """The camera model with these intrinsics."""
        fx, fy, cx, cy = self.K
        K = np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1.0]])
        return CameraModel(self.model, self.width, self.height, K, np.array(self.distortion))


# ROS limits names of topics to 255 characters, and file systems those of files; control characters would reach
# terminals and tables.
MAX_NAME_LENGTH = 255
CONTROL_CHARACTERS = r"\x00-\x1f\x7f-\x9f\u2028\u2029"
FrameName = Annotated[str, Field(max_length=MAX_NAME_LENGTH, pattern=rf"^[^{CONTROL_CHARACTERS}]*$")]
Name = Annotated[FrameName, Field(min_length=1)]


def word_or_values(value: Any) -> str:
    """Which of two forms a value has, for unions of a word and of values."""
    return "word" if isinstance(value, str) else "values"


# Clocks that count from the start of a computer are off by the time since 1970.
_StatedOffset = Annotated[float, Strict(), Field(ge=-1e10, le=1e10, allow_inf_nan=False)]
ClockOffset = Annotated[
    Annotated[_StatedOffset, Tag("values")] | Annotated[Literal["estimate"], Tag("word")],
    Discriminator(word_or_values),
]
"""A sensor's clock minus the root's, s; or ``estimate``, to find it from the motion of the board."""


class RangeNoise(StrictModel):
    """Noise of a scanner's beams (MSG-Cal, eqs. 7–9)."""

    range: RangeSigma = 0.02
    """Standard deviation along the beam, m."""
    angle: AngleSigma = 0.001
    """Standard deviation of the beam's direction, rad."""

    def at(self, distance: float | Array) -> Array:
        """Standard deviations (N,) of measurements at distances (N,), m: the same at all."""
        return np.full(np.shape(distance), self.range)

    def of_beams(self, ranges: Array, directions: Array) -> Array:  # noqa: ARG002
        """Standard deviations (N,) of ranges (N,) along directions (N, 3), m."""
        return np.full(len(ranges), self.range)


@dataclass(frozen=True)
class BeamError:
    """A systematic error of a scanner: its prior, how it changes beams, and what is reported of it."""

    quantity: str
    """What it is called in results and, without a clause, in messages."""
    unit: str
    """``m``, ``rad``, or nothing for ratios."""
    stddev: float
    """Prior standard deviation; 0 means exact."""
    stated: float = 0.0
    lengthen: Callable[[Array], Array] | None = None
    """By how much (N,) or (1,), m, one unit lengthens ranges of 1 m along directions (N, 3), sensor frame;"""
    power: int = 0
    """others by as much times this power of them."""
    turn: Callable[[Array], Array] | None = None
    """Rotation vectors (N, 3), rad, by which one unit turns directions (N, 3), sensor frame."""
    clause: str = ""
    """See :class:`calgraph.verdict.parameter_estimates.DescribedParameter`."""


def list_turns(errors: Sequence[BeamError], directions: Array) -> Array:
    """Rotation vectors (3, E, N), rad, of directions (N, 3) by one unit of each of the E errors that turn them.

    The derivative of a turned vector v by a value is the cross product of the rotation vector and v; where several
    errors turn, to first order in the others.
    """
    turns = [error.turn(directions).T for error in errors if error.turn]
    return np.stack(turns, axis=1) if turns else np.zeros((3, 0, len(directions)))


def lengthen_equally(directions: Array) -> Array:  # noqa: ARG001
    """(1,), the same for all directions (N, 3): see :attr:`BeamError.lengthen`."""
    return np.ones(1)


class TimeUncertainty(StrictModel):
    """What all sensors share."""

    stamp_delay: TimeStddev = 0.02
    """Seconds, by which it measures later than its stamps, relative to the root; only where the board moves.
    Drivers stamp images when exposures begin or when they arrive, 5 to 30 ms off."""


class RangeUncertainty(TimeUncertainty):
    """What scanners with one and with several beams share."""

    range_bias: LengthStddev = 0.02
    """m, the same for all beams. Data sheets state ±30 mm (Velodyne VLP-16, SICK LMS1xx, Hokuyo UTM-30LX up to
    10 m) to ±60 mm (SICK TiM), as limits: one and a half to three of these standard deviations."""
    range_scale: Ratio = 0.003
    """Relative. Clocks of scanners are better, but a linearity error of ±30 mm over 10 m has this slope.
    Triangulating and cheap phase-shift scanners need 1 %: Hokuyo URG-04LX and RPLIDAR A1 state 1 % of the
    range."""

    def beam_errors(self) -> tuple[BeamError, ...]:
        """The table of all systematic errors of one scanner's beams; kinds with more of them add theirs."""
        longer = "ranges of {of} are {size} longer|shorter than they should be"
        return (
            BeamError("range bias", "m", self.range_bias, lengthen=lengthen_equally, clause=longer),
            BeamError("range scale", "", self.range_scale, 1.0, lengthen_equally, power=1, clause=longer),
        )


class ScannerSpec(StrictModel):
    """What a 2-D scanner and a 3-D LiDAR state."""

    kind: str
    topic: Name
    """Topic of its messages; in a plain folder the sensor's folder."""
    frame_id: Name | None = None
    """The sensor's frame; that of its messages' headers if left out."""
    clock_offset: ClockOffset | None = None
    """The sensor's clock minus the root's, s, of a rig whose sensors have different clocks."""
    noise: RangeNoise = RangeNoise()


class MotionSpec(StrictModel):
    """What a sensor states that measures motion only, and is calibrated in a drive."""

    topic: Name
    """Topic of its messages; of a text file with a pose in each line, the file's name without suffix."""
    frame_id: Name | None = None
    """The sensor's frame; that of its messages if left out."""
    clock_offset: ClockOffset | None = None
    """Of rigs with a board only; estimated in a drive."""
    uncertainty: TimeUncertainty = TimeUncertainty()

    @property
    def noise(self) -> NoReturn:
        """It is estimated, and only rigs with a board, which have no such sensors, state noise.

        Raises:
            AttributeError: always.
        """
        raise AttributeError("the noise of a trajectory or gyroscope is estimated, not stated")

    @property
    def stated_intrinsics(self) -> None:
        """None: it is no camera."""
        return None


class OpticalSpec(StrictModel):
    """What a sensor with a lens states."""

    kind: str
    topic: Name
    """Image topic; in a plain folder the sensor's folder."""
    camera_info: Name | None = None
    """Topic with its intrinsics."""
    intrinsics: Any = None
    """The intrinsics, instead of a topic."""
    frame_id: Name | None = None
    """The sensor's frame; that of its messages' headers if left out."""
    clock_offset: ClockOffset | None = None
    """The sensor's clock minus the root's, s, of a rig whose sensors have different clocks."""

    @model_validator(mode="after")
    def _one_source(self) -> Self:
        if self.camera_info is not None and self.intrinsics is not None:
            raise invalid("", "give camera_info (a topic) or intrinsics, not both")
        return self

    @property
    def stated_intrinsics(self) -> Intrinsics | None:
        """The intrinsics, if they are stated."""
        return self.intrinsics if isinstance(self.intrinsics, Intrinsics) else None
