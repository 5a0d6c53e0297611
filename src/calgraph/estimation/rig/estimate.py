"""The default joint estimator of a rig: all sensors and boards at once, in the units that the sensors measure."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from calgraph.captures import CaptureSet
from calgraph.config import CameraSpec, Rig
from calgraph.detection import BoardCorners
from calgraph.estimation.rig.board_observations import (
    BoardObservation,
    detections_of,
    group_detections,
    initial_board_pose,
)
from calgraph.estimation.rig.board_outlines import add_outlines, drop_wrong_outlines, outlines_contradict
from calgraph.estimation.rig.bundle_solver import (
    COARSE_TOLERANCE,
    Bundle,
    BundleState,
    MinimizedBundle,
    linearize_bundle,
    minimize_bundle,
    stack_poses,
)
from calgraph.estimation.rig.covariances import pose_covariance, view_covariance_factors
from calgraph.estimation.rig.extra_parameters import Estimable, add_extra_parameters, summarize_extra_parameters
from calgraph.estimation.rig.observations import BoardViews, CornerObservations, RangeObservations, relative_poses
from calgraph.estimation.rig.priors import PosePrior, RigidGroup, apply_rigid_groups, with_priors, without_priors
from calgraph.estimation.rig.solution import MeasuredNoise, RigSolution, SolvedBundle
from calgraph.estimation.rig.variance_components import find_outlier_views, update_variance_components
from calgraph.geometry import Array, Index
from calgraph.pairwise import MatchFilter, PairwiseEstimate, select_matches

# Views sway by this much to begin with, m: before noise is known, few views must pass for wrong.
_INITIAL_VIEW_BIAS = 0.003
# Rounds of solving, measuring the noise and leaving out what is wrong, until nothing changes by more than a share.
_MAX_ROUNDS = 12
# Outlines come to a solution that has settled.
_MAX_OUTLINE_ROUNDS = 4
_STEPS_PER_ROUND = 4
# That share of noises, and of sways, which are told by few views and never as surely.
_NOISE_TOLERANCE, _BIAS_TOLERANCE = 0.02, 0.05
_OUTLIER_VIEW = "lies elsewhere than the other sensors have the board in this capture"


def solve_bundle(
    rig: Rig,
    captured: CaptureSet,
    estimates: Sequence[PairwiseEstimate],
    T_root_sensor: Mapping[str, Array],
    *,
    keep: MatchFilter = "ransac",
    estimate: Sequence[Estimable] = (),
    priors: Sequence[PosePrior] = (),
    groups: Sequence[RigidGroup] = (),
) -> RigSolution:
    """Solves for all connected sensors and all boards at once.

    The noise of single measurements, and by how much whole views err, are measured on the way; views that
    contradict all others are left out by name.

    Args:
        rig: the rig.
        captured: detections, and the cameras' intrinsics.
        estimates: pairs with the matches that agree.
        T_root_sensor: start poses of the connected sensors, the root first.
        keep: ``ransac`` uses the pairwise inliers only, ``none`` the first candidates of every common capture.
        estimate: what to estimate besides poses.
        priors: what is known of sensors' poses.
        groups: sensors that are fixed to each other.
    """
    among = [e for e in estimates if e.sensor_a in T_root_sensor and e.sensor_b in T_root_sensor]
    boards = group_detections([(pair, select_matches(pair, keep)) for pair in among])
    if len(T_root_sensor) == 1:
        return RigSolution("bundle", T_root_sensor, np.zeros((6, 6)), {}, converged=True)
    bundle, state = build_bundle(rig, captured, boards, T_root_sensor)
    bundle = without_priors(bundle)
    if estimate:
        bundle, state = add_extra_parameters(bundle, state, rig, _board_numbers(captured, boards), estimate)
    bundle, solved, rejected = _estimate_variance_components(
        bundle, minimize_bundle(bundle, state, tolerance=COARSE_TOLERANCE, exact=False), _MAX_ROUNDS
    )
    outlined, outlined_solved, more = _solve_with_outlines(bundle, solved, rig, captured, boards)
    if outlines_contradict((bundle, solved), (outlined, outlined_solved)):
        remarks: tuple[str, ...] = (
            "where scanners see the board end contradicts planes and prints: outlines are not used; is size the "
            "sheet's, and does nothing but the sheet stand out beside it?",
        )
    else:
        bundle, solved, rejected = outlined, outlined_solved, rejected | more
        bundle, remarks = drop_wrong_outlines(bundle, solved)
    # What was known had no part so far: were it wrong, it would pass for noise.
    bundle = with_priors(bundle, priors, groups)
    solved = minimize_bundle(
        bundle, apply_rigid_groups(solved.state, bundle.sensors, groups), tolerance=COARSE_TOLERANCE
    )
    names = bundle.sensors
    return RigSolution(
        estimator="bundle",
        T_root_sensor=dict(zip(names, solved.state.T_root_sensor, strict=True)),
        joint_covariance=pose_covariance(bundle, solved.state, solved.equations),
        residuals=dict(_residuals_by_sensor(bundle, solved)),
        converged=solved.converged,
        remarks=remarks,
        rejected={(boards[i].capture, name): _OUTLIER_VIEW for i, name in sorted(rejected)},
        noise={
            name: MeasuredNoise(views.noise_scale, float(np.sqrt(sway)))
            for name, views, sway in zip(names, bundle.views, bundle.bias_variance[: len(names)], strict=True)
        },
        extra_parameters=summarize_extra_parameters(bundle, solved.state, solved.equations),
        solved_bundle=SolvedBundle(bundle, solved, np.array([board.capture for board in boards])),
    )


def cramer_rao(
    rig: Rig, captured: CaptureSet, T_root_sensor: Mapping[str, Array], T_root_board: Mapping[int, Array]
) -> dict[str, Array]:
    """The least covariance (6, 6) that any unbiased estimate of each sensor's pose can have, in the root's axes.

    Args:
        rig: the rig, with the true noise of its sensors.
        captured: detections; of each sensor and capture the first.
        T_root_sensor: true poses (4, 4), the root first.
        T_root_board: true poses (4, 4) of the board by capture.
    """
    seen = {c: {n: 0 for n in T_root_sensor if c in captured.detections[n]} for c in T_root_board}
    boards = [BoardObservation(c, by) for c, by in seen.items() if by]
    bundle, state = build_bundle(rig, captured, boards, T_root_sensor)
    truth = replace(state, T_root_board=stack_poses([T_root_board[board.capture] for board in boards]))
    bundle, laid = add_outlines(bundle, truth, rig, captured.detections, boards, 0.0)
    truth = replace(truth, extra=laid.extra)
    exact = replace(update_noise(bundle, truth), bias_variance=np.zeros_like(bundle.bias_variance))
    spread = pose_covariance(exact, truth, linearize_bundle(exact, truth))
    blocks = spread.reshape(len(bundle.sensors), 6, len(bundle.sensors), 6)
    return {name: blocks[i, :, i] for i, name in enumerate(bundle.sensors)}


def build_bundle(
    rig: Rig, captured: CaptureSet, boards: Sequence[BoardObservation], T_root_sensor: Mapping[str, Array]
) -> tuple[Bundle, BundleState]:
    """The bundle of sighted boards, and its start."""
    names = tuple(T_root_sensor)
    views = tuple(_select_views(rig, captured, name, boards) for name in names)
    bundle = Bundle(
        names,
        views,
        body=np.arange(len(names)),
        bias_variance=np.full(len(names), _INITIAL_VIEW_BIAS**2),
        lever=0.5 * max(rig.board_size),
    )
    state = BundleState(
        stack_poses([T_root_sensor[name] for name in names]),
        stack_poses([initial_board_pose(board, captured.detections, T_root_sensor) for board in boards]),
        np.zeros(0),
    )
    return update_noise(bundle, state), state


def _board_numbers(captured: CaptureSet, boards: Sequence[BoardObservation]) -> Index:
    """(C,) which of the rig's boards each sighting is of, as cameras saw it; the first where none did."""
    seen = [
        [d.board for _, d in detections_of(b, captured.detections) if isinstance(d, BoardCorners)] for b in boards
    ]
    return np.array([found[0] if found else 0 for found in seen], dtype=np.intp)


