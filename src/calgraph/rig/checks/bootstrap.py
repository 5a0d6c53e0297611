"""Bootstrap over captures: a test of the covariances of the poses.

A covariance assumes the noise model, the view bias, and independent errors of captures. The scatter over resampled
captures assumes the last only. Source: Efron, "Bootstrap methods: another look at the jackknife", 1979.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from scipy.special import chdtri

from calgraph.geometry import Array, Index, se3
from calgraph.rig.bundle.bundle_solver import (
    COARSE_TOLERANCE,
    Bundle,
    BundleEquations,
    BundleState,
    minimize_bundle,
)
from calgraph.rig.bundle.covariances import axis_jacobian, gradient_by_board, sum_information
from calgraph.rig.bundle.linearization import CachedLinearization
from calgraph.rig.bundle.solution import SolvedBundle

CovarianceVerdict = Literal["honest", "optimistic", "pessimistic"]


@dataclass(frozen=True, eq=False)
class BootstrapScatter:
    """Scatter of a sensor's pose over resampled captures, along its axes."""

    stated: Array
    """(6,) standard deviations by the covariance of the pose, m and rad."""
    bootstrapped: Array
    """(6,) standard deviations estimated from the scatter."""
    low: Array
    """(6,) lower ends of the simultaneous confidence intervals of ``bootstrapped / stated``."""
    high: Array
    """(6,) upper ends."""

    @property
    def ratio(self) -> Array:
        """(6,) ``bootstrapped / stated``: above 1 the covariance is optimistic."""
        return self.bootstrapped / self.stated

    @property
    def verdict(self) -> CovarianceVerdict:
        """``honest`` if the intervals of all axes contain 1; otherwise the side on which one does not."""
        if np.any(self.low > 1):
            return "optimistic"
        return "pessimistic" if np.any(self.high < 1) else "honest"

    @property
    def worst(self) -> int:
        """The axis of the largest discrepancy, on the side of the verdict."""
        return int(np.argmin(self.ratio) if self.verdict == "pessimistic" else np.argmax(self.low))


# Limit on steps of each sample's solution, which starts near its minimum: 8 % of those in the tests reach it, and
# are used as they are.
_BOOTSTRAP_MAX_STEPS = 8
# Share of the stated variance that a draw is expected to have at least. Draws nearly equal to the captures have
# no expected scatter, and would divide by zero; 1 % is the mean of 100 captures of which one is exchanged.
_BOOTSTRAP_MIN_VARIANCE_SHARE = 0.01
# Probability with which all intervals of the bootstrap hold together if all covariances do; the usual level.
BOOTSTRAP_CONFIDENCE = 0.95


def bootstrap_poses(
    solved: SolvedBundle,
    rounds: int,
    rng: np.random.Generator,
    progress: Callable[[float], None],
    *,
    exact: bool = True,
    confidence: float = BOOTSTRAP_CONFIDENCE,
) -> dict[str, BootstrapScatter]:
    """Compares the covariances of poses with their scatter over resampled captures.

    Args:
        solved: the solution; its noise and view bias are kept.
        rounds: number of samples of the captures, drawn with replacement.
        rng: draws them.
        progress: called with the share of the work that is done, 0..1.
        exact: whether samples are solved to their minimum, instead of by one Gauss-Newton step.
        confidence: probability with which all intervals hold together if all covariances do.

    Returns:
        By sensor; none for those whose pose is not estimated.
    """
    state, equations = solved.minimized.state, solved.minimized.equations
    bundle = _without_tails(solved.bundle, state)
    captures, capture = np.unique(solved.captures, return_inverse=True)
    of_capture = np.eye(len(captures))[:, capture]
    information = sum_information(bundle, equations, of_capture)
    gradient = of_capture @ gradient_by_board(bundle, equations)
    V = equations.covariance
    to_sensor = np.array([np.kron(np.eye(2), T[:3, :3].T) for T in state.T_root_sensor])
    axes = axis_jacobian(bundle, state)
    H, _, _ = equations.eliminate_boards()
    stated = np.sqrt(np.einsum("sig,gh,sih->si", axes, V, axes, optimize=True))
    squares = np.zeros_like(stated)
    free = axes[:, 0].any(axis=-1)
    for i in range(rounds):
        counts = np.bincount(rng.integers(len(captures), size=len(captures)), minlength=len(captures))
        by_gradient, expected = _difference_variances(information, H, V, axes, counts)
        if exact:
            boards = np.repeat(np.arange(len(capture)), counts[capture])
            resampled, cache, start = _resample_bundle(bundle, state, equations, boards)
            T_root_sensor = minimize_bundle(
                resampled, start, cache, iterations=_BOOTSTRAP_MAX_STEPS, tolerance=COARSE_TOLERANCE, exact=False
            ).state.T_root_sensor
            along = (to_sensor @ se3.difference(T_root_sensor, state.T_root_sensor)[..., None])[..., 0]
        else:
            along = -by_gradient @ ((counts - 1.0) @ gradient)
        expected = np.maximum(expected, _BOOTSTRAP_MIN_VARIANCE_SHARE * stated**2)
        squares[free] += along[free] ** 2 / expected[free] / rounds
        progress((i + 1) / rounds)
    ratio = np.sqrt(squares)
    low, high = _confidence_factors(axes[free] @ V, information, rounds, confidence)
    return {
        bundle.sensors[s]: BootstrapScatter(stated[s], ratio[s] * stated[s], ratio[s] * low[i], ratio[s] * high[i])
        for i, s in enumerate(np.flatnonzero(free))
    }


