"""How well the sensors predict each other in captures that had no part in the solution.

Sensor poses are solved without some captures. In each of those, the board is placed by what all sensors but one
saw, and that one's measurements are compared with it. A covariance may be wrong, and residuals can be small
because unknowns followed them: here neither can hide anything.

Source: Stone, "Cross-validatory choice and assessment of statistical predictions", 1974.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from calgraph.errors import InputError
from calgraph.estimation.rig.bundle_solver import (
    BOARD_PRIOR_INFORMATION,
    COARSE_TOLERANCE,
    Bundle,
    BundleEquations,
    BundleState,
    linearize_bundle,
    minimize_bundle,
    retract_state,
    view_jacobians,
)
from calgraph.estimation.rig.covariances import parameter_covariance
from calgraph.estimation.rig.normal_equations import accumulate
from calgraph.estimation.rig.observations import BoardViews, CornerObservations, RangeObservations, relative_poses
from calgraph.estimation.rig.relinearization import CachedLinearization
from calgraph.estimation.rig.solution import SolvedBundle
from calgraph.geometry import Array, se3
from calgraph.result import HeldOutError
from calgraph.result.evidence import rms

# Directions in which the others place a board worse than this are taken from the sensor's own view, m.
_PLACED = 0.02
# A view whose own tilt is less certain than this has none to compare, rad.
_TILT = 0.1
# Steps that place boards before sensors that are held.
_STEPS = 2
# Directions of a view with less than this share of its information are not measured by it.
_RANK = 1e-10


@dataclass(frozen=True, eq=False)
class _PredictionErrors:
    """How far some of a sensor's views are from what the others predict."""

    error: Array
    """(N,) px between corners, or m between beam ends and the board's plane."""
    along: Array
    """(N,) m along the beam; empty for cameras."""
    tilt: Array
    """(V,) rad, of those views that have one."""
    squared: Array
    """(V,) squared Mahalanobis distances of views from their predictions."""
    freedom: NDArray[np.intp]
    """(V,) how many directions were predicted."""


def cross_validate(adjusted: SolvedBundle, folds: int) -> dict[str, HeldOutError]:
    """Leaves out every capture once, in so many solutions.

    The noise and sway are those of the whole solution, which is also where the others start.

    Args:
        adjusted: the whole solution.
        folds: groups of captures; every group is left out as a whole.

    Returns:
        By sensor, how far what it saw is from its prediction; none for one that no other sensor predicts.

    Raises:
        InputError: there is one fold, or a number below.
    """
    if folds < 2:
        raise InputError(f"`folds`: must be 0 for none, or 2 and more, got {folds}")
    bundle = adjusted.bundle
    units: dict[str, Literal["px", "m"]] = {
        name: "px" if isinstance(views, CornerObservations) else "m"
        for name, views in zip(bundle.sensors, bundle.views, strict=True)
    }
    _, number = np.unique(adjusted.captures, return_inverse=True)
    fold_of = number % folds
    errors: dict[str, list[_PredictionErrors]] = {name: [] for name in bundle.sensors}
    visits = adjusted.minimized.equations.cache
    for fold in range(min(folds, int(number.max()) + 1)):
        others, near = _select_boards(bundle, visits, fold_of != fold)
        trained = minimize_bundle(others, adjusted.minimized.state, near, tolerance=COARSE_TOLERANCE, exact=False)
        spread = parameter_covariance(trained.equations)
        # An outline is what a scanner saw itself: it must not place the board for it.
        left, near = _select_boards(bundle.without_outlines(), visits[: len(bundle.views)], fold_of == fold)
        state, system = _solve_boards(left, trained.state, near)
        for s, name in enumerate(bundle.sensors):
            if len(left.views[s].board):
                errors[name].append(_compare_with_prediction(left, state, system, spread, s))
    summaries = {name: _summarize(found, units[name]) for name, found in errors.items()}
    return {name: summary for name, summary in summaries.items() if summary}


def _select_boards(
    bundle: Bundle, visits: Sequence[CachedLinearization], kept: NDArray[np.bool_]
) -> tuple[Bundle, list[CachedLinearization]]:
    """The bundle and visits with the views of some boards (C,) only."""
    keep = [kept[views.board] for views in bundle.all_views]
    views = [views.select(some) for views, some in zip(bundle.all_views, keep, strict=True)]
    return bundle.with_views(views), [at.select(some) for at, some in zip(visits, keep, strict=True)]


