"""The joint estimator at the statistical limit: sensor poses, and one pose for each board that was held.

Residuals are in the units that sensors measure. Boards do not know each other, so they are eliminated one by one
(Schur complement), and what is left is a small dense problem over sensors, however many captures there are.

Source: Triggs et al., "Bundle adjustment: a modern synthesis", 1999, section 6.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from calgraph.errors import CalibrationError
from calgraph.estimation.damping import Damping
from calgraph.estimation.rig.observations import BoardViews, relative_poses
from calgraph.estimation.rig.relinearization import CachedLinearization, linearize_views
from calgraph.geometry import Array, Index, se3, so3

# What is believed of a board without any data (m⁻², rad⁻²): it keeps what no view sees from being singular.
BOARD_PRIOR_INFORMATION = 1e-4
# What is believed of a sensor without any data: m and rad.
_POSE_PRIOR_STDDEV = np.array([10.0, 10.0, 10.0, np.pi, np.pi, np.pi])
# Where the next step would gain less than this (half squared standard deviations), nothing is off by more than 5 %
# of its own,
COARSE_TOLERANCE = 1e-3
# nor by more than a thousandth.
_FINE_TOLERANCE = 1e-7
# What sums were moved along by steps that gained less than so many times that, they are as exact: to second order.
_EXTRAPOLATION_LIMIT = 20.0


@dataclass(frozen=True, eq=False)
class SensorPrior:
    """What is known of a sensor's pose beforehand."""

    sensor: int
    T_root_sensor: Array
    """(4, 4)."""
    information: Array
    """(6, 6) inverse covariance of its error in the root's fixed axes."""


@dataclass(frozen=True)
class ExtraParameter:
    """A number that is estimated along with the poses."""

    of: str
    """Whose: a sensor, or a tag."""
    quantity: str
    unit: str
    """``m``, ``px``, ``rad``, or nothing."""
    prior_value: float
    """What it is beforehand taken to be."""
    prior_stddev: float
    """Standard deviation of that: wide, so that it decides only what nothing measures."""
    view_sets: tuple[int, ...]
    """Those whose measurements depend on it, and outlines, as the bundle counts all views."""


@dataclass(frozen=True, eq=False)
class Bundle:
    """Who measured which boards."""

    sensors: tuple[str, ...]
    """Sensors, the root first."""
    views: tuple[BoardViews, ...]
    """Of each sensor."""
    body: Index
    """(S,) which rigid body each sensor is on, counted from 0, the root's: sensors of one body move as one."""
    bias_variance: Array
    """(K,) variance of the displacement with which a sensor sees a board in each view of its own, m²: of all S
    sensors' views, then of the outlines."""
    lever: float
    """A displacement by one metre comes with a rotation of one metre over this, m: half the size of a board."""
    priors: tuple[SensorPrior, ...] = ()
    extra_parameters: tuple[ExtraParameter, ...] = ()
    """Besides poses. Views of a sensor take theirs in this order."""
    outlines: tuple[BoardViews, ...] = ()
    """(O,) where scanners saw the sheets end: views with noise, sway and unknowns of their own."""
    outline_sensor: tuple[int, ...] = ()
    """(O,) the sensor that each outline is of."""

    @property
    def all_views(self) -> tuple[BoardViews, ...]:
        """(K,) of each sensor, then the outlines: below, ``k`` counts these."""
        return (*self.views, *self.outlines)

    def sensor_of(self, k: int) -> int:
        """Whose views they are."""
        return k if k < len(self.views) else self.outline_sensor[k - len(self.views)]

    def with_views(self, all_views: Sequence[BoardViews]) -> "Bundle":
        """The bundle with other views (K,)."""
        sensors = len(self.views)
        return replace(self, views=tuple(all_views[:sensors]), outlines=tuple(all_views[sensors:]))

    def without_outlines(self) -> "Bundle":
        """The bundle with what sensors saw of the boards' planes and prints alone."""
        return replace(self, outlines=(), outline_sensor=(), bias_variance=self.bias_variance[: len(self.views)])

    def extra_indices(self, k: int) -> Index:
        """(e,) which unknowns the measurements depend on."""
        return np.array([i for i, one in enumerate(self.extra_parameters) if k in one.view_sets], dtype=np.intp)

    def columns(self, k: int) -> Index:
        """(n,) columns of the reduced problem that views depend on: of the sensor's body, and own unknowns."""
        return np.concatenate([self.pose_columns(self.sensor_of(k)), self.extra_indices(k) + 6 * self.body_count])

    def pose_columns(self, sensor: int) -> Index:
        """(6,) columns of the body that a sensor is on, in the reduced problem; (0,) of the root's."""
        body = int(self.body[sensor])
        return np.arange(6 * (body - 1), 6 * body) if body > 0 else np.zeros(0, dtype=np.intp)

    @property
    def body_count(self) -> int:
        """Number of bodies that move."""
        return int(self.body.max())

    @property
    def parameter_count(self) -> int:
        """Number of unknowns of the reduced problem."""
        return 6 * self.body_count + len(self.extra_parameters)

    @property
    def prior_stddev(self) -> Array:
        """(G,) standard deviations of the reduced problem's unknowns without any data."""
        return np.concatenate(
            [np.tile(_POSE_PRIOR_STDDEV, self.body_count), [one.prior_stddev for one in self.extra_parameters]]
        )

    def bias_variances(self, k: int) -> Array:
        """(6 + e,) variances of the displacement of one view, along the sensor's axes."""
        shape = np.array([1, 1, 1, *[self.lever**-2] * 3, *[0.0] * self.all_views[k].extra_count])
        return np.asarray(self.bias_variance[k] * shape)