def _without_tails(bundle: Bundle, state: BundleState) -> Bundle:
    """The bundle with Gaussian priors: in their tails, samples of few captures move parameters far away."""
    stddev = (bundle.prior_stddev / np.sqrt(bundle.prior_weights(state.extra)))[6 * bundle.body_count :]
    parameters = [
        replace(one, prior_stddev=s) for one, s in zip(bundle.extra_parameters, stddev.tolist(), strict=True)
    ]
    return replace(bundle, extra_parameters=tuple(parameters), prior_tail=1e9)


def _resample_bundle(
    bundle: Bundle, state: BundleState, equations: BundleEquations, boards: Index
) -> tuple[Bundle, list[CachedLinearization], BundleState]:
    """Bundle, cached linearizations and state of the drawn boards (B,), which may repeat."""
    resampled, cache = [], []
    for views, linearization in zip(bundle.all_views, equations.cache, strict=True):
        view_of = np.full(len(state.T_root_board), -1)
        view_of[views.board] = np.arange(len(views.board))
        detected = np.flatnonzero(view_of[boards] >= 0)
        resampled.append(replace(views.select(view_of[boards[detected]]), board=detected))
        cache.append(linearization.select(view_of[boards[detected]]))
    return bundle.with_views(resampled), cache, replace(state, T_root_board=state.T_root_board[boards])


def _difference_variances(
    information: Array, H: Array, V: Array, axes: Array, counts: Index
) -> tuple[Array, Array]:
    """Of the difference between the solution of all captures and that of a sample, along axes.

    The gradients of the captures at the solution add up to minus that of the priors. Two of them have the
    covariance ``S_i [i = j] - S_i V S_j`` if V holds, with ``S`` (C, G, G) their information. A sample differs by
    ``-H⁻¹ Σ (counts - 1) gradient``, where H is its information. Samples without the captures that determine a
    sensor are thus expected to differ much, and those of few captures less than their errors.

    Args:
        information: (C, G, G) of the captures.
        H: (G, G) information of the solution, and
        V: (G, G) its covariance.
        axes: (S, 6, G).
        counts: (C,) how many times each capture is in the sample.

    Returns:
        (S, 6, G) minus the derivatives of the differences by the gradient, and their expected variances (S, 6).
    """
    added = np.tensordot(counts - 1.0, information, axes=1)
    by_gradient = np.linalg.solve(H + added, axes.reshape(-1, len(H)).T)
    squares = np.tensordot((counts - 1.0) ** 2, information, axes=1)
    known = added @ by_gradient
    variances = np.sum(by_gradient * (squares @ by_gradient) - known * (V @ known), axis=0)
    return np.asarray(by_gradient.T.reshape(axes.shape)), np.asarray(variances.reshape(axes.shape[:2]))


def _confidence_factors(
    by_gradient: Array, information: Array, rounds: int, confidence: float
) -> tuple[Array, Array]:
    """Factors (S, 6) from ratios of standard deviations to the ends of their intervals.

    A variance estimated from unequal contributions is approximately chi-squared, with the effective number of
    contributions as degrees of freedom (Satterthwaite, "An approximate distribution of estimates of variance
    components", 1946).
    """
    each = np.einsum("sig,cgh,sih->csi", by_gradient, information, by_gradient, optimize=True)
    total = np.sum(each, axis=0)
    # No capture contributes to a pose that is its prior.
    share = np.divide(np.sum(each**2, axis=0), total**2, out=np.ones_like(total), where=total > 0)
    dof = 1 / (share + 1 / rounds)
    tail = (1 - confidence) / max(dof.size, 1) / 2
    return np.sqrt(dof / chdtri(dof, tail)), np.sqrt(dof / chdtri(dof, 1 - tail))
