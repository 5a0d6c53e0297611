"""Options of the calibration of a robot that drives."""

from dataclasses import dataclass

from calgraph.parallel.engine import THIS_PROCESS, Engine
from calgraph.result.extrinsics_file import PriorFile


@dataclass(frozen=True)
class DriveOptions:
    """Options of the calibration of a robot that drives through surroundings."""

    seed: int = 0
    """Of the random samples; the same seed gives the same result."""
    prior: PriorFile | None = None
    """Poses that are known before, with standard deviations above 0."""
    engine: Engine = THIS_PROCESS
    """Where sensors are tracked; does not affect the result."""