@dataclass(frozen=True, eq=False)
class BundleState:
    """Values of all unknowns."""

    T_root_sensor: Array
    """(S, 4, 4)."""
    T_root_board: Array
    """(C, 4, 4)."""
    extra: Array
    """(E,) of the unknowns besides poses."""


@dataclass(frozen=True, eq=False)
class MarginalizedViews:
    """One sensor's views, or an outline's, at a state."""

    information: Array
    """(V, q, q) on the numbers that measurements depend on."""
    gradient: Array
    """(V, q)."""
    local_jacobian: Array
    """(V, q, 6 + e) how these move with the pose of the board before the sensor, and the sensor's own unknowns,"""
    J_sensor: Array
    """(V, q, n) with the n columns of the reduced problem that they depend on,"""
    J_board: Array
    """(V, q, 6) and with the board."""


@dataclass(frozen=True, eq=False)
class BundleEquations:
    """Normal equations of all views at a state."""

    cost: float
    views: tuple[MarginalizedViews, ...]
    H: Array
    """(G, G) of the sensors."""
    g: Array
    """(G,)."""
    H_board: Array
    """(C, 6, 6) of the boards."""
    g_board: Array
    """(C, 6)."""
    H_board_sensor: Array
    """(C, 6, G) between a board and the sensors."""
    cache: tuple[CachedLinearization, ...]
    """(K,) where the views' measurements were looked at."""
    exact: bool
    """Whether that was at this very state."""

    def eliminate_boards(self, damping: float = 0.0) -> tuple[Array, Array, Array]:
        """The problem without boards: its matrix (G, G) and gradient (G,), and ``K`` (C, 6, G + 1).

        Boards follow the sensors' step: their own is ``-(K[..., :-1] @ step + K[..., -1])``.
        """
        right = np.concatenate([self.H_board_sensor, self.g_board[..., None]], axis=-1)
        K = np.linalg.solve(_damp(self.H_board, damping) + BOARD_PRIOR_INFORMATION * np.eye(6), right)
        rows, size = K.shape[0] * K.shape[1], len(self.g)
        both = self.H_board_sensor.reshape(rows, size).T @ K.reshape(rows, size + 1)
        return _damp(self.H, damping) - both[:, :-1], self.g - both[:, -1], K


@dataclass(frozen=True, eq=False)
class MinimizedBundle:
    """Where the solver stopped."""

    state: BundleState
    equations: BundleEquations
    iterations: int
    converged: bool


