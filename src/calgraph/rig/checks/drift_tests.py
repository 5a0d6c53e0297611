"""Drifts: poses of sensors that change linearly in the course of the captures.

Drifts that are significant are named. Smaller ones are part of the covariance: the pose at the end of a recording
differs from the estimated one, which is that in its middle, by half the drift.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.special import chdtri, fdtri

from calgraph.config.settings import DiagnosticsSettings, DriftTestSettings
from calgraph.geometry import Array
from calgraph.result.finding import Finding
from calgraph.rig.bundle.bundle_solver import (
    Bundle,
    BundleEquations,
    BundleState,
    MinimizedBundle,
    body_jacobian,
    displacement_jacobian,
    linearize_bundle,
)
from calgraph.rig.bundle.covariances import pose_jacobian, view_covariance_factors
from calgraph.rig.bundle.settling import MAX_SETTLED_CHANGE
from calgraph.rig.bundle.solution import RigSolution, SolvedBundle
from calgraph.rig.bundle.variance_components import update_variance_components
from calgraph.rig.checks.pose_changes import add_changes, change_poses, predict_changes
from calgraph.rig.checks.serial_correlation import measure_serial_correlation

# Prior information (m⁻², rad⁻²) on a drift: makes directions that no view measures invertible.
_DRIFT_PRIOR_INFORMATION = 1e-3
# Sizes of a large drift that are averaged over. With 24 of them, standard deviations differ by at most 3 %.
_SIZES = 8


@dataclass(frozen=True, eq=False)
class DriftStatistics:
    """Score statistics of drifts of all bodies, the root's first: rigid groups, and sensors outside of them."""

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

    def test_bodies(self) -> tuple[Array, Array]:
        """Of the drift of each body as if no other drifts: :func:`predict_changes` (B,), (B, 6).

        A drift is the change of the pose of the body's first sensor in the course of the captures.
        """
        B = len(self.bodies)
        of_bodies = self.information.reshape(B, 6, B, 6)[np.arange(B), :, np.arange(B)]
        squared, change = predict_changes(of_bodies, self.score.reshape(B, 6))
        return squared / self.serial_correlation, change

    def repeat(self, multiple: float) -> "DriftStatistics":
        """Those expected of a multiple of the captures: changes are as significant, and smaller by its root."""
        return replace(self, information=multiple * self.information, score=np.sqrt(multiple) * self.score)

    def beside(self, body: int) -> "DriftStatistics":
        """The statistics beside the drift of a body, which has none any more."""
        rows = slice(6 * body, 6 * body + 6)
        gain = self.information[:, rows] @ np.linalg.inv(self.information[rows, rows])
        information = self.information - gain @ self.information[rows]
        information[rows, rows] += self.information[rows, rows]
        return replace(self, information=information, score=self.score - gain @ self.score[rows])


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
    time = order_boards(solved)
    factor = measure_serial_correlation(bundle, solved.minimized, solved.order)
    statistics = replace(score_drifts(bundle, state, solved.minimized.equations, time), serial_correlation=factor)
    if statistics.test_bodies()[0].max() <= chdtri(6, _TRIGGER_PROBABILITY / len(statistics.bodies)):
        return statistics
    for _ in range(_MAX_ROUNDS):
        try:
            bundle, change = _update_variances_beside_drifts(bundle, state, time)
        except np.linalg.LinAlgError:
            # Few views of a sensor at nearly one time do not determine its drift: variances stay as they are.
            break
        if change < MAX_SETTLED_CHANGE:
            break
    return replace(score_drifts(bundle, state, linearize_bundle(bundle, state), time), serial_correlation=factor)


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
        squared, changes = statistics.test_bodies()
        body = int(np.argmax(squared))
        # Variances of view biases have about as much freedom as there are captures.
        if squared[body] <= 6 * fdtri(6, statistics.captures, 1 - _FALSE_ALARM_PROBABILITY):
            return
        least, change = squared[body] - 2 * np.log(_INDISTINGUISHABLE_RATIO), changes[body]
        likely = [sensors for sensors, one in zip(bodies, squared, strict=True) if one >= least]
        names = " or ".join(" and ".join(sensors) for sensors in likely)
        which = ", these captures do not determine which," if len(likely) > 1 else ""
        mm, degrees = 1000 * np.linalg.norm(change[:3]), np.degrees(np.linalg.norm(change[3:]))
        yield Finding(
            f"the pose of {names}{which} drifts by {mm:.1f} mm and {degrees:.2f}° in the course of the captures, "
            f"{np.sqrt(squared[body] / 6):.1f} times what noise explains: fix it to the robot, and record again",
            tuple(name for sensors in (bodies if bodies[0] in likely else likely) for name in sensors),
        )
        statistics = statistics.beside(body)


