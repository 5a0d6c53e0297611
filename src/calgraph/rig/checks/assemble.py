"""Assembles the Calibration of a rig: poses with verdicts, and the outcome of every pair and capture."""

from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import replace
from types import MappingProxyType

import numpy as np

from calgraph.boards.detections import BoardCorners, Detection, PlanePatch
from calgraph.config import CameraSpec, Intrinsics, Rig, SensorSpec
from calgraph.errors import Rejected
from calgraph.geometry import Array, Index, plane, se3
from calgraph.graph.pairwise_estimate import PairwiseEstimate
from calgraph.graph.spanning_tree import SpanningTree
from calgraph.result import (
    BoardOutline,
    BoardView,
    Calibration,
    CaptureRow,
    Edge,
    ErrorBudget,
    ErrorSource,
    Evidence,
    FitError,
    HeldOutError,
    Pictures,
    PriorErrors,
    Remedy,
    SensorPose,
    apply_estimates,
)
from calgraph.result.evidence import rms
from calgraph.result.finding import Finding
from calgraph.rig.bundle.board_observations import Node
from calgraph.rig.bundle.bundle_solver import view_state
from calgraph.rig.bundle.corner_observations import CornerObservations
from calgraph.rig.bundle.covariances import prior_error_derivatives
from calgraph.rig.bundle.error_sources import DRIFT, split_covariance
from calgraph.rig.bundle.priors import frame_id
from calgraph.rig.bundle.problem import Problem
from calgraph.rig.bundle.range_observations import RangeObservations
from calgraph.rig.bundle.solution import RigSolution, SolvedBundle
from calgraph.rig.captures.detect import CaptureSet
from calgraph.rig.captures.holds import Hold
from calgraph.rig.checks.contradictions import find_contradictions
from calgraph.rig.checks.drift_tests import DriftStatistics, include_serial_correlation
from calgraph.rig.checks.prior_tests import find_contradicted_priors
from calgraph.rig.checks.uncorrected_errors import collect_corrections, find_uncorrected_errors
from calgraph.rig.pairs.board_pair import PairwiseEstimates, select_successful
from calgraph.sensors.kinds import KINDS
from calgraph.verdict.grades import (
    LONE_ROOT,
    collect_findings,
    find_ambiguous_poses,
    find_inconsistent_sensors,
    grade_pose,
    merge_reasons,
    select_reasons,
)

UsedResiduals = Mapping[tuple[int, str], Mapping[int, Sequence[float]]]
"""By capture and sensor, residuals of the matches between its used detections and others, by candidate, m."""

_NOT_CONVERGED = (
    "the joint solution has not converged; check target and intrinsics in rig.yaml, and record more captures"
)

# Most points of a view in a picture; more do not change what it shows.
_MAX_POINTS = 300


def collect_board_views(captures: CaptureSet, used: UsedResiduals, solution: RigSolution) -> tuple[BoardView, ...]:
    """The measurements of each sensor in each capture: those in the bundle, otherwise the first detection."""
    solved = [_subsample_view(view) for view in _views_of_bundle(solution)]
    shown = {(view.capture, view.sensor) for view in solved}
    detected = [
        BoardView(
            capture,
            name,
            solution.solved_bundle is None and (capture, name) in used,
            _subsample_measurements(found[0]),
        )
        for name, by_capture in captures.detections.items()
        for capture, found in by_capture.items()
        if (capture, name) not in shown
    ]
    return tuple(sorted([*solved, *detected], key=lambda view: (view.capture, view.sensor)))


def measure_fit(solution: RigSolution) -> dict[str, FitError]:
    """RMS reprojection error of each camera, and RMS distance of each scanner's points from the boards."""
    residuals: dict[str, list[Array]] = {}
    for view in _views_of_bundle(solution):
        if view.residuals is not None:
            residuals.setdefault(view.sensor, []).append(view.residuals)
    joined = {name: np.concatenate(parts) for name, parts in residuals.items()}
    return {
        name: FitError(len(errors), "px", rms(np.linalg.norm(errors, axis=1)) or 0.0)
        if errors.ndim == 2
        else FitError(len(errors), "m", rms(errors) or 0.0)
        for name, errors in joined.items()
    }