def linearize_bundle(
    bundle: Bundle, state: BundleState, cache: Sequence[CachedLinearization | None] = ()
) -> BundleEquations:
    """The normal equations at a state.

    Args:
        bundle: the measurements.
        state: where.
        cache: (K,) earlier linearizations of the same views, or None: extrapolated where they are near enough.
    """
    size, boards = bundle.parameter_count, len(state.T_root_board)
    cost, H, g = _prior_equations(bundle, state)
    H_board, g_board, coupling = np.zeros((boards, 6, 6)), np.zeros((boards, 6)), np.zeros((boards, 6, size))
    equations, visits = [], []
    for k, views in enumerate(bundle.all_views):
        T_root_board, sway, own = (
            state.T_root_board[views.board],
            bundle.bias_variances(k),
            state.extra[bundle.extra_indices(k)],
        )
        T_sensor_board = relative_poses(state.T_root_sensor[bundle.sensor_of(k)], T_root_board)
        before = cache[k] if cache else None
        sums = before.extrapolate(views, T_sensor_board, own) if before else None
        visits.append(before if before and sums else linearize_views(views, T_sensor_board, own, sway))
        sums = sums or visits[k].equations
        A, b, costs = sums.marginalize_bias(sway)
        by_sensor, by_board = (sums.local_jacobian @ J for J in view_jacobians(bundle, state, k))
        equations.append(MarginalizedViews(A, b, sums.local_jacobian, by_sensor, by_board))
        cost += float(costs.sum())
        columns, n = bundle.columns(k), by_sensor.shape[-1]
        J = np.concatenate([by_sensor, by_board], axis=-1)
        Jt = np.swapaxes(J, -1, -2)
        both, slope = Jt @ A @ J, (Jt @ b[..., None])[..., 0]
        H[np.ix_(columns, columns)] += both[:, :n, :n].sum(axis=0)
        g[columns] += slope[:, :n].sum(axis=0)
        H_board[views.board] += both[:, n:, n:]
        g_board[views.board] += slope[:, n:]
        coupling[np.ix_(views.board, np.arange(6), columns)] += both[:, n:, :n]
    for prior in bundle.priors:
        cost += _add_sensor_prior(bundle, state, prior, H, g)
    exact = not any(at is before for at, before in zip(visits, cache, strict=False))
    return BundleEquations(cost, tuple(equations), H, g, H_board, g_board, coupling, tuple(visits), exact)


def minimize_bundle(
    bundle: Bundle,
    state: BundleState,
    cache: Sequence[CachedLinearization | None] = (),
    *,
    iterations: int = 50,
    tolerance: float = _FINE_TOLERANCE,
    exact: bool = True,
) -> MinimizedBundle:
    """Minimises the robust cost of all views and priors.

    Args:
        bundle: the measurements.
        state: start values.
        cache: (K,) earlier linearizations of the same views near the solution, or None.
        iterations: steps at most, rejected ones included.
        tolerance: the solver stops where the next step would gain less, in half squared standard deviations.
        exact: whether measurements are looked at where the solver stops; else those of views that stay near are
            believed to change as they did when they were.

    Raises:
        CalibrationError: the residuals are not finite at the start.
    """
    system = linearize_bundle(bundle, state, cache)
    if not np.isfinite(system.cost):
        raise CalibrationError("the start poses give residuals that are not finite: a board is behind a camera")
    # What was gained since measurements were looked at.
    since = 0.0 if system.exact else np.inf
    damping = Damping(1e-5)
    for iteration in range(iterations):
        H, g, K = system.eliminate_boards(damping.value)
        step: Array = np.asarray(-np.linalg.solve(H, g), dtype=np.float64)
        boards = -(K[..., :-1] @ step + K[..., -1])
        predicted = -0.5 * float(system.g @ step + np.sum(system.g_board * boards))
        if done := predicted <= tolerance + 1e-12 * system.cost:
            if not exact or since <= _EXTRAPOLATION_LIMIT * tolerance:
                return MinimizedBundle(state, system, iteration, converged=True)
        else:
            trial = retract_state(bundle, state, step, boards)
            ahead = linearize_bundle(bundle, trial, system.cache)
            gained = system.cost - ahead.cost
        if done or (exact and gained < 0 and since > 0):
            # What was moved along is too coarse to judge by.
            system, since = linearize_bundle(bundle, state), 0.0
        elif gained >= 0:  # False where the trial's residuals are not finite
            state, system, since = trial, ahead, 0.0 if ahead.exact else since + gained
            damping = damping.accept_step(gained / predicted)
        else:
            damping = damping.reject_step()
    return MinimizedBundle(state, system, iterations, converged=False)


