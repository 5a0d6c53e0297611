"""Formatting of numbers and names on the page."""

import math


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