def _solve_boards(
    bundle: Bundle, state: BundleState, visits: Sequence[CachedLinearization]
) -> tuple[BundleState, BundleEquations]:
    """Boards where all sensors together have them, with sensors held."""
    held, system = np.zeros(bundle.parameter_count), linearize_bundle(bundle, state, visits)
    for _ in range(_STEPS):
        step = _multiply(_invert_information(system.H_board), -system.g_board)
        state = retract_state(bundle, state, held, step)
        system = linearize_bundle(bundle, state, visits)
    return state, system


def _compare_with_prediction(
    bundle: Bundle, state: BundleState, system: BundleEquations, spread: Array, sensor: int
) -> _PredictionErrors:
    """How far one sensor's views are from what the others predict, to first order about the placed boards.

    All algebra is in metres on the board: rotations are multiplied by the lever.

    Args:
        bundle: views that were left out.
        state: sensors as they were found without them, and boards as all of these views place them.
        system: the normal equations there.
        spread: (G, G) covariance of the sensors.
        sensor: which one is predicted.
    """
    views, own = bundle.views[sensor], state.extra[bundle.extra_indices(sensor)]
    T_placed = relative_poses(state.T_root_sensor[sensor], state.T_root_board[views.board])
    said = accumulate(views.linearize(T_placed, own), views.start)
    meters = np.array([1, 1, 1, *[bundle.lever] * 3, *[1] * views.extra_count])
    A, b = said.information / meters / meters[:, None], said.gradient / meters
    x, X = _predict_boards(bundle, state, system, spread, sensor)
    X, free = _split_predicted(X * meters * meters[:, None])
    X += np.diag(bundle.bias_variances(sensor) * meters**2)
    # Where the others leave the board free, it is where the sensor itself has it.
    least = _RANK * np.trace(A, axis1=-2, axis2=-1)
    _, loose = _symmetric_roots(free @ A @ free, least)
    follow = loose @ loose
    x = x * meters - _multiply(follow, _multiply(A, x * meters) + b)
    stay = np.eye(len(meters)) - follow @ A
    X = stay @ X @ np.swapaxes(stay, -1, -2) - follow
    root, inverse = _symmetric_roots(A, least)
    # Along what the sensor does not measure, first order reaches any distance: stay.
    x = _multiply(root @ inverse, x)
    squared, freedom = _squared_distances(_multiply(root, x) + _multiply(inverse, b), root @ (X @ root + inverse))
    tested = freedom > 0
    T_predicted = se3.retract(T_placed, x[:, :6] / meters[:6])
    T_own = se3.retract(T_placed, -_multiply(inverse @ inverse, b)[:, :6] / meters[:6])
    tilted = tested & _observes_tilt(A, T_placed, bundle.lever)
    error, along = _error_sizes(views.select(tested), T_predicted[tested], own)
    cosine = np.sum(T_predicted[tilted, :3, 2] * T_own[tilted, :3, 2], axis=-1)
    return _PredictionErrors(error, along, np.arccos(np.clip(cosine, -1, 1)), squared[tested], freedom[tested])


def _predict_boards(
    bundle: Bundle, state: BundleState, system: BundleEquations, spread: Array, sensor: int
) -> tuple[Array, Array]:
    """By how much the other sensors move each board before this one, (V, p), and its covariance (V, p, p)."""
    at, board = system.views[sensor], bundle.views[sensor].board
    of_sensor, B = view_jacobians(bundle, state, sensor)
    Jt = np.swapaxes(at.J_board, -1, -2)
    L = _invert_information(system.H_board[board] - Jt @ at.information @ at.J_board)
    step = -_multiply(L, system.g_board[board] - _multiply(Jt, at.gradient))
    coupling = system.H_board_sensor[board]
    coupling[..., bundle.columns(sensor)] -= Jt @ at.information @ at.J_sensor
    by_sensors = -B @ L @ coupling
    by_sensors[..., bundle.columns(sensor)] += of_sensor
    return _multiply(B, step), B @ L @ np.swapaxes(B, -1, -2) + by_sensors @ spread @ np.swapaxes(
        by_sensors, -1, -2
    )