def collect_board_outlines(
    rig: Rig, captures: CaptureSet, used: UsedResiduals, solution: RigSolution
) -> tuple[BoardOutline, ...]:
    """The board of each capture: as estimated by the bundle, otherwise as detected by a camera or 3-D LiDAR."""
    solved = list(_outlines_of_bundle(rig, captures, solution.solved_bundle)) if solution.solved_bundle else []
    estimated = {outline.capture for outline in solved}
    detected = (
        _detected_outline(rig, captures, used, solution, hold.index)
        for hold in captures.holds
        if hold.index not in estimated
    )
    return tuple(sorted([*solved, *filter(None, detected)], key=lambda outline: outline.capture))


def _views_of_bundle(solution: RigSolution) -> Iterator[BoardView]:
    if (solved := solution.solved_bundle) is None:
        return
    bundle, state = solved.bundle, solved.minimized.state
    for s, (name, views) in enumerate(zip(bundle.sensors, bundle.views, strict=True)):
        if not len(views.board):  # its pose is a prior
            continue
        T_sensor_board, extra = view_state(bundle, state, s)
        errors = -views.unwhiten(views.linearize(T_sensor_board, extra).residual)
        if isinstance(views, CornerObservations):
            measured = views.pixels
        else:
            assert isinstance(views, RangeObservations)
            measured = views.directions * views.ranges[:, None]
            errors = errors[:, 0] * views.incidence(T_sensor_board)
        parts = (np.split(values, views.start[1:]) for values in (measured, errors))
        for board, points, error in zip(views.board, *parts, strict=True):
            yield BoardView(int(solved.captures[board]), name, True, points, error)


def _subsample_view(view: BoardView) -> BoardView:
    step = len(view.measured) // _MAX_POINTS + 1
    residuals = None if view.residuals is None else view.residuals[::step]
    return replace(view, measured=view.measured[::step], residuals=residuals)


def _subsample_measurements(detection: Detection) -> Array:
    measured = detection.pixels if isinstance(detection, BoardCorners) else detection.points
    return np.asarray(measured[:: len(measured) // _MAX_POINTS + 1])


def _outlines_of_bundle(rig: Rig, captures: CaptureSet, solved: SolvedBundle) -> Iterator[BoardOutline]:
    """The outlines of boards that a camera detected: of others, the bundle estimates the plane only."""
    bundle, T_root_board = solved.bundle, solved.minimized.state.T_root_board
    done: set[int] = set()
    for name, views in zip(bundle.sensors, bundle.views, strict=True):
        for board, start in zip(views.board.tolist(), views.start, strict=True):
            if isinstance(views, CornerObservations) and board not in done:
                done.add(board)
                capture = int(solved.captures[board])
                found = captures.detections[name][capture]
                number = _board_number(found, views.pixels[start])
                yield BoardOutline(capture, se3.apply(T_root_board[board], _board_rectangle(rig, number)), number)


def _board_number(found: Sequence[Detection], pixel: Array) -> int:
    """Number of the board whose first corner was detected at a pixel (2,)."""
    return next(d.board for d in found if isinstance(d, BoardCorners) and np.array_equal(d.pixels[0], pixel))


def _detected_outline(
    rig: Rig, captures: CaptureSet, used: UsedResiduals, solution: RigSolution, capture: int
) -> BoardOutline | None:
    """The board of one capture as detected by a camera, otherwise by a 3-D LiDAR; None without either."""
    detections: list[tuple[Array, Detection]] = [
        (T, captures.detections[name][capture][k])
        for name, T in solution.T_root_sensor.items()
        for k in used.get((capture, name), {})
    ]
    for T, detection in detections:
        if isinstance(detection, BoardCorners):
            corners = se3.apply(T @ detection.T_camera_board, _board_rectangle(rig, detection.board))
            return BoardOutline(capture, corners, detection.board)
    for T, detection in detections:
        if isinstance(detection, PlanePatch):
            return BoardOutline(capture, se3.apply(T, _patch_rectangle(detection)))
    return None


def _board_rectangle(rig: Rig, number: int) -> Array:
    """(4, 3) corners of a board in the board frame, m."""
    signs = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]])
    return np.column_stack([signs * np.array(rig.boards[number].size) / 2, np.zeros(4)])


