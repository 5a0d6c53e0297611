"""The rig: its sensors with their noise, its target, and how captures are marked in the recording."""

from collections.abc import Mapping
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import Discriminator, Field, Strict, Tag, model_validator

from calgraph.config.board_ambiguity import check_boards_distinguishable
from calgraph.config.settings import Settings
from calgraph.config.strict_model import StrictModel, invalid, limit_to
from calgraph.config.target import Board, Cylinder, Length, People, Target
from calgraph.config.uncertainty import (
    CameraUncertainty,
    Lidar2dUncertainty,
    Lidar3dUncertainty,
    Metres,
    Tilt,
    Tolerance,
)
from calgraph.sensors import CameraModel

_POSITIVE = Field(gt=0, allow_inf_nan=False)
# More noise than this makes a sensor useless, and is a number in another unit.
_MAX_PIXELS = 20
PixelSigma = Annotated[float, Strict(), _POSITIVE, limit_to(_MAX_PIXELS, "pixels")]
RangeSigma = Annotated[float, Strict(), _POSITIVE, limit_to(1, "m")]
AngleSigma = Annotated[float, Strict(), _POSITIVE, limit_to(0.2, "rad")]
Seconds = Annotated[float, Strict(), Field(ge=0, allow_inf_nan=False)]
Window = tuple[Seconds, Seconds]
Instant = Annotated[float, Strict(), Field(allow_inf_nan=False)]
Spread = Annotated[float, Strict(), _POSITIVE, limit_to(60, "s")]
CaptureMode = Literal["rest", "snapshots", "synchronized"]
# ROS limits names of topics to 255 characters, and file systems those of files; control characters would reach
# terminals and tables.
MAX_NAME_LENGTH = 255
CONTROL_CHARACTERS = r"\x00-\x1f\x7f-\x9f\u2028\u2029"
FrameName = Annotated[str, Field(max_length=MAX_NAME_LENGTH, pattern=rf"^[^{CONTROL_CHARACTERS}]*$")]
Name = Annotated[FrameName, Field(min_length=1)]
# The largest sensors have 20,000 pixels a side, and the longest lenses focal lengths of some 100,000.
PixelCount = Annotated[int, Strict(), Field(ge=1, le=65_536)]
PixelLength = Annotated[Length, limit_to(1e6, "pixels")]
Coefficient = Annotated[float, Strict(), Field(ge=-1e6, le=1e6, allow_inf_nan=False)]


class Capture(StrictModel):
    """Intervals of the recording in which the target is searched for."""

    background: Window | None = None
    """Start and end of the time without target and operator, s from the start of the recording."""
    trigger: Name | None = None
    """Topic whose every message starts a capture; without it, holds are found by motion detection."""
    exclude: tuple[tuple[Instant, Instant], ...] = ()
    """Intervals to ignore, s from the start of the recording; negative if stamps are of a late clock."""
    mode: CaptureMode | None = None
    """``rest``: the board rests between moves. ``snapshots``: the sensors measured each pose of the board once.
    ``synchronized``: frames of all sensors with nearly equal stamps while the board moves. Found from the stamps
    if left out."""
    max_spread: Spread | None = None
    """Maximum time between the stamps of one snapshot or set of frames, s; found from the stamps if left out."""

    @model_validator(mode="after")
    def _fitting(self) -> "Capture":
        if self.trigger and self.mode in ("snapshots", "synchronized"):
            raise invalid(
                "trigger", f"marks times at which the board rests, but mode is {self.mode}: leave one out"
            )
        if self.max_spread and (self.trigger or self.mode == "rest"):
            raise invalid("max_spread", "is of snapshots and of synchronized frames, not of a board that rests")
        return self

    @model_validator(mode="after")
    def _ordered(self) -> "Capture":
        windows = {f"exclude[{i}]": window for i, window in enumerate(self.exclude)}
        if self.background:
            windows["background"] = self.background
        for key, (start, end) in windows.items():
            if end <= start:
                raise invalid(key, f"must end after it starts, got [{start:g}, {end:g}]")
        return self

    def allows(self, start: float, end: float) -> bool:
        """Whether an interval, s from the start of the recording, lies in no window without captures."""
        excluded = [*self.exclude, *([self.background] if self.background else [])]
        return not any(start < b and end > a for a, b in excluded)


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
            model_error=min(model_error, _MAX_PIXELS) or None,
        )

    def to_camera(self) -> CameraModel:
        """The camera model with these intrinsics."""
        fx, fy, cx, cy = self.K
        K = np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1.0]])
        return CameraModel(self.model, self.width, self.height, K, np.array(self.distortion))


