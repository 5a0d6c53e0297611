"""Tests of steps in the poses of a bundle's sensors, at all times between captures."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.special import chdtri, fdtri

from calgraph.errors import CalibrationError
from calgraph.geometry import Array, Index, se3, se_n
from calgraph.rig.bundle.bundle_setup import set_noise
from calgraph.rig.bundle.bundle_solver import (
    BOARD_PRIOR_INFORMATION,
    COARSE_TOLERANCE,
    OUTLIER_SIGNIFICANCE,
    Bundle,
    BundleEquations,
    BundleState,
    MinimizedBundle,
    linearize_bundle,
    minimize_bundle,
)
from calgraph.rig.bundle.covariances import pose_covariance, view_covariance_factors
from calgraph.rig.bundle.normal_equations import whitening
from calgraph.rig.bundle.settling import settle_variances
from calgraph.rig.bundle.variance_components import measure_consistency
from calgraph.rig.checks.drift_tests import LAGS, measure_score_correlation, measure_serial_correlation

# Prior information (m⁻², rad⁻²) on a step: makes directions that no view measures invertible.
_STEP_PRIOR_INFORMATION = 1.0


@dataclass(frozen=True, eq=False)
class StepStatistics:
    """Score statistics of steps in the pose of one sensor, after each of some of its views."""

    first_after: Index
    """(T,) index of the sensor's first view after the step."""
    squared: Array
    """(T,) squared Mahalanobis distance of the step from zero: χ² with six degrees of freedom without one."""
    step: Array
    """(T, 6) most likely step in the root's fixed axes."""


@dataclass(frozen=True, eq=False)
class ReleasedPose:
    """What each view of a sensor contributes to the normal equations of a step, with its board eliminated."""

    information: Array
    """(V, 6, 6) on the step,"""
    coupling: Array
    """(V, 6, G) between the step and the reduced problem's parameters,"""
    score: Array
    """(V, 6) and gradient, at the solution without a step."""
    covariance: Array
    """(G, G) of these parameters."""

    def score_steps(self, min_views: int, order: Index | None = None) -> StepStatistics:
        """The statistics of steps between at least ``min_views`` views each, for views in an order (V,)."""
        views = np.arange(len(self.score)) if order is None else order
        first_after = np.arange(min_views, len(views) - min_views + 1)
        if not len(first_after):
            return StepStatistics(first_after, np.zeros(0), np.zeros((0, 6)))
        squared, step = self._solve_steps(
            *(_sum_from(one[views])[first_after] for one in (self.information, self.coupling, self.score))
        )
        return StepStatistics(first_after, squared, step)

    def score_without_any_one(self, first_after: int) -> float:
        """The least statistic of a step if any one view counts as on its other side.

        That of a bump remains large; that of an outlier among few views does not.
        """
        after = np.arange(len(self.score)) >= first_after
        sums = (
            tuple(
                of_views[side].sum(axis=0) - of_views[side]
                for of_views in (self.information, self.coupling, self.score)
            )
            for side in (after, ~after)
        )
        return min(float(self._solve_steps(*one)[0].min()) for one in sums)

    def _solve_steps(self, information: Array, coupling: Array, score: Array) -> tuple[Array, Array]:
        """The squared Mahalanobis distances (T,) and the steps (T, 6) of sums over the views after each step."""
        information = information - coupling @ self.covariance @ se_n.transpose(coupling)
        information = (information + se_n.transpose(information)) / 2 + _STEP_PRIOR_INFORMATION * np.eye(6)
        step: Array = np.asarray(-np.linalg.solve(information, score[..., None])[..., 0], dtype=np.float64)
        return np.asarray(-np.sum(score * step, axis=-1)), step


