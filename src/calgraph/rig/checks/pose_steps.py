"""Tests of steps in the poses of a bundle's sensors, at all times between captures."""

from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, replace

import numpy as np
from scipy.special import chdtri, fdtri

from calgraph.errors import CalibrationError
from calgraph.geometry import Array, Index, se3
from calgraph.rig.bundle.bundle_setup import update_noise
from calgraph.rig.bundle.bundle_solver import (
    COARSE_TOLERANCE,
    Bundle,
    BundleEquations,
    BundleState,
    MinimizedBundle,
    linearize_bundle,
    minimize_bundle,
    sum_views,
)
from calgraph.rig.bundle.covariances import pose_covariance, view_covariance_factors
from calgraph.rig.bundle.linearization import OUTLIER_SIGNIFICANCE
from calgraph.rig.bundle.normal_equations import whitening
from calgraph.rig.bundle.settling import settle_variances
from calgraph.rig.bundle.variance_components import measure_consistency
from calgraph.rig.checks.pose_changes import PoseChanges, release_poses
from calgraph.rig.checks.serial_correlation import LAGS, measure_score_correlation, measure_serial_correlation

# Prior information (m⁻², rad⁻²) on a step: makes directions that no view measures invertible.
_STEP_PRIOR_INFORMATION = 1.0


def score_steps(released: PoseChanges, min_views: int, order: Index | None = None) -> tuple[Array, Array]:
    """Score statistics of steps in the pose of one sensor, for its views in an order (V,).

    Returns:
        The squared Mahalanobis distances (T,) from no step, χ² with six degrees of freedom without one, and the
        steps (T, 6) in the root's fixed axes: before each view with at least ``min_views`` before and from it on.
    """
    views = np.arange(len(released.gradient)) if order is None else order
    first_after = np.arange(min_views, len(views) - min_views + 1)
    after = released.combine(lambda of_views: np.cumsum(of_views[views[::-1]], axis=0)[::-1][first_after])
    return after.test(_STEP_PRIOR_INFORMATION)


def score_without_any_one(released: PoseChanges, first_after: int) -> float:
    """The least statistic of a step before a view if any one view counts as on its other side.

    That of a bump remains large; that of an outlier among few views does not.
    """

    def score_side(side: slice) -> float:
        others = released.combine(lambda of_views: of_views[side].sum(axis=0) - of_views[side])
        return float(others.test(_STEP_PRIOR_INFORMATION)[0].min())

    return min(score_side(slice(first_after, None)), score_side(slice(first_after)))


@dataclass(frozen=True, eq=False)
class PoseStep:
    """A step in the pose of a sensor."""

    sensors: tuple[str, ...]
    """The sensor; several if the views do not determine which of them moved."""
    before: Index
    """Boards, or captures, of its views before the step,"""
    after: Index
    """and after it. Boards that may be on either side are in neither."""
    step: Array
    """(6,) in the root's fixed axes."""
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
    with suppress(CalibrationError, np.linalg.LinAlgError):
        while len(steps) < max_bumps and (found := _find_step(bundle, solution, min_views)):
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
    tests = sum(max(len(views.board) - 2 * min_views + 1, 0) for views in bundle.views)
    if not tests:
        return None
    trigger = float(chdtri(6, _TRIGGER_PROBABILITY / tests))

    def score(equations: BundleEquations) -> tuple[list[PoseChanges], list[Array], list[Array]]:
        views = [
            replace(at, information=w[:, None, None] * at.information, gradient=w[:, None] * at.gradient)
            for at, w in zip(equations.views, weights, strict=True)
        ]
        released = release_poses(bundle, state, sum_views(bundle, state, views))
        squared, changes = zip(*(score_steps(one, min_views) for one in released), strict=True)
        return released, _require_several_views(released, squared, min_views, trigger), list(changes)

    _, squared, steps = score(solution.equations)
    k, i = best = _select_largest(squared)
    if squared[k][i] <= trigger:
        return None
    split = _split_sensor(bundle, state, k, min_views + i, steps[k][i])
    # The variances without the step contain its effect: with those beside the step, the tests select again.
    rescaled = _copy_variances(bundle, state, split.bundle)
    released, squared, steps = score(linearize_bundle(rescaled, state))
    k, i = _select_largest(squared)
    if (k, i) != best:
        split = _split_sensor(bundle, state, k, min_views + i, steps[k][i])
    if split.bundle.bias_variance[:, 0].max() > _MAX_VIEW_BIAS**2:
        return None
    step, covariance, freedom, factor = _measure_step(split, k)
    largest = [float(of_sensor.max(initial=0.0)) for of_sensor in squared]
    # A few lines on boards determine a pose poorly, and may have a far solution that its covariance does not span.
    distance = min(float(step @ np.linalg.solve(covariance, step)), largest[k]) / factor
    significant = distance > 6 * fdtri(6, freedom, 1 - _FALSE_ALARM_PROBABILITY / tests)
    if not significant or not _depends_on_order(released[k], largest[k], min_views):
        return None
    margin = 2 * np.log(_INDISTINGUISHABLE_RATIO)
    names = dict.fromkeys(bundle.sensors[j] for j in range(len(largest)) if largest[j] >= largest[k] - margin)
    likely = min_views + np.flatnonzero(squared[k] >= largest[k] - 2 * np.log(_MIN_TIME_LIKELIHOOD))
    boards = bundle.views[k].board
    found = PoseStep(tuple(names), boards[: likely[0]], boards[likely[-1] :], step, factor)
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


