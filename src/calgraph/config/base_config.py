"""The frame of a vehicle, as rig.yaml states it."""

from typing import Annotated, Literal

from pydantic import Field, Strict

from calgraph.io.strict_model import StrictModel
from calgraph.sensors.kinds.stated import FrameName

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
