"""Results of the joint estimators of a rig."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from calgraph.geometry import Array, Index, diagonal_blocks
from calgraph.result import EstimatedParameter
from calgraph.rig.bundle.board_observations import BoardObservation, Node
from calgraph.rig.bundle.bundle_solver import Bundle, MinimizedBundle


@dataclass(frozen=True)
class MeasuredNoise:
    """Estimated variance components of a sensor."""

    scale: float
    """Standard deviation of single measurements, over that stated in rig.yaml."""
    view_bias: float
    """Standard deviation of the view bias, a displacement common to all measurements of one view, m;"""
    view_tilt: float = 0.0
    """of the rotation common to them, rad;"""
    ring_bias: float = 0.0
    """of the range bias common to those of one ring in one view, m;"""
    stamp_error: float = 0.0
    """and of the stamps of views of a moving board, s."""


@dataclass(frozen=True, eq=False)
class SolvedBundle:
    """A solved bundle, from which diagnostics are computed."""

    bundle: Bundle
    """With the estimated noise, and without outlier views."""
    minimized: MinimizedBundle
    captures: Index
    """(C,) the capture of each board."""
    boards: Sequence[BoardObservation] = ()
    """All unambiguous detections, outlier views included; in order of captures."""

    @property
    def order(self) -> Index:
        """(C,) the rank of each board's capture in time, from 0."""
        return np.unique(self.captures, return_inverse=True)[1]


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
    """Whitened residuals by sensor, or by kind of edge."""
    converged: bool
    used: Mapping[Node, int] | None = None
    """The detections that were used, with a number of their board; None if these are the inliers of pairs."""
    rejected: Mapping[tuple[int, str], str] = field(default_factory=dict)
    """By capture and sensor, why none of its detections is used, where the estimator judged one."""
    noise: Mapping[str, MeasuredNoise] = field(default_factory=dict)
    """By sensor, where it was estimated."""
    systematic: tuple[EstimatedParameter, ...] = ()
    """Systematic errors of sensors and boards, with their priors."""
    solved_bundle: SolvedBundle | None = None
    """The bundle's solution; None for other estimators, and where no two sensors share a board."""

    @property
    def covariance(self) -> dict[str, Array]:
        """(6, 6) by sensor, in the root's fixed axes; zero for the root."""
        return dict(zip(self.T_root_sensor, diagonal_blocks(self.joint_covariance, 6), strict=True))
