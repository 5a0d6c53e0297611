"""Numbers and names as they stand on the page."""

import math
from html import escape

from calgraph.result import SensorPose

KINDS = {"camera": "camera", "lidar2d": "2-D scanner", "lidar3d": "3-D LiDAR"}
"""What a sensor of a kind is called."""


def escaped(text: object) -> str:
    """Any text, safe inside HTML elements and quoted attributes."""
    return escape(str(text), quote=True)


def digits(value: float, significant: int = 2) -> str:
    """A number with so many significant digits and no exponent."""
    if math.isnan(value):
        return "?"
    if math.isinf(value):
        return "∞" if value > 0 else "−∞"
    if value == 0:
        return "0"
    # The exponent after rounding: 0.0996 has two digits as 0.10.
    exponent = int(f"{value:.{significant - 1}e}".split("e")[1])
    decimals = max(significant - 1 - exponent, 0)
    return f"{value:.{decimals}f}".replace("-", "−")


def fixed(value: float, decimals: int) -> str:
    """A number with so many decimals and a typographic minus; 0 for what rounds to -0."""
    if not math.isfinite(value):
        return digits(value)
    return f"{round(value, decimals) + 0.0:.{decimals}f}".replace("-", "−")


def length(metres: float) -> str:
    """A standard deviation or residual: millimetres, or metres where those get long."""
    if not math.isfinite(metres):
        return digits(metres)
    if abs(metres) >= 1:
        return f"{digits(metres)} m" if abs(metres) < 1e4 else "> 10 km"
    return f"{digits(1e3 * metres)} mm"


def angle(radians: float) -> str:
    """A standard deviation of a rotation in degrees; more than a turn says nothing."""
    degrees = math.degrees(radians)
    if math.isnan(degrees):
        return digits(degrees)
    return "> 180°" if degrees > 180 else f"{digits(degrees)}°"


def counted(number: int, noun: str) -> str:
    """``1 capture``, ``2 captures``."""
    return f"{number} {noun}{'' if number == 1 else 's'}"


def kind_of(sensor: SensorPose) -> str:
    """What the sensor is, in words."""
    return KINDS[sensor.kind]