def _split_predicted(X: Array) -> tuple[Array, Array]:
    """A covariance (V, p, p) without the directions in which it places nothing, and the projectors on those."""
    values, vectors = np.linalg.eigh(X)
    placed = values < _PLACED**2
    turned = np.swapaxes(vectors, -1, -2)
    return (vectors * (values * placed)[..., None, :]) @ turned, (vectors * ~placed[..., None, :]) @ turned


def _symmetric_roots(A: Array, least: Array) -> tuple[Array, Array]:
    """The symmetric roots of matrices (V, p, p) and of their pseudoinverses: eigenvalues below ``least`` are 0."""
    values, vectors = np.linalg.eigh(A)
    seen = values > least[..., None]
    size = np.sqrt(np.where(seen, values, 1.0))
    turned = np.swapaxes(vectors, -1, -2)
    return (vectors * (size * seen)[..., None, :]) @ turned, (vectors * (seen / size)[..., None, :]) @ turned


def _squared_distances(off: Array, covariance: Array) -> tuple[Array, NDArray[np.intp]]:
    """Squared Mahalanobis distances (V,) and their degrees of freedom.

    In units of the sensor's own noise: what is predicted has a variance of one and more, the rest none.
    """
    values, vectors = np.linalg.eigh((covariance + np.swapaxes(covariance, -1, -2)) / 2)
    predicted = values > 0.5
    along = _multiply(np.swapaxes(vectors, -1, -2), off)
    squared = np.sum(predicted * along**2 / np.where(predicted, values, 1.0), axis=-1)
    return squared, np.asarray(predicted.sum(axis=-1), dtype=np.intp)


def _observes_tilt(A: Array, T_sensor_board: Array, lever: float) -> NDArray[np.bool_]:
    """(V,) which views tell both tilts of the board themselves; a single scan line does not."""
    across = np.zeros((len(A), A.shape[-1], 2))
    across[:, 3:6] = T_sensor_board[:, :3, :2]
    certain = A + np.eye(A.shape[-1]) / lever**2
    spread = np.swapaxes(across, -1, -2) @ np.linalg.inv(certain) @ across
    return np.asarray(np.linalg.eigvalsh(spread)[:, -1] < (_TILT * lever) ** 2, dtype=np.bool_)


def _error_sizes(views: BoardViews, T_sensor_board: Array, own: Array) -> tuple[Array, Array]:
    """Distances (N,) in px between corners, or in m from the board's plane; and those along the beam, m."""
    residual = views.linearize(T_sensor_board, own).residual
    if isinstance(views, CornerObservations):
        return np.linalg.norm(residual, axis=1) * views.noise_scale * views.noise.pixel, np.zeros(0)
    assert isinstance(views, RangeObservations)
    along = residual[:, 0] * views.sigma
    count = np.diff(views.start, append=len(views.ranges))
    normal = np.repeat(T_sensor_board[:, :3, 2], count, axis=0)
    return np.abs(along * np.sum(normal * views.directions, axis=1)), np.abs(along)


def _summarize(found: Sequence[_PredictionErrors], unit: Literal["px", "m"]) -> HeldOutError | None:
    """All views of one sensor in numbers; None if none was predicted."""
    freedom = sum(int(e.freedom.sum()) for e in found)
    if not freedom:
        return None
    error = np.concatenate([e.error for e in found])
    return HeldOutError(
        views=sum(len(e.freedom) for e in found),
        unit=unit,
        rms=float(np.sqrt(np.mean(error**2))),
        median=float(np.median(error)),
        along=rms(np.concatenate([e.along for e in found])),
        tilt=rms(np.concatenate([e.tilt for e in found])),
        ratio=float(np.sqrt(sum(float(e.squared.sum()) for e in found) / freedom)),
    )


def _multiply(A: Array, x: Array) -> Array:
    """Matrices (V, n, p) times vectors (V, p)."""
    return np.asarray((A @ x[..., None])[..., 0])


def _invert_information(H_board: Array) -> Array:
    """Covariances of boards (V, 6, 6), wide where nothing places them; a general inverse would spoil the rest."""
    values, vectors = np.linalg.eigh(H_board)
    return np.asarray(
        (vectors / np.maximum(values, BOARD_PRIOR_INFORMATION)[..., None, :]) @ np.swapaxes(vectors, -1, -2)
    )
