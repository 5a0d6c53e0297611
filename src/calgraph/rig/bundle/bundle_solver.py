"""Bundle adjustment of a rig: sensor poses, one pose for each board, and extra parameters such as range biases.

Residuals are in the units of the measurements. Boards are conditionally independent given the sensors, so each is
eliminated (Schur complement), which leaves a small dense problem over the sensors for any number of captures.

Source: Triggs et al., "Bundle adjustment: a modern synthesis", 1999, section 6.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property, partial

import numpy as np

from calgraph.errors import CalibrationError
from calgraph.geometry import Array, Index, se3, se_n, so3
from calgraph.rig.bundle.bundle_parameters import SensorPrior, SystematicParameter
from calgraph.rig.bundle.linearization import CachedLinearization, linearize_views
from calgraph.rig.bundle.normal_equations import BiasVariances
from calgraph.rig.bundle.observations import BoardViews, relative_poses
from calgraph.solver.levenberg_marquardt import minimize

# Prior information on a board's pose (m⁻², rad⁻²), 10⁻⁷ of a beam's: makes unmeasured directions invertible.
BOARD_PRIOR_INFORMATION = 1e-4
# Predicted decrease of the cost (half squared standard deviations) at which the solver stops: no parameter is then
# off by more than 5 % of its standard deviation,
COARSE_TOLERANCE = 1e-3
# or by more than 0.05 %.
_FINE_TOLERANCE = 1e-7


# Prior standard deviation of a sensor's position about the present estimate, m: several times the size of any
# rig, so that it matters only for directions without measurements.
_POSITION_PRIOR_STDDEV = 10.0
# The same of its rotation, rad: half a turn is the largest rotation.
_ROTATION_PRIOR_STDDEV = math.pi
# Standard deviations of a prior beyond which it is not Gaussian, but has the tails of a Cauchy distribution
# (Huber, "Robust statistics", 1981, section 4.8): the deviation from which a finding names the error. Priors
# describe usual hardware, but distortion that is left out, or tags of another size, is ten times as far off.
_PRIOR_TAIL = 3.0
# Minimum standard deviation of the bias of a view's edges, m: a scanner measures the board up to anywhere within
# the footprint of a beam, 9 mm of 3 mrad at 3 m. Edges fit each other better than this within a view; on the real
# VLP-16 (benchmarks/subsets.py), 2 mm make poses from different captures differ by 1.8 of the stated variance, 5
# mm by 1.2, 10 mm by 1.0.
_MIN_VIEW_BIAS = 0.008


@dataclass(frozen=True, eq=False)
class Bundle:
    """The observations of all boards, and the parameters that they depend on."""

    sensors: tuple[str, ...]
    """Names, the root first."""
    views: tuple[BoardViews, ...]
    """Of each sensor."""
    body: Index
    """(S,) index of each sensor's rigid body; 0 is the root's, which does not move."""
    bias_variance: Array
    """(K, 4) variances of the view bias: of the displacement (m²) and rotation (rad²) of the board before the
    sensor along each axis, of the bias of each ring (m²), and of the stamp of a view of a moving board (s²). Of
    all S sensors' views, then of the outlines."""
    lever: float
    """Half the size of a board, m: rotations times it compare with displacements."""
    priors: tuple[SensorPrior, ...] = ()
    extra_parameters: tuple[SystematicParameter, ...] = ()
    """Besides poses. A sensor's views use theirs in this order."""
    outlines: tuple[BoardViews, ...] = ()
    """(O,) views of the boards' outlines, with separate noise, bias and extra parameters."""
    outline_sensor: tuple[int, ...] = ()
    """(O,) index of each outline's sensor."""
    prior_tail: float = _PRIOR_TAIL
    """Standard deviations beyond which priors of the extra parameters have tails."""
    robust_views: bool = False
    """Whether views that deviate from the others are down-weighted, as long as variances have not settled."""

    @property
    def all_views(self) -> tuple[BoardViews, ...]:
        """(K,) of each sensor, then the outlines; below, ``k`` is an index of this tuple."""
        return (*self.views, *self.outlines)

    def sensor_of(self, k: int) -> int:
        """Index of the sensor of views k."""
        return k if k < len(self.views) else self.outline_sensor[k - len(self.views)]

    def with_views(self, all_views: Sequence[BoardViews]) -> "Bundle":
        """The bundle with other views (K,)."""
        sensors = len(self.views)
        return replace(self, views=tuple(all_views[:sensors]), outlines=tuple(all_views[sensors:]))

    def without_outlines(self) -> "Bundle":
        """The bundle with observations of the boards' planes and prints only.

        Parameters of outlines alone stay, with their priors only.
        """
        sensors = len(self.views)
        parameters = tuple(
            replace(one, view_sets=tuple(k for k in one.view_sets if k < sensors)) for one in self.extra_parameters
        )
        return replace(
            self,
            extra_parameters=parameters,
            bias_variance=self.bias_variance[:sensors],
            outlines=(),
            outline_sensor=(),
        )

    def extra_indices(self, k: int) -> Index:
        """(e,) indices of the extra parameters of views k."""
        return self._extra_of_views[k]

    @cached_property
    def _extra_of_views(self) -> tuple[Index, ...]:
        """(K,) as of :meth:`extra_indices`: a residual distortion has a hundred, and each step asks for all."""
        sets, count = [set(one.view_sets) for one in self.extra_parameters], len(self.all_views)
        return tuple(np.flatnonzero([k in of_parameter for of_parameter in sets]) for k in range(count))

    def columns(self, k: int) -> Index:
        """(n,) columns of the reduced problem that views k depend on: the pose of a body, and extra parameters."""
        return np.concatenate([self.pose_columns(self.sensor_of(k)), self.extra_indices(k) + 6 * self.body_count])

    def pose_columns(self, sensor: int) -> Index:
        """(6,) columns of a sensor's body in the reduced problem; (0,) for the root's."""
        body = int(self.body[sensor])
        return np.arange(6 * (body - 1), 6 * body) if body > 0 else np.zeros(0, dtype=np.intp)

    @property
    def body_count(self) -> int:
        """Number of bodies besides the root's."""
        return int(self.body.max())

    @cached_property
    def board_kinds(self) -> tuple[tuple[Index, Index], ...]:
        """(K,) the first views of each kind of board, whose extra parameters are the same, and each one's kind."""
        extra = (views.parameters.index for views in self.all_views)
        found = (np.unique(one, axis=0, return_index=True, return_inverse=True) for one in extra)
        return tuple((first, kind.ravel()) for _, first, kind in found)

    @property
    def parameter_count(self) -> int:
        """Number G of parameters of the reduced problem."""
        return 6 * self.body_count + len(self.extra_parameters)

    @property
    def prior_stddev(self) -> Array:
        """(G,) prior standard deviations of the reduced problem's parameters."""
        pose = [_POSITION_PRIOR_STDDEV] * 3 + [_ROTATION_PRIOR_STDDEV] * 3
        return np.array(pose * self.body_count + [one.prior_stddev for one in self.extra_parameters])

    def prior_weights(self, extra: Array) -> Array:
        """(G,) factors of the priors' information at extra parameters (E,): less than 1 in the tails.

        Beyond some standard deviations, the prior has the tails of a Cauchy distribution: a lens or print that is
        grossly wrong contradicts it, and is then estimated from the data.
        """
        tail = self.prior_tail * np.array([one.prior_stddev for one in self.extra_parameters])
        weights = np.ones(self.parameter_count)
        weights[6 * self.body_count :] = (tail / np.maximum(np.abs(extra), tail)) ** 2
        return weights

    def bias_components(self, k: int) -> tuple[int, ...]:
        """Columns of ``bias_variance`` that views k have: a displacement, a rotation, rings, and the stamp."""
        views = self.all_views[k]
        return (0, 1, *([2] if views.parameters.ring_count else []), *([3] if len(views.twist) else []))

    def least_bias_variance(self, k: int) -> Array:
        """(4,) least variances of the bias of views k, in the columns of ``bias_variance``."""
        least = _MIN_VIEW_BIAS if k >= len(self.views) else 0.0
        return np.array([least, least / self.lever, least, 0.0]) ** 2

    def bias_variances(self, k: int) -> BiasVariances:
        """Of each view in k."""
        displacement, rotation, ring, stamp = self.bias_variance[k]
        views = self.all_views[k]
        pose = np.tile(np.repeat([displacement, rotation], 3), (len(views.board), 1))
        if len(views.motion_variance):
            pose += views.motion_variance
        return BiasVariances(pose, np.full(len(pose), ring), np.full(len(pose), stamp))


