"""What a joint estimator found, whichever it was."""

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np

from calgraph.estimation.rig.bundle_solver import Bundle, MinimizedBundle
from calgraph.geometry import Array, Index
from calgraph.result import EstimatedParameter


@dataclass(frozen=True)
class MeasuredNoise:
    """How large a sensor's errors are, as its measurements scatter."""

    scale: float
    """Standard deviation of single measurements, over that stated in rig.yaml."""
    view_bias: float
    """Standard deviation of the displacement that all measurements of one view share, m."""


@dataclass(frozen=True, eq=False)
class SolvedBundle:
    """A solved bundle, for whoever asks it more: how well it predicts, what a further board would tell."""

    bundle: Bundle
    """With the noise that was measured, and without the views that were wrong."""
    minimized: MinimizedBundle
    captures: Index
    """(C,) the capture of each board."""


@dataclass(frozen=True, eq=False)
class RigSolution:
    """A joint solution of a rig's connected sensors."""

    estimator: str
    T_root_sensor: Mapping[str, Array]
    """(4, 4) by sensor, the root first."""
    joint_covariance: Array
    """(S·6, S·6) of all poses' errors in the root's fixed axes, in the order of ``T_root_sensor``; zero for the
    root."""
    residuals: Mapping[str, Array]
    """Whitened residuals by what was measured."""
    converged: bool
    remarks: tuple[str, ...] = ()
    """What was seen and yet not used, and why."""
    rejected: Mapping[tuple[int, str], str] = field(default_factory=dict)
    """By capture and sensor, why what it saw was left out although it agreed with another sensor."""
    noise: Mapping[str, MeasuredNoise] = field(default_factory=dict)
    """By sensor, where it was measured."""
    graph_error: float = float("nan")
    """Sum of squared errors over all of a hypergraph's edges but sensor–sensor, m² (MSG-Cal, VII.A)."""
    extra_parameters: tuple[EstimatedParameter, ...] = ()
    """What was estimated besides poses."""
    solved_bundle: SolvedBundle | None = None
    """What the bundle ended with; None for other estimators, and where no two sensors share a board."""

    @property
    def covariance(self) -> dict[str, Array]:
        """(6, 6) by sensor, in the root's fixed axes; zero for the root."""
        count = len(self.T_root_sensor)
        blocks = self.joint_covariance.reshape(count, 6, count, 6)[np.arange(count), :, np.arange(count)]
        return dict(zip(self.T_root_sensor, blocks, strict=True))
