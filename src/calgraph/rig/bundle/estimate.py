"""The default joint estimator of a rig: a bundle over all sensors and boards, with estimated noise."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from calgraph.config import Rig
from calgraph.config.settings import MatchFilter
from calgraph.geometry import Array, Index
from calgraph.graph.pairwise_estimate import PairwiseEstimate, select_matches
from calgraph.rig.bundle.board_observations import (
    BoardObservation,
    Node,
    add_unambiguous_detections,
    group_detections,
    locating_sensors,
)
from calgraph.rig.bundle.board_outlines import add_outlines
from calgraph.rig.bundle.bundle_setup import INITIAL_VIEW_BIAS, build_bundle
from calgraph.rig.bundle.bundle_solver import (
    COARSE_TOLERANCE,
    Bundle,
    MinimizedBundle,
    minimize_bundle,
    view_state,
)
from calgraph.rig.bundle.covariances import pose_covariance
from calgraph.rig.bundle.priors import PosePrior, RigidGroup, apply_rigid_groups, with_priors, without_priors
from calgraph.rig.bundle.settling import STEPS_PER_ROUND, select_views, settle_variances
from calgraph.rig.bundle.solution import MeasuredNoise, RigSolution, SolvedBundle
from calgraph.rig.bundle.systematic_parameters import summarize_systematic_parameters
from calgraph.rig.captures.detect import CaptureSet


@dataclass(frozen=True, eq=False)
class SettledBundle:
    """A bundle of some of the views of boards, its solution, and the boards."""

    bundle: Bundle
    """Of the views that are kept."""
    solution: MinimizedBundle
    boards: Sequence[BoardObservation]
    """(C,) as detected, with views that are not kept."""

    def nodes(self) -> dict[Node, int]:
        """The detections that are kept, with the index of their board."""
        return {
            (self.boards[i].capture, name, self.boards[i].detection_index[name]): i
            for name, views in zip(self.bundle.sensors, self.bundle.views, strict=True)
            for i in views.board.tolist()
        }


# Rounds of solving, estimating noise and rejecting views, without outlines: of 38 rigs of the frozen corpus, 32
# settle in 3 to 5, and one takes all.
MAX_ROUNDS = 24


def _settle(
    rig: Rig, captured: CaptureSet, boards: Sequence[BoardObservation], T_root_sensor: Mapping[str, Array]
) -> SettledBundle:
    """The bundle of the views that agree, without outlines, and its solution.

    Detections that no pair has as inliers are judged by the solution of the others, as these are: by the
    Mahalanobis distance from their prediction. A board without inliers is located by one of its detections.
    """
    complete, start = build_bundle(rig, captured, boards, T_root_sensor)
    complete = without_priors(complete)
    located_by = [locating_sensors(board, captured.detections) for board in boards]
    kept = [
        np.array([name in located_by[i] for i in views.board.tolist()], dtype=np.bool_)
        for name, views in zip(complete.sensors, complete.views, strict=True)
    ]
    at_first = replace(select_views(complete, complete, start, kept), robust_views=True)
    solution = minimize_bundle(at_first, start, tolerance=COARSE_TOLERANCE, exact=False)
    bundle, solution, _ = settle_variances(complete, solution, MAX_ROUNDS, kept=kept)
    return _drop_lone_views(SettledBundle(bundle, solution, boards))


def _drop_lone_views(settled: SettledBundle) -> SettledBundle:
    """The bundle without the boards that one detection located, and that no other agrees with."""
    bundle, state = settled.bundle, settled.solution.state
    count = np.bincount(np.concatenate([views.board for views in bundle.views]), minlength=len(settled.boards))
    old = [len(board.detection_index) > len(board.unmatched) for board in settled.boards]
    useful = (count > 1) | ((count > 0) & np.array(old, dtype=np.bool_))
    if useful.all():
        return settled
    number: Index = np.cumsum(useful) - 1
    views = []
    for of_sensor in bundle.views:
        some = of_sensor.select(useful[of_sensor.board])
        views.append(replace(some, board=number[some.board]))
    boards = [board for board, keep in zip(settled.boards, useful, strict=True) if keep]
    state = replace(state, T_root_board=state.T_root_board[useful])
    bundle = bundle.with_views(views)
    return SettledBundle(bundle, minimize_bundle(bundle, state, tolerance=COARSE_TOLERANCE, exact=False), boards)


_OUTLIER_VIEW = "outlier of the joint solution: inconsistent with the board's pose from the other sensors"


def solve_bundle(
    rig: Rig,
    captured: CaptureSet,
    estimates: Sequence[PairwiseEstimate],
    T_root_sensor: Mapping[str, Array],
    *,
    keep: MatchFilter = "ransac",
    priors: Sequence[PosePrior] = (),
    groups: Sequence[RigidGroup] = (),
) -> RigSolution:
    """Solves for the poses of all connected sensors and boards jointly.

    Systematic errors of sensors and boards, the noise of measurements and the bias of views are estimated, and
    outlier views rejected.

    Args:
        rig: the rig.
        captured: detections, and the cameras' intrinsics.
        estimates: pairs with their inliers.
        T_root_sensor: start poses of the connected sensors, the root first.
        keep: ``ransac`` uses the pairwise inliers only, ``none`` the first candidates of every common capture.
        priors: of sensors' poses.
        groups: sensors with exact relative poses.
    """
    connected = [e for e in estimates if e.sensor_a in T_root_sensor and e.sensor_b in T_root_sensor]
    if len(T_root_sensor) == 1:
        return RigSolution("bundle", T_root_sensor, np.zeros((6, 6)), {}, converged=True)
    matched = group_detections([(pair, select_matches(pair, keep)) for pair in connected])
    boards = matched
    if keep == "ransac":
        paired = {name for board in matched for name in board.detection_index}
        located = [name for name in T_root_sensor if name in paired]
        boards = add_unambiguous_detections(matched, captured.detections, located)
    settled = _settle(rig, captured, boards, T_root_sensor)
    used = settled.nodes()
    views = {(capture, name) for capture, name, _ in used}
    judged = sorted({(board.capture, name) for board in boards for name in board.detection_index})
    bundle, solution = _solve_with_outlines(settled, rig, captured)
    # Priors enter last: an error of theirs must not increase the estimated noise.
    bundle = with_priors(bundle, priors, groups)
    start = apply_rigid_groups(solution.state, bundle.sensors, groups)
    solution = minimize_bundle(bundle, start, tolerance=COARSE_TOLERANCE)
    names = bundle.sensors
    return RigSolution(
        estimator="bundle",
        T_root_sensor=dict(zip(names, solution.state.T_root_sensor, strict=True)),
        joint_covariance=pose_covariance(bundle, solution.state, solution.equations),
        residuals={
            name: views.linearize(*view_state(bundle, solution.state, s)).residual
            for s, (name, views) in enumerate(zip(names, bundle.views, strict=True))
        },
        converged=solution.converged,
        used=used,
        rejected=dict.fromkeys([view for view in judged if view not in views], _OUTLIER_VIEW),
        noise={
            name: MeasuredNoise(views.noise_scale, *np.sqrt(variances).tolist())
            for name, views, variances in zip(names, bundle.views, bundle.bias_variance[: len(names)], strict=True)
        },
        systematic=summarize_systematic_parameters(bundle, solution.state, solution.equations),
        solved_bundle=SolvedBundle(
            bundle, solution, np.array([board.capture for board in settled.boards]), boards
        ),
    )


# Rounds with outlines: all of 35 rigs of the frozen corpus settle in 2 to 6.
_MAX_OUTLINE_ROUNDS = 12


def _solve_with_outlines(settled: SettledBundle, rig: Rig, captured: CaptureSet) -> tuple[Bundle, MinimizedBundle]:
    """The bundle with outlines, and its solution.

    Outlines are added to a solution, because sides are assigned at its poses, and so that they do not influence
    the estimated noise of planes and prints.
    """
    bundle, solution = settled.bundle, settled.solution
    outlined, state = add_outlines(
        bundle, solution.state, rig, captured.detections, settled.boards, INITIAL_VIEW_BIAS**2
    )
    if not outlined.outlines:
        return bundle, solution
    same = [new is old for new, old in zip(outlined.views, bundle.views, strict=True)]
    cached = [cached if kept else None for cached, kept in zip(solution.equations.cache, same, strict=True)]
    cache = (*cached, *[None] * len(outlined.outlines))
    solution = minimize_bundle(
        outlined, state, cache, iterations=STEPS_PER_ROUND, tolerance=COARSE_TOLERANCE, exact=False
    )
    first = len(outlined.views)
    bundle, solution, _ = settle_variances(outlined, solution, _MAX_OUTLINE_ROUNDS, first=first)
    return bundle, solution
