"""What a calibration estimated besides poses."""

from dataclasses import dataclass


@dataclass(frozen=True)
class Estimated:
    """A number of a sensor or of the target, with what it was taken to be beforehand."""

    of: str
    """A sensor, or a tag: ``tag 3``."""
    quantity: str
    """``range bias``; fx, fy, cx, cy, k1 and so on of a camera; x, y, rotation of a tag off its stated place."""
    unit: str
    """``m``, ``px``, ``rad``, or nothing."""
    stated: float
    value: float
    stddev: float
    measured: bool
    """Whether the captures tell it; where they do not, it is hardly better known than before."""
