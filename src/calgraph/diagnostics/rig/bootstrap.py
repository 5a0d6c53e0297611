"""Whether covariances hold: how far poses scatter when captures are drawn anew from those that there are.

A covariance trusts the noise, the sway, and that captures err independently. The scatter over resampled captures
trusts only the last. Source: Efron, "Bootstrap methods: another look at the jackknife", 1979.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from scipy.special import chdtri

from calgraph.estimation.rig.board_information import information_by_board
from calgraph.estimation.rig.bundle_solver import (
    COARSE_TOLERANCE,
    Bundle,
    BundleEquations,
    BundleState,
    minimize_bundle,
    pose_jacobian,
)
from calgraph.estimation.rig.covariances import parameter_covariance
from calgraph.estimation.rig.relinearization import CachedLinearization
from calgraph.estimation.rig.solution import SolvedBundle
from calgraph.geometry import Array, Index, se3

CovarianceVerdict = Literal["honest", "optimistic", "pessimistic"]

# Probability with which all intervals together hold if all covariances do.
CONFIDENCE = 0.95
# Draws like the captures themselves hardly move: by this share of the variance at least they are taken to.
_MIN_VARIANCE_SHARE = 0.01
# Steps of each solution: it starts near.
_STEPS = 8


@dataclass(frozen=True, eq=False)
class BootstrapScatter:
    """How a sensor's pose scatters over resampled captures, along its own axes."""

    stated: Array
    """(6,) standard deviations by the pose's covariance, m and rad."""
    bootstrapped: Array
    """(6,) those that its scatter tells."""
    low: Array
    """(6,) lower ends of the intervals of ``found / stated``; all intervals together hold with 95 %."""
    high: Array
    """(6,)."""

    @property
    def ratio(self) -> Array:
        """(6,) ``found / stated``: above 1 the covariance is optimistic."""
        return self.bootstrapped / self.stated

    @property
    def verdict(self) -> CovarianceVerdict:
        """Whether the intervals of all axes have 1 in them; if not, on which side they lie."""
        if np.any(self.low > 1):
            return "optimistic"
        return "pessimistic" if np.any(self.high < 1) else "honest"

    @property
    def worst(self) -> int:
        """The axis that is farthest from what is stated, on the side of the verdict."""
        return int(np.argmin(self.ratio) if self.verdict == "pessimistic" else np.argmax(self.low))


def bootstrap_poses(
    adjusted: SolvedBundle, rounds: int, rng: np.random.Generator, progress: Callable[[float], None]
) -> dict[str, BootstrapScatter]:
    """Compares the covariances of poses with their scatter over resampled captures.

    Args:
        adjusted: the solution; its noise and sway are kept.
        rounds: how often as many captures are drawn, each any number of times.
        rng: draws them.
        progress: told how much is done, 0..1.

    Returns:
        By sensor; none for those that do not move.
    """
    bundle, state, system = adjusted.bundle, adjusted.minimized.state, adjusted.minimized.equations
    captures, capture = np.unique(adjusted.captures, return_inverse=True)
    shares = np.zeros((len(captures), bundle.parameter_count, bundle.parameter_count))
    np.add.at(shares, capture, information_by_board(bundle, system))
    V = parameter_covariance(system)
    turns = np.array([np.kron(np.eye(2), T[:3, :3].T) for T in state.T_root_sensor])
    axes = turns @ pose_jacobian(bundle, state).reshape(len(turns), 6, -1)
    squares, stated = np.zeros(axes.shape[:2]), np.sqrt(_axis_variances(axes, V))
    free = axes[:, 0].any(axis=-1)
    for i in range(rounds):
        often = np.bincount(rng.integers(len(captures), size=len(captures)), minlength=len(captures))
        drawn, near, at = _resample_bundle(
            bundle, state, system, np.repeat(np.arange(len(capture)), often[capture])
        )
        solved = minimize_bundle(drawn, at, near, iterations=_STEPS, tolerance=COARSE_TOLERANCE, exact=False)
        both = zip(solved.state.T_root_sensor, state.T_root_sensor, strict=True)
        moves = np.array([se3.difference(T, T_whole) for T, T_whole in both])
        expected = np.maximum(
            _axis_variances(axes, _difference_covariance(shares, V, often)), _MIN_VARIANCE_SHARE * stated**2
        )
        squares[free] += ((turns @ moves[..., None])[..., 0] ** 2)[free] / expected[free] / rounds
        progress((i + 1) / rounds)
    ratio = np.sqrt(squares)
    low, high = _confidence_factors(axes[free] @ V, shares, rounds)
    return {
        bundle.sensors[s]: BootstrapScatter(stated[s], ratio[s] * stated[s], ratio[s] * low[i], ratio[s] * high[i])
        for i, s in enumerate(np.flatnonzero(free))
    }


def _resample_bundle(
    bundle: Bundle, state: BundleState, system: BundleEquations, boards: Index
) -> tuple[Bundle, list[CachedLinearization], BundleState]:
    """Bundle, visits and state of some boards, each as often as it was drawn."""
    views, visits = [], []
    for own, visit in zip(bundle.all_views, system.cache, strict=True):
        view_of = np.full(len(state.T_root_board), -1)
        view_of[own.board] = np.arange(len(own.board))
        seen = np.flatnonzero(view_of[boards] >= 0)
        views.append(replace(own.select(view_of[boards[seen]]), board=seen))
        visits.append(visit.select(view_of[boards[seen]]))
    return bundle.with_views(views), visits, replace(state, T_root_board=state.T_root_board[boards])


def _difference_covariance(shares: Array, V: Array, often: Index) -> Array:
    """Covariance (G, G) of the move from the whole solution to one of captures drawn so often (C,).

    Captures have gradients at the whole solution that sum up to that of the priors, and of which two have the
    covariance ``S_i [i = j] - S_i V S_j`` if V holds, with ``S`` (C, G, G) their information. A draw moves by
    ``-H⁻¹ Σ (often - 1) gradient``, where H is its own information. So draws that happen to lack what fixes a
    sensor may move it far, and those of few captures are not expected to scatter as much as their errors.
    """
    more = np.tensordot(often - 1.0, shares, axes=1)
    inverse = np.linalg.inv(np.linalg.inv(V) + more)
    return np.asarray(inverse @ (np.tensordot((often - 1.0) ** 2, shares, axes=1) - more @ V @ more) @ inverse)


def _axis_variances(axes: Array, V: Array) -> Array:
    """(S, 6) along axes (S, 6, G)."""
    return np.asarray(np.einsum("sig,gh,sih->si", axes, V, axes, optimize=True))


def _confidence_factors(by_gradient: Array, shares: Array, rounds: int) -> tuple[Array, Array]:
    """Factors (S, 6) from ratios of standard deviations to the ends of their intervals.

    A variance that is estimated from unequal contributions is nearly chi-squared, with as many degrees of freedom
    as there are contributions that matter (Satterthwaite, "An approximate distribution of estimates of variance
    components", 1946).
    """
    each = np.einsum("sig,cgh,sih->csi", by_gradient, shares, by_gradient, optimize=True)
    freedom = 1 / (np.sum(each**2, axis=0) / np.sum(each, axis=0) ** 2 + 1 / rounds)
    tail = (1 - CONFIDENCE) / freedom.size / 2
    return np.sqrt(freedom / chdtri(freedom, tail)), np.sqrt(freedom / chdtri(freedom, 1 - tail))