EstimatedLens = Literal["estimate", "estimate pinhole", "estimate fisheye"]


def _word_or_values(value: Any) -> str:
    return "word" if isinstance(value, str) else "values"


# Clocks that count from the start of a computer are off by the time since 1970.
_StatedOffset = Annotated[float, Strict(), Field(ge=-1e10, le=1e10, allow_inf_nan=False)]
ClockOffset = Annotated[
    Annotated[_StatedOffset, Tag("values")] | Annotated[Literal["estimate"], Tag("word")],
    Discriminator(_word_or_values),
]
"""A sensor's clock minus the root's, s; or ``estimate``, to find it from the motion of the board."""


class PixelNoise(StrictModel):
    """Noise of a camera's corners."""

    pixel: PixelSigma = 0.3
    """Standard deviation of a corner in x and in y, pixels."""


class RangeNoise(StrictModel):
    """Noise of a scanner's beams (MSG-Cal, eqs. 7–9)."""

    range: RangeSigma = 0.02
    """Standard deviation along the beam, m."""
    angle: AngleSigma = 0.001
    """Standard deviation of the beam's direction, rad."""


class CameraSpec(StrictModel):
    """A camera of the rig."""

    kind: Literal["camera"] = "camera"
    topic: Name
    """Image topic; in a plain folder the sensor's folder."""
    camera_info: Name | None = None
    """Topic with its intrinsics."""
    intrinsics: (
        Annotated[
            Annotated[Intrinsics, Tag("values")] | Annotated[EstimatedLens, Tag("word")],
            Discriminator(_word_or_values),
        ]
        | None
    ) = None
    """The intrinsics, instead of a topic; or ``estimate``, to estimate them from the recording even if it states
    any, with the model that fits best, ``estimate pinhole`` or ``estimate fisheye``."""
    frame_id: Name | None = None
    """The sensor's frame; that of its messages' headers if left out."""
    clock_offset: ClockOffset | None = None
    """The sensor's clock minus the root's, s, of a rig whose sensors have different clocks."""
    noise: PixelNoise = PixelNoise()
    uncertainty: CameraUncertainty = CameraUncertainty()

    @model_validator(mode="after")
    def _one_source(self) -> "CameraSpec":
        if self.camera_info is not None and self.intrinsics is not None:
            raise invalid("", "give camera_info (a topic) or intrinsics, not both")
        return self

    @property
    def stated_intrinsics(self) -> Intrinsics | None:
        """The intrinsics, if they are stated."""
        return self.intrinsics if isinstance(self.intrinsics, Intrinsics) else None

    @property
    def lens_to_estimate(self) -> Literal["pinhole", "fisheye"] | None:
        """The model of intrinsics that are to be estimated, if it is stated."""
        models: dict[Any, Literal["pinhole", "fisheye"]] = {
            "estimate pinhole": "pinhole", "estimate fisheye": "fisheye",
        }  # fmt: skip
        return None if isinstance(self.intrinsics, Intrinsics) else models.get(self.intrinsics)


class Lidar2dSpec(StrictModel):
    """A 2-D laser scanner of the rig."""

    kind: Literal["lidar2d"] = "lidar2d"
    topic: Name
    """Topic of its messages; in a plain folder the sensor's folder."""
    frame_id: Name | None = None
    """The sensor's frame; that of its messages' headers if left out."""
    clock_offset: ClockOffset | None = None
    """The sensor's clock minus the root's, s, of a rig whose sensors have different clocks."""
    noise: RangeNoise = RangeNoise()
    mounting: Literal["upright", "inverted"] | None = None
    """Of a network's scanner: inverted if it is mounted upside-down. Recognised from mirrored tracks if left out;
    the root is then taken as upright."""
    height: Metres | None = None
    """Of a network's scanner above the floor, m. It is not measured; exports state it relative to the root's."""
    roll: Tilt | None = None
    """Of a network's scanner about its levelled x axis, degrees; not measured, but exported. That of a scanner
    mounted upside-down is without the 180°."""
    pitch: Tilt | None = None
    """The same about its levelled y axis, degrees."""
    uncertainty: Lidar2dUncertainty = Lidar2dUncertainty()