def _patch_rectangle(patch: PlanePatch) -> Array:
    """(4, 3) corners of the rectangle around a detected patch, in the sensor's frame, m."""
    basis = plane.tangent_basis(patch.plane[:3])
    _, _, axes = np.linalg.svd((patch.points - patch.center) @ basis, full_matrices=False)
    along = (patch.points - patch.center) @ basis @ axes.T
    low, high = np.percentile(along, [1, 99], axis=0)
    flat = np.array([[low[0], low[1]], [high[0], low[1]], [high[0], high[1]], [low[0], high[1]]])
    return np.asarray(patch.center + flat @ axes @ basis.T)


def assemble_rig(
    problem: Problem,
    tree: SpanningTree,
    solution: RigSolution,
    held_out: Mapping[str, HeldOutError] = MappingProxyType({}),
    drifts: DriftStatistics | None = None,
    remedies: Sequence[Remedy] = (),
) -> Calibration:
    """Assembles the calibration of a rig.

    Args:
        problem: the problem that was solved.
        tree: the spanning tree that the joint solution started from.
        solution: the joint solution of the connected sensors.
        held_out: errors of its cross-validation by sensor.
        drifts: their statistics, if they have been measured.
        remedies: of sensors that are not certain enough.
    """
    rig, captures, pairs = problem.rig, problem.captures, problem.pairs
    settings = rig.settings.diagnostics.verdict
    connected = tree.T_root_sensor
    estimates = [e for e in select_successful(pairs) if e.sensor_a in connected and e.sensor_b in connected]
    used = _used_residuals(estimates, solution)
    paired = {name for estimate in estimates for name in (estimate.sensor_a, estimate.sensor_b)}
    kinds = {name: rig.sensors[name].kind for name in connected}
    contradictions = find_contradictions(solution, rig, captures, held_out, drifts)
    findings: list[Finding] = [*captures.findings, *contradictions]
    corrections = collect_corrections(rig, solution)
    weak = {name for finding in findings for name in finding.sensors}
    findings += find_uncorrected_errors(rig, solution, corrections, weak)
    ambiguous = find_ambiguous_poses(kinds, estimates)
    if solved := solution.solved_bundle:
        first = find_contradicted_priors(
            solved.bundle, solved.minimized, problem.solver.groups, settings.false_alarm_probability
        )
    else:
        # The baseline has no systematic parameters: pairs show a wrong scale of all detections of a sensor.
        first = find_inconsistent_sensors(rig.root, kinds, estimates, settings.max_normalized_rms)
    # Causes first: what is wrong with the recording, then with what was stated, then what these do to the fit.
    reasons = merge_reasons(
        collect_findings(captures.findings),
        first,
        {} if solution.converged else dict.fromkeys(connected, _NOT_CONVERGED),
        collect_findings(contradictions),
    )
    if hint := _hint_at_background(rig):
        reasons = {name: [f"{cause}{hint}", *others] for name, (cause, *others) in reasons.items()}
    if rig.root in reasons:
        # What is wrong with the root's measurements is wrong with all poses in its frame.
        of_root = [f"the root {rig.root} is weak, in whose frame the pose is"]
        reasons = {name: reasons.get(name, of_root) for name in connected}
    root_first = [n for n in sorted(rig.sensors, key=lambda name: name != rig.root) if n in connected]
    rows, budget = _rows_of(solution, root_first), split_budget(solution, root_first, drifts)
    sensors, covariance = [], solution.covariance
    for k, name in enumerate(root_first):
        spec, T = rig.sensors[name], solution.T_root_sensor[name]
        verdict = LONE_ROOT if len(connected) == 1 else grade_pose(
            name, spec.kind, T, covariance[name], reasons.get(name, ()), ambiguous.get(name, 0.0),
            tolerance=rig.tolerance, settings=settings, shares=budget.shares_by_source(k) if budget else {},
            remedy=next((one for one in remedies if one.sensor == name), None),
        )  # fmt: skip
        sensors.append(
            SensorPose(
                name=name,
                parent=tree.parents.get(name),
                frame_id=frame_id(name, rig, captures),
                kind=spec.kind,
                T_root_sensor=T,
                intrinsics=_refine_intrinsics(name, spec, solution),
                verdict=verdict,
            )
        )
    return Calibration(
        root=rig.root,
        sensors=tuple(sensors),
        joint_covariance=solution.joint_covariance[np.ix_(rows, rows)],
        systematic=solution.systematic,
        prior_errors=_collect_prior_errors(solution, root_first),
        budget=budget,
        corrections=corrections,
        evidence=Evidence(
            estimator=solution.estimator,
            tolerance=rig.tolerance,
            edges=tuple(_assemble_edge(names, pair, tree, captures) for names, pair in pairs.items()),
            captures=tuple(
                _assemble_row(hold, name, captures, used, solution, paired)
                for hold in captures.holds
                for name in rig.sensors
            ),
            unconnected=_explain_unconnected(rig, captures, pairs, connected),
            remarks=tuple(finding.text for finding in findings),
            residuals=solution.residuals,
            fit=measure_fit(solution),
            cross_validation=held_out,
            remedies=tuple(remedies),
        ),
        pictures=Pictures(
            snapshots=captures.snapshots,
            board_outlines=collect_board_outlines(rig, captures, used, solution),
            board_views=collect_board_views(captures, used, solution),
        ),
    )