@dataclass(frozen=True, eq=False)
class BundleState:
    """Values of all parameters."""

    T_root_sensor: Array
    """(S, 4, 4)."""
    T_root_board: Array
    """(C, 4, 4)."""
    extra: Array
    """(E,) extra parameters."""


@dataclass(frozen=True, eq=False)
class MarginalizedViews:
    """Normal equations of one set of views at a state, with the view biases marginalised, and robust weights."""

    information: Array
    """(V, q, q) on the local parameters."""
    gradient: Array
    """(V, q)."""
    local_jacobian: Array
    """(V, q, 6 + e) derivatives of the local parameters by the board's pose before the sensor and the extra
    parameters."""
    by_sensor: Array
    """(V, 6, b) derivatives of that pose by the pose of the sensor's body, b = 0 of the root's,"""
    by_board: Array
    """(V, 6, 6) and by the board's."""

    @property
    def J_sensor(self) -> Array:
        """(V, q, n) derivatives of the local parameters by the columns of the reduced problem that they depend on.

        Not kept: of twenty lenses with a residual distortion, they are 100 MB at each state.
        """
        by_pose, by_extra = self.local_jacobian[..., :6], self.local_jacobian[..., 6:]
        return np.concatenate([by_pose @ self.by_sensor, by_extra], axis=-1)

    @property
    def J_board(self) -> Array:
        """(V, q, 6) derivatives of the local parameters by the board's pose."""
        return self.local_jacobian[..., :6] @ self.by_board

    def sum_information(self, J: Array, first_of_kind: Index, kind: Index) -> Array:
        """(n, n) information of all views on the columns of the reduced problem, with ``J_sensor`` J.

        The derivatives by extra parameters are the same in all views of one kind of board: these are summed first.
        """
        b = self.by_sensor.shape[-1]
        H = np.zeros((J.shape[-1], J.shape[-1]))
        H[:b] = (se_n.transpose(J[..., :b]) @ self.information @ J).sum(axis=0)
        H[b:, :b] = H[:b, b:].T
        for i, v in enumerate(first_of_kind):
            H[b:, b:] += J[v, :, b:].T @ self.information[kind == i].sum(axis=0) @ J[v, :, b:]
        return H