def update_noise(bundle: Bundle, state: BundleState) -> Bundle:
    """The bundle with the noise that measurements have if taken at this state."""
    views = [
        own.update_noise(
            relative_poses(state.T_root_sensor[bundle.sensor_of(k)], state.T_root_board[own.board]),
            own.noise_scale,
        )
        for k, own in enumerate(bundle.all_views)
    ]
    return bundle.with_views(views)


def _select_views(rig: Rig, captured: CaptureSet, name: str, boards: Sequence[BoardObservation]) -> BoardViews:
    """What one sensor saw of the boards."""
    spec = rig.sensors[name]
    seen = [
        (i, captured.detections[name][board.capture][board.detection_index[name]])
        for i, board in enumerate(boards)
        if name in board.detection_index
    ]
    indices = [i for i, _ in seen]
    if isinstance(spec, CameraSpec):
        corners = [d for _, d in seen if isinstance(d, BoardCorners)]
        return CornerObservations.from_detections(indices, corners, captured.cameras[name], spec.noise)
    surfaces = [d for _, d in seen if not isinstance(d, BoardCorners)]
    return RangeObservations.from_detections(indices, surfaces, spec.noise)


def _solve_with_outlines(
    plain: Bundle, solved: MinimizedBundle, rig: Rig, captured: CaptureSet, boards: Sequence[BoardObservation]
) -> tuple[Bundle, MinimizedBundle, set[tuple[int, str]]]:
    """The bundle with outlines, settled, and the views that it leaves out.

    Outlines come when planes and prints are right: they must not bend these, nor choose sides far off.
    """
    bundle, state = add_outlines(plain, solved.state, rig, captured.detections, boards, _INITIAL_VIEW_BIAS**2)
    if not bundle.outlines:
        return plain, solved, set()
    near = (*solved.equations.cache, *[None] * len(bundle.outlines))
    solved = minimize_bundle(
        bundle, state, near, iterations=_STEPS_PER_ROUND, tolerance=COARSE_TOLERANCE, exact=False
    )
    return _estimate_variance_components(bundle, solved, _MAX_OUTLINE_ROUNDS, first=len(bundle.views))


