"""The options of a simulated rig recording. Angles are in degrees, as on the command line."""

from typing import Annotated, Literal

from pydantic import Field, model_validator

from calgraph.config import Board, Tag
from calgraph.config.board_ambiguity import check_boards_distinguishable
from calgraph.io.strict_model import StrictModel

# Upper limits are far above those of real sensors and rooms: beyond them no machine has the memory or the time.
Positive = Annotated[float, Field(gt=0, le=1e6, allow_inf_nan=False)]
NotNegative = Annotated[float, Field(ge=0, le=1e6, allow_inf_nan=False)]
Finite = Annotated[float, Field(ge=-1e6, le=1e6, allow_inf_nan=False)]
Stamp = Annotated[float, Field(ge=0, le=1e10, allow_inf_nan=False)]
Probability = Annotated[float, Field(ge=0, le=1)]
Count = Annotated[int, Field(ge=0, le=1000)]
Pixels = Annotated[int, Field(ge=32, le=20_000)]
Rate = Annotated[float, Field(gt=0, le=10_000, allow_inf_nan=False)]
Resolution = Annotated[float, Field(ge=0.01, le=720)]

MEASUREMENTS_PER_HOLD = 2
"""Complete measurements of every sensor in a hold without a given duration."""


class CameraOptions(StrictModel):
    """The cameras of the simulated robot."""

    count: Count = 1
    """Number of cameras, 60 degrees apart, the middle one facing ahead."""
    rate: Rate = 3.0
    """Images per second."""
    width: Pixels = 1280
    """Pixels."""
    height: Pixels = 960
    """Pixels."""
    field_of_view: Annotated[float, Field(gt=1, lt=200)] = 90.0
    """Horizontal, of the undistorted lens, degrees; a pinhole needs less than 180."""
    model: Literal["pinhole", "fisheye"] = "pinhole"
    """Lens: pinhole with optional plumb_bob or rational distortion, or equidistant fisheye."""
    distortion: tuple[Finite, ...] = ()
    """Coefficients in OpenCV's order: none, 4, 5 or 8 for a pinhole, none or 4 for a fisheye."""
    noise: NotNegative = 1.0
    """Standard deviation of a pixel, grey values of 255."""
    blur: NotNegative = 0.6
    """Standard deviation of the lens' point spread, pixels."""
    encoding: Literal["jpeg", "png", "raw"] = "jpeg"
    """Encoding of the recorded images."""
    texels_per_mm: Annotated[float, Field(gt=0, le=20)] = 2.0
    """Resolution at which the board's face is drawn."""

    @model_validator(mode="after")
    def _possible_lens(self) -> "CameraOptions":
        if self.model == "pinhole" and self.field_of_view >= 175:
            raise ValueError("a pinhole's field_of_view must be below 175 degrees; take model fisheye")
        return self


class BeamOptions(StrictModel):
    """Noise and range of a scanner's beams (MSG-Cal, eqs. 7–9)."""

    range_noise: NotNegative = 0.012
    """Standard deviation along the beam, m."""
    angle_noise: NotNegative = 0.001
    """Standard deviation of a beam's direction, rad."""
    mixed_pixels: Probability = 0.3
    """Probability that one of the two beams at a depth edge falls between the two depths."""
    dropout: Probability = 0.005
    """Probability that a beam returns nothing."""
    min_range: NotNegative = 0.1
    """m."""
    max_range: Positive = 30.0
    """m."""


class LaserOptions(BeamOptions):
    """The 2-D scanners of the simulated robot."""

    count: Count = 3
    """Number of scanners: front, left, right, then behind."""
    rate: Rate = 20.0
    """Published scans per second; a driver may skip some turns of the mirror."""
    mirror_rate: Rate = 40.0
    """Turns of the mirror per second."""
    field_of_view: Annotated[float, Field(gt=0, le=360)] = 270.0
    """Degrees."""
    resolution: Resolution = 0.25
    """Degrees between beams."""
    tilt: Finite = 6.0
    """Tilt of the scan planes, each in a different direction, degrees."""

    @model_validator(mode="after")
    def _mirror_keeps_up(self) -> "LaserOptions":
        if self.mirror_rate < self.rate:
            raise ValueError(f"mirror_rate must be at least the rate, {self.rate}")
        return self


class SpinningOptions(BeamOptions):
    """The 3-D scanners made of a slowly spinning 2-D scanner (MSG-Cal, Fig. 4)."""

    range_noise: NotNegative = 0.015
    """Standard deviation along the beam, m."""
    count: Count = 1
    """Number of scanners."""
    scan_rate: Rate = 50.0
    """Scans per second of the 2-D scanner."""
    field_of_view: Annotated[float, Field(gt=0, le=360)] = 270.0
    """Of the 2-D scanner, degrees."""
    resolution: Resolution = 0.5
    """Between the beams of the 2-D scanner, degrees."""
    tilt: Finite = 8.0
    """Of its forward axis away from the axis of rotation, degrees."""
    offset: Finite = 0.05
    """Of the 2-D scanner from the axis of rotation, m."""
    scans_per_degree: Annotated[float, Field(gt=0, le=1000)] = 1 / 3
    """Scans per degree of rotation; with scan_rate and scan_angle this gives the duration of a sweep."""
    scan_angle: Annotated[float, Field(gt=0, le=360)] = 180.0
    """Rotation of a sweep, degrees; 180 cover all azimuths because the scanner measures to both sides."""