@dataclass(frozen=True, eq=False)
class BundleEquations:
    """Normal equations of the bundle at a state."""

    cost: float
    views: tuple[MarginalizedViews, ...]
    H: Array
    """(G, G) of the sensors and extra parameters."""
    g: Array
    """(G,)."""
    H_board: Array
    """(C, 6, 6) of the boards."""
    g_board: Array
    """(C, 6)."""
    H_board_sensor: Array
    """(C, 6, G) between boards and sensors."""
    cache: tuple[CachedLinearization, ...]
    """(K,) the linearizations that they are extrapolated from."""
    extrapolated: float
    """Decrease of the cost since all of these were at this state, by extrapolation; 0 if they are."""

    @cached_property
    def covariance(self) -> Array:
        """(G, G) of the poses of bodies and of the extra parameters; read-only."""
        covariance = np.asarray(np.linalg.inv(self.eliminate_boards()[0]))
        covariance.flags.writeable = False
        return covariance

    def solve(self, damping: float) -> tuple[tuple[Array, Array], float]:
        """Steps (G,) of the sensors and (C, 6) of the boards, and their predicted decrease of the cost."""
        H, g, K = self.eliminate_boards(damping)
        step: Array = np.asarray(-np.linalg.solve(H, g), dtype=np.float64)
        boards = -(K[..., :-1] @ step + K[..., -1])
        decrease = damping * np.diagonal(self.H) @ step**2 - self.g @ step
        damped = damping * np.diagonal(self.H_board, axis1=-2, axis2=-1) * boards
        decrease += np.sum((damped - self.g_board) * boards)
        return (step, boards), 0.5 * float(decrease)

    def eliminate_boards(self, damping: float = 0.0) -> tuple[Array, Array, Array]:
        """Schur complement: matrix (G, G) and gradient (G,) of the reduced problem, and ``K`` (C, 6, G + 1).

        For a step of the sensors, that of the boards is ``-(K[..., :-1] @ step + K[..., -1])``.
        """
        right = np.concatenate([self.H_board_sensor, self.g_board[..., None]], axis=-1)
        K = np.linalg.solve(_damp(self.H_board, damping) + BOARD_PRIOR_INFORMATION * np.eye(6), right)
        rows, size = K.shape[0] * K.shape[1], len(self.g)
        both = self.H_board_sensor.reshape(rows, size).T @ K.reshape(rows, size + 1)
        return _damp(self.H, damping) - both[:, :-1], self.g - both[:, -1], K


