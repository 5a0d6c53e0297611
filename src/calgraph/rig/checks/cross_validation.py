"""Cross-validation: how well the sensors predict each other in held-out captures.

Sensor poses are estimated without some captures. In each of these, the board is located by all sensors but one,
and the measurements of that one are compared with the prediction. In contrast to residuals, unknowns that absorb
errors do not reduce the errors of the prediction.

Source: Stone, "Cross-validatory choice and assessment of statistical predictions", 1974.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from calgraph.errors import InputError
from calgraph.geometry import Array, Index, matvec, se3, se_n
from calgraph.parallel.engine import Processes
from calgraph.parallel.kept_values import Kept
from calgraph.parallel.processes import forked_jobs
from calgraph.result import HeldOutError
from calgraph.result.evidence import rms
from calgraph.rig.bundle.bundle_solver import (
    BOARD_PRIOR_INFORMATION,
    COARSE_TOLERANCE,
    HUBER_THRESHOLD,
    Bundle,
    BundleEquations,
    BundleState,
    MarginalizedViews,
    linearize_bundle,
    minimize_bundle,
    retract_state,
    view_state,
)
from calgraph.rig.bundle.linearization import CachedLinearization
from calgraph.rig.bundle.normal_equations import accumulate
from calgraph.rig.bundle.observations import velocity_along_sensor
from calgraph.rig.bundle.range_observations import RangeObservations
from calgraph.rig.bundle.solution import SolvedBundle
from calgraph.solver.squared_distances import compute_squared_distances

# Gauss–Newton steps that locate boards with sensors fixed; they start from the solution of all captures.
_BOARD_STEPS = 2
# Prior standard deviation of systematic parameters over the limit of a predicted direction: small, so that the
# split into predicted and free directions is that of the board's pose.
_SHARE_OF_PREDICTED = 0.1
# Relative eigenvalue below which a view has no information along a direction (numerical rank).
_RANK_TOLERANCE = 1e-10


@dataclass(frozen=True, eq=False)
class _PredictionErrors:
    """Errors of some views of a sensor relative to the prediction by the others."""

    board: Index
    """(V,) board of each view."""
    error: Array
    """(N,) px between corners, or m between beam ends and the board's plane."""
    along: Array
    """(N,) m along the beam; empty for cameras."""
    tilt: Array
    """(V,) rad, of those views that have one."""
    squared: Array
    """(V,) squared Mahalanobis distances of views from their predictions."""
    dof: NDArray[np.intp]
    """(V,) number of predicted directions."""


def cross_validate(
    solved: SolvedBundle, folds: int, jobs: int = 1, progress: Callable[[float], None] = lambda _done: None
) -> dict[str, HeldOutError]:
    """Holds out every capture once, in one of several solutions.

    Noise and view bias are those of the solution of all captures, from which the others start.

    Args:
        solved: the solution of all captures.
        folds: number of groups of captures; each group is held out as a whole.
        jobs: maximum number of processes; they do not change the
            result.
        progress: called with the fraction done, below 1: other checks follow.

    Returns:
        The errors of the predictions by sensor; none for one that no other sensor predicts.

    Raises:
        InputError: there are fewer than two folds.
    """
    if folds < 2:
        raise InputError(f"`folds`: must be 0 for none, or 2 and more, got {folds}")
    bundle = solved.bundle
    units = {name: views.unit for name, views in zip(bundle.sensors, bundle.views, strict=True)}
    fold_of = solved.order % folds
    errors: dict[str, list[_PredictionErrors]] = {name: [] for name in bundle.sensors}
    given = Kept.of(solved)
    work = [(given, fold_of == fold) for fold in np.unique(fold_of)]
    for number, found in enumerate(Processes(forked_jobs(jobs)).map(_hold_out, work)):
        progress((number + 1) / (len(work) + 1))
        for name, error in found.items():
            errors[name].append(error)
    summaries = {name: _summarize(found, units[name], solved.captures) for name, found in errors.items()}
    return {name: summary for name, summary in summaries.items() if summary}


