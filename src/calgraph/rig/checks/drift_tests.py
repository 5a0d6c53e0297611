"""Drifts: poses of sensors that change linearly in the course of the captures.

Drifts that are significant are named. Smaller ones are part of the covariance: the pose at the end of a recording
differs from the estimated one, which is that in its middle, by half the drift.
"""

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
from scipy.special import chdtri, fdtri

from calgraph.config.settings import DiagnosticsSettings, DriftTestSettings
from calgraph.geometry import Array, Index, se3, se_n, so3
from calgraph.result.finding import Finding
from calgraph.rig.bundle.bundle_parameters import SystematicParameter
from calgraph.rig.bundle.bundle_solver import (
    Bundle,
    BundleEquations,
    BundleState,
    MinimizedBundle,
    body_jacobian,
    linearize_bundle,
    pose_jacobian,
)
from calgraph.rig.bundle.covariances import gradient_by_board, view_covariance_factors
from calgraph.rig.bundle.settling import MAX_SETTLED_CHANGE
from calgraph.rig.bundle.solution import RigSolution, SolvedBundle
from calgraph.rig.bundle.variance_components import update_variance_components

# Prior information (m⁻², rad⁻²) on a drift: makes directions that no view measures invertible.
_DRIFT_PRIOR_INFORMATION = 1e-3
# Sizes of a large drift that are averaged over. With 24 of them, standard deviations differ by at most 3 %.
_SIZES = 8


@dataclass(frozen=True, eq=False)
class Drift:
    """The drift of a body as if no other drifts."""

    change: Array
    """(6,) of the pose of its first sensor in the course of the captures, in the root's fixed axes."""
    covariance: Array
    """(6, 6)."""
    squared: float
    """Squared Mahalanobis distance from no drift: χ² with six degrees of freedom without one."""


@dataclass(frozen=True, eq=False)
class DriftStatistics:
    """Score statistics of the drifts of all bodies, the root's first: rigid groups, and sensors outside of them.

    Source: Rao, "Large sample tests of statistical hypotheses concerning several parameters", 1948.
    """

    bodies: tuple[tuple[str, ...], ...]
    """(B,) the sensors of each."""
    information: Array
    """(B·6, B·6) on their drifts; singular, as a common drift of all is one of the boards."""
    score: Array
    """(B·6,) gradient of the cost without drifts."""
    influence: Array
    """(B·6, G) derivatives of the parameters of a bundle, estimated without drifts, by drifts."""
    captures: int
    """Number of captures."""
    serial_correlation: float = 1.0
    """Factor of all variances, for errors that successive captures have in common."""

    def drift(self, body: int) -> Drift:
        """The drift of a body."""
        rows = slice(6 * body, 6 * body + 6)
        covariance = np.asarray(np.linalg.inv(self.information[rows, rows]), dtype=np.float64)
        change, factor = -covariance @ self.score[rows], self.serial_correlation
        return Drift(change, factor * covariance, -float(self.score[rows] @ change) / factor)

    def beside(self, body: int) -> "DriftStatistics":
        """The statistics beside the drift of a body, which has none any more."""
        rows = slice(6 * body, 6 * body + 6)
        gain = self.information[:, rows] @ np.linalg.inv(self.information[rows, rows])
        information = self.information - gain @ self.information[rows]
        information[rows, rows] += self.information[rows, rows]
        return replace(self, information=information, score=self.score - gain @ self.score[rows])

    def limit(self, false_alarm_probability: float) -> float:
        """Of a body's squared distance: variances of view biases have about as much freedom as captures."""
        return 6 * float(fdtri(6, self.captures, 1 - false_alarm_probability))


# Probability with which a recording without drifts is tested with variances that are estimated together with
# drifts, which takes as long as a third of its solution.
_TRIGGER_PROBABILITY = 0.1
# Rounds of estimating these variances; they start at those of the solution.
_MAX_ROUNDS = 4