def release_poses(
    bundle: Bundle, state: BundleState, equations: BundleEquations, weights: Sequence[Array]
) -> list[ReleasedPose]:
    """The contributions of all views to steps in the pose of every sensor, the root included.

    The pose of one sensor is released in the views after the step: the gradient by these six parameters at the
    solution without them, with all other parameters eliminated, predicts the step. A board contributes to the
    steps before it, so that sums over boards in order of time give all times together.

    Source: Rao, "Large sample tests of statistical hypotheses concerning several parameters", 1948.

    Args:
        bundle: sensors' views in order of time, without outlines.
        state: its solution.
        equations: at the solution.
        weights: (S,) of each view (V,), in [0, 1], to bound the influence of outliers.

    Returns:
        (S,) by sensor.
    """
    G, boards = bundle.parameter_count, len(state.T_root_board)
    H = np.diag(bundle.prior_weights(state.extra) * bundle.prior_stddev**-2)
    g = H.diagonal() * np.concatenate([np.zeros(6 * bundle.body_count), state.extra])
    H_board = np.tile(BOARD_PRIOR_INFORMATION * np.eye(6), (boards, 1, 1))
    board_parameters = np.zeros((boards, 6, G + 1))
    for k, (views, at, w) in enumerate(zip(bundle.views, equations.views, weights, strict=True)):
        columns, J, Jt_board = bundle.columns(k), at.J_sensor, se_n.transpose(at.J_board)
        A, b = w[:, None, None] * at.information, w[:, None, None] * at.gradient[..., None]
        H[np.ix_(columns, columns)] += replace(at, information=A).sum_information(views.extra_of_local)
        g[columns] += (se_n.transpose(J) @ b)[..., 0].sum(axis=0)
        H_board[views.board] += Jt_board @ A @ at.J_board
        board_parameters[np.ix_(views.board, np.arange(6), columns)] += Jt_board @ A @ J
        board_parameters[views.board, :, -1] += (Jt_board @ b)[..., 0]
    eliminated = np.linalg.solve(H_board, board_parameters)
    rows = boards * 6
    both = board_parameters[..., :-1].reshape(rows, G).T @ eliminated.reshape(rows, G + 1)
    inverse = np.asarray(np.linalg.inv(H - both[:, :-1]), dtype=np.float64)
    estimate = -inverse @ (g - both[:, -1])
    released = []
    for k, (views, at, w) in enumerate(zip(bundle.views, equations.views, weights, strict=True)):
        T_root_sensor = np.broadcast_to(state.T_root_sensor[k], (len(views.board), 4, 4))
        by_pose, _ = se_n.relative_pose_jacobians(T_root_sensor, state.T_root_board[views.board])
        J = at.local_jacobian[..., :6] @ by_pose
        JtA = w[:, None, None] * se_n.transpose(J) @ at.information
        to_board = JtA @ at.J_board
        information = JtA @ J - to_board @ np.linalg.solve(H_board[views.board], se_n.transpose(to_board))
        coupled = -to_board @ eliminated[views.board]
        coupled[..., bundle.columns(k)] += JtA @ at.J_sensor
        coupled[..., -1] += w[:, None] * (se_n.transpose(J) @ at.gradient[..., None])[..., 0]
        score = coupled[..., -1] + coupled[..., :-1] @ estimate
        released.append(ReleasedPose(information, coupled[..., :-1], score, inverse))
    return released


def _sum_from(of_views: Array) -> Array:
    """(V, ...) sums over each view and all after it."""
    return np.asarray(np.cumsum(of_views[::-1], axis=0)[::-1])


@dataclass(frozen=True, eq=False)
class PoseStep:
    """A step in the pose of a sensor."""

    sensors: tuple[str, ...]
    """The sensor; several if the views do not determine which of them moved."""
    before: Index
    """Boards of its views before the step,"""
    after: Index
    """and after it. Boards that may be on either side are in neither."""
    step: Array
    """(6,) in the root's fixed axes."""
    squared: float
    """Squared Mahalanobis distance from no step."""
    serial_correlation: float
    """Factor of variances by errors that successive boards have in common, beside it and the steps before."""


# Minimum number of captures of a sensor on either side of a step: a board that slips in a few captures in a row
# is not a bump.
_MIN_VIEWS = 4
# Maximum number of steps found in a recording.
_MAX_BUMPS = 4