def _refine_intrinsics(name: str, spec: SensorSpec, solution: RigSolution) -> Intrinsics | None:
    """The intrinsics of a camera that were estimated from the recording, with the joint solution's values."""
    if not isinstance(spec, CameraSpec) or not (start := spec.stated_intrinsics) or not start.estimated_from_views:
        return None
    camera = apply_estimates(solution.systematic, name, start.to_camera())
    return Intrinsics.from_camera(camera, start.estimated_from_views, start.model_error or 0.0)


def _hint_at_background(rig: Rig) -> str:
    """What to try where scanners have no background, and may take other surfaces for the board."""
    scanners = any(KINDS[spec.kind].measures_ranges for spec in rig.sensors.values())
    if not scanners or rig.capture.background:
        return ""
    return "; no background is set: state a time without board and operator as capture.background"


def _rows_of(solution: RigSolution, names: Sequence[str]) -> Index:
    """Rows of the solution's covariance of sensors in another order."""
    order = list(solution.T_root_sensor)
    return np.concatenate([6 * order.index(name) + np.arange(6) for name in names])


def split_budget(
    solution: RigSolution, names: Sequence[str], drifts: DriftStatistics | None
) -> ErrorBudget | None:
    """What the covariance of the poses comes from; what is added after the solution are sources, too."""
    if (solved := solution.solved_bundle) is None:
        return None
    parts = split_covariance(solved.bundle, solved.minimized)
    if drifts is not None:
        total = np.sum(list(parts.values()), axis=0)
        correlated = include_serial_correlation(total, solved.bundle, drifts)
        parts[ErrorSource("serial correlation")] = correlated - total
        parts[DRIFT] = solution.joint_covariance - correlated
    rows = _rows_of(solution, names)
    covariance = np.array(list(parts.values()))[:, rows[:, None], rows]
    return ErrorBudget.of_poses(list(parts), covariance, [solution.T_root_sensor[name] for name in names])


def _collect_prior_errors(solution: RigSolution, names: Sequence[str]) -> PriorErrors | None:
    """Errors of the poses by those of the stated values."""
    if solution.solved_bundle is None:
        return None
    bundle, minimized = solution.solved_bundle.bundle, solution.solved_bundle.minimized
    derivatives = prior_error_derivatives(bundle, minimized.state, minimized.equations)
    parameters = tuple((one.of, one.quantity) for one in bundle.extra_parameters)
    return PriorErrors(parameters, derivatives[_rows_of(solution, names)])


def _assemble_edge(
    names: tuple[str, str], pair: PairwiseEstimate | Rejected, tree: SpanningTree, captures: CaptureSet
) -> Edge:
    common = len(set(captures.detections[names[0]]) & set(captures.detections[names[1]]))
    if isinstance(pair, Rejected):
        return Edge(*names, common, 0, in_tree=False, residuals=np.zeros(0), note=pair.reason)
    residuals = pair.residuals[pair.inliers]
    return Edge(*names, common, len(residuals), in_tree=tree.has_edge(*names), residuals=residuals)


