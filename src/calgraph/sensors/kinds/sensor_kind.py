"""What all code that is not of one wing needs to know of a kind of sensor."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

from calgraph.io.strict_model import StrictModel
from calgraph.sensors.camera_model import CameraModel
from calgraph.sensors.messages import Image, Message

LEVEL_AXES = ("forward (x)", "sideways (y)", "height (z)", "roll (about x)", "pitch (about y)", "yaw (about z)")
"""Names of the axes of a frame with x forward and z up."""
OPTICAL_AXES = ("sideways (x)", "height (y)", "depth (z)", "pitch (about x)", "yaw (about y)", "roll (about z)")
"""The same with z forward and y down."""


def foxglove_types(*names: str) -> tuple[str, ...]:
    """Names of types of Foxglove's messages: in its own schemas, and as messages of ROS."""
    return tuple(f"{package}{name}" for name in names for package in ("foxglove.", "foxglove_msgs/msg/"))


@dataclass(frozen=True)
class SensorKind:
    """One kind of sensor."""

    name: str
    """As rig.yaml and calibration.yaml state it."""
    title: str
    """What people call it."""
    spec: type[StrictModel]
    """Its part of rig.yaml."""
    messages: tuple[type[Message], ...]
    """What it sends; the first is what else a message of this kind is called in errors."""
    types: tuple[str, ...]
    """Types of topics, of ROS and of plain folders, that are of this kind unless another kind claims them."""
    detects: Literal["corners", "plane", "line", "motion", "nothing"]
    """What it measures of a board; ``motion`` of kinds that are calibrated in a drive only, ``nothing`` of a
    floor."""
    axes: tuple[str, ...]
    """Names of the six axes of its frame: along x, y, z, and about them."""
    shape: Literal["frustum", "disc", "rings", "axes"]
    """How its field of view is drawn; ``axes`` of kinds without one."""
    color: str
    """In which it is drawn on a dark page."""
    default_name: str
    """Of a sensor whose topic has only generic parts."""
    residual: str
    """What its residuals on a board are called."""
    noise_causes: str
    """What to check where its measurements are noisier than stated,"""
    error_causes: str
    """and where its residuals contradict those of other sensors."""
    correction: str
    """How its data are corrected by its systematic parameters, for people and other programs."""
    drafted_noise: str = ""
    """The noise that a drafted rig.yaml states, of kinds whose noise is stated."""
    claims: Callable[[Message], bool] = lambda _message: False
    """Whether a topic is of this kind by its first message, for any type of topic."""
    convert: Callable[[Image, CameraModel], Message] | None = None
    """What its images measured, with its intrinsics, of kinds whose images are not searched themselves. Raises
    ValueError where an image has no such measurements."""

    states_frame: bool = True
    """Whether the headers of its messages state its frame, not that in which it moves."""

    @property
    def optical(self) -> bool:
        """Whether its frame has z forward and y down."""
        return self.axes == OPTICAL_AXES

    @property
    def measures_ranges(self) -> bool:
        """Whether it measures distances, so that it may have a background."""
        return self.detects in ("plane", "line")


FLOOR = SensorKind(
    name="floor",
    title="floor",
    spec=StrictModel,
    messages=(),
    types=(),
    detects="nothing",
    axes=LEVEL_AXES,
    shape="axes",
    color="#a8a8a8",
    default_name="floor",
    residual="",
    noise_causes="",
    error_causes="",
    correction="",
)
"""The root of a network may be the floor: no sensor, but a frame that poses are stated in."""