def view_jacobians(bundle: Bundle, state: BundleState, k: int) -> tuple[Array, Array]:
    """How boards before a sensor, and its own unknowns, move with the reduced problem's, and with the boards.

    Returns:
        (V, 6 + e, n), by ``bundle.columns(k)``, and (V, 6 + e, 6).
    """
    views, sensor = bundle.all_views[k], bundle.sensor_of(k)
    count, own = len(views.board), views.extra_count
    T_root_sensor = np.broadcast_to(state.T_root_sensor[sensor], (count, 4, 4))
    by_pose, of_board = se3.relative_pose_jacobians(T_root_sensor, state.T_root_board[views.board])
    moving = len(bundle.pose_columns(sensor))
    by_sensor, by_board = np.zeros((count, 6 + own, moving + own)), np.zeros((count, 6 + own, 6))
    by_sensor[:, :6, :moving] = (by_pose @ _body_jacobian(bundle, state, sensor))[..., :moving]
    by_sensor[:, 6:, moving:] = np.eye(own)
    by_board[:, :6] = of_board
    return by_sensor, by_board


def retract_state(bundle: Bundle, state: BundleState, step: Array, boards: Array) -> BundleState:
    """The state after steps (G,) of the sensors and (C, 6) of the boards, along the root's fixed axes."""
    T = state.T_root_sensor.copy()
    for s in np.flatnonzero(bundle.body > 0):
        lever = _body_jacobian(bundle, state, int(s))
        T[s] = se3.retract(T[s], lever @ step[bundle.pose_columns(int(s))])
    own = state.extra + step[len(step) - len(state.extra) :]
    return BundleState(_restore_rigid_groups(bundle, state, T), se3.retract(state.T_root_board, boards), own)


def pose_jacobian(bundle: Bundle, state: BundleState) -> Array:
    """(S·6, G) how all sensors' poses move with the unknowns of the reduced problem, in the root's fixed axes."""
    by_unknowns = np.zeros((6 * len(bundle.sensors), bundle.parameter_count))
    for s in np.flatnonzero(bundle.body > 0):
        by_unknowns[6 * s : 6 * s + 6, bundle.pose_columns(int(s))] = _body_jacobian(bundle, state, int(s))
    return by_unknowns


def _body_jacobian(bundle: Bundle, state: BundleState, sensor: int) -> Array:
    """(6, 6) how a sensor's pose moves with its body, which turns about its first sensor."""
    first = int(np.flatnonzero(bundle.body == bundle.body[sensor])[0])
    J = np.eye(6)
    J[:3, 3:] = -so3.hat(state.T_root_sensor[sensor, :3, 3] - state.T_root_sensor[first, :3, 3])
    return J


def _restore_rigid_groups(bundle: Bundle, before: BundleState, T_root_sensor: Array) -> Array:
    """The poses, with those on one body as far apart as before: a step keeps that to first order only."""
    T = T_root_sensor.copy()
    for s, body in enumerate(bundle.body):
        first = int(np.flatnonzero(bundle.body == body)[0])
        if body > 0 and first != s:
            T[s] = T[first] @ se3.inverse(before.T_root_sensor[first]) @ before.T_root_sensor[s]
    return T


def _prior_equations(bundle: Bundle, state: BundleState) -> tuple[float, Array, Array]:
    """What is known without data: cost, matrix (G, G) and gradient (G,)."""
    # Poses are not drawn anywhere: only what no data fix stays where it is.
    off = np.zeros(bundle.parameter_count)
    off[6 * bundle.body_count :] = state.extra - [one.prior_value for one in bundle.extra_parameters]
    certain = bundle.prior_stddev**-2
    return 0.5 * float(certain @ off**2), np.diag(certain), certain * off


def _add_sensor_prior(bundle: Bundle, state: BundleState, prior: SensorPrior, H: Array, g: Array) -> float:
    """Adds a prior to the sensors' normal equations, in place; returns its cost."""
    error = se3.difference(state.T_root_sensor[prior.sensor], prior.T_root_sensor)
    J = np.eye(6)
    J[3:, 3:] = so3.left_jacobian_inverse(error[3:])
    J = J @ _body_jacobian(bundle, state, prior.sensor)
    if len(columns := bundle.pose_columns(prior.sensor)):
        H[np.ix_(columns, columns)] += J.T @ prior.information @ J
        g[columns] += J.T @ prior.information @ error
    return 0.5 * float(error @ prior.information @ error)


def _damp(H: Array, damping: float) -> Array:
    """Marquardt's scaling of matrices (..., n, n)."""
    size = H.shape[-1]
    return H * (1 + damping * np.eye(size))


def stack_poses(parts: Sequence[Array]) -> Array:
    """Poses (n, 4, 4) of a sequence of them, also of none."""
    return np.array(parts, dtype=np.float64).reshape(-1, 4, 4)