def measure_drifts(solved: SolvedBundle) -> DriftStatistics:
    """The statistics of a solution.

    Its variances contain the effect of drifts: where one may be significant, they are estimated again with them.
    """
    bundle, state = solved.bundle, solved.minimized.state
    order = np.unique(solved.captures, return_inverse=True)[1]
    time = order / max(int(order.max(initial=0)), 1) - 0.5
    factor = measure_serial_correlation(bundle, solved.minimized, order)
    statistics = replace(_score_drifts(bundle, solved.minimized, time), serial_correlation=factor)
    bodies = range(len(statistics.bodies))
    trigger = chdtri(6, _TRIGGER_PROBABILITY / len(bodies))
    if max(statistics.drift(body).squared for body in bodies) <= trigger:
        return statistics
    for _ in range(_MAX_ROUNDS):
        try:
            bundle, change = _update_variances_beside_drifts(bundle, state, time)
        except np.linalg.LinAlgError:
            # Few views of a sensor at nearly one time do not determine its drift: variances stay as they are.
            break
        if change < MAX_SETTLED_CHANGE:
            break
    return replace(_score_drifts(bundle, _linearize(bundle, state), time), serial_correlation=factor)


# Probability with which a drift is reported of a sensor at rest; a false alarm makes a good result weak, so that
# 1 in 1000 sensors is rare enough.
_FALSE_ALARM_PROBABILITY = 1e-3
# Sensors whose drifts have a likelihood smaller than the largest by less than this factor are all named, as with
# bumps.
_INDISTINGUISHABLE_RATIO = 1e4


def find_drifts(statistics: DriftStatistics) -> Iterator[Finding]:
    """Significant drifts, the most significant one first; each is searched beside those before it."""
    bodies = statistics.bodies
    for _ in bodies[1:]:
        drifts = [statistics.drift(body) for body in range(len(bodies))]
        largest = max(drifts, key=lambda drift: drift.squared)
        if largest.squared <= statistics.limit(_FALSE_ALARM_PROBABILITY):
            return
        least = largest.squared - 2 * np.log(_INDISTINGUISHABLE_RATIO)
        likely = [sensors for sensors, drift in zip(bodies, drifts, strict=True) if drift.squared >= least]
        names = " or ".join(" and ".join(sensors) for sensors in likely)
        which = ", these captures do not determine which," if len(likely) > 1 else ""
        mm, degrees = 1000 * np.linalg.norm(largest.change[:3]), np.degrees(np.linalg.norm(largest.change[3:]))
        yield Finding(
            f"the pose of {names}{which} drifts by {mm:.1f} mm and {degrees:.2f}° in the course of the captures, "
            f"{np.sqrt(largest.squared / 6):.1f} times what noise explains: fix it to the robot, and record again",
            tuple(name for sensors in (bodies if bodies[0] in likely else likely) for name in sensors),
        )
        statistics = statistics.beside(drifts.index(largest))


def include_drifts(
    solution: RigSolution, solved: SolvedBundle, statistics: DriftStatistics, settings: DiagnosticsSettings
) -> RigSolution:
    """The solution with covariances of the poses at the end of the recording, after drifts of all bodies.

    Errors that successive captures have in common increase variances before.

    Given the recording, drifts have the second moments of :func:`compute_drift_moments`. These add to the
    covariance by the error that a drift causes: half of it, as the estimated pose is that in the middle of the
    recording, and less or more where captures are not distributed evenly. A drift of the root moves all others.
    """
    bundle, state = solved.bundle, solved.minimized.state
    of_estimate = pose_jacobian(bundle, state) @ statistics.influence.T
    at_end = np.zeros((len(bundle.sensors), 6, 6 * len(statistics.bodies)))
    for s, body in enumerate(bundle.body.tolist()):
        if body:
            at_end[s, :, 6 * body : 6 * body + 6] = body_jacobian(bundle, state, s)
            at_end[s, :, :6] = -_displacement_with_root(state, s)
    error = of_estimate - at_end.reshape(of_estimate.shape) / 2
    # Priors have no part in it: they alone place a sensor without views.
    measured = np.repeat([len(views.board) > 0 for views in bundle.views], 6)
    scale = np.where(measured, np.sqrt(statistics.serial_correlation), 1.0)
    covariance = scale[:, None] * solution.joint_covariance * scale
    covariance += error @ compute_drift_moments(statistics, settings.drifts) @ error.T
    return replace(solution, joint_covariance=covariance)


