"""Parameters that a calibration estimates besides poses."""

import math
from dataclasses import dataclass

_DISPLAY_UNITS = {"m": (1e3, "mm"), "rad": (180 / math.pi, "°")}


@dataclass(frozen=True)
class EstimatedParameter:
    """A parameter of a sensor or of the target, with its stated value and its estimate."""

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
    """Whether the captures determine it; otherwise its prior dominates."""

    @property
    def formatted(self) -> tuple[str, str, str, str]:
        """Stated value, value, standard deviation and unit, for display: mm and degrees instead of m and rad.

        Values have as many decimals as leave two digits of the standard deviation.
        """
        factor, unit = _DISPLAY_UNITS.get(self.unit, (1.0, self.unit))
        stddev = factor * self.stddev
        decimals = max(1 - math.floor(math.log10(stddev)), 0) if 0 < stddev < math.inf else 3
        texts = (
            f"{round(factor * v, decimals) + 0.0:.{decimals}f}" for v in (self.stated, self.value, self.stddev)
        )
        stated, value, deviation = texts
        return stated, value, deviation, unit
