"""The rig: its sensors with their noise, its target, and how captures are marked in the recording."""

from collections.abc import Mapping
from difflib import get_close_matches
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import Field, Strict, model_validator

from calgraph.config.board_ambiguity import check_boards_distinguishable
from calgraph.config.settings import Settings
from calgraph.config.target import Board, Cylinder, People, Surroundings, Target, Tolerance
from calgraph.io.strict_model import StrictModel, invalid, limit_to
from calgraph.io.yaml_limits import MAX_RIG_VALUES
from calgraph.io.yaml_reading import read_yaml, validate_content
from calgraph.sensors import CameraModel
from calgraph.sensors.kinds import FLOOR, KINDS, CameraSpec, Lidar3dSpec, SensorSpec, TrajectorySpec
from calgraph.sensors.kinds.stated import FrameName, Name

_POSITIVE = Field(gt=0, allow_inf_nan=False)
Seconds = Annotated[float, Strict(), Field(ge=0, allow_inf_nan=False)]
Window = tuple[Seconds, Seconds]
Instant = Annotated[float, Strict(), Field(allow_inf_nan=False)]
Spread = Annotated[float, Strict(), _POSITIVE, limit_to(60, "s")]
DRIVE_KINDS = ("lidar2d", "lidar3d", "camera", "trajectory", "gyroscope")
"""Kinds of sensors that are calibrated from a drive."""
CaptureMode = Literal["rest", "snapshots", "synchronized"]


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


# No vehicle is wider, m.
_Side = Annotated[float, Strict(), Field(ge=-100, le=100, allow_inf_nan=False)]


class Base(StrictModel):
    """The frame of a vehicle that drives: on the floor below the centre of an axle, x ahead, z up."""

    frame: FrameName = "base_link"
    """Its name, at which exports are rooted."""
    axle: Literal["rear", "front", "middle"] = "rear"
    """The axle whose wheels do not steer: ``middle`` of a robot that steers by different speeds of its wheels."""
    y: _Side | None = None
    """Of the root, to the left of the middle of the axle, m, which no drive determines without ``wheels``."""
    wheels: str | None = None
    """The sensor that is the odometry of the wheels: distances of the middle of the axle determine y."""
    inverted: Annotated[bool, Strict()] = False
    """Whether the z axis of the root points down."""