# Minimum multiple of these standard deviations that large drifts have, 0.5 mm and 0.05°: beyond what small drifts
# explain. In 204 simulated recordings with drifts of 0.15° to 1°, good poses at the end are off by more than five
# standard deviations in 3, and right ones are weak by their covariance in 2 of 102; with 10 in 3 and 5.
_MIN_LARGE_MULTIPLE = 5.0
# The largest, 10 mm and 1°: larger ones show in any recording.
_MAX_LARGE_MULTIPLE = 100.0


def compute_drift_moments(statistics: DriftStatistics, settings: DriftTestSettings) -> Array:
    """Second moments (B·6, B·6) of the drifts of all bodies, given the recording.

    All bodies have small drifts: normal, of mean zero, with the standard deviations of the settings. One of them
    may have a large one: a multiple of these standard deviations within the limits of the settings, with its
    logarithm uniform. That none has, and that a certain one has, are equally likely. The moments are the mean over
    these models, each weighted by its probability given the recording, so that bodies share what they explain
    equally.

    Source: Hoeting et al., "Bayesian model averaging: a tutorial", Statistical Science 1999.
    """
    bodies = len(statistics.bodies)
    small = np.tile(np.repeat([settings.translation, settings.rotation], 3), bodies)
    multiples = np.geomspace(_MIN_LARGE_MULTIPLE, _MAX_LARGE_MULTIPLE, _SIZES)
    stddev, log_prior = [small], [0.0]
    for body in range(bodies):
        of_body = np.arange(len(small)) // 6 == body
        stddev += [np.where(of_body, multiple * small, small) for multiple in multiples]
        log_prior += [-np.log(_SIZES)] * _SIZES
    scale = np.array(stddev)
    information = statistics.information / statistics.serial_correlation
    # With drifts in units of their standard deviations, priors have unit covariance.
    precision = np.eye(len(small)) + scale[:, :, None] * information * scale[:, None, :]
    covariance = scale[:, :, None] * np.linalg.inv(precision) * scale[:, None, :]
    score = -statistics.score / statistics.serial_correlation
    mean = covariance @ score
    log_probability = np.array(log_prior) + (mean @ score - np.linalg.slogdet(precision)[1]) / 2
    probability = np.exp(log_probability - log_probability.max())
    probability /= probability.sum()
    return np.asarray(np.einsum("m,mij->ij", probability, covariance) + (probability * mean.T) @ mean)


def _displacement_with_root(state: BundleState, sensor: int) -> Array:
    """(6, 6) that of a point of the root's body at the sensor, by that of the root."""
    J = np.eye(6)
    J[:3, 3:] = -so3.hat(state.T_root_sensor[sensor, :3, 3])
    return J


def _linearize(bundle: Bundle, state: BundleState) -> MinimizedBundle:
    return MinimizedBundle(state, linearize_bundle(bundle, state), 0, converged=True)


