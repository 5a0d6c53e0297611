"""Priors of sensors' poses, and systematic parameters, of a bundle."""

from dataclasses import dataclass

from calgraph.geometry import Array


@dataclass(frozen=True, eq=False)
class SensorPrior:
    """Gaussian prior of a sensor's pose."""

    sensor: int
    T_root_sensor: Array
    """(4, 4)."""
    information: Array
    """(6, 6) inverse covariance of its error in the root's fixed axes."""


@dataclass(frozen=True)
class SystematicParameter:
    """An error of a sensor or of the target that all captures share, estimated besides the poses.

    Its value is the stated one plus ``scale`` times the bundle's, whose prior mean and start value are 0.
    """

    of: str
    """The sensor, board or tag that it belongs to."""
    quantity: str
    unit: str
    """``m``, ``px``, ``rad``, or nothing."""
    prior_stddev: float
    """Of the bundle's value."""
    view_sets: tuple[int, ...]
    """Indices in :attr:`Bundle.all_views` of the views that depend on it."""
    stated: float = 0.0
    """In ``unit``."""
    scale: float = 1.0
    """``unit`` over that of the bundle."""