def find_pose_steps(bundle: Bundle, solution: MinimizedBundle) -> list[PoseStep]:
    """The significant steps in the poses of sensors, each searched beside those before it.

    None if successive boards at rest have errors in common beside these steps. Moving boards always have some:
    their serial correlation is a part of the variances, and one step is searched at a time, as there may be few
    independent views between two.

    Args:
        bundle: all views, also outliers, in order of time; without outlines and priors of poses.
        solution: its solution.
    """
    moving = any(len(views.twist) for views in bundle.views)
    max_bumps, min_views = (1, max(_MIN_VIEWS, 2 * LAGS)) if moving else (_MAX_BUMPS, _MIN_VIEWS)
    steps: list[PoseStep] = []
    while len(steps) < max_bumps:
        try:
            found = _find_step(bundle, solution, min_views)
        except (CalibrationError, np.linalg.LinAlgError):
            break
        if found is None:
            break
        step, bundle, solution = found
        steps.append(step)
    # Errors that depend on the board's pose change with time as well. They remain beside steps.
    return [] if steps and steps[-1].serial_correlation > 1 and not moving else steps


# Probability with which a recording without bumps is tested with estimated variances, which takes as long as its
# solution.
_TRIGGER_PROBABILITY = 0.1
# Rounds of estimating the variances together with a step; they start at those of the solution.
_MAX_ROUNDS = 8
# m; where views scatter with a larger standard deviation on either side of a step, another error of the model is
# larger than the step: flat boards and working scanners vary by 1 to 3 mm.
_MAX_VIEW_BIAS = 0.01
# Bound on the probability with which a recording without bumps has one reported, for all sensors and times
# together; Bonferroni's bound is conservative, as neighbouring times have nearly the same statistic. A false
# alarm costs captures, a bump that is missed an error of up to several standard deviations.
_FALSE_ALARM_PROBABILITY = 5e-3
# Sensors whose steps have a likelihood smaller than the largest by less than this factor are all named.
_INDISTINGUISHABLE_RATIO = 1e4
# Captures are neither before nor after a step if the likelihood of times on either side of them is less than this
# factor below the largest: about 95 %.
_MIN_TIME_LIKELIHOOD = 20.0


def _find_step(
    bundle: Bundle, solution: MinimizedBundle, min_views: int
) -> tuple[PoseStep, Bundle, MinimizedBundle] | None:
    """The most significant step, the bundle with it and its solution; None if none is significant."""
    state, weights = solution.state, _downweight_outliers(bundle, solution)
    released = release_poses(bundle, state, solution.equations, weights)
    scores = [one.score_steps(min_views) for one in released]
    tests = sum(len(one.squared) for one in scores)
    if not tests:
        return None
    trigger = float(chdtri(6, _TRIGGER_PROBABILITY / tests))
    scores = _require_several_views(released, scores, trigger)
    best = _select_largest(scores)
    if scores[best[0]].squared[best[1]] <= trigger:
        return None
    split = _split_sensor(bundle, state, scores, best, _MAX_ROUNDS)
    # The variances without the step contain its effect: with those beside the step, the tests select again.
    rescaled = _set_variances(bundle, state, split)
    equations = linearize_bundle(rescaled, state)
    released = release_poses(rescaled, state, equations, weights)
    scores = [one.score_steps(min_views) for one in released]
    scores = _require_several_views(released, scores, trigger)
    if not any(len(one.squared) for one in scores):
        return None
    again = _select_largest(scores)
    if again != best:
        best, split = again, _split_sensor(bundle, state, scores, again, _MAX_ROUNDS)
    k, _ = best
    if split.bundle.bias_variance[:, 0].max() > _MAX_VIEW_BIAS**2:
        return None
    step, covariance, freedom, factor = _measure_step(split, k)
    largest = [float(one.squared.max(initial=0.0)) for one in scores]
    # A few lines on boards determine a pose poorly, and may have a far solution that its covariance does not span.
    squared = min(float(step @ np.linalg.solve(covariance, step)), largest[k]) / factor
    significant = squared > 6 * fdtri(6, freedom, 1 - _FALSE_ALARM_PROBABILITY / tests)
    if not significant or not _depends_on_order(released[k], largest[k], min_views):
        return None
    margin = 2 * np.log(_INDISTINGUISHABLE_RATIO)
    names = dict.fromkeys(bundle.sensors[j] for j in range(len(scores)) if largest[j] >= largest[k] - margin)
    likely = scores[k].first_after[scores[k].squared >= largest[k] - 2 * np.log(_MIN_TIME_LIKELIHOOD)]
    boards = bundle.views[k].board
    found = PoseStep(tuple(names), boards[: likely[0]], boards[likely[-1] :], step, squared, factor)
    return found, split.complete, split.solution