def _score_drifts(bundle: Bundle, solution: MinimizedBundle, time: Array) -> DriftStatistics:
    """The statistics with the variances of the bundle; ``time`` (C,) of each board is from -1/2 to 1/2."""
    bodies = bundle.body_count + 1
    _, equations = _add_drifts(bundle, solution, time, range(bodies))
    H, g, _ = equations.eliminate_boards()
    G = bundle.parameter_count
    gain = H[G:, :G] @ np.linalg.inv(H[:G, :G])
    information = H[G:, G:] - gain @ H[:G, G:] + _DRIFT_PRIOR_INFORMATION * np.eye(6 * bodies)
    sensors = [tuple(n for n, b in zip(bundle.sensors, bundle.body, strict=True) if b == i) for i in range(bodies)]
    return DriftStatistics(
        tuple(sensors), (information + information.T) / 2, g[G:] - gain @ g[:G], gain, len(np.unique(time))
    )


def _update_variances_beside_drifts(bundle: Bundle, state: BundleState, time: Array) -> tuple[Bundle, float]:
    """The bundle after one update of the sensors' variances with drifts, to first order, and the largest change.

    The root does not drift here, as all may drift relative to it.
    """
    solution = _linearize(bundle, state)
    drifting, equations = _add_drifts(bundle, solution, time, range(1, bundle.body_count + 1))
    (step, boards), _ = equations.solve(0.0)
    views = []
    for k, (of_views, at) in enumerate(zip(bundle.all_views, equations.views, strict=True)):
        moved = at.J_sensor @ step[drifting.columns(k)] + (at.J_board @ boards[of_views.board, :, None])[..., 0]
        views.append(replace(at, gradient=at.gradient + (at.information @ moved[..., None])[..., 0]))
    equations = replace(equations, views=tuple(views))
    factors = view_covariance_factors(drifting, equations)[: len(bundle.sensors)]
    return update_variance_components(bundle, replace(solution, equations=equations), factors)


def _add_drifts(
    bundle: Bundle, solution: MinimizedBundle, time: Array, bodies: range
) -> tuple[Bundle, BundleEquations]:
    """The bundle and its equations with the drifts of some bodies as parameters, which come last."""
    state, equations, G = solution.state, solution.equations, bundle.parameter_count
    count, size = len(state.T_root_board), G + 6 * len(bodies)
    H, g, H_board_sensor = np.zeros((size, size)), np.zeros(size), np.zeros((count, 6, size))
    H[:G, :G], g[:G], H_board_sensor[..., :G] = equations.H, equations.g, equations.H_board_sensor
    all_views = list(equations.views)
    for k, (of_views, at) in enumerate(zip(bundle.all_views, equations.views, strict=True)):
        s = bundle.sensor_of(k)
        if (body := int(bundle.body[s])) not in bodies:
            continue
        T_root_sensor = np.broadcast_to(state.T_root_sensor[s], (len(of_views.board), 4, 4))
        by_pose, _ = se3.relative_pose_jacobians(T_root_sensor, state.T_root_board[of_views.board])
        J = at.local_jacobian[..., :6] @ by_pose @ body_jacobian(bundle, state, s)
        J = time[of_views.board, None, None] * J
        JtA = se_n.transpose(J) @ at.information
        rows, columns = G + 6 * bodies.index(body) + np.arange(6), bundle.columns(k)
        H[np.ix_(rows, rows)] += (JtA @ J).sum(axis=0)
        by_parameters = (JtA @ at.J_sensor).sum(axis=0)
        H[np.ix_(rows, columns)] += by_parameters
        H[np.ix_(columns, rows)] += by_parameters.T
        g[rows] += (se_n.transpose(J) @ at.gradient[..., None]).sum(axis=0)[:, 0]
        H_board_sensor[np.ix_(of_views.board, np.arange(6), rows)] += se_n.transpose(JtA @ at.J_board)
        all_views[k] = replace(at, local_jacobian=np.concatenate([at.local_jacobian, J], axis=-1))
    parameters = tuple(
        SystematicParameter(bundle.sensors[0], "drift", "", np.inf, _views_of_body(bundle, body))
        for body in bodies
        for _ in range(6)
    )
    return replace(bundle, extra_parameters=(*bundle.extra_parameters, *parameters)), replace(
        equations, views=tuple(all_views), H=H, g=g, H_board_sensor=H_board_sensor
    )


