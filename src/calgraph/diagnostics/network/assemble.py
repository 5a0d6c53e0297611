"""From averaged poses of a network to a Calibration: lifted to space, with the evidence of every pair."""

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from calgraph.config import Rig
from calgraph.diagnostics.network.walk_report import floor_views, met, walk_rows
from calgraph.diagnostics.verdict import grade_pose
from calgraph.errors import Rejected
from calgraph.estimation.network.estimate import JointNetwork
from calgraph.estimation.network.planar_poses import in_space
from calgraph.geometry import Array, se2
from calgraph.graph import PoseGraph, PoseGraphSolution, compute_joint_covariance
from calgraph.pairwise import PoseHypothesis, ScannerPairEstimate
from calgraph.pairwise.synchronized_tracks import resample_tracks
from calgraph.result import Calibration, Edge, SensorPose
from calgraph.tracking import Tracked

_ADVICE = "let people walk farther across, and to and fro, where {name} and others both see them"

NetworkPairs = Mapping[tuple[str, str], ScannerPairEstimate | Rejected]


def assemble_network(
    rig: Rig,
    frames: Mapping[str, str],
    followed: Mapping[str, Tracked | Rejected],
    pairs: NetworkPairs,
    graph: PoseGraph,
    names: tuple[str, ...],
    averaged: PoseGraphSolution,
    start: float,
    joint: JointNetwork | None = None,
) -> Calibration:
    """Collects everything a network's calibration tells its user.

    Args:
        rig: the network.
        frames: frame_id by scanner, as its messages state it.
        followed: what each scanner followed, or why nothing.
        pairs: hypotheses, or the reason why there are none, by pair of scanners.
        graph: of all hypotheses of the connected scanners.
        names: the connected scanners in the order of the graph's nodes, the root first.
        averaged: their poses, and the hypotheses that agree.
        start: of the recording, s.
        joint: the joint solution, if there is one; its poses count then.
    """
    tracked = {name: own for name, own in followed.items() if isinstance(own, Tracked)}
    late = {} if joint is None else dict(zip(names, joint.offset.tolist(), strict=True))
    samples = {name: resample_tracks(_on_time(own, late.get(name, 0.0))) for name, own in tracked.items()}
    T_root_scanner = averaged.T_root_node if joint is None else joint.T_root_scanner
    planar = dict(zip(names, T_root_scanner, strict=True))
    meeting = met(samples, planar)
    right = graph.select_edges(averaged.inliers)
    together = in_space(
        compute_joint_covariance(right, averaged.T_root_node) if joint is None else joint.pose_covariance
    )
    spread = together.reshape(len(names), 6, len(names), 6)[np.arange(len(names)), :, np.arange(len(names))]
    clocks = np.full((len(names), 2), np.nan) if joint is None else joint.clocks
    parents = _parents(right, names)
    T_root_sensor = se2.to_se3(T_root_scanner)
    agreeing = {frozenset((names[i], names[j])): (T_root_scanner[i], T_root_scanner[j]) for i, j in right.edges}
    return Calibration(
        root=rig.root,
        sensors=tuple(
            SensorPose(
                name=name,
                parent=parents.get(name),
                frame_id=rig.sensors[name].frame_id or frames[name] or name,
                kind="lidar2d",
                T_root_sensor=T_root_sensor[k],
                covariance=spread[k],
                verdict=grade_pose(name, "lidar2d", T_root_sensor[k], spread[k], evidence="walk", advice=_ADVICE),
                clock_offset=_estimated(clocks[k, 0]),
                clock_offset_stddev=_estimated(clocks[k, 1]),
            )
            for k, name in enumerate(names)
        ),
        edges=tuple(_edge(pair, found, agreeing, parents) for pair, found in pairs.items()),
        captures=walk_rows(samples, meeting, start),
        unconnected={name: _why_alone(name, followed, pairs) for name in rig.sensors if name not in names},
        residuals={"positions": meeting.residuals.ravel()} if len(meeting.residuals) else {},
        estimator="averaging" if joint is None else "joint",
        floor=floor_views(tracked, samples, planar, start),
        joint_covariance=together,
        start={} if joint is None else dict(zip(names, se2.to_se3(averaged.T_root_node), strict=True)),
    )


def _on_time(tracked: Tracked, late: float) -> Tracked:
    """The same tracks by the root's clock; the scanner's own is so much ahead of it, s."""
    tracks = tuple(replace(track, times=track.times - late) for track in tracked.tracks)
    return replace(tracked, tracks=tracks)


def _estimated(value: float) -> float | None:
    return float(value) if np.isfinite(value) else None


def _parents(right: PoseGraph, names: tuple[str, ...]) -> dict[str, str]:
    """Each scanner's neighbour on the way to the root, over the surest of the edges that agree."""
    sure = np.argsort(-np.linalg.eigvalsh(right.information)[:, 0], kind="stable")
    parents: dict[str, str] = {}
    reached = {0}
    while True:
        step = next((e for e in sure if (right.edges[e, 0] in reached) != (right.edges[e, 1] in reached)), None)
        if step is None:
            return parents
        i, j = (int(node) for node in right.edges[step])
        here, there = (i, j) if i in reached else (j, i)
        parents[names[there]] = names[here]
        reached.add(there)


def _edge(
    pair: tuple[str, str],
    found: ScannerPairEstimate | Rejected,
    agreeing: Mapping[frozenset[str], tuple[Array, Array]],
    parents: Mapping[str, str],
) -> Edge:
    a, b = pair
    if isinstance(found, Rejected):
        return Edge(a, b, 0, 0, in_tree=False, residuals=np.zeros(0), note=found.reason)
    poses = agreeing.get(frozenset(pair))
    if poses is None:
        note = "contradicts the other pairs"
        return Edge(a, b, _shared(found.hypotheses[0]), 0, in_tree=False, residuals=np.zeros(0), note=note)
    T_root_a, T_root_b = poses if (a, b) == (found.sensor_a, found.sensor_b) else poses[::-1]
    T_a_b = se2.inverse(T_root_a) @ T_root_b
    off, right = min(
        ((float(np.linalg.norm(se2.difference(T_a_b, h.T_a_b)[:2])), h) for h in found.hypotheses),
        key=lambda found: found[0],
    )
    in_tree = parents.get(a) == b or parents.get(b) == a
    return Edge(a, b, _shared(right), right.observations, in_tree=in_tree, residuals=np.array([off]))


def _shared(hypothesis: PoseHypothesis) -> int:
    """How many positions both scanners should have seen, were the hypothesis right."""
    return round(hypothesis.observations / hypothesis.matched_share)


def _why_alone(name: str, followed: Mapping[str, Tracked | Rejected], pairs: NetworkPairs) -> str:
    own = followed[name]
    if isinstance(own, Rejected):
        return own.reason
    reasons: dict[str, list[str]] = {}
    for (a, b), found in pairs.items():
        if name in (a, b) and isinstance(found, Rejected):
            reasons.setdefault(found.reason, []).append(b if a == name else a)
    said = "; ".join(f"{', '.join(others)}: {why}" for why, others in reasons.items())
    return f"followed {len(own.tracks)} tracks, but {said or 'no other scanner did'}"
