"""The default joint estimator of a rig: a bundle over all sensors and boards, with estimated noise."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from calgraph.captures import CaptureSet
from calgraph.config import CameraSpec, Rig
from calgraph.detection import BoardCorners
from calgraph.estimation.rig.board_observations import (
    BoardObservation,
    board_number,
    group_detections,
    initial_board_pose,
)
from calgraph.estimation.rig.board_outlines import add_outlines
from calgraph.estimation.rig.bundle_solver import (
    COARSE_TOLERANCE,
    Bundle,
    BundleState,
    MinimizedBundle,
    linearize_bundle,
    minimize_bundle,
    stack_poses,
)
from calgraph.estimation.rig.corner_observations import CornerObservations
from calgraph.estimation.rig.covariances import pose_covariance, view_covariance_factors
from calgraph.estimation.rig.observations import BoardViews, relative_poses
from calgraph.estimation.rig.priors import PosePrior, RigidGroup, apply_rigid_groups, with_priors, without_priors
from calgraph.estimation.rig.range_observations import RangeObservations
from calgraph.estimation.rig.solution import MeasuredNoise, RigSolution, SolvedBundle
from calgraph.estimation.rig.systematic_parameters import (
    add_systematic_parameters,
    summarize_systematic_parameters,
)
from calgraph.estimation.rig.variance_components import (
    measure_consistency,
    select_consistent_views,
    update_variance_components,
)
from calgraph.geometry import Array
from calgraph.pairwise import MatchFilter, PairwiseEstimate, select_matches

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
    boards = group_detections([(pair, select_matches(pair, keep)) for pair in connected])
    if len(T_root_sensor) == 1:
        return RigSolution("bundle", T_root_sensor, np.zeros((6, 6)), {}, converged=True)
    bundle, state = build_bundle(rig, captured, boards, T_root_sensor)
    bundle = without_priors(bundle)
    solution = minimize_bundle(bundle, state, tolerance=COARSE_TOLERANCE, exact=False)
    bundle, solution, rejected = settle_variances(bundle, solution, bundle.settings.variances.max_rounds)
    bundle, solution, more = _solve_with_outlines(bundle, solution, rig, captured, boards)
    rejected |= more
    # Priors enter last: an error of theirs must not increase the estimated noise.
    bundle = with_priors(bundle, priors, groups)
    start = apply_rigid_groups(solution.state, bundle.sensors, groups)
    solution = minimize_bundle(bundle, start, tolerance=COARSE_TOLERANCE)
    names = bundle.sensors
    return RigSolution(
        estimator="bundle",
        T_root_sensor=dict(zip(names, solution.state.T_root_sensor, strict=True)),
        joint_covariance=pose_covariance(bundle, solution.state, solution.equations),
        residuals=dict(_residuals_by_sensor(bundle, solution)),
        converged=solution.converged,
        rejected={(boards[i].capture, name): _OUTLIER_VIEW for i, name in sorted(rejected)},
        noise={
            name: MeasuredNoise(views.noise_scale, *np.sqrt(variances).tolist())
            for name, views, variances in zip(names, bundle.views, bundle.bias_variance[: len(names)], strict=True)
        },
        systematic=summarize_systematic_parameters(bundle, solution.state, solution.equations),
        solved_bundle=SolvedBundle(bundle, solution, np.array([board.capture for board in boards])),
    )


def solve_poses(
    rig: Rig, captured: CaptureSet, estimates: Sequence[PairwiseEstimate], T_root_sensor: Mapping[str, Array]
) -> dict[str, Array]:
    """Joint poses of all connected sensors with the stated noise, to reselect the inliers of pairs.

    Args:
        rig: the rig.
        captured: detections, and the cameras' intrinsics.
        estimates: pairs with their inliers.
        T_root_sensor: start poses (4, 4) of the connected sensors, the root first.

    Returns:
        ``T_root_sensor`` (4, 4) by sensor.
    """
    connected = [e for e in estimates if e.sensor_a in T_root_sensor and e.sensor_b in T_root_sensor]
    if not connected:
        return dict(T_root_sensor)
    boards = group_detections([(pair, select_matches(pair, "ransac")) for pair in connected])
    bundle, state = build_bundle(rig, captured, boards, T_root_sensor)
    solution = minimize_bundle(without_priors(bundle), state, tolerance=COARSE_TOLERANCE, exact=False)
    return dict(zip(bundle.sensors, solution.state.T_root_sensor, strict=True))


def cramer_rao(
    rig: Rig, captured: CaptureSet, T_root_sensor: Mapping[str, Array], T_root_board: Mapping[int, Array]
) -> dict[str, Array]:
    """The Cramér–Rao bound (6, 6) on the covariance of each sensor's pose, in the root's axes.

    Systematic errors have the priors of the rig, and edges of boards their least view bias (Van Trees, "Detection,
    estimation, and modulation theory", 1968, section 2.4.3).

    Args:
        rig: the rig, with the true noise of its sensors.
        captured: detections; of each sensor and capture the first.
        T_root_sensor: true poses (4, 4), the root first.
        T_root_board: true poses (4, 4) of the board by capture.
    """
    detected = {c: {n: 0 for n in T_root_sensor if c in captured.detections[n]} for c in T_root_board}
    boards = [BoardObservation(c, by) for c, by in detected.items() if by]
    bundle, state = build_bundle(rig, captured, boards, T_root_sensor)
    truth = replace(state, T_root_board=stack_poses([T_root_board[board.capture] for board in boards]))
    bundle, with_offsets = add_outlines(bundle, truth, rig, captured.detections, boards, 0.0)
    truth = replace(truth, extra=with_offsets.extra)
    least = np.array([bundle.least_bias_variance(k) for k in range(len(bundle.all_views))])
    exact = replace(update_noise(bundle, truth), bias_variance=least)
    bound = pose_covariance(exact, truth, linearize_bundle(exact, truth))
    blocks = bound.reshape(len(bundle.sensors), 6, len(bundle.sensors), 6)
    return {name: blocks[i, :, i] for i, name in enumerate(bundle.sensors)}


def build_bundle(
    rig: Rig, captured: CaptureSet, boards: Sequence[BoardObservation], T_root_sensor: Mapping[str, Array]
) -> tuple[Bundle, BundleState]:
    """The bundle of the observed boards, and its start values."""
    names = tuple(T_root_sensor)
    views = tuple(_select_views(rig, captured, name, boards) for name in names)
    bundle = Bundle(
        names,
        views,
        body=np.arange(len(names)),
        bias_variance=np.zeros((len(names), 3)),
        lever=0.5 * max(rig.board_size),
        settings=rig.settings.estimation.rig,
    )
    initial = bundle.settings.variances.initial_view_bias
    for k in range(len(names)):
        components = list(bundle.bias_components(k))
        bundle.bias_variance[k, components] = (initial * np.array([1, 1 / bundle.lever, 1])[components]) ** 2
    state = BundleState(
        stack_poses([T_root_sensor[name] for name in names]),
        stack_poses([initial_board_pose(board, captured.detections, T_root_sensor) for board in boards]),
        np.zeros(0),
    )
    number = np.array([board_number(board, captured.detections) for board in boards], dtype=np.intp)
    bundle, state = add_systematic_parameters(bundle, state, rig, number)
    return update_noise(bundle, state), state


def update_noise(bundle: Bundle, state: BundleState) -> Bundle:
    """The bundle with the noise of its measurements at this state."""
    all_views = []
    for k, views in enumerate(bundle.all_views):
        T_sensor_board = relative_poses(state.T_root_sensor[bundle.sensor_of(k)], state.T_root_board[views.board])
        all_views.append(views.update_noise(T_sensor_board, views.noise_scale))
    return bundle.with_views(all_views)


def _select_views(rig: Rig, captured: CaptureSet, name: str, boards: Sequence[BoardObservation]) -> BoardViews:
    """One sensor's views of the boards."""
    spec = rig.sensors[name]
    detected = [
        (i, captured.detections[name][board.capture][board.detection_index[name]])
        for i, board in enumerate(boards)
        if name in board.detection_index
    ]
    indices = [i for i, _ in detected]
    if isinstance(spec, CameraSpec):
        corners = [d for _, d in detected if isinstance(d, BoardCorners)]
        return CornerObservations.from_detections(indices, corners, captured.cameras[name], spec.noise)
    surfaces = [d for _, d in detected if not isinstance(d, BoardCorners)]
    return RangeObservations.from_detections(
        indices, surfaces, spec.noise, rig.settings.estimation.rig.min_incidence_cosine
    )


def _solve_with_outlines(
    bundle: Bundle, solution: MinimizedBundle, rig: Rig, captured: CaptureSet, boards: Sequence[BoardObservation]
) -> tuple[Bundle, MinimizedBundle, set[tuple[int, str]]]:
    """The bundle with outlines, its solution, and the rejected views.

    Outlines are added to a solution, because sides are assigned at its poses, and so that they do not influence
    the estimated noise of planes and prints.
    """
    settings = bundle.settings.variances
    outlined, state = add_outlines(
        bundle, solution.state, rig, captured.detections, boards, settings.initial_view_bias**2
    )
    if not outlined.outlines:
        return bundle, solution, set()
    cache = (*solution.equations.cache, *[None] * len(outlined.outlines))
    solution = minimize_bundle(
        outlined, state, cache, iterations=settings.steps_per_round, tolerance=COARSE_TOLERANCE, exact=False
    )
    return settle_variances(outlined, solution, settings.max_outline_rounds, first=len(outlined.views))


def settle_variances(
    bundle: Bundle, solution: MinimizedBundle, rounds: int, first: int = 0
) -> tuple[Bundle, MinimizedBundle, set[tuple[int, str]]]:
    """The bundle with estimated noise and view bias, its solution, and rejected views by board and sensor.

    Variances settle before views are judged: views that scatter as all others do are not outliers. A rejected view
    returns once it agrees with the others. Components are estimated, and views judged, from ``first`` on.
    """
    settings = bundle.settings.variances
    complete, kept = bundle, [np.ones(len(views.board), dtype=np.bool_) for views in bundle.all_views]
    for _ in range(rounds):
        before, factors = bundle, view_covariance_factors(bundle, solution.equations)
        bundle, change = update_variance_components(bundle, solution, factors, first)
        settled = change < settings.max_settled_change
        selected = _judge_views(complete, before, solution, factors, kept, first, settled=settled)
        if any(np.any(new != old) for new, old in zip(selected, kept, strict=True)):
            bundle, kept = _select_views_of(complete, before, solution.state, selected), selected
        elif settled:
            break
        unchanged = zip(solution.equations.cache, before.all_views, bundle.all_views, strict=True)
        cache = [cached if new is old else None for cached, old, new in unchanged]
        solution = minimize_bundle(
            bundle,
            solution.state,
            cache,
            iterations=settings.steps_per_round,
            tolerance=COARSE_TOLERANCE,
            exact=False,
        )
    rejected = {
        (int(board), name)
        for name, views, part in zip(complete.sensors, complete.views, kept[: len(complete.views)], strict=True)
        for board in views.board[~part]
    }
    return bundle, solution, rejected


def _judge_views(
    complete: Bundle,
    bundle: Bundle,
    solution: MinimizedBundle,
    factors: Sequence[Array],
    kept: Sequence[NDArray[np.bool_]],
    first: int,
    *,
    settled: bool,
) -> list[NDArray[np.bool_]]:
    """(K,) masks of views of the complete bundle to keep, judged by the solution of those that are kept.

    As long as variances have not settled, only gross outliers are rejected, and no view returns.
    """
    everything = [np.ones_like(part) for part in kept]
    scaled, equations = _select_views_of(complete, bundle, solution.state, everything), solution.equations
    if not all(np.all(part) for part in kept):
        equations = linearize_bundle(scaled, solution.state)
        factors = view_covariance_factors(scaled, solution.equations, equations.views)
    consistency = measure_consistency(scaled, equations, factors, kept)
    selected = select_consistent_views(scaled, consistency, kept, settled=settled)
    return [*kept[:first], *selected[first:]]


def _select_views_of(
    complete: Bundle, bundle: Bundle, state: BundleState, kept: Sequence[NDArray[np.bool_]]
) -> Bundle:
    """The bundle with some of the views (K,) of the complete one, with its own noise."""
    all_views = []
    for k, (views, scaled, part) in enumerate(zip(complete.all_views, bundle.all_views, kept, strict=True)):
        if len(scaled.board) == part.sum() and np.array_equal(views.board[part], scaled.board):
            all_views.append(scaled)
            continue
        some = views.select(part)
        T_sensor_board = relative_poses(state.T_root_sensor[complete.sensor_of(k)], state.T_root_board[some.board])
        all_views.append(some.update_noise(T_sensor_board, scaled.noise_scale))
    return bundle.with_views(all_views)


def _residuals_by_sensor(bundle: Bundle, solution: MinimizedBundle) -> Iterator[tuple[str, Array]]:
    for s, (name, views) in enumerate(zip(bundle.sensors, bundle.views, strict=True)):
        T_sensor_board = relative_poses(solution.state.T_root_sensor[s], solution.state.T_root_board[views.board])
        yield name, views.linearize(T_sensor_board, solution.state.extra[bundle.extra_indices(s)]).residual