def _hold_out(solved: SolvedBundle, held_out_boards: NDArray[np.bool_]) -> dict[str, _PredictionErrors]:
    """The errors of the predictions in some boards (C,), by sensor, with poses from the others."""
    bundle, caches = solved.bundle, solved.minimized.equations.cache
    training, cache = _select_boards(bundle, caches, ~held_out_boards)
    trained = minimize_bundle(training, solved.minimized.state, cache, tolerance=COARSE_TOLERANCE, exact=False)
    covariance = trained.equations.covariance
    # An outline is measured by a scanner: it must not locate the board for that scanner.
    held_out, cache = _select_boards(bundle.without_outlines(), caches[: len(bundle.views)], held_out_boards)
    state, equations = _solve_boards(held_out, trained.state, cache)
    if not np.isfinite(equations.cost):  # by the trained poses, a board is behind a camera
        return {}
    return {
        name: _compare_with_prediction(held_out, state, equations, covariance, s)
        for s, name in enumerate(bundle.sensors)
        if len(held_out.views[s].board)
    }


def _select_boards(
    bundle: Bundle, cache: Sequence[CachedLinearization], kept: NDArray[np.bool_]
) -> tuple[Bundle, list[CachedLinearization]]:
    """The bundle and cached linearizations with the views of some boards (C,) only."""
    keep = [kept[views.board] for views in bundle.all_views]
    views = [views.select(some) for views, some in zip(bundle.all_views, keep, strict=True)]
    return bundle.with_views(views), [one.select(some) for one, some in zip(cache, keep, strict=True)]


def _solve_boards(
    bundle: Bundle, state: BundleState, cache: Sequence[CachedLinearization]
) -> tuple[BundleState, BundleEquations]:
    """Boards located by all sensors, whose poses are fixed."""
    fixed, equations = np.zeros(bundle.parameter_count), linearize_bundle(bundle, state, cache)
    for _ in range(_BOARD_STEPS if np.isfinite(equations.cost) else 0):
        step = matvec(_invert_information(equations.H_board), -equations.g_board)
        moved = retract_state(bundle, state, fixed, step)
        after = linearize_bundle(bundle, moved, cache)
        # A step that puts a board behind a camera is not taken.
        if not np.isfinite(after.cost):
            break
        state, equations = moved, after
    return state, equations


# m; directions in which the other sensors locate a held-out board worse than this are not compared: errors of
# interest are smaller, and first-order predictions hold up to about this distance.
_PREDICTED_BOARD_STDDEV = 0.02
# rad (6°); views that determine the tilt of a board worse than this are not compared in tilt.
_COMPARED_TILT_STDDEV = 0.1


