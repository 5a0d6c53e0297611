"""Formatting of numbers and names on the page."""

import math

import numpy as np

from calgraph.geometry.so3 import roll_pitch_yaw
from calgraph.result import BaseFrame


def format_significant(value: float, significant: int = 2) -> str:
    """A number with ``significant`` digits and no exponent."""
    if math.isnan(value):
        return "?"
    if math.isinf(value):
        return "∞" if value > 0 else "−∞"
    if value == 0:
        return "0"
    # The exponent after rounding: 0.0996 is 0.10 with two digits.
    exponent = int(f"{value:.{significant - 1}e}".split("e")[1])
    decimals = max(significant - 1 - exponent, 0)
    return f"{value:.{decimals}f}".replace("-", "−")


def format_fixed(value: float, decimals: int) -> str:
    """A number with ``decimals`` decimals and a typographic minus; -0 becomes 0."""
    if not math.isfinite(value):
        return format_significant(value)
    return f"{round(value, decimals) + 0.0:.{decimals}f}".replace("-", "−")


def format_length(meters: float) -> str:
    """A standard deviation or residual in millimetres, or in metres from 1 m."""
    if not math.isfinite(meters):
        return format_significant(meters)
    if abs(meters) >= 1:
        return f"{format_significant(meters)} m" if abs(meters) < 1e4 else "> 10 km"
    return f"{format_significant(1e3 * meters)} mm"


def format_angle(radians: float) -> str:
    """A standard deviation of a rotation in degrees; beyond half a turn it is uninformative."""
    degrees = math.degrees(radians)
    if math.isnan(degrees):
        return format_significant(degrees)
    return "> 180°" if degrees > 180 else f"{format_significant(degrees)}°"


def format_count(number: int, noun: str) -> str:
    """``1 capture``, ``2 captures``."""
    return f"{number} {noun}{'' if number == 1 else 's'}"


_AXES_OF_BASE = ("x", "y", "z", "roll", "pitch", "yaw")


def format_base(base: BaseFrame) -> dict[str, str]:
    """By axis, the place of the root on the vehicle, m, and its roll, pitch and yaw, degrees, ± σ if measured."""
    if not base.known:
        return {}
    values = [*base.T_base_root[:3, 3], *np.degrees(roll_pitch_yaw(base.T_base_root[:3, :3]))]
    texts = {}
    for axis, value, stddev in zip(_AXES_OF_BASE, values, base.stddev, strict=True):
        digits, unit, scale = (3, " m", 1.0) if axis in "xyz" else (2, "°", 180 / np.pi)
        number = f"{round(value, digits) + 0.0:.{digits}f}"
        if np.isfinite(stddev):
            texts[axis] = f"{number} ±{scale * stddev:.{digits}f}{unit}"
        else:
            stated = axis in "xyz" and np.isfinite(value)
            texts[axis] = f"{number}{unit} (stated)" if stated else "not measured"
    return texts
