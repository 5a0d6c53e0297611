"""Whether what was known beforehand agrees with what the captures say."""

from collections.abc import Iterator, Sequence
from dataclasses import replace

import numpy as np
from scipy.special import chdtri

from calgraph.estimation.rig.bundle_solver import Bundle, MinimizedBundle, linearize_bundle
from calgraph.estimation.rig.covariances import parameter_covariance, pose_covariance
from calgraph.estimation.rig.normal_equations import consistency_statistic
from calgraph.estimation.rig.priors import RigidGroup
from calgraph.geometry import Array, se3

# What is known is doubted if chance alone would have it as far from the captures once in so many.
_CHANCE = 1e-4
# Directions in which the captures have less than this share in a pose are the prior's.
_COMPROMISE = 1e-3


def find_contradicted_priors(
    bundle: Bundle, solved: MinimizedBundle, groups: Sequence[RigidGroup]
) -> dict[str, str]:
    """Sensors whose pose rests on what is known alone, or contradicts it, each with the reason."""
    alone = "no capture ties {} to another sensor: it is where it was said to be"
    unseen = {
        name: alone.format(name)
        for name, views in zip(bundle.sensors[1:], bundle.views[1:], strict=True)
        if not len(views.board)
    }
    return unseen | dict(_contradicted_groups(bundle, solved, groups)) | dict(_contradicted_poses(bundle, solved))


def _contradicted_poses(bundle: Bundle, solved: MinimizedBundle) -> Iterator[tuple[str, str]]:
    """Sensors whose prior contradicts the captures, each with the reason.

    The prior is a view of the pose like any other: its error at the solution has the covariance of the prior less
    that of the solution. Source: Baarda, "A testing procedure for use in geodetic networks", 1968.
    """
    size = len(bundle.sensors)
    spread = pose_covariance(bundle, solved.state, solved.equations).reshape(size, 6, size, 6)
    for prior in bundle.priors:
        s, A = prior.sensor, prior.information
        error = se3.difference(solved.state.T_root_sensor[s], prior.T_root_sensor)
        squared, freedom = consistency_statistic(A[None], spread[s, :, s][None], (A @ error)[None])
        if freedom[0] and squared[0] > chdtri(freedom[0], _CHANCE):
            # The solution is a compromise: without the prior it would be farther away.
            apart = np.linalg.pinv(np.eye(6) - spread[s, :, s] @ A, rcond=_COMPROMISE) @ error
            name = bundle.sensors[s]
            yield (
                name,
                f"the prior of {name} disagrees with the captures by {_format_discrepancy(squared[0], apart)}",
            )


def _contradicted_groups(
    bundle: Bundle, solved: MinimizedBundle, groups: Sequence[RigidGroup]
) -> Iterator[tuple[str, str]]:
    """Sensors of rigid groups that contradict the captures, each with the one that these would move most surely.

    One sensor at a time is freed: the force with which its views pull at it tells how far it would go.
    Source: Rao, "Large sample tests of statistical hypotheses concerning several parameters", 1948.
    """
    for group in groups:
        members = [s for s, name in enumerate(bundle.sensors) if name in group.T_group_sensor]
        pulls = [(*_score_statistic(bundle, solved, s), s) for s in members if s > 0 and len(members) > 1]
        squared, moves, s = max(pulls, key=lambda pull: pull[0], default=(0.0, np.zeros(6), 0))
        if squared > chdtri(6, _CHANCE):
            name = bundle.sensors[s]
            others = ", ".join(bundle.sensors[member] for member in members if member != s)
            reason = (
                f"the captures contradict that {name} is fixed to {others} as {group.source} says: "
                f"they would move it by {_format_discrepancy(squared, moves)}"
            )
            yield from ((bundle.sensors[member], reason) for member in members if member > 0)


def _score_statistic(bundle: Bundle, solved: MinimizedBundle, sensor: int) -> tuple[float, Array]:
    """Squared Mahalanobis distance of the step (6,) that a sensor would take if it were on no body but its own."""
    # Bodies are counted on from those there are; one that was its alone has moved as far as it would.
    body = bundle.body.copy()
    body[sensor] = body.max() + 1
    free = replace(bundle, body=np.unique(body, return_inverse=True)[1])
    system = linearize_bundle(free, solved.state)
    _, g, _ = system.eliminate_boards()
    step = -parameter_covariance(system) @ g
    return float(-g @ step), step[free.pose_columns(sensor)]


def _format_discrepancy(squared: float, error: Array) -> str:
    mm, degrees = 1000 * np.linalg.norm(error[:3]), np.degrees(np.linalg.norm(error[3:]))
    return f"{np.sqrt(squared):.1f} standard deviations ({mm:.0f} mm, {degrees:.2f}°)"