def _compare_with_prediction(
    bundle: Bundle, state: BundleState, equations: BundleEquations, covariance: Array, sensor: int
) -> _PredictionErrors:
    """Errors of one sensor's views relative to the prediction by the others, linearized at the located boards.

    All algebra is in metres on the board: rotations are multiplied by the lever.

    Args:
        bundle: the held-out views.
        state: sensors as estimated without them, and boards as located by all of these views.
        equations: the normal equations there.
        covariance: (G, G) of the sensors.
        sensor: the predicted one.
    """
    views, (T_board, extra) = bundle.views[sensor], view_state(bundle, state, sensor)
    observed = accumulate(views.linearize(T_board, extra), views.start, HUBER_THRESHOLD)
    prior = [bundle.extra_parameters[i].prior_stddev for i in bundle.extra_indices(sensor)]
    # Systematic parameters are predicted at least as well as by their priors.
    small = _SHARE_OF_PREDICTED * _PREDICTED_BOARD_STDDEV / np.array(prior)
    meters = np.array([1, 1, 1, *[bundle.lever] * 3, *small])
    A, b = observed.information / meters / meters[:, None], observed.gradient / meters
    x, X = _predict_boards(bundle, equations, covariance, sensor)
    X, free = _split_predicted(X * meters * meters[:, None])
    X += np.eye(len(meters)) * (_bias_variances(bundle, sensor) * meters**2)[:, None]
    velocity = velocity_along_sensor(views.twist, T_board)
    if velocity is not None:
        moved = velocity * meters[:6]
        X[:, :6, :6] += bundle.bias_variances(sensor).stamp[:, None, None] * moved[:, :, None] * moved[:, None]
    # Along directions that the others do not predict, the board follows the sensor itself.
    least = _RANK_TOLERANCE * np.trace(A, axis1=-2, axis2=-1)
    _, loose = _symmetric_roots(free @ A @ free, least)
    follow = loose @ loose
    x = x * meters - matvec(follow, matvec(A, x * meters) + b)
    stay = np.eye(len(meters)) - follow @ A
    X = stay @ X @ se_n.transpose(stay) - follow
    root, inverse = _symmetric_roots(A, least)
    # Along directions that the sensor does not measure, a first-order step may be arbitrarily long: it is zero.
    x = matvec(root @ inverse, x)
    # In units of the sensor's noise: predicted directions have a variance of one or more, the others none.
    error, covariance = matvec(root, x) + matvec(inverse, b), root @ (X @ root + inverse)
    covariance = (covariance + se_n.transpose(covariance)) / 2
    squared, dof = compute_squared_distances(error, covariance, 0.5, np.ones(len(meters)))
    tested = dof > 0
    T_predicted = se3.retract(T_board, x[:, :6] / meters[:6])
    T_own = se3.retract(T_board, -matvec(inverse @ inverse, b)[:, :6] / meters[:6])
    tilted = tested & _observes_tilt(A, T_board, bundle.lever, _COMPARED_TILT_STDDEV)
    compared, T_compared = views.select(tested), T_predicted[tested]
    norm = np.linalg.norm(compared.linearize(T_compared, extra).residual, axis=1)
    error, along = compared.unwhiten(norm[:, None])[:, 0], np.zeros(0)
    if isinstance(compared, RangeObservations):
        error, along = error * compared.incidence(T_compared), error
    cosine = np.sum(T_predicted[tilted, :3, 2] * T_own[tilted, :3, 2], axis=-1)
    tilt = np.arccos(np.clip(cosine, -1, 1))
    return _PredictionErrors(views.board[tested], error, along, tilt, squared[tested], dof[tested])


def _bias_variances(bundle: Bundle, sensor: int) -> Array:
    """(V, 6 + e) variances of the biases of a sensor's views, in its pose and in its extra parameters."""
    views, variances = bundle.views[sensor], bundle.bias_variances(sensor)
    rings = views.parameters.index[:1, views.parameters["varying"]].ravel()
    of_extra = np.zeros((len(variances.pose), views.parameters.count))
    of_extra[:, rings[rings >= 0]] = variances.ring[:, None]
    return np.concatenate([variances.pose, of_extra], axis=1)


def view_jacobians(views: MarginalizedViews) -> tuple[Array, Array]:
    """Derivatives of the boards' poses before a sensor, and of its e extra parameters.

    Returns:
        (V, 6 + e, n) by the n columns of the reduced problem, and (V, 6 + e, 6) by the boards' poses.
    """
    (count, _, b), e = views.by_sensor.shape, views.local_jacobian.shape[-1] - 6
    by_sensor, by_board = np.zeros((count, 6 + e, b + e)), np.zeros((count, 6 + e, 6))
    by_sensor[:, :6, :b], by_sensor[:, 6:, b:], by_board[:, :6] = views.by_sensor, np.eye(e), views.by_board
    return by_sensor, by_board


