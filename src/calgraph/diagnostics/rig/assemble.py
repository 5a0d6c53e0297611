"""From a joint solution to a Calibration: poses with verdicts, and what became of every pair and capture."""

from collections.abc import Collection, Sequence

import numpy as np

from calgraph.captures import CaptureSet, Hold
from calgraph.config import Rig
from calgraph.diagnostics.rig.board_pictures import InlierResiduals, collect_board_outlines, collect_board_views
from calgraph.diagnostics.rig.prior_tests import find_contradicted_priors
from calgraph.diagnostics.verdict import find_ambiguous_poses, find_inconsistent_sensors, grade_pose
from calgraph.errors import Rejected
from calgraph.estimation.rig.priors import frame_id
from calgraph.estimation.rig.problem import Problem
from calgraph.estimation.rig.solution import RigSolution
from calgraph.geometry import Array
from calgraph.graph import SpanningTree
from calgraph.pairwise import PairwiseEstimate, PairwiseEstimates, select_successful
from calgraph.result import Calibration, CaptureRow, Edge, Evidence, Pictures, SensorPose


def assemble_rig(problem: Problem, tree: SpanningTree, joint: RigSolution) -> Calibration:
    """Collects everything a calibration tells its user.

    Args:
        problem: what was solved.
        tree: the spanning tree that the joint solution started from.
        joint: the joint solution of the connected sensors.
    """
    rig, captured, pairs = problem.rig, problem.captured, problem.pairs
    connected = tree.T_root_sensor
    within = [e for e in select_successful(pairs) if e.sensor_a in connected and e.sensor_b in connected]
    used = {seen: r for seen, r in _inlier_residuals(within).items() if seen not in joint.rejected}
    kinds = {name: rig.sensors[name].kind for name in connected}
    doubted, ambiguous = find_inconsistent_sensors(rig.root, kinds, within), find_ambiguous_poses(kinds, within)
    adjusted, groups = joint.solved_bundle, problem.solver.groups
    of_known = find_contradicted_priors(adjusted.bundle, adjusted.minimized, groups) if adjusted else {}
    for name, why in of_known.items():
        doubted[name] = f"{doubted[name]}; {why}" if name in doubted else why
    if not joint.converged:
        doubted = dict.fromkeys(connected, "the joint solution was still moving when it was stopped") | doubted
    root_first = [n for n in sorted(rig.sensors, key=lambda name: name != rig.root) if n in connected]
    return Calibration(
        root=rig.root,
        sensors=tuple(
            _assemble_sensor(name, rig, captured, tree, joint, doubted.get(name, ""), ambiguous.get(name, 0.0))
            for name in root_first
        ),
        joint_covariance=_reorder_covariance(joint, root_first),
        estimated_parameters=joint.extra_parameters,
        evidence=Evidence(
            estimator=joint.estimator,
            edges=tuple(_assemble_edge(names, pair, tree, captured) for names, pair in pairs.items()),
            captures=tuple(
                _assemble_row(hold, name, captured, used, joint) for hold in captured.holds for name in rig.sensors
            ),
            unconnected=_explain_unconnected(rig, captured, pairs, connected),
            remarks=joint.remarks,
            residuals=joint.residuals,
        ),
        pictures=Pictures(
            snapshots=captured.snapshots,
            board_outlines=collect_board_outlines(rig, captured, used, joint),
            board_views=collect_board_views(captured, used, joint),
        ),
    )


def _assemble_sensor(
    name: str, rig: Rig, captured: CaptureSet, tree: SpanningTree, joint: RigSolution, doubt: str, rival: float
) -> SensorPose:
    spec = rig.sensors[name]
    T, covariance = joint.T_root_sensor[name], joint.covariance[name]
    return SensorPose(
        name=name,
        parent=tree.parents.get(name),
        frame_id=frame_id(name, rig, captured),
        kind=spec.kind,
        T_root_sensor=T,
        covariance=covariance,
        verdict=grade_pose(name, spec.kind, T, covariance, doubt, rival),
    )