def include_drifts(
    solution: RigSolution, solved: SolvedBundle, statistics: DriftStatistics, settings: DiagnosticsSettings
) -> RigSolution:
    """The solution with covariances of the poses at the end of the recording, after drifts of all bodies.

    Errors that successive captures have in common increase variances before.

    Poses change linearly or by a step, each with the probability that the recording leaves it, and these changes
    have the second moments of :func:`compute_drift_moments`. They add to the covariance by the error that a change
    causes: half of it, as the estimated pose is that in the middle of the recording, and less or more where
    captures are not distributed evenly. A change of the root moves all others.
    """
    covariance = include_serial_correlation(solution.joint_covariance, solved.bundle, statistics)
    by_drifts = average_drifts(solved, list(list_changes(solved, statistics)), settings.drifts)
    return replace(solution, joint_covariance=covariance + by_drifts)


def average_drifts(
    solved: SolvedBundle,
    possible: Sequence[tuple[DriftStatistics, float]],
    settings: DriftTestSettings,
    multiple: float = 1.0,
) -> Array:
    """Covariance (S·6, S·6) of the errors of poses at the end of the recording by changes that it leaves possible.

    Args:
        solved: the solution.
        possible: of :func:`list_changes`.
        settings: of drifts.
        multiple: of the captures, as if there were more of them like these.
    """
    bundle, state = solved.bundle, solved.minimized.state
    at_end = np.zeros((len(bundle.sensors), 6, 6 * (bundle.body_count + 1)))
    for s, body in enumerate(bundle.body.tolist()):
        if body:
            at_end[s, :, 6 * body : 6 * body + 6] = body_jacobian(bundle, state, s)
            at_end[s, :, :6] = -displacement_jacobian(state, s, 0)
    jacobian, moments, log_probability = pose_jacobian(bundle, state), [], []
    for changes, log_prior in possible:
        of_changes, log_evidence = compute_drift_moments(changes.repeat(multiple), settings)
        error = jacobian @ changes.influence.T - at_end.reshape(len(jacobian), -1) / 2
        moments.append(error @ of_changes @ error.T)
        log_probability.append(log_prior + log_evidence)
    probability = np.exp(np.array(log_probability) - max(log_probability))
    return np.asarray(np.einsum("f,fij->ij", probability / probability.sum(), moments))


def include_serial_correlation(covariance: Array, bundle: Bundle, statistics: DriftStatistics) -> Array:
    """The covariance (S·6, S·6) of all poses with errors that successive captures have in common."""
    # Priors have no part in it: they alone place a sensor without views.
    measured = np.repeat([len(views.board) > 0 for views in bundle.views], 6)
    scale = np.where(measured, np.sqrt(statistics.serial_correlation), 1.0)
    return np.asarray(scale[:, None] * covariance * scale)


# Times of steps, of the length of the recording from its middle: of a bump that is not significant. Nearer to the
# ends, few captures are on one side, so that right results would be weak: 1 of 16 with a quarter.
_STEP_TIMES = (-1 / 6, 0.0, 1 / 6)


def list_changes(solved: SolvedBundle, drifts: DriftStatistics) -> Iterator[tuple[DriftStatistics, float]]:
    """Drifts, and steps that are as likely together, each with the logarithm of its prior probability."""
    yield drifts, np.log(0.5)
    bundle, minimized, time = solved.bundle, solved.minimized, order_boards(solved)
    for of_step in _STEP_TIMES:
        step = np.where(time < of_step, -0.5, 0.5)
        changes = score_drifts(bundle, minimized.state, minimized.equations, step)
        yield replace(changes, serial_correlation=drifts.serial_correlation), np.log(0.5 / len(_STEP_TIMES))


def order_boards(solved: SolvedBundle) -> Array:
    """(C,) time of each board, counted in captures, from -1/2 to 1/2."""
    return np.asarray(solved.order / max(int(solved.order.max(initial=0)), 1) - 0.5)


