"""Variance components: noise of measurements, bias of views; and the rejection and return of outlier views."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.special import chdtr, chdtri

from calgraph.geometry import Array, Index, se_n
from calgraph.rig.bundle.bundle_solver import (
    HUBER_THRESHOLD,
    Bundle,
    BundleEquations,
    MarginalizedViews,
    MinimizedBundle,
)
from calgraph.rig.bundle.covariances import ViewFactors
from calgraph.rig.bundle.linearization import OUTLIER_SIGNIFICANCE
from calgraph.rig.bundle.normal_equations import consistency_statistic, huber_variance_factor
from calgraph.rig.bundle.observations import relative_poses

# Relative ridge on the Fisher matrix: two sensors determine the sum of their variances only, and the step along
# the difference is zero.
_FISHER_RIDGE = 0.01
# Limit on the decrease of a variance in one step, four times its standard deviation: without it, steps from the
# initial variances to zero and back take 16 rounds instead of 7 to settle.
_MAX_SHRINKAGE = 16.0
# Smaller relative changes of a noise are not applied: they would only cost a linearization.
_MIN_NOISE_CHANGE = 5e-3


def update_variance_components(
    bundle: Bundle, solution: MinimizedBundle, factors: Sequence[ViewFactors], first: int = 0, step: float = 1.0
) -> tuple[Bundle, float]:
    """The bundle after one step of Fisher scoring for the variances of noise and view bias (REML).

    Within a view, measurements scatter about its best fit. That determines the noise poorly where views have
    few measurements, such as the two end points of a line on the board; but views scatter among each other with
    the noise as well as with the bias, so both are estimated jointly.

    The gradients of views have the covariance ``W = A - A P A`` if noise and bias are right. Views of one board
    are correlated, so sensors are scored jointly; the correlation between boards, through the sensors' poses, is
    neglected.

    Source: Patterson and Thompson, "Recovery of inter-block information when block sizes are unequal", Biometrika
    1971.

    Args:
        bundle: sensors' and outlines' views.
        solution: its solution.
        factors: of :func:`calgraph.rig.bundle.covariances.view_covariance_factors`, from ``first`` on.
        first: index of the first views whose components are estimated; those before it keep theirs.
        step: length of the step, of 1.

    Returns:
        The bundle, and the largest change of a variance in its standard errors.
    """
    statistics = [_view_statistics(bundle, solution.equations, k, F) for k, F in enumerate(factors, start=first)]
    # Noise and bias of each in turn.
    score = np.concatenate([one.score for one in statistics])
    end = np.cumsum([len(one.score) for one in statistics])
    rows = [slice(e - len(one.score), e) for e, one in zip(end, statistics, strict=True)]
    fisher = np.zeros((len(score), len(score)))
    for i, one in enumerate(statistics):
        fisher[rows[i], rows[i]] = one.fisher
        for j, other in enumerate(statistics[:i]):
            _, here, there = np.intersect1d(one.board, other.board, assume_unique=True, return_indices=True)
            W = one.solution_factors[here] @ se_n.transpose(other.solution_factors[there])
            between = _sum_squares(W, one.of_variance[here], other.of_variance[there])
            fisher[rows[i], rows[j]] = between
            fisher[rows[j], rows[i]] = between.T
    before = np.concatenate([
        [1.0, *bundle.bias_variance[k, one.components]] for k, one in enumerate(statistics, start=first)
    ])  # fmt: skip
    least, most = np.zeros(len(score)), np.full(len(score), np.inf)
    least[end - [len(one.score) for one in statistics]] = [one.bounds[0] for one in statistics]
    most[end - [len(one.score) for one in statistics]] = [one.bounds[1] for one in statistics]
    _add_prior_of_biases(bundle, statistics, rows, before, score, fisher)
    least = np.maximum(least, before / _MAX_SHRINKAGE)
    after = np.minimum(_fisher_scoring_step(before, score, fisher, least, _FISHER_RIDGE), most)
    after = before + step * (after - before)
    state, all_views, bias_variance = solution.state, list(bundle.all_views), bundle.bias_variance.copy()
    change = np.zeros_like(after)
    for k, (one, row) in enumerate(zip(statistics, rows, strict=True), start=first):
        views, (noise, *bias) = bundle.all_views[k], after[row]
        bias_variance[k, one.components] = np.maximum(bias, bundle.least_bias_variance(k)[one.components])
        change[row.start + 1 : row.stop] = (bias_variance - bundle.bias_variance)[k, one.components]
        scale = _shrink_noise_scale(views.noise_scale**2 * noise, one.fisher[0, 0])
        change[row.start] = 0.0
        if abs(scale / views.noise_scale - 1) >= _MIN_NOISE_CHANGE:
            change[row.start] = (scale / views.noise_scale) ** 2 - 1
            T_root_sensor = state.T_root_sensor[bundle.sensor_of(k)]
            T_sensor_board = relative_poses(T_root_sensor, state.T_root_board[views.board])
            all_views[k] = views.update_noise(T_sensor_board, scale)
    relative = np.abs(change) * np.sqrt(fisher.diagonal() / 2)
    return replace(bundle.with_views(all_views), bias_variance=bias_variance), float(relative.max(initial=0.0))


@dataclass(frozen=True, eq=False)
class _ViewStatistics:
    """Likelihood of c variances, of noise relative to the present one and of view biases, for one set of views."""

    board: Index
    """(V,)."""
    components: Index
    """(c - 1,) columns of :attr:`Bundle.bias_variance`."""
    of_variance: Array
    """(V, c, m) weights of the squares along m directions for each variance: of those where noise has unit
    covariance, of displacements and rotations, of rings, and of stamps."""
    solution_factors: Array
    """(V, m, r) factors of the reduction of the gradients' covariance by the solution, in these directions."""
    score: Array
    """(c,) twice the derivative of the log-likelihood by the variances."""
    fisher: Array
    """(c, c) twice their Fisher information."""
    bounds: tuple[float, float]
    """Of the noise variance in one step."""