def _estimate_variance_components(
    bundle: Bundle, solved: MinimizedBundle, rounds: int, first: int = 0
) -> tuple[Bundle, MinimizedBundle, set[tuple[int, str]]]:
    """The bundle with its noise and sway measured and wrong views left out; and those, by board and sensor.

    Noise and sway are measured, and wrong views sought, from the first ones on: what is before has settled.
    """
    rejected: set[tuple[int, str]] = set()
    seen = np.array([len(views.board) for views in bundle.all_views])
    for _ in range(rounds):
        before, spreads = bundle, view_covariance_factors(bundle, solved.equations)
        contradicting = find_outlier_views(bundle, solved.equations, spreads, first)
        bundle = update_variance_components(bundle, solved, spreads, first)
        bundle, wrong = _remove_outlier_views(bundle, contradicting, seen)
        rejected |= wrong
        if _has_converged(before, bundle):
            break
        kept = zip(solved.equations.cache, before.all_views, bundle.all_views, strict=True)
        near = [at if views is was else None for at, was, views in kept]
        solved = minimize_bundle(
            bundle, solved.state, near, iterations=_STEPS_PER_ROUND, tolerance=COARSE_TOLERANCE, exact=False
        )
    return bundle, solved, rejected


def _remove_outlier_views(
    bundle: Bundle, contradicting: Sequence[NDArray[np.bool_]], seen: NDArray[np.intp]
) -> tuple[Bundle, set[tuple[int, str]]]:
    """The bundle without the views that contradict the others, (K,) masks; and those, by board and sensor.

    A sensor that would lose more than half of the views (K,) it had keeps them: not they, its model is wrong.
    """
    wrong = [bad & (len(bad) - bad.sum() > count / 2) for bad, count in zip(contradicting, seen, strict=True)]
    rejected = {
        (int(board), name)
        for name, views, bad in zip(bundle.sensors, bundle.views, wrong[: len(bundle.views)], strict=True)
        for board in views.board[bad]
    }
    left = [
        views.select(~bad) if np.any(bad) else views for views, bad in zip(bundle.all_views, wrong, strict=True)
    ]
    return bundle.with_views(left), rejected


def _has_converged(a: Bundle, b: Bundle) -> bool:
    """Whether two bundles have the same views, and nearly the same noise."""
    same_views = all(len(p.board) == len(q.board) for p, q in zip(a.all_views, b.all_views, strict=True))
    same_noise = all(
        abs(p.noise_scale / q.noise_scale - 1) < _NOISE_TOLERANCE
        for p, q in zip(a.all_views, b.all_views, strict=True)
    )
    smallest = np.minimum(a.bias_variance, b.bias_variance)
    same_sway = bool(np.all(np.abs(a.bias_variance - b.bias_variance) <= 2 * _BIAS_TOLERANCE * smallest + 1e-9))
    return same_views and same_noise and same_sway


def _residuals_by_sensor(bundle: Bundle, solved: MinimizedBundle) -> Iterator[tuple[str, Array]]:
    for s, (name, views) in enumerate(zip(bundle.sensors, bundle.views, strict=True)):
        T_sensor_board = relative_poses(solved.state.T_root_sensor[s], solved.state.T_root_board[views.board])
        yield name, views.linearize(T_sensor_board, solved.state.extra[bundle.extra_indices(s)]).residual