def _predict_boards(
    bundle: Bundle, equations: BundleEquations, covariance: Array, sensor: int
) -> tuple[Array, Array]:
    """Change of each board pose before a sensor by the other sensors (V, p), and its covariance (V, p, p)."""
    omitted, board = equations.views[sensor], bundle.views[sensor].board
    of_sensor, B = view_jacobians(omitted)
    Jt = se_n.transpose(omitted.J_board)
    L = _invert_information(equations.H_board[board] - Jt @ omitted.information @ omitted.J_board)
    step = -matvec(L, equations.g_board[board] - matvec(Jt, omitted.gradient))
    coupling, columns = equations.H_board_sensor[board], bundle.columns(sensor)
    coupling[..., columns] -= Jt @ omitted.information @ omitted.J_sensor
    # Of boards (6) and the sensor's columns (n): with a residual distortion, p and n are a hundred, G thousands.
    of_boards = -L @ coupling
    shared = of_boards @ covariance
    between = B @ shared[..., columns] @ se_n.transpose(of_sensor)
    own = of_sensor @ covariance[np.ix_(columns, columns)] @ se_n.transpose(of_sensor)
    of_boards = L + shared @ se_n.transpose(of_boards)
    return matvec(B, step), B @ of_boards @ se_n.transpose(B) + between + se_n.transpose(between) + own


def _split_predicted(X: Array) -> tuple[Array, Array]:
    """A covariance (V, p, p) without directions that are not predicted, and the projectors on those."""
    values, vectors = np.linalg.eigh(X)
    predicted = values < _PREDICTED_BOARD_STDDEV**2
    transposed = se_n.transpose(vectors)
    return (vectors * (values * predicted)[..., None, :]) @ transposed, (
        vectors * ~predicted[..., None, :]
    ) @ transposed


def _symmetric_roots(A: Array, least: Array) -> tuple[Array, Array]:
    """The symmetric roots of matrices (V, p, p) and of their pseudoinverses: eigenvalues below ``least`` are 0."""
    values, vectors = np.linalg.eigh(A)
    observed = values > least[..., None]
    size = np.sqrt(np.where(observed, values, 1.0))
    transposed = se_n.transpose(vectors)
    return (vectors * (size * observed)[..., None, :]) @ transposed, (
        vectors * (observed / size)[..., None, :]
    ) @ transposed


def _observes_tilt(A: Array, T_sensor_board: Array, lever: float, max_stddev: float) -> NDArray[np.bool_]:
    """(V,) which views determine both tilts of the board; a single scan line does not."""
    across = np.zeros((len(A), A.shape[-1], 2))
    across[:, 3:6] = T_sensor_board[:, :3, :2]
    regularized = A + np.eye(A.shape[-1]) / lever**2
    covariance = se_n.transpose(across) @ np.linalg.inv(regularized) @ across
    return np.asarray(np.linalg.eigvalsh(covariance)[:, -1] < (max_stddev * lever) ** 2, dtype=np.bool_)


def _summarize(
    found: Sequence[_PredictionErrors], unit: Literal["px", "m"], capture_of_board: Index
) -> HeldOutError | None:
    """All views of one sensor in numbers; None if none was predicted."""
    dof = sum(int(e.dof.sum()) for e in found)
    if not dof:
        return None
    error = np.concatenate([e.error for e in found])
    return HeldOutError(
        captures=len(np.unique(capture_of_board[np.concatenate([e.board for e in found])])),
        unit=unit,
        rms=float(np.sqrt(np.mean(error**2))),
        median=float(np.median(error)),
        along=rms(np.concatenate([e.along for e in found])),
        tilt=rms(np.concatenate([e.tilt for e in found])),
        ratio=float(np.sqrt(sum(float(e.squared.sum()) for e in found) / dof)),
    )


def _invert_information(H_board: Array) -> Array:
    """Covariances of boards (V, 6, 6), large along unobserved directions (a general inverse loses precision)."""
    values, vectors = np.linalg.eigh(H_board)
    return np.asarray(
        (vectors / np.maximum(values, BOARD_PRIOR_INFORMATION)[..., None, :]) @ se_n.transpose(vectors)
    )