# Factor that bounds the change of a noise variance by the scatter among views in one round: before outliers are
# rejected, it is too large.
_MAX_VARIANCE_FACTOR = 4.0


def _view_statistics(bundle: Bundle, equations: BundleEquations, k: int, factors: ViewFactors) -> _ViewStatistics:
    """Those of views k, with their ``factors`` of :func:`view_covariance_factors`."""
    unmarginalized, at, views = equations.cache[k].equations, equations.views[k], bundle.all_views[k]
    p, R = unmarginalized.pose_count, views.parameters.ring_count
    squares, freedom = unmarginalized.within_view_scatter()
    components = np.array(bundle.bias_components(k), dtype=np.intp)
    by_pose, q = se_n.transpose(at.local_jacobian[..., :6]), at.information.shape[-1]
    whiten, rings = unmarginalized.whiten_views()[0], np.arange(q - R, q)
    by_ring = np.broadcast_to(np.eye(q)[rings], (len(views.board), R, q))
    # A board at rest is not displaced by an error of the stamp.
    velocity = unmarginalized.velocity
    by_stamp = np.zeros((len(views.board), 0, q)) if velocity is None else velocity[:, None] @ by_pose
    directions = np.concatenate([whiten[:, :p], by_pose, by_ring, by_stamp], axis=1)
    of_variance = np.zeros((len(views.board), 1 + len(components), directions.shape[1]))
    of_variance[:, 0, :p] = 1
    # Noise has unit covariance along the rings, too, where these are scaled.
    of_variance[:, 0, p + 6 : p + 6 + R] = whiten[:, p + np.arange(R), rings] ** 2
    end = p + 6 + R
    parts = slice(p, p + 3), slice(p + 3, p + 6), slice(p + 6, end), slice(end, None)
    for i, component in enumerate(components, 1):
        of_variance[:, i, parts[component]] = 1
    weighted = directions @ at.information
    solution_factors = factors.multiply(weighted)
    W = weighted @ se_n.transpose(directions)
    W = W - solution_factors @ se_n.transpose(solution_factors)
    squared, checked = _test_poses(at, factors, p, MIN_REDUNDANCY)
    weight = _downweight_views(squared, checked)
    among = weight[:, None] * (directions @ at.gradient[..., None])[..., 0] ** 2
    expected = np.diagonal(W, axis1=-2, axis2=-1)
    score = np.einsum("vci,vi->c", of_variance, among - expected)
    fisher = _sum_squares(W, of_variance, of_variance)
    # The linear fit of a view that is far off does not fit it.
    limit = chdtri(np.maximum(checked, 1), OUTLIER_SIGNIFICANCE)
    near = np.minimum(1, limit / np.maximum(squared, limit)) ** 2
    within = (near @ squares) / huber_variance_factor(views.dimension, HUBER_THRESHOLD)
    freedom = near @ freedom
    score[0] += within - freedom
    fisher[0, 0] += freedom
    expected_among = np.sum(of_variance[:, 0] * expected)
    max_factor = _MAX_VARIANCE_FACTOR
    low, high = (
        (within + factor * expected_among) / max(freedom + expected_among, 1.0)
        for factor in (1 / max_factor, max_factor)
    )
    return _ViewStatistics(
        views.board, components, of_variance, solution_factors, score, fisher, (float(low), float(high))
    )