class MultibeamOptions(BeamOptions):
    """The 3-D LiDARs with several beams at fixed elevations."""

    count: Count = 0
    """Number of scanners."""
    rate: Rate = 10.0
    """Sweeps per second."""
    rings: Annotated[int, Field(ge=2, le=1000)] = 16
    """Beams."""
    lowest: Finite = -15.0
    """Elevation of the lowest beam, degrees."""
    highest: Finite = 15.0
    """Elevation of the highest beam, degrees."""
    resolution: Resolution = 0.2
    """Degrees of azimuth between columns."""


class DepthOptions(StrictModel):
    """The depth cameras of the simulated robot: stereo cameras, which match windows of pixels."""

    count: Count = 0
    """Number of depth cameras, 60 degrees apart, the middle one facing ahead."""
    rate: Rate = 3.0
    """Images per second."""
    width: Pixels = 320
    """Pixels."""
    height: Pixels = 240
    """Pixels."""
    field_of_view: Annotated[float, Field(gt=1, lt=170)] = 70.0
    """Horizontal, degrees."""
    distortion: tuple[Finite, ...] = ()
    """Coefficients in OpenCV's order: none, 4, 5 or 8."""
    noise: NotNegative = 0.003
    """Standard deviation of a depth at 1 m, m; it grows with the square of the depth."""
    warp: NotNegative = 0.002
    """Standard deviation of its constant errors, of the whole image and of its border, m at 1 m."""
    window: Annotated[int, Field(ge=1, le=31)] = 3
    """Edge of the matching window, pixels: errors within it are correlated, and near objects grow."""
    min_range: NotNegative = 0.3
    """m."""
    max_range: Positive = 6.0
    """m."""


class RigScenario(StrictModel):
    """A robot, a board, and an operator who carries it around."""

    camera: CameraOptions = CameraOptions()
    laser: LaserOptions = LaserOptions()
    spinning: SpinningOptions = SpinningOptions()
    multibeam: MultibeamOptions = MultibeamOptions()
    depth: DepthOptions = DepthOptions()
    root: str | None = None
    """The sensor that everything is expressed in; the first LiDAR, or else the first sensor, if left out."""
    mount_position: NotNegative = 0.15
    """Largest offset of each sensor from its nominal position along each axis, m."""
    mount_rotation: NotNegative = 4.0
    """Largest rotation of each sensor about each axis, degrees."""

    board: Board = Board(
        size=(1.2, 0.9),
        tags=(
            Tag(id=0, size=0.32, center=(-0.38, 0.2)),
            Tag(id=1, size=0.32, center=(0.38, 0.2)),
            Tag(id=2, size=0.32, center=(0.0, -0.2)),
        ),
    )
    """The board and its print."""
    companions: tuple[Board, ...] = ()
    """Further boards, shown simultaneously, each by another operator to the left of the previous one."""

    bearings: Annotated[tuple[Finite, ...], Field(min_length=1)] = (
        -130, -80, -45, -30, -20, -10, 10, 20, 30, 45, 80, 130,
    )  # fmt: skip
    """Directions in which the board is shown, degrees to the left of ahead, in the order of the walk."""
    radii: Annotated[tuple[Positive, ...], Field(min_length=1)] = (1.7, 2.5)
    """Distances at which the board is shown, m."""
    samples: Annotated[int, Field(ge=1, le=1000)] = 2
    """Random rotations of the board at each bearing and radius."""
    max_rotation: Annotated[float, Field(ge=0, le=80)] = 30.0
    """Largest roll, pitch and yaw relative to facing the robot, degrees."""
    heights: tuple[Finite, Finite] = (0.75, 1.1)
    """Lowest and highest centre of the board, m above the ground."""

    background: Positive = 5.0
    """Duration of the empty room at the start, s."""
    move_time: Positive = 0.8
    """Duration of a move from one pose to the next, s."""
    hold_time: Positive | None = None
    """Duration of a hold, s; if left out, until every sensor has completed two measurements."""
    trigger: bool = True
    """Whether a message marks the start of every hold."""
    disturbed: Probability = 0.0
    """Fraction of the captures in which the board slips during the hold."""
    slip_distance: NotNegative = 0.06
    """Distance of the slip, m."""
    slip_rotation: NotNegative = 4.0
    """Rotation of the slip, degrees."""
    clutter: Count = 8
    """Number of boxes and columns in the room."""
    start_time: Stamp = 1_700_000_000.0
    """Stamp at the start of the recording, s."""

    @model_validator(mode="after")
    def _consistent(self) -> "RigScenario":
        options = (self.camera, self.laser, self.spinning, self.multibeam, self.depth)
        if sum(one.count for one in options) < 2:
            raise ValueError("a rig needs at least two sensors")
        if self.heights[1] < self.heights[0]:
            raise ValueError(f"heights must be lowest, highest, got {list(self.heights)}")
        check_boards_distinguishable(self.boards)
        return self

    @property
    def boards(self) -> tuple[Board, ...]:
        """All boards, in the order of rig.yaml."""
        return (self.board, *self.companions)

    @property
    def captures(self) -> int:
        """Number of captures."""
        return len(self.bearings) * len(self.radii) * self.samples
