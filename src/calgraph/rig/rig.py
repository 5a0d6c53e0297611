"""The rig: its sensors with their noise, its target, and how captures are marked in the recording."""

from collections.abc import Mapping
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import Field, field_validator, model_validator

from calgraph.rig.model import StrictModel
from calgraph.rig.target import Board, Cylinder, People, Target
from calgraph.sensors import CameraModel

Sigma = Annotated[float, Field(gt=0, allow_inf_nan=False)]
Seconds = Annotated[float, Field(ge=0, allow_inf_nan=False)]
Window = tuple[Seconds, Seconds]


class Capture(StrictModel):
    """Where in the recording the target is to be looked for."""

    background: Window | None = None
    """Start and end of the time without target and operator, s from the start of the recording."""
    trigger: str | None = None
    """Topic whose every message starts a capture; without it holds are found by stillness."""
    exclude: tuple[Window, ...] = ()
    """Times to ignore, s from the start of the recording."""

    @model_validator(mode="after")
    def _ordered(self) -> "Capture":
        for start, end in (*([self.background] if self.background else []), *self.exclude):
            if end <= start:
                raise ValueError(f"a window must end after it starts, got [{start}, {end}]")
        return self


class Intrinsics(StrictModel):
    """A camera's intrinsics, as :class:`calgraph.sensors.CameraModel` explains them."""

    model: Literal["pinhole", "fisheye"] = "pinhole"
    width: Annotated[int, Field(gt=0)]
    height: Annotated[int, Field(gt=0)]
    K: tuple[float, float, float, float]
    """fx, fy, cx, cy, pixels."""
    distortion: tuple[float, ...] = ()

    @field_validator("distortion")
    @classmethod
    def _known_length(cls, value: tuple[float, ...]) -> tuple[float, ...]:
        if len(value) not in (0, 4, 5, 8):
            raise ValueError(f"distortion has 0, 4, 5 or 8 coefficients, got {len(value)}")
        return value

    def camera(self) -> CameraModel:
        """The camera model with these intrinsics."""
        fx, fy, cx, cy = self.K
        K = np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1.0]])
        return CameraModel(self.model, self.width, self.height, K, np.array(self.distortion))


class PixelNoise(StrictModel):
    """Noise of a camera's corners."""

    pixel: Sigma = 0.3
    """Standard deviation of a corner in x and in y, pixels."""


class RangeNoise(StrictModel):
    """Noise of a scanner's beams (MSG-Cal, eqs. 7–9)."""

    range: Sigma = 0.02
    """Standard deviation along the beam, m."""
    angle: Sigma = 0.001
    """Standard deviation of the beam's direction, rad."""


class CameraSpec(StrictModel):
    """A camera of the rig."""

    kind: Literal["camera"]
    topic: str
    """Image topic; in a plain folder the sensor's folder."""
    camera_info: str | None = None
    """Topic with its intrinsics."""
    intrinsics: Intrinsics | None = None
    frame_id: str | None = None
    noise: PixelNoise = PixelNoise()

    @model_validator(mode="after")
    def _one_source(self) -> "CameraSpec":
        if self.camera_info is not None and self.intrinsics is not None:
            raise ValueError("give camera_info (a topic) or intrinsics, not both")
        return self


class Lidar2dSpec(StrictModel):
    """A 2-D laser scanner of the rig."""

    kind: Literal["lidar2d"]
    topic: str
    frame_id: str | None = None
    noise: RangeNoise = RangeNoise()


class Lidar3dSpec(StrictModel):
    """A 3-D LiDAR of the rig."""

    kind: Literal["lidar3d"]
    topic: str
    frame_id: str | None = None
    noise: RangeNoise = RangeNoise()


SensorSpec = Annotated[CameraSpec | Lidar2dSpec | Lidar3dSpec, Field(discriminator="kind")]


class Rig(StrictModel):
    """A whole rig.yaml."""

    root: str
    """The sensor whose frame everything is expressed in."""
    target: Target | tuple[Board, ...]
    capture: Capture = Capture()
    sensors: dict[str, SensorSpec]

    @model_validator(mode="after")
    def _root_exists(self) -> "Rig":
        if self.root not in self.sensors:
            raise ValueError(f"root {self.root!r} is not one of the sensors: {', '.join(self.sensors)}")
        return self

    @property
    def boards(self) -> tuple[Board, ...]:
        """The boards to look for; empty if the target is not a board."""
        if isinstance(self.target, Board):
            return (self.target,)
        return () if isinstance(self.target, People | Cylinder) else self.target

    def cameras(self) -> Mapping[str, CameraSpec]:
        """The cameras by name."""
        return {name: s for name, s in self.sensors.items() if isinstance(s, CameraSpec)}

    def settings(self) -> dict[str, Any]:
        """All settings, defaults included, as plain values for rig.resolved.yaml."""
        return self.model_dump(mode="json", exclude_none=True)