def _views_of_body(bundle: Bundle, body: int) -> tuple[int, ...]:
    """Indices of the view sets of a body's sensors."""
    return tuple(k for k in range(len(bundle.all_views)) if bundle.body[bundle.sensor_of(k)] == body)


# Captures until correlations are taken to end, by Bartlett's weights: twice the cube root of the usual 30 to 60
# captures is 6 to 8, and more would leave few independent sums.
LAGS = 6
# Random orders of the captures, all of which have less correlation than that of time if it is significant: a
# false-alarm probability of 1 %, which costs 20 to 50 % of variance.
_PERMUTATIONS = 99


def measure_serial_correlation(bundle: Bundle, solution: MinimizedBundle, order: Index) -> float:
    """The factor by which serial correlation increases the variances of poses; 1 where it is not significant.

    What each board adds to the poses has a long-run variance, with lags weighted as by Bartlett, after removal of
    a linear trend. It is the mean over all directions in the space of poses, whitened by the covariance of the
    solution, so that it does not depend on the root and on units. Its ratio to that of random orders of the boards
    is the factor if it is larger than in all of them.

    Source: Newey and West, "A simple, positive semi-definite, heteroskedasticity and autocorrelation consistent
    covariance matrix", Econometrica 1987.

    Args:
        bundle: the observations.
        solution: its solution.
        order: (C,) of the boards in time.
    """
    if len(order) < 2 * LAGS or not bundle.body_count:
        return 1.0
    poses = 6 * bundle.body_count
    H, _, _ = solution.equations.eliminate_boards()
    covariance = np.linalg.inv(H)[:, :poses]
    steps = gradient_by_board(bundle, solution.equations) @ covariance
    steps = np.linalg.solve(np.linalg.cholesky(covariance[:poses]), steps.T).T
    steps = steps[np.argsort(order, kind="stable")]
    rng = np.random.default_rng(0)
    random_orders = [_long_run_variance(rng.permutation(steps), LAGS) for _ in range(_PERMUTATIONS)]
    variance = _long_run_variance(steps, LAGS)
    return variance / float(np.median(random_orders)) if variance > max(random_orders) else 1.0


def measure_score_correlation(scores: Array) -> float:
    """The factor by which serial correlation of views increases the variance of sums of their scores, at least 1.

    The long-run covariance of the scores, with lags weighted as by Bartlett, has one largest eigenvalue for the
    views in order of time, and others for random orders, whose median is what independent views have.

    Args:
        scores: (V, m) of views in order of time.
    """
    rng = np.random.default_rng(0)
    random_orders = [_largest_long_run_variance(rng.permutation(scores), LAGS) for _ in range(_PERMUTATIONS)]
    return max(1.0, _largest_long_run_variance(scores, LAGS) / float(np.median(random_orders)))


def _largest_long_run_variance(series: Array, lags: int) -> float:
    """The largest eigenvalue of the long-run covariance of a series (V, m)."""
    covariance = series.T @ series
    for k in range(1, min(lags, len(series))):
        product = series[k:].T @ series[:-k]
        covariance += (1 - k / lags) * (product + product.T)
    return float(np.linalg.eigvalsh(covariance)[-1])


def _long_run_variance(steps: Array, lags: int) -> float:
    """Of a series (C, n) without its linear trend, over its variance; both are sums over columns."""
    trend = np.stack([np.ones(len(steps)), np.linspace(-1, 1, len(steps))], axis=1)
    left = steps - trend @ np.linalg.lstsq(trend, steps, rcond=None)[0]
    products = [np.sum(left[k:] * left[: len(left) - k]) for k in range(lags)]
    return float(1 + sum(2 * (1 - k / lags) * products[k] for k in range(1, lags)) / products[0])