# Directions that the other views check with less than this redundancy number (Baarda) do not enter the test for
# outliers, nor that of priors: an error there has little effect, and the statistic would amplify rounding.
MIN_REDUNDANCY = 1e-3
# Share of correct views whose statistics are truncated when variances are estimated: variances stay bounded with
# up to half of outlier views.
_TRUNCATED_SHARE = 0.1


def _downweight_views(squared: Array, freedom: Index) -> Array:
    """(V,) weights of the squared gradients of views: those of outliers are truncated at a quantile.

    The mean of a truncated χ² is smaller by a factor that the weights make up for. Source: Huber, "Robust
    statistics", 1981, section 5.3 (proposal 2).
    """
    d = np.maximum(freedom, 1)
    limit = chdtri(d, _TRUNCATED_SHARE)
    mean_share = chdtr(d + 2, limit) + limit / d * _TRUNCATED_SHARE
    return np.asarray(np.minimum(1, limit / np.maximum(squared, 1e-12)) / mean_share)


def _sum_squares(W: Array, rows: Array, columns: Array) -> Array:
    """(c, d) weighted sums of the squares of matrices (V, m, n), with weights (V, c, m) and (V, d, n)."""
    return np.asarray(np.sum(rows @ W**2 @ se_n.transpose(columns), axis=0))


# Weight of the usual view bias, in degrees of freedom: as much as one or two views.
_USUAL_BIAS_WEIGHT = 2.0
# Usual standard deviation of a view's displacement, of its edges' by a tilt, and of a ring's ranges, m: boards
# are flat, and ranges of one material right, to 1 to 2 mm. Estimates from few views are drawn towards it.
_USUAL_VIEW_BIAS = 0.0015
# Usual standard deviation of the stamps of a moving board's views, s: half of an exposure. Estimates from few
# views are drawn towards it.
_USUAL_STAMP_ERROR = 0.002


def usual_bias_variances(bundle: Bundle) -> Array:
    """(4,) usual variances of view biases, in the columns of :attr:`Bundle.bias_variance`."""
    displacement = _USUAL_VIEW_BIAS
    return np.square([displacement, displacement / bundle.lever, displacement, _USUAL_STAMP_ERROR])


def _add_prior_of_biases(
    bundle: Bundle,
    statistics: Sequence[_ViewStatistics],
    rows: Sequence[slice],
    variances: Array,
    score: Array,
    fisher: Array,
) -> None:
    """Adds observations of the usual size of view biases to score (n,) and Fisher matrix (n, n), in place.

    Without them, the estimate from few views is zero as often as not, and the poses' covariance too small. Source:
    Chung et al., "A nondegenerate penalized likelihood estimator for variance parameters", Psychometrika 2013.
    """
    weight, usual = _USUAL_BIAS_WEIGHT, usual_bias_variances(bundle)
    for one, row in zip(statistics, rows, strict=True):
        bias = np.arange(row.start + 1, row.stop)
        at = np.maximum(variances[bias], usual[one.components])
        score[bias] += weight * (usual[one.components] - variances[bias]) / at**2
        fisher[bias, bias] += weight / at**2


# Minimum noise over the stated one: a noise of zero, as of detections without noise, would be singular.
_MIN_NOISE_RATIO = 0.01
# Weight of the stated noise, in degrees of freedom: rig.yaml is right to a factor of about 1.5.
STATED_NOISE_WEIGHT = 3.0


def _shrink_noise_scale(variance: float, freedom: float) -> float:
    """Noise over that stated, shrunk towards 1, from its estimated variance with ``freedom`` degrees of freedom.

    The stated noise is uncertain by a factor, so logarithms are averaged: in a mean of variances, noise stated ten
    times too large would weigh as a hundred measurements.
    """
    least = _MIN_NOISE_RATIO**2
    return float(np.sqrt(max(variance, least)) ** (freedom / (freedom + STATED_NOISE_WEIGHT)))


def _fisher_scoring_step(variances: Array, score: Array, fisher: Array, least: Array, ridge: float) -> Array:
    """Variances after one step of Fisher scoring, none of them below the least."""
    from scipy.optimize import nnls  # takes as long to import as all of NumPy

    # Two sensors alone determine the sum of their variances only: the ridge keeps the difference.
    regularized = fisher + np.diag(ridge * np.diag(fisher) + np.finfo(float).tiny)
    root = np.linalg.cholesky(regularized).T
    above, _ = nnls(root, root @ (variances - least) + np.linalg.solve(root.T, score))
    return np.asarray(least + above)