@dataclass(frozen=True, eq=False)
class MinimizedBundle:
    """The result of a minimisation."""

    state: BundleState
    equations: BundleEquations
    iterations: int
    converged: bool


# Residuals beyond this many standard deviations are down-weighted (Huber): Gaussian noise loses 0.3 % of its
# information.
HUBER_THRESHOLD = 2.5


def linearize_bundle(
    bundle: Bundle, state: BundleState, cache: Sequence[CachedLinearization | None] = ()
) -> BundleEquations:
    """The normal equations at a state.

    Args:
        bundle: the observations.
        state: the linearization point.
        cache: (K,) earlier linearizations of the same views, or None: extrapolated where they are near enough.
    """
    equations, costs, linearizations = [], [], []
    for k, views in enumerate(bundle.all_views):
        bias, (T_sensor_board, extra) = bundle.bias_variances(k), view_state(bundle, state, k)
        cached = cache[k] if cache else None
        at = cached.extrapolate(views, T_sensor_board, extra) if cached else None
        if not (cached and at):
            cached = linearize_views(views, T_sensor_board, extra, bias, HUBER_THRESHOLD)
            at = cached.equations
        linearizations.append(cached)
        A, b, of_views = at.marginalize_bias(bias)
        if bundle.robust_views:
            weight, of_views = cached.weigh_views(at, of_views)
            A, b = weight[:, None, None] * A, weight[:, None] * b
        equations.append(MarginalizedViews(A, b, at.local_jacobian, *view_pose_jacobians(bundle, state, k)))
        costs.append(float(of_views.sum()))
    extrapolated = np.inf if any(new is old for new, old in zip(linearizations, cache, strict=False)) else 0.0
    found = sum_views(bundle, state, equations, costs)
    return replace(found, cache=tuple(linearizations), extrapolated=extrapolated)