# Minimum multiple of these standard deviations that large drifts have, 0.5 mm and 0.05°: beyond what small drifts
# explain. In 204 simulated recordings with drifts of 0.15° to 1°, good poses at the end are off by more than five
# standard deviations in 3, and right ones are weak by their covariance in 2 of 102; with 10 in 3 and 5.
_MIN_LARGE_MULTIPLE = 5.0
# The largest, 10 mm and 1°: larger ones show in any recording.
_MAX_LARGE_MULTIPLE = 100.0


# Displacements and rotations of a large drift: it has both, or one of them.
_LARGE_PARTS = ((True, True), (True, False), (False, True))


def compute_drift_moments(statistics: DriftStatistics, settings: DriftTestSettings) -> tuple[Array, float]:
    """Second moments (B·6, B·6) of the drifts of all bodies, given the recording, and the log-evidence for them.

    All bodies have small drifts: normal, of mean zero, with the standard deviations of the settings. One of them
    may have a large displacement, rotation or both: a multiple of these standard deviations within the limits of
    the settings, with its logarithm uniform. That none has, and that a certain one has, are equally likely. The
    moments are the mean over these models, each weighted by its probability given the recording, so that bodies
    share what they explain equally.

    Source: Hoeting et al., "Bayesian model averaging: a tutorial", Statistical Science 1999.
    """
    bodies = len(statistics.bodies)
    small = np.tile(np.repeat([settings.translation, settings.rotation], 3), bodies)
    multiples = np.geomspace(_MIN_LARGE_MULTIPLE, _MAX_LARGE_MULTIPLE, _SIZES)
    stddev, log_prior = [small], [0.0]
    for body in range(bodies):
        of_body = np.arange(len(small)) // 6 == body
        for parts in _LARGE_PARTS:
            large = of_body & np.tile(np.repeat(parts, 3), bodies)
            stddev += [np.where(large, multiple * small, small) for multiple in multiples]
            log_prior += [-np.log(_SIZES * len(_LARGE_PARTS))] * _SIZES
    scale = np.array(stddev)
    information = statistics.information / statistics.serial_correlation
    # With drifts in units of their standard deviations, priors have unit covariance.
    precision = np.eye(len(small)) + scale[:, :, None] * information * scale[:, None, :]
    covariance = scale[:, :, None] * np.linalg.inv(precision) * scale[:, None, :]
    score = -statistics.score / statistics.serial_correlation
    mean = covariance @ score
    log_probability = np.array(log_prior) + (mean @ score - np.linalg.slogdet(precision)[1]) / 2
    probability = np.exp(log_probability - log_probability.max())
    log_evidence = float(log_probability.max() + np.log(probability.sum()))
    probability /= probability.sum()
    moments = np.einsum("m,mij->ij", probability, covariance) + (probability * mean.T) @ mean
    return np.asarray(moments), log_evidence


def score_drifts(bundle: Bundle, state: BundleState, equations: BundleEquations, time: Array) -> DriftStatistics:
    """The statistics with the variances of the bundle; ``time`` (C,) of each board is from -1/2 to 1/2."""
    bodies = range(bundle.body_count + 1)
    drifts = change_poses(bundle, state, equations, time)
    (information,), (score,) = drifts.eliminate_parameters(_DRIFT_PRIOR_INFORMATION)
    sensors = [tuple(n for n, b in zip(bundle.sensors, bundle.body, strict=True) if b == i) for i in bodies]
    return DriftStatistics(tuple(sensors), information, score, drifts.influence[0], len(np.unique(time)))


def _update_variances_beside_drifts(bundle: Bundle, state: BundleState, time: Array) -> tuple[Bundle, float]:
    """The bundle after one update of the sensors' variances with drifts, to first order, and the largest change.

    The root does not drift here, as all may drift relative to it.
    """
    bodies = range(1, bundle.body_count + 1)
    drifting, equations = add_changes(bundle, state, linearize_bundle(bundle, state), time, bodies)
    (step, boards), _ = equations.solve(0.0)
    views = []
    for k, (of_views, at) in enumerate(zip(bundle.all_views, equations.views, strict=True)):
        moved = at.J_sensor @ step[drifting.columns(k)] + (at.J_board @ boards[of_views.board, :, None])[..., 0]
        views.append(replace(at, gradient=at.gradient + (at.information @ moved[..., None])[..., 0]))
    equations = replace(equations, views=tuple(views))
    factors = view_covariance_factors(drifting, equations)[: len(bundle.sensors)]
    return update_variance_components(bundle, MinimizedBundle(state, equations, 0, converged=True), factors)