class Lidar3dSpec(StrictModel):
    """A 3-D LiDAR of the rig."""

    kind: Literal["lidar3d"] = "lidar3d"
    topic: Name
    """Topic of its messages; in a plain folder the sensor's folder."""
    frame_id: Name | None = None
    """The sensor's frame; that of its messages' headers if left out."""
    clock_offset: ClockOffset | None = None
    """The sensor's clock minus the root's, s, of a rig whose sensors have different clocks."""
    noise: RangeNoise = RangeNoise()
    uncertainty: Lidar3dUncertainty = Lidar3dUncertainty()


SensorSpec = Annotated[CameraSpec | Lidar2dSpec | Lidar3dSpec, Field(discriminator="kind")]


class Rig(StrictModel):
    """A whole rig.yaml."""

    root: str
    """The sensor whose frame everything is expressed in."""
    target: Target
    """The calibration target: one board, a list of boards, people or a cylinder. The command calgraph board prints
    the block of a board."""
    capture: Capture = Capture()
    """Intervals of the recording in which the target is searched for."""
    sensors: Annotated[dict[Name, SensorSpec], Field(min_length=1)]
    """The sensors by name."""
    tolerance: Tolerance = Tolerance()
    """The largest acceptable error of a pose."""
    settings: Settings = Settings()
    """The numbers that influence the result, stage by stage."""

    @model_validator(mode="after")
    def _root_exists(self) -> "Rig":
        if self.root not in self.sensors:
            raise invalid("root", f"must be one of the sensors, {', '.join(self.sensors)}, got {self.root!r}")
        return self

    @model_validator(mode="after")
    def _topics_differ(self) -> "Rig":
        owners: dict[str, str] = {}
        for name, sensor in self.sensors.items():
            other = owners.setdefault(sensor.topic, name)
            if other != name:
                raise invalid(f"sensors.{name}.topic", f"is also that of {other}, got {sensor.topic!r}")
        return self

    @model_validator(mode="after")
    def _cameras_need_a_print(self) -> "Rig":
        printed = [board for board in self.boards if board.tags or board.pattern]
        if self.boards and not printed and self.cameras():
            cameras = ", ".join(self.cameras())
            raise invalid("target", f"needs tags or a pattern, without which no camera detects it ({cameras})")
        return self

    @model_validator(mode="after")
    def _mountings_are_of_networks(self) -> "Rig":
        for name, sensor in self.sensors.items():
            for key in ("mounting", "height", "roll", "pitch"):
                if not self.is_network and getattr(sensor, key, None) is not None:
                    raise invalid(
                        f"sensors.{name}.{key}", "applies to networks only: a board determines all of a pose"
                    )
        return self

    @model_validator(mode="after")
    def _clock_offsets_are_relative_to_the_root(self) -> "Rig":
        for name, sensor in self.sensors.items():
            if sensor.clock_offset is None:
                continue
            key = f"sensors.{name}.clock_offset"
            if self.is_network:
                raise invalid(key, "applies to rigs only: those of a network are estimated from tracks")
            if name == self.root:
                raise invalid(key, "is relative to the root's clock, and this is the root: leave it out")
        return self

    @model_validator(mode="after")
    def _boards_are_distinguishable(self) -> "Rig":
        check_boards_distinguishable(self.boards)
        return self

    @property
    def is_network(self) -> bool:
        """Whether this is a network of scanners calibrated from moving objects, not a rig with boards."""
        return isinstance(self.target, People | Cylinder)

    @property
    def boards(self) -> tuple[Board, ...]:
        """The boards to detect; empty if the target is not a board."""
        if isinstance(self.target, Board):
            return (self.target,)
        return () if isinstance(self.target, People | Cylinder) else self.target

    @property
    def board_size(self) -> tuple[float, float]:
        """Width and height of the largest board, m."""
        return max((board.size for board in self.boards), key=lambda size: size[0] * size[1])

    @property
    def topics(self) -> Mapping[str, str]:
        """Topic by sensor."""
        return {name: spec.topic for name, spec in self.sensors.items()}

    def cameras(self) -> Mapping[str, CameraSpec]:
        """The cameras by name."""
        return {name: s for name, s in self.sensors.items() if isinstance(s, CameraSpec)}

    def camera_models(self) -> dict[str, CameraModel]:
        """Models of the cameras whose intrinsics are stated; see :func:`calgraph.recording.resolve_intrinsics`."""
        stated = {name: spec.stated_intrinsics for name, spec in self.cameras().items()}
        return {name: intrinsics.to_camera() for name, intrinsics in stated.items() if intrinsics}

    def to_plain(self) -> dict[str, Any]:
        """All keys, defaults included, as plain values for rig.resolved.yaml."""
        return self.model_dump(mode="json", exclude_none=True)