def _split_sensor(bundle: Bundle, state: BundleState, k: int, first_after: int, step: Array) -> _Split:
    """The bundle with a step: the views after it are of another sensor, whose systematic errors are the same."""
    added, after = len(bundle.sensors), np.arange(len(bundle.views[k].board)) >= first_after
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
    moved = se3.retract(state.T_root_sensor[k], step)
    start = replace(state, T_root_sensor=np.concatenate([state.T_root_sensor, moved[None]]))
    solution = minimize_bundle(complete, start, tolerance=COARSE_TOLERANCE, exact=False)
    settled, solution, _ = settle_variances(complete, solution, _MAX_ROUNDS)
    settled, state = _pool_variances(settled, solution.state, k, added), solution.state
    complete = _copy_variances(complete, state, settled)
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
    return update_noise(replace(bundle, bias_variance=bias_variance), state, scales)


def _copy_variances(bundle: Bundle, state: BundleState, other: Bundle) -> Bundle:
    """The bundle with the variances of another one that has the same sensors, or more."""
    sensors = len(bundle.sensors)
    scales = [views.noise_scale for views in other.views[:sensors]]
    return update_noise(replace(bundle, bias_variance=other.bias_variance[:sensors]), state, scales)


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
    released = release_poses(bundle, solution.state, solution.equations)
    scores = np.concatenate([released[j].eliminate_parameters(0.0)[1] for j in parts])
    information = np.sum([released[j].information.sum(axis=0) for j in parts], axis=0)
    whiten, _ = whitening(information)
    order = np.argsort(np.concatenate([bundle.views[j].board for j in parts]))
    return measure_score_correlation(scores[order] @ whiten.T)


# Random orders of a sensor's captures, none of which may have a larger statistic than that of time: 0.5 % of
# them, for any distribution of outliers.
_PERMUTATIONS = 199


def _depends_on_order(released: PoseChanges, largest: float, min_views: int) -> bool:
    """Whether a statistic is larger than the largest of all times for views in any of many random orders.

    Boards that slip, and other outliers, give large statistics in any order.

    Source: Good, "Permutation, parametric and bootstrap tests of hypotheses", 2005.
    """
    rng, views = np.random.default_rng(0), len(released.gradient)
    orders = (rng.permutation(views) for _ in range(_PERMUTATIONS))
    return all(score_steps(released, min_views, order)[0].max() < largest for order in orders)


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
    released: Sequence[PoseChanges], squared: Sequence[Array], min_views: int, trigger: float
) -> list[Array]:
    """The statistics (S,) of steps, with zero in place of those above the trigger that rest on one view."""
    least = float(chdtri(6, _SINGLE_VIEW_PROBABILITY))
    return [
        np.array([
            value if value <= trigger or score_without_any_one(one, first_after) > least else 0.0
            for first_after, value in enumerate(of_sensor, min_views)
        ])
        for one, of_sensor in zip(released, squared, strict=True)
    ]  # fmt: skip


def _select_largest(squared: Sequence[Array]) -> tuple[int, int]:
    """Index of the view set and of the time of the largest statistic."""
    # One that has no time counts less than one whose statistics are all zero.
    k = int(np.argmax([of_sensor.max(initial=-1.0) for of_sensor in squared]))
    return k, int(np.argmax(squared[k]))