class Rig(StrictModel):
    """A whole rig.yaml."""

    root: str
    """The sensor whose frame everything is expressed in.

    Or ``floor``, of a network of 3-D LiDARs: z is up, the origin below the first of them, x along its heading."""
    target: Target
    """A board (calgraph board prints it), people, a cylinder, or {kind: surroundings} for a robot that drives."""
    base: Base | None = None
    """The vehicle's frame, of a robot that drives."""
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
        if self.is_on_floor:
            if not self.is_network or self.reference == self.root:
                raise invalid("root", f"{FLOOR.name!r} needs 3-D LiDARs in target: {{kind: people}}")
        elif self.root not in self.sensors:
            close = get_close_matches(self.root, self.sensors, n=1)
            hint = (
                f"did you mean {close[0]!r}?"
                if close
                else "calgraph export joins the result to the URDF that other frames are of"
            )
            sensors = ", ".join(self.sensors)
            raise invalid("root", f"must be one of the sensors, {sensors}, got {self.root!r}; {hint}")
        return self

    @model_validator(mode="after")
    def _topics_differ(self) -> "Rig":
        owners: dict[tuple[str | None, ...], str] = {}
        for name, sensor in self.sensors.items():
            # One topic of tf has the trajectories of several frames.
            pair = (sensor.frame_id, sensor.parent) if isinstance(sensor, TrajectorySpec) and sensor.parent else ()
            other = owners.setdefault((sensor.topic, *pair), name)
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
                    raise invalid(f"sensors.{name}.{key}", "applies to networks only: other targets determine it")
        return self

    @model_validator(mode="after")
    def _clock_offsets_are_relative_to_the_root(self) -> "Rig":
        for name, sensor in self.sensors.items():
            if sensor.clock_offset is None:
                continue
            key = f"sensors.{name}.clock_offset"
            if self.is_network:
                raise invalid(key, "applies to rigs only: those of a network are estimated from tracks")
            if self.is_drive:
                raise invalid(key, "applies to rigs with a board only: those of a drive are estimated from turns")
            if name == self.root and sensor.clock_offset != "estimate":
                raise invalid(key, "is relative to the root's clock, and this is the root: leave it out")
        return self

    @model_validator(mode="after")
    def _drives_have_their_kinds(self) -> "Rig":
        for name, sensor in self.sensors.items():
            key = f"sensors.{name}.kind"
            if self.is_drive and sensor.kind not in DRIVE_KINDS:
                allowed = ", ".join(DRIVE_KINDS)
                raise invalid(key, f"must be one of {allowed} with surroundings, got {sensor.kind}")
            if not self.is_drive and KINDS[sensor.kind].detects == "motion":
                raise invalid(key, f"needs target: {{kind: surroundings}}, a robot that drives, got {sensor.kind}")
        if self.sensors[self.reference].kind == "gyroscope":
            raise invalid("root", f"must be a sensor with a trajectory, got the gyroscope {self.root!r}")
        if self.is_drive and self.cameras() and not self.boards:
            cameras = ", ".join(self.cameras())
            raise invalid("target.boards", f"must list the boards in the room that cameras detect ({cameras})")
        return self

    @model_validator(mode="after")
    def _base_is_of_drives(self) -> "Rig":
        if self.base and not self.is_drive:
            raise invalid("base", "applies to robots that drive only: other targets do not determine it")
        if self.base is None:
            return self
        others = {spec.frame_id for name, spec in self.sensors.items() if name != self.base.wheels}
        if self.base.frame in others:
            raise invalid("base.frame", f"is also the frame of a sensor, got {self.base.frame!r}")
        if self.base.wheels is not None:
            wheels = self.sensors.get(self.base.wheels)
            if wheels is None or wheels.kind != "trajectory":
                raise invalid("base.wheels", f"must be a sensor of kind trajectory, got {self.base.wheels!r}")
            if self.base.y is not None:
                raise invalid("base.wheels", "determines y: leave out base.y, or wheels")
        return self

    @model_validator(mode="after")
    def _boards_are_distinguishable(self) -> "Rig":
        check_boards_distinguishable(self.boards)
        return self

    @property
    def is_on_floor(self) -> bool:
        """Whether the root is the floor, no sensor."""
        return self.root == FLOOR.name and self.root not in self.sensors

    @property
    def reference(self) -> str:
        """The sensor that others are relative to: the root, or the first 3-D LiDAR where that is the floor."""
        lidars = (name for name, spec in self.sensors.items() if isinstance(spec, Lidar3dSpec))
        return next(lidars, self.root) if self.is_on_floor else self.root

    @property
    def is_network(self) -> bool:
        """Whether this is a network of scanners calibrated from moving objects, not a rig with boards."""
        return isinstance(self.target, People | Cylinder)

    @property
    def is_drive(self) -> bool:
        """Whether this is a robot that drives through surroundings, without a target."""
        return isinstance(self.target, Surroundings)

    @property
    def boards(self) -> tuple[Board, ...]:
        """The boards to detect; empty if the target has none."""
        if isinstance(self.target, Board):
            return (self.target,)
        if isinstance(self.target, Surroundings):
            return self.target.boards
        return self.target if isinstance(self.target, tuple) else ()

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


def load_rig(path: Path | str) -> Rig:
    """Reads a rig.yaml.

    Raises:
        InputError: the file is missing, is not YAML, has more values than any rig needs, or has invalid keys
            or values, each on one line.
    """
    path = Path(path)
    return validate_content(Rig, read_yaml(path, MAX_RIG_VALUES), path)
