"""Tests of priors and of rigid groups against the captures."""

from collections.abc import Iterator, Sequence
from dataclasses import replace

import numpy as np
from scipy.special import chdtri

from calgraph.geometry import Array, se3
from calgraph.rig.bundle.bundle_solver import Bundle, MinimizedBundle, linearize_bundle
from calgraph.rig.bundle.covariances import pose_covariance
from calgraph.rig.bundle.normal_equations import consistency_statistic
from calgraph.rig.bundle.priors import RigidGroup
from calgraph.rig.bundle.variance_components import MIN_REDUNDANCY

# Singular values below this belong to directions that the prior alone determines (numerical rank).
_RANK_TOLERANCE = 1e-3


def find_contradicted_priors(
    bundle: Bundle, solved: MinimizedBundle, groups: Sequence[RigidGroup], false_alarm_probability: float
) -> dict[str, str]:
    """Sensors whose pose rests on a prior alone, or whose prior or rigid group the captures contradict.

    Args:
        bundle: the problem.
        solved: its solution.
        groups: the rigid groups that it was constrained by.
        false_alarm_probability: of each test, if prior, noise and covariances are right.

    Returns:
        The reason by sensor.
    """
    without_views = {
        name: f"no capture connects {name} to another sensor: its pose is the prior; record captures "
        "in which it and another sensor detect the board"
        for name, views in zip(bundle.sensors[1:], bundle.views[1:], strict=True)
        if not len(views.board)
    }
    of_groups = dict(_contradicted_groups(bundle, solved, groups, false_alarm_probability))
    return without_views | of_groups | dict(_contradicted_poses(bundle, solved, false_alarm_probability))


def _contradicted_poses(
    bundle: Bundle, solved: MinimizedBundle, false_alarm_probability: float
) -> Iterator[tuple[str, str]]:
    """Sensors whose prior the captures contradict, each with the reason.

    The prior is a measurement of the pose: its residual at the solution has the covariance of the prior minus that
    of the solution. Source: Baarda, "A testing procedure for use in geodetic networks", 1968.
    """
    size = len(bundle.sensors)
    covariance = pose_covariance(bundle, solved.state, solved.equations).reshape(size, 6, size, 6)
    for prior in bundle.priors:
        s, A = prior.sensor, prior.information
        error = se3.difference(solved.state.T_root_sensor[s], prior.T_root_sensor)
        squared, dof = consistency_statistic(
            A[None], (A @ covariance[s, :, s] @ A)[None], (A @ error)[None], MIN_REDUNDANCY
        )
        if dof[0] and squared[0] > chdtri(dof[0], false_alarm_probability):
            # The prior pulls the solution towards itself: without it the error would be larger.
            discrepancy = np.linalg.pinv(np.eye(6) - covariance[s, :, s] @ A, rcond=_RANK_TOLERANCE) @ error
            name, difference = bundle.sensors[s], _format_discrepancy(squared[0], discrepancy)
            yield (
                name,
                f"the prior of {name} disagrees with the captures by {difference}; correct the prior, "
                "or state larger standard deviations",
            )


def _contradicted_groups(
    bundle: Bundle, solved: MinimizedBundle, groups: Sequence[RigidGroup], false_alarm_probability: float
) -> Iterator[tuple[str, str]]:
    """Sensors of rigid groups that the captures contradict, with the sensor of the largest score statistic.

    One sensor at a time is released: the gradient of its views at the constrained solution predicts its step.
    Source: Rao, "Large sample tests of statistical hypotheses concerning several parameters", 1948.
    """
    for group in groups:
        members = [s for s, name in enumerate(bundle.sensors) if name in group.T_group_sensor]
        scores = [(*_score_statistic(bundle, solved, s), s) for s in members if s > 0]
        squared, step, s = max(scores, key=lambda score: score[0], default=(0.0, np.zeros(6), 0))
        if squared > chdtri(6, false_alarm_probability):
            name = bundle.sensors[s]
            others = ", ".join(bundle.sensors[member] for member in members if member != s)
            reason = (
                f"the captures contradict the rigid group of {name} and {others} in {group.source}: "
                f"released, {name} moves by {_format_discrepancy(squared, step)}; "
                "correct the group, or leave it out"
            )
            yield from ((bundle.sensors[member], reason) for member in members if member > 0)


def _score_statistic(bundle: Bundle, solved: MinimizedBundle, sensor: int) -> tuple[float, Array]:
    """Squared Mahalanobis distance of the step (6,) of a sensor that is released from its body, and the step."""
    # The released sensor gets a new body; bodies are renumbered in case its old one is empty.
    body = bundle.body.copy()
    body[sensor] = body.max() + 1
    released = replace(bundle, body=np.unique(body, return_inverse=True)[1])
    system = linearize_bundle(released, solved.state)
    _, g, _ = system.eliminate_boards()
    step = -system.covariance @ g
    return float(-g @ step), step[released.pose_columns(sensor)]


def _format_discrepancy(squared: float, error: Array) -> str:
    mm, degrees = 1000 * np.linalg.norm(error[:3]), np.degrees(np.linalg.norm(error[3:]))
    return f"{np.sqrt(squared):.1f} standard deviations ({mm:.0f} mm, {degrees:.2f}°)"
