"""Levenberg–Marquardt, for any state and any linear solver, and for batches of small problems.

Source: Madsen, Nielsen, Tingleff, "Methods for non-linear least squares problems", 2004, algorithm 3.16.
"""

import dataclasses
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from typing import Any, Generic, Protocol, Self, TypeVar

import numpy as np
from numpy.typing import NDArray

from calgraph.geometry import Array

# Minimum damping: smaller values have no effect in double precision.
_MIN_DAMPING = 1e-12
# Damping up to which a small step means a minimum; beyond it, steps are small because they keep failing.
_MAX_CONVERGED_DAMPING = 1.0


class Linearization(Protocol):
    """A least-squares problem, linearized at a state."""

    @property
    def cost(self) -> float:
        """Half the sum of squared whitened residuals; not finite at infeasible states."""

    def solve(self, damping: float) -> tuple[Any, float]:
        """The damped step, and the decrease of the cost that the linear model predicts for it."""


@dataclass(frozen=True, eq=False)
class DenseLinearization:
    """Residuals of one problem and their Jacobian, or those of K problems; a :class:`Linearization`."""

    residual: Array
    """([K,] m) whitened."""
    jacobian: Array
    """([K,] m, p)."""

    @cached_property
    def cost(self) -> Any:
        """([K])."""
        return 0.5 * np.einsum("...i,...i", self.residual, self.residual)

    @cached_property
    def information(self) -> Array:
        """([K,] p, p)."""
        return np.asarray(np.swapaxes(self.jacobian, -1, -2) @ self.jacobian)

    @property
    def gradient(self) -> Array:
        """([K,] p)."""
        return np.asarray((self.residual[..., None, :] @ self.jacobian)[..., 0, :])

    def solve(self, damping: Any) -> tuple[Array, Any]:
        """Steps ([K,] p) and predicted decreases ([K])."""
        damped, g = self.information.copy(), self.gradient
        diagonal = np.einsum("...ii->...i", damped)  # a view
        scaling = np.asarray(damping)[..., None] * diagonal
        diagonal += scaling
        step = np.asarray(-np.linalg.solve(damped, g[..., None])[..., 0])
        return step, 0.5 * np.einsum("...i,...i", step, scaling * step - g)

    def replace(self, accepted: NDArray[np.bool_], trial: Self) -> Self:
        """Those of the trial where accepted (K,)."""
        return dataclasses.replace(
            self,
            residual=np.where(accepted[:, None], trial.residual, self.residual),
            jacobian=np.where(accepted[:, None, None], trial.jacobian, self.jacobian),
        )


S = TypeVar("S")
L = TypeVar("L", bound=Linearization)
B = TypeVar("B", bound=DenseLinearization)


@dataclass(frozen=True)
class Damping:
    """Marquardt's parameter of one problem."""

    value: float
    growth: float = 2.0
    """Factor by which the next rejected step increases it."""

    def update(self, gain: float) -> "Damping":
        """After a step with this ratio of the cost's decrease to the predicted one; not positive: rejected."""
        if gain > 0:
            return Damping(max(self.value * max(1 / 3, 1 - (2 * min(gain, 1.0) - 1) ** 3), _MIN_DAMPING))
        return Damping(self.value * self.growth, 2 * self.growth)


@dataclass(frozen=True, eq=False)
class Minimum(Generic[S, L]):
    """The result of a minimisation."""

    state: S
    linearization: L
    """At the state."""
    iterations: int
    """Number of steps, rejected ones included."""
    converged: bool


def minimize(
    state: S,
    linearize: Callable[[S, L | None], L],
    retract: Callable[[S, Any], S],
    *,
    iterations: int,
    tolerance: float,
    relative_tolerance: float = 1e-12,
    damping: float = 1e-5,
    refine: Callable[[S, L, bool], L | None] | None = None,
) -> Minimum[S, L]:
    """Minimises a cost from a start value.

    Args:
        state: start value.
        linearize: the problem at a state, given that at the state before, from which it may be extrapolated.
        retract: the state after a step.
        iterations: steps at most, rejected ones included.
        tolerance: the minimum is reached where the next step is predicted to decrease the cost by less than this,
        relative_tolerance: or by less than this share of the cost.
        damping: initial value.
        refine: a more accurate linearization at the same state, or None if the given one is accurate enough to end
            the iteration (True) or to reject a step (False); for problems that extrapolate.

    Returns:
        The minimum; without steps and not converged if the cost is not finite at the start.
    """
    at = linearize(state, None)
    if not np.isfinite(at.cost):
        return Minimum(state, at, 0, converged=False)
    damped = Damping(damping)
    for iteration in range(iterations):
        try:
            step, predicted = at.solve(damped.value)
        except np.linalg.LinAlgError:
            predicted = np.nan
        if not np.isfinite(predicted):  # singular in floating point: more damping
            settled, gain = False, 0.0
        elif settled := predicted <= tolerance + relative_tolerance * at.cost:
            gain = 0.0
        else:
            trial = retract(state, step)
            ahead = linearize(trial, at)
            gain = float((at.cost - ahead.cost) / predicted)
        if gain > 0:  # False for NaN: the trial is not feasible
            state, at = trial, ahead
        elif refined := refine(state, at, settled) if refine else None:
            at = refined
            continue
        elif settled:
            return Minimum(state, at, iteration, converged=damped.value <= _MAX_CONVERGED_DAMPING)
        damped = damped.update(gain)
    return Minimum(state, at, iterations, converged=False)


def minimize_batch(
    states: Array,
    linearize: Callable[[Array], B],
    retract: Callable[[Array, Array], Array],
    *,
    iterations: int,
    relative_tolerance: float,
    damping: float = 1e-5,
) -> tuple[Array, B]:
    """Minimises the costs of K independent problems.

    Args:
        states: (K, ...) start values.
        linearize: the problems at states (K, ...).
        retract: states (K, ...) after steps (K, p).
        iterations: steps at most, rejected ones included.
        relative_tolerance: minima are reached where the next step is predicted to decrease the cost by less than
            this share of it.
        damping: initial value.

    Returns:
        The states (K, ...) and the problems there; start values that are not feasible are kept.
    """
    at = linearize(states)
    damped = [Damping(damping)] * len(states)
    for _ in range(iterations):
        step, predicted = at.solve(np.array([d.value for d in damped]))
        active = np.isfinite(at.cost) & (predicted > relative_tolerance * at.cost)
        if not active.any():
            break
        trial = retract(states, step)
        ahead = linearize(trial)
        gain = np.zeros(len(states))
        gain[active] = (at.cost[active] - ahead.cost[active]) / predicted[active]
        accepted = gain > 0
        states = np.where(accepted.reshape(-1, *[1] * (states.ndim - 1)), trial, states)
        at = at.replace(accepted, ahead)
        damped = [d.update(g) for d, g in zip(damped, gain.tolist(), strict=True)]
    return states, at