@dataclass(frozen=True, eq=False)
class ViewConsistency:
    """How well each view of a set agrees with the others."""

    squared: Array
    """(V,) squared Mahalanobis distance of its gradient."""
    freedom: NDArray[np.intp]
    """(V,) its degrees of freedom."""

    def merge(self, others: "ViewConsistency", part: NDArray[np.bool_]) -> "ViewConsistency":
        """That of V views, of which these are those of a mask (V,), and the others the rest."""
        squared, freedom = np.zeros(len(part)), np.zeros(len(part), dtype=np.intp)
        squared[part], squared[~part] = self.squared, others.squared
        freedom[part], freedom[~part] = self.freedom, others.freedom
        return ViewConsistency(squared, freedom)

    def excess(self, significance: float) -> Array:
        """(V,) the statistic over its limit at a significance level."""
        return np.asarray(self.squared / chdtri(np.maximum(self.freedom, 1), significance))


def measure_consistency(
    equations: BundleEquations, factors: Sequence[ViewFactors], first: int = 0, *, predicted: bool = False
) -> list[ViewConsistency]:
    """The consistency of each view with those that a solution is made of, by view set from ``first`` on.

    Args:
        equations: of the views, at the solution.
        factors: of :func:`calgraph.rig.bundle.covariances.view_covariance_factors` of the solution, from ``first``
            on.
        first: index of the first view set.
        predicted: whether the views are not part of the solution.
    """
    return [
        ViewConsistency(*_test_poses(at, F, cached.equations.pose_count, MIN_REDUNDANCY, predicted=predicted))
        for cached, at, F in zip(equations.cache[first:], equations.views[first:], factors, strict=True)
    ]


def _test_poses(
    at: MarginalizedViews, factors: ViewFactors, pose_count: int, min_redundancy: float, *, predicted: bool = False
) -> tuple[Array, NDArray[np.intp]]:
    """:func:`consistency_statistic` of the pose's local parameters; infinite where residuals are not finite."""
    # By the others' solution, the board of an outlier view may be behind the camera.
    finite = np.isfinite(at.gradient).all(axis=-1) & factors.finite
    information, by_solution, gradient = (
        values if finite.all() else np.where(finite.reshape(-1, *[1] * (values.ndim - 1)), values, 0.0)
        for values in (at.information, factors.multiply(at.information[:, :pose_count]), at.gradient)
    )
    squared, freedom = consistency_statistic(
        information[:, :pose_count, :pose_count],
        by_solution @ se_n.transpose(by_solution),
        gradient[:, :pose_count],
        min_redundancy,
        predicted=predicted,
    )
    return np.where(finite, squared, np.inf), freedom


# A sensor that would lose a larger share of its views keeps them: where most views are outliers, the model of the
# sensor is wrong instead.
_MAX_OUTLIER_SHARE = 0.5


def select_consistent_views(
    bundle: Bundle, consistency: Sequence[ViewConsistency], kept: Sequence[NDArray[np.bool_]], first: int = 0
) -> list[NDArray[np.bool_]]:
    """By view set, a mask (V,) of the views to keep: outliers are rejected, and views that agree now return.

    Of each board only the worst view is rejected. No view returns before the outliers are gone that bias the
    solution, nor one of a board that no view locates, with which any would agree. Views before ``first`` stay as
    they are; ``consistency`` is of the others.
    """
    judged = bundle.all_views[first:]
    worst: Array = np.zeros(1 + max(int(views.board.max(initial=-1)) for views in bundle.all_views))
    located = np.zeros(len(worst), dtype=np.bool_)
    for views, part in zip(bundle.all_views, kept, strict=True):
        located[views.board[part]] = True
    excess = [one.excess(OUTLIER_SIGNIFICANCE) for one in consistency]
    for views, over, part in zip(judged, excess, kept[first:], strict=True):
        worst[views.board] = np.maximum(worst[views.board], np.where(part, over, 0.0))
    selected = [*kept[:first]]
    for views, over, part in zip(judged, excess, kept[first:], strict=True):
        left = part & ~((over > 1.0) & (over >= worst[views.board]))
        if left.sum() < (1 - _MAX_OUTLIER_SHARE) * len(part):
            # Its model is wrong instead.
            left = part
        return_now = worst.max(initial=0.0) <= 1.0
        selected.append(left | (~part & (over <= 1.0) & located[views.board]) if return_now else left)
    return selected