def _reorder_covariance(joint: RigSolution, names: Sequence[str]) -> Array:
    """The joint covariance of the sensors in another order."""
    order = list(joint.T_root_sensor)
    rows = np.concatenate([6 * order.index(name) + np.arange(6) for name in names])
    return np.asarray(joint.joint_covariance[np.ix_(rows, rows)])


def _assemble_edge(
    names: tuple[str, str], pair: PairwiseEstimate | Rejected, tree: SpanningTree, captured: CaptureSet
) -> Edge:
    common = len(set(captured.detections[names[0]]) & set(captured.detections[names[1]]))
    if isinstance(pair, Rejected):
        return Edge(*names, common, 0, in_tree=False, residuals=np.zeros(0), note=pair.reason)
    residuals = pair.residuals[pair.inliers]
    return Edge(*names, common, len(residuals), in_tree=tree.has_edge(*names), residuals=residuals)


def _inlier_residuals(estimates: Sequence[PairwiseEstimate]) -> InlierResiduals:
    """By capture and sensor: residuals of its inlier matches, by candidate."""
    used: dict[tuple[int, str], dict[int, list[float]]] = {}
    for pair in estimates:
        for (capture, i, j), r in zip(pair.matches[pair.inliers], pair.residuals[pair.inliers], strict=True):
            used.setdefault((int(capture), pair.sensor_a), {}).setdefault(int(i), []).append(float(r))
            used.setdefault((int(capture), pair.sensor_b), {}).setdefault(int(j), []).append(float(r))
    return used


def _assemble_row(
    hold: Hold, name: str, captured: CaptureSet, used: InlierResiduals, joint: RigSolution
) -> CaptureRow:
    residual, reason = None, ""
    if (hold.index, name) in used:
        matched = np.concatenate(list(used[hold.index, name].values()))
        residual = float(np.sqrt(np.mean(matched**2)))
    elif hold.index not in captured.detections[name]:
        reason = captured.rejections[hold.index, name]
    elif (hold.index, name) in joint.rejected:
        reason = joint.rejected[hold.index, name]
    elif any(hold.index in seen for other, seen in captured.detections.items() if other != name):
        reason = "disagrees with what the other sensors saw"
    else:
        reason = "no other sensor saw the board"
    return CaptureRow(
        hold.index,
        hold.start - captured.start,
        hold.end - captured.start,
        name,
        residual is not None,
        reason,
        residual,
    )


def _explain_unconnected(
    rig: Rig, captured: CaptureSet, pairs: PairwiseEstimates, connected: Collection[str]
) -> dict[str, str]:
    """Why each sensor outside the root's tree is there, as the rest of a sentence that starts with its name."""
    alone = {name: _explain_no_pair(name, captured, pairs) for name in rig.sensors if name not in connected}
    if not captured.detections[rig.root]:
        # Then no sensor can be connected, and what they saw themselves is not the reason.
        blind = f"the root {rig.root} {_explain_no_pair(rig.root, captured, pairs)}"
        return {name: f"{reason}; {blind}" for name, reason in alone.items()}
    return alone


def _explain_no_pair(name: str, captured: CaptureSet, pairs: PairwiseEstimates) -> str:
    seen = captured.detections[name]
    if not seen:
        misses = [reason for (_, sensor), reason in captured.rejections.items() if sensor == name]
        commonest = max(misses, key=misses.count)
        return f"found the board in none of {len(captured.holds)} captures, mostly because: {commonest}"
    reasons = [
        f"{b if a == name else a}: {pair.reason}"
        for (a, b), pair in pairs.items()
        if name in (a, b) and isinstance(pair, Rejected)
    ]
    return f"found the board in {len(seen)} captures, but " + "; ".join(reasons or ["no other sensor did"])