def sum_views(
    bundle: Bundle, state: BundleState, equations: Sequence[MarginalizedViews], costs: Sequence[float] = ()
) -> BundleEquations:
    """The normal equations of the bundle from those of all its views (K,) at a state, with their costs."""
    size, boards = bundle.parameter_count, len(state.T_root_board)
    cost, H, g = _prior_equations(bundle, state)
    H_board, g_board, H_board_sensor = np.zeros((boards, 6, 6)), np.zeros((boards, 6)), np.zeros((boards, 6, size))
    for k, (views, at) in enumerate(zip(bundle.all_views, equations, strict=True)):
        columns, J, J_board, b = bundle.columns(k), at.J_sensor, at.J_board, at.gradient[..., None]
        Jt_board = se_n.transpose(J_board)
        Jt_board_A = Jt_board @ at.information
        H[np.ix_(columns, columns)] += at.sum_information(J, *bundle.board_kinds[k])
        g[columns] += (se_n.transpose(J) @ b)[..., 0].sum(axis=0)
        H_board[views.board] += Jt_board_A @ J_board
        g_board[views.board] += (Jt_board @ b)[..., 0]
        H_board_sensor[np.ix_(views.board, np.arange(6), columns)] += Jt_board_A @ J
    cost = sum(costs, cost)
    for prior in bundle.priors:
        error, J = linearize_sensor_prior(bundle, state, prior)
        cost += 0.5 * float(error @ prior.information @ error)
        if len(columns := bundle.pose_columns(prior.sensor)):
            H[np.ix_(columns, columns)] += J.T @ prior.information @ J
            g[columns] += J.T @ prior.information @ error
    return BundleEquations(cost, tuple(equations), H, g, H_board, g_board, H_board_sensor, (), 0.0)


# The solution is linearized exactly if the cost fell by more than this multiple of the solver's tolerance since
# the last exact linearization: extrapolation is exact to second order below.
_MAX_COST_RATIO = 20.0
# Limit on steps of a solution, which states whether it converged: most take fewer than 10, and 0.3 % of those in
# the tests reach it.
_MAX_STEPS = 50


def minimize_bundle(
    bundle: Bundle,
    state: BundleState,
    cache: Sequence[CachedLinearization | None] = (),
    *,
    iterations: int | None = None,
    tolerance: float = _FINE_TOLERANCE,
    exact: bool = True,
) -> MinimizedBundle:
    """Minimises the robust cost of all views and priors.

    Args:
        bundle: the observations.
        state: start values.
        cache: (K,) earlier linearizations of the same views near the solution, or None.
        iterations: steps at most, rejected ones included; by default as many as the settings allow.
        tolerance: the solver stops where the next step would gain less, in half squared standard deviations.
        exact: whether the final state is linearized exactly, instead of by extrapolation where that is near.

    Raises:
        CalibrationError: the residuals are not finite at the start.
    """

    def linearize(state: BundleState, near: BundleEquations | None) -> BundleEquations:
        equations = linearize_bundle(bundle, state, near.cache if near else cache)
        if near and equations.extrapolated:
            equations = replace(equations, extrapolated=near.extrapolated + near.cost - equations.cost)
        return equations

    def refine(state: BundleState, equations: BundleEquations, settled: bool) -> BundleEquations | None:
        limit = _MAX_COST_RATIO * tolerance if settled else 0.0
        return linearize_bundle(bundle, state) if equations.extrapolated > limit else None

    run = partial(
        minimize,
        state,
        retract=lambda state, step: retract_state(bundle, state, *step),
        iterations=_MAX_STEPS if iterations is None else iterations,
        tolerance=tolerance,
        refine=refine if exact else None,
    )
    minimum = run(linearize=linearize)
    defined = (one.is_defined(*view_state(bundle, minimum.state, k)) for k, one in enumerate(bundle.all_views))
    if (exact and not minimum.converged) or not all(defined):
        # Extrapolation keeps robust weights: its steps may lead off the minimum, or boards out of a camera's view.
        minimum = run(linearize=lambda state, _: linearize_bundle(bundle, state))
    if not np.isfinite(minimum.linearization.cost):
        raise CalibrationError("the start poses give residuals that are not finite: a board is behind a camera")
    return MinimizedBundle(minimum.state, minimum.linearization, minimum.iterations, minimum.converged)


def view_state(bundle: Bundle, state: BundleState, k: int) -> tuple[Array, Array]:
    """The poses (V, 4, 4) of boards before the sensor of views k, and its extra parameters (e,)."""
    T_root_sensor, board = state.T_root_sensor[bundle.sensor_of(k)], bundle.all_views[k].board
    return relative_poses(T_root_sensor, state.T_root_board[board]), state.extra[bundle.extra_indices(k)]


