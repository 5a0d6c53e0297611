"""Whether covariances hold: how far poses scatter when captures are drawn anew from those that there are.

A covariance trusts the noise, the sway, and that captures err independently. The scatter over resampled captures
trusts only the last. Source: Efron, "Bootstrap methods: another look at the jackknife", 1979.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from scipy.special import chdtri

from calgraph.geometry import Array, se3
from calgraph.refinement.board_shares import board_shares
from calgraph.refinement.bundle import Bundle, State, pose_jacobian, reduced_covariance, solve
from calgraph.refinement.joint import Adjusted
from calgraph.refinement.views import Index

Honesty = Literal["honest", "optimistic", "pessimistic"]

# Probability with which all intervals together hold if all covariances do.
CONFIDENCE = 0.95
# Shares of a normal distribution one standard deviation below and above its mean.
_TAILS = (0.158655, 0.841345)
# Of how many standard deviations' worth of draws one value of that width says as much.
_WIDTH_EFFICIENCY = 0.54
# Steps of each solution: it starts near.
_STEPS = 8


@dataclass(frozen=True, eq=False)
class Scatter:
    """How a sensor's pose scatters over resampled captures, along its own axes."""

    stated: Array
    """(6,) standard deviations that the captures give the pose by its covariance, m and rad."""
    found: Array
    """(6,) how far it scattered."""
    low: Array
    """(6,) lower ends of the intervals of ``found / stated``; all intervals together hold with 95 %."""
    high: Array
    """(6,)."""

    @property
    def ratio(self) -> Array:
        """(6,) ``found / stated``: above 1 the covariance is optimistic."""
        return self.found / self.stated

    @property
    def verdict(self) -> Honesty:
        """Whether the intervals of all axes have 1 in them; if not, on which side they lie."""
        if np.any(self.low > 1):
            return "optimistic"
        return "pessimistic" if np.any(self.high < 1) else "honest"

    @property
    def worst(self) -> int:
        """The axis that is farthest from what is stated, on the side of the verdict."""
        return int(np.argmin(self.ratio) if self.verdict == "pessimistic" else np.argmax(self.low))


def resample(
    adjusted: Adjusted, rounds: int, rng: np.random.Generator, progress: Callable[[float], None]
) -> dict[str, Scatter]:
    """Compares the covariances of poses with their scatter over resampled captures.

    Args:
        adjusted: the solution; its noise and sway are kept.
        rounds: how often as many captures are drawn, each any number of times.
        rng: draws them.
        progress: told how much is done, 0..1.

    Returns:
        By sensor; none for those that do not move.
    """
    bundle, state = adjusted.bundle, adjusted.solved.state
    boards_of = [np.flatnonzero(adjusted.captures == capture) for capture in np.unique(adjusted.captures)]
    turns = np.array([np.kron(np.eye(2), T[:3, :3].T) for T in state.T_root_sensor])
    errors = np.empty((rounds, len(bundle.names), 6))
    for i in range(rounds):
        drawn = np.concatenate([boards_of[k] for k in rng.integers(len(boards_of), size=len(boards_of))])
        solved = solve(*_drawn(bundle, state, drawn), iterations=_STEPS)
        moves = (
            se3.difference(T, T0) for T, T0 in zip(solved.state.T_root_sensor, state.T_root_sensor, strict=True)
        )
        errors[i] = (turns @ np.array(list(moves))[..., None])[..., 0]
        progress((i + 1) / rounds)
    # A draw that hardly ties a sensor throws it far: the middle two thirds of the draws tell the width.
    lower, upper = np.quantile(errors, _TAILS, axis=0)
    shares, followed = _shares(adjusted, turns)
    stated = np.sqrt(shares.sum(axis=0))
    free = np.flatnonzero(stated[:, 0] > 0)
    low, high = _interval(shares[:, free], rounds)
    found = (upper - lower)[free] / 2 / np.sqrt(1 - followed[free])
    ratio = found / stated[free]
    return {
        bundle.names[s]: Scatter(stated[s], found[i], (ratio * low)[i], (ratio * high)[i])
        for i, s in enumerate(free)
    }


def _drawn(bundle: Bundle, state: State, boards: Index) -> tuple[Bundle, State]:
    """Bundle and state of some boards, each as often as it was drawn."""
    views = []
    for own in bundle.views:
        view_of = np.full(len(state.T_root_board), -1)
        view_of[own.board] = np.arange(len(own.board))
        seen = np.flatnonzero(view_of[boards] >= 0)
        views.append(replace(own.where(view_of[boards[seen]]), board=seen))
    return replace(bundle, views=tuple(views)), replace(state, T_root_board=state.T_root_board[boards])


def _shares(adjusted: Adjusted, turns: Array) -> tuple[Array, Array]:
    """What each capture contributes to the variances of the poses, along the sensors' own axes.

    The error of the solution is the sum over captures of ``V g``, where V is its covariance and ``g`` a capture's
    gradient, of covariance S: its information. At the solution, of which it is part, g only has ``S - S V S``.

    Returns:
        Contributions (C, S, 6), and by which share of their sum (S, 6) scatter at the solution is too small.
    """
    bundle, solved = adjusted.bundle, adjusted.solved
    J = pose_jacobian(bundle, solved.state).reshape(len(bundle.names), 6, bundle.size)
    V = reduced_covariance(solved.system)
    information = board_shares(bundle, solved.system)
    captures, capture = np.unique(adjusted.captures, return_inverse=True)
    S = np.zeros((len(captures), bundle.size, bundle.size))
    np.add.at(S, capture, information)
    by_gradient = turns @ J @ V
    shares = np.einsum("sig,cgh,sih->csi", by_gradient, S, by_gradient, optimize=True)
    lost = np.einsum("sig,gh,sih->si", by_gradient, np.sum(S @ V @ S, axis=0), by_gradient, optimize=True)
    total = shares.sum(axis=0)
    return shares, lost / np.where(total > 0, total, 1)


def _interval(shares: Array, rounds: int) -> tuple[Array, Array]:
    """Factors (S, 6) from a ratio of standard deviations to the ends of its interval.

    A variance estimated from unequal contributions is nearly chi-squared, with as many degrees of freedom as
    there are contributions that matter (Satterthwaite, "An approximate distribution of estimates of variance
    components", 1946).
    """
    uneven = np.sum(shares**2, axis=0) / np.sum(shares, axis=0) ** 2
    freedom = 1 / (uneven + 1 / (_WIDTH_EFFICIENCY * rounds))
    tail = (1 - CONFIDENCE) / freedom.size / 2
    return np.sqrt(freedom / chdtri(freedom, tail)), np.sqrt(freedom / chdtri(freedom, 1 - tail))