def _used_residuals(estimates: Sequence[PairwiseEstimate], solution: RigSolution) -> UsedResiduals:
    """By capture and sensor of the detections that are used: residuals of matches on one board, by candidate."""
    board_of = solution.used
    inliers = {end for e in estimates for row in e.matches[e.inliers].tolist() for end in _ends(e, row)}
    used: dict[tuple[int, str], dict[int, list[float]]] = {}
    for capture, name, k in sorted(inliers if board_of is None else board_of):
        used.setdefault((capture, name), {})[k] = []
    for pair in estimates:
        for row, inlier, r in zip(pair.matches.tolist(), pair.inliers, pair.residuals.tolist(), strict=True):
            first, second = _ends(pair, row)
            if inlier if board_of is None else first in board_of and board_of[first] == board_of.get(second):
                for capture, name, k in (first, second):
                    used[capture, name][k].append(r)
    return used


def _ends(pair: PairwiseEstimate, row: Sequence[int]) -> tuple[Node, Node]:
    """The two detections of a match."""
    capture, i, j = row
    return (capture, pair.sensor_a, i), (capture, pair.sensor_b, j)


def _assemble_row(
    hold: Hold,
    name: str,
    captures: CaptureSet,
    used: UsedResiduals,
    solution: RigSolution,
    paired: Collection[str],
) -> CaptureRow:
    """The use of one sensor in one capture; those paired have a relative pose to another sensor."""
    residual, reason = None, ""
    if (hold.index, name) in used:
        # A detection may have no match with a sensor of which RANSAC found no relative pose.
        if len(matched := np.concatenate(list(used[hold.index, name].values()))):
            residual = float(np.sqrt(np.mean(matched**2)))
    elif hold.index not in captures.detections[name]:
        reason = captures.rejections[hold.index, name]
    elif (hold.index, name) in solution.rejected:
        reason = solution.rejected[hold.index, name]
    elif name not in paired:
        reason = "no relative pose of it and another sensor was estimated"
    elif any(hold.index in found for other, found in captures.detections.items() if other != name):
        reason = "outlier with respect to the other sensors"
    else:
        reason = "no other sensor detected the board"
    return CaptureRow(
        hold.index,
        hold.start - captures.start,
        hold.end - captures.start,
        name,
        (hold.index, name) in used,
        reason,
        residual,
    )


def _explain_unconnected(
    rig: Rig, captures: CaptureSet, pairs: PairwiseEstimates, connected: Collection[str]
) -> dict[str, str]:
    """Why each sensor is not connected to the root, as the rest of a sentence that starts with its name."""
    reasons = {
        name: _explain_no_pair(name, captures, pairs) + _hint_at_background(rig)
        for name in rig.sensors
        if name not in connected
    }
    if not captures.detections[rig.root]:
        # Then no sensor can be connected.
        of_root = f"the root {rig.root} {_explain_no_pair(rig.root, captures, pairs)}"
        return {name: f"{reason}; {of_root}" for name, reason in reasons.items()}
    return reasons


def _explain_no_pair(name: str, captures: CaptureSet, pairs: PairwiseEstimates) -> str:
    detected = captures.detections[name]
    rejections = [reason for (_, sensor), reason in captures.rejections.items() if sensor == name]
    commonest = max(rejections, key=rejections.count, default="")
    if not detected:
        return f"detected the board in none of {len(captures.holds)} captures, mostly because: {commonest}"
    partners: dict[str, list[str]] = {}
    for (a, b), pair in pairs.items():
        if name in (a, b) and isinstance(pair, Rejected):
            partners.setdefault(pair.reason, []).append(b if a == name else a)
    reasons = [f"{', '.join(others)}: {reason}" for reason, others in partners.items()]
    if len(rejections) > len(detected):
        reasons.append(f"in {len(rejections)} captures it did not, mostly because: {commonest}")
    stated, more = select_reasons(reasons or ["no other sensor did"], where="in the report")
    return f"detected the board in {len(detected)} captures, but " + "; ".join([*stated, *more])