@dataclass(frozen=True, eq=False)
class _Split:
    """A bundle with one more step."""

    complete: Bundle
    """All views, with the variances of those that agree."""
    solution: MinimizedBundle
    """Of these."""
    bundle: Bundle
    """Without outlier views, with equal variances before and after the step."""
    state: BundleState
    """The solution of these."""


def _split_sensor(
    bundle: Bundle, state: BundleState, scores: Sequence[StepStatistics], best: tuple[int, int], rounds: int
) -> _Split:
    """The bundle with a step: the views after it are of another sensor, whose systematic errors are the same."""
    k, i = best
    added, after = len(bundle.sensors), np.arange(len(bundle.views[k].board)) >= scores[k].first_after[i]
    views = [*bundle.views, bundle.views[k].select(after)]
    views[k] = bundle.views[k].select(~after)
    complete = replace(
        bundle,
        sensors=(*bundle.sensors, bundle.sensors[k]),
        views=tuple(views),
        body=np.append(bundle.body, bundle.body_count + 1),
        bias_variance=np.concatenate([bundle.bias_variance, bundle.bias_variance[k : k + 1]]),
        extra_parameters=tuple(
            replace(one, view_sets=(*one.view_sets, added)) if k in one.view_sets else one
            for one in bundle.extra_parameters
        ),
    )
    moved = se3.retract(state.T_root_sensor[k], scores[k].step[i])
    start = replace(state, T_root_sensor=np.concatenate([state.T_root_sensor, moved[None]]))
    solution = minimize_bundle(complete, start, tolerance=COARSE_TOLERANCE, exact=False)
    settled, solution, _ = settle_variances(complete, solution, rounds)
    settled = _pool_variances(settled, solution.state, k, added)
    state, scales = solution.state, [views.noise_scale for views in settled.views]
    complete = set_noise(replace(complete, bias_variance=settled.bias_variance), state, scales)
    return _Split(
        complete, minimize_bundle(complete, state, tolerance=COARSE_TOLERANCE, exact=False), settled, state
    )


def _pool_variances(bundle: Bundle, state: BundleState, k: int, added: int) -> Bundle:
    """The bundle with the mean variances of views k and those added: few views determine them poorly."""
    share = np.array([len(bundle.views[k].board), len(bundle.views[added].board)], dtype=np.float64) + 1e-9
    share /= share.sum()
    bias_variance, scales = bundle.bias_variance.copy(), [views.noise_scale for views in bundle.views]
    bias_variance[[k, added]] = share @ bias_variance[[k, added]]
    scales[k] = scales[added] = float(np.sqrt(share @ np.square([scales[k], scales[added]])))
    return set_noise(replace(bundle, bias_variance=bias_variance), state, scales)


def _set_variances(bundle: Bundle, state: BundleState, split: _Split) -> Bundle:
    """The bundle without a step, with the variances beside it."""
    sensors = len(bundle.sensors)
    scales = [views.noise_scale for views in split.bundle.views[:sensors]]
    return set_noise(replace(bundle, bias_variance=split.bundle.bias_variance[:sensors]), state, scales)