def view_pose_jacobians(bundle: Bundle, state: BundleState, k: int) -> tuple[Array, Array]:
    """Derivatives (V, 6, 6) of the boards' poses before a sensor by its body, none if fixed, and by the boards."""
    views, sensor = bundle.all_views[k], bundle.sensor_of(k)
    T_root_sensor = np.broadcast_to(state.T_root_sensor[sensor], (len(views.board), 4, 4))
    by_sensor, by_board = se3.relative_pose_jacobians(T_root_sensor, state.T_root_board[views.board])
    return by_sensor @ body_jacobian(bundle, state, sensor)[:, : len(bundle.pose_columns(sensor))], by_board


def retract_state(bundle: Bundle, state: BundleState, step: Array, boards: Array) -> BundleState:
    """The state after steps (G,) of the sensors and (C, 6) of the boards, along the root's fixed axes."""
    T = state.T_root_sensor.copy()
    for s in np.flatnonzero(bundle.body > 0):
        J = body_jacobian(bundle, state, int(s))
        T[s] = se3.retract(T[s], J @ step[bundle.pose_columns(int(s))])
    extra = state.extra + step[len(step) - len(state.extra) :]
    return BundleState(_restore_rigid_groups(bundle, state, T), se3.retract(state.T_root_board, boards), extra)


def body_jacobian(bundle: Bundle, state: BundleState, sensor: int) -> Array:
    """(6, 6) derivative of a sensor's pose by that of its body, which is the pose of its first sensor."""
    return displacement_jacobian(state, sensor, int(np.flatnonzero(bundle.body == bundle.body[sensor])[0]))


def displacement_jacobian(state: BundleState, sensor: int, other: int) -> Array:
    """(6, 6) derivative of the pose of one sensor by that of another one that it is fixed to."""
    J = np.eye(6)
    J[:3, 3:] = -so3.hat(state.T_root_sensor[sensor, :3, 3] - state.T_root_sensor[other, :3, 3])
    return J


def _restore_rigid_groups(bundle: Bundle, before: BundleState, T_root_sensor: Array) -> Array:
    """The poses with relative poses on one body as before, which a step keeps to first order only."""
    T = T_root_sensor.copy()
    for s, body in enumerate(bundle.body):
        first = int(np.flatnonzero(bundle.body == body)[0])
        if body > 0 and first != s:
            T[s] = T[first] @ se3.inverse(before.T_root_sensor[first]) @ before.T_root_sensor[s]
    return T


def _prior_equations(bundle: Bundle, state: BundleState) -> tuple[float, Array, Array]:
    """Cost, matrix (G, G) and gradient (G,) of the priors of the reduced problem's parameters."""
    # Zero-gradient regularizer of poses, for unobserved directions.
    off = np.zeros(bundle.parameter_count)
    off[6 * bundle.body_count :] = state.extra
    weights = bundle.prior_weights(state.extra)
    information = weights * bundle.prior_stddev**-2
    tails = -np.log(weights) * bundle.prior_tail**2
    return 0.5 * float(np.sum(information * off**2 + tails)), np.diag(information), information * off


def linearize_sensor_prior(bundle: Bundle, state: BundleState, prior: SensorPrior) -> tuple[Array, Array]:
    """Error (6,) of a sensor's pose from its prior, and its derivatives (6, 6) by the pose of its body."""
    error = se3.difference(state.T_root_sensor[prior.sensor], prior.T_root_sensor)
    J = np.eye(6)
    J[3:, 3:] = so3.left_jacobian_inverse(error[3:])
    return error, J @ body_jacobian(bundle, state, prior.sensor)


def _damp(H: Array, damping: float) -> Array:
    """Matrices (..., n, n) with Marquardt's damping of their diagonals."""
    damped, diagonal = H.copy(), np.arange(H.shape[-1])
    damped[..., diagonal, diagonal] *= 1 + damping
    return damped
