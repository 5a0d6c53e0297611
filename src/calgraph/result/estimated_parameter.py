"""Systematic parameters, as a calibration states them."""

import math
from dataclasses import dataclass

_DISPLAY_UNITS = {"m": (1e3, "mm"), "s": (1e3, "ms"), "rad": (180 / math.pi, "°")}


@dataclass(frozen=True)
class EstimatedParameter:
    """A systematic parameter of a sensor or of the target: its stated value, its prior, and its estimate."""

    of: str
    """A sensor, ``board``, or a tag: ``tag 3``."""
    quantity: str
    """``range bias``, ``focal length``, ``print scale`` and so on."""
    unit: str
    """``m``, ``px``, ``rad``, or nothing for ratios."""
    stated: float
    prior: float
    """Standard deviation of the stated value, from ``uncertainty`` in rig.yaml."""
    value: float
    stddev: float
    """Of the value, given the data and all priors."""

    @property
    def deviation(self) -> float:
        """Value minus stated, in prior standard deviations."""
        return (self.value - self.stated) / self.prior

    @property
    def formatted(self) -> tuple[str, str, str, str, str]:
        """Stated value, prior, value, standard deviation and unit, for display: mm and degrees, not m and rad.

        Values have as many decimals as leave two digits of the standard deviation.
        """
        factor, unit = _DISPLAY_UNITS.get(self.unit, (1.0, self.unit))
        stddev = factor * self.stddev
        decimals = max(1 - math.floor(math.log10(stddev)), 0) if 0 < stddev < math.inf else 3
        stated, value, deviation = (
            f"{round(factor * v, decimals) + 0.0:.{decimals}f}" for v in (self.stated, self.value, self.stddev)
        )
        return stated, f"{factor * self.prior:.2g}", value, deviation, unit
