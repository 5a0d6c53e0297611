"""Options of the calibration of a robot that drives."""

from dataclasses import dataclass

from calgraph.parallel.engine import THIS_PROCESS, Engine


@dataclass(frozen=True)
class DriveOptions:
    """Options of the calibration of a robot that drives through surroundings."""

    seed: int = 0
    """Of the random samples; the same seed gives the same result."""
    engine: Engine = THIS_PROCESS
    """Where sensors are tracked; does not affect the result."""