def _measure_step(split: _Split, k: int) -> tuple[Array, Array, float, float]:
    """The step (6,) between views k and those added last, its covariance, and the freedom of its variances.

    The last is the factor of the covariance by errors that successive boards have in common beside the step.
    """
    bundle = split.bundle
    solution = minimize_bundle(bundle, split.state, tolerance=COARSE_TOLERANCE)
    state, added = solution.state, len(bundle.sensors) - 1
    joint = pose_covariance(bundle, state, solution.equations).reshape(added + 1, 6, added + 1, 6)
    covariance = joint[k, :, k] + joint[added, :, added] - joint[k, :, added] - joint[added, :, k]
    factors = view_covariance_factors(bundle, solution.equations)
    freedom, moving = 0.0, len(bundle.views[k].twist) > 0
    for j in (k, added):
        A = solution.equations.views[j].information
        # Of boards at rest, variances of noise and rings determine the step as well.
        p = solution.equations.cache[j].equations.pose_count if moving else A.shape[-1]
        whiten, measured = whitening(A[:, :p, :p])
        freedom += float(measured.sum() - np.sum(factors[j].multiply(whiten @ A[:, :p]) ** 2))
    step = se3.difference(state.T_root_sensor[added], state.T_root_sensor[k])
    factor = measure_serial_correlation(bundle, solution, np.arange(len(state.T_root_board)))
    if moving:
        factor = max(factor, _correlate_scores(bundle, solution, (k, added)))
    return step, covariance, max(freedom, 1.0), factor


def _correlate_scores(bundle: Bundle, solution: MinimizedBundle, parts: Sequence[int]) -> float:
    """The factor of :func:`measure_score_correlation` of the views of a sensor on both sides of a step."""
    ones = [np.ones(len(views.board)) for views in bundle.views]
    released = release_poses(bundle, solution.state, solution.equations, ones)
    scores = np.concatenate([released[j].score for j in parts])
    information = np.sum([released[j].information.sum(axis=0) for j in parts], axis=0)
    whiten, _ = whitening(information)
    order = np.argsort(np.concatenate([bundle.views[j].board for j in parts]))
    return measure_score_correlation(scores[order] @ whiten.T)


# Random orders of a sensor's captures, none of which may have a larger statistic than that of time: 0.5 % of
# them, for any distribution of outliers.
_PERMUTATIONS = 199


def _depends_on_order(released: ReleasedPose, largest: float, min_views: int) -> bool:
    """Whether a statistic is larger than the largest of all times for views in any of many random orders.

    Boards that slip, and other outliers, give large statistics in any order.

    Source: Good, "Permutation, parametric and bootstrap tests of hypotheses", 2005.
    """
    rng, views = np.random.default_rng(0), len(released.score)
    return all(
        released.score_steps(min_views, rng.permutation(views)).squared.max() < largest
        for _ in range(_PERMUTATIONS)
    )


def _downweight_outliers(bundle: Bundle, solution: MinimizedBundle) -> list[Array]:
    """(S,) weights (V,) of views, inverse to their Mahalanobis distance where they are outliers."""
    factors = view_covariance_factors(bundle, solution.equations)
    return [
        1 / np.sqrt(np.maximum(one.excess(OUTLIER_SIGNIFICANCE), 1.0))
        for one in measure_consistency(solution.equations, factors)
    ]


# A step must remain where any one capture counts as on its other side, with a smaller probability than this by
# chance: one wrong detection among the last four of a scanner had a statistic of 427, and 3 without it; bumps of
# a few standard deviations have 15 and more.
_SINGLE_VIEW_PROBABILITY = 0.05


def _require_several_views(
    released: Sequence[ReleasedPose], scores: Sequence[StepStatistics], trigger: float
) -> list[StepStatistics]:
    """The statistics, with zero in place of those above the trigger that rest on one view."""
    least = float(chdtri(6, _SINGLE_VIEW_PROBABILITY))
    return [
        replace(
            statistics,
            squared=np.array([
                squared if squared <= trigger or one.score_without_any_one(first) > least else 0.0
                for first, squared in zip(statistics.first_after, statistics.squared, strict=True)
            ]),
        )
        for one, statistics in zip(released, scores, strict=True)
    ]  # fmt: skip


def _select_largest(scores: Sequence[StepStatistics]) -> tuple[int, int]:
    """Index of the view set and of the time of the largest statistic."""
    # One that has no time counts less than one whose statistics are all zero.
    k = int(np.argmax([one.squared.max(initial=-1.0) for one in scores]))
    return k, int(np.argmax(scores[k].squared))
