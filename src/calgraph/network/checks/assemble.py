"""Assembles the Calibration of a network: poses lifted to SE(3), with the evidence of every pair."""

import re
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from types import MappingProxyType

import numpy as np
from numpy.typing import NDArray

from calgraph.config import Lidar2dSpec, Rig
from calgraph.errors import Rejected
from calgraph.geometry import Array, Index, diagonal_blocks, se2
from calgraph.graph.pose_graph import PoseGraph
from calgraph.graph.spanning_tree import walk_tree
from calgraph.network.checks.remedies import find_network_remedies
from calgraph.network.graph.network_graph import compute_joint_covariance
from calgraph.network.graph.network_initialization import NetworkInitialization
from calgraph.network.joint.body_equations import predict_beams
from calgraph.network.joint.error_sources import compute_error_budget
from calgraph.network.joint.estimate import NetworkSolution
from calgraph.network.joint.planar_poses import lift_covariance
from calgraph.network.joint.problem import BodyObservations, BodyPath, NetworkProblem, NetworkState
from calgraph.network.joint.track_association import MAX_DISTANCE
from calgraph.network.pairs.hypothesis_evidence import PoseHypothesis
from calgraph.network.pairs.scanner_pair import ScannerPairEstimate, ScannerPairs
from calgraph.network.pairs.synchronized_tracks import (
    TICK_PERIOD,
    SimultaneousPairs,
    TrackSamples,
    pair_samples,
    resample_tracks,
)
from calgraph.network.tracking.track import ScannerTracks, correct_tracks
from calgraph.result import (
    BeamView,
    Calibration,
    CaptureRow,
    Edge,
    ErrorBudget,
    Evidence,
    FitError,
    FloorView,
    ModelledBodies,
    Pictures,
    Remedy,
    SensorPose,
    StatedPose,
)
from calgraph.result.finding import Finding
from calgraph.verdict.grades import LONE_ROOT, collect_findings, grade_pose, select_reasons

_ADVICE = "let people walk farther and in more directions where the views of scanners overlap"
# Partners that a reason names: a scanner of a large network that no pair connects has up to 150.
_LISTED_PARTNERS = 8
_DIGITS = re.compile(r"[0-9.]+")


# Ticks (TICK_PERIOD of pairs) at which another scanner has to track a walk for the report to call it shared: half
# a second, one step.
_MIN_SHARED_TICKS = 5


def assemble_network(
    rig: Rig,
    frames: Mapping[str, str],
    followed: Mapping[str, ScannerTracks | Rejected],
    initialization: NetworkInitialization,
    start: float,
    joint: NetworkSolution | None = None,
    findings: Sequence[Finding] = (),
    *,
    averaged_variance: float = 1.0,
    clock_offset: Mapping[str, float] = MappingProxyType({}),
    inverted: Collection[str] = (),
) -> Calibration:
    """Assembles the calibration of a network.

    Args:
        rig: the network.
        frames: frame_id by scanner, as its messages state it.
        followed: the tracks of each scanner, or why it has none.
        initialization: averaged poses of the connected scanners, and the pairs.
        start: of the recording, s.
        joint: the joint solution, if there is one; its poses and clocks replace the averaged ones.
        findings: what does not fit the rig in the messages of the recording, and what contradicts the solution.
        averaged_variance: variances of averaged poses and clocks over those of pairs; 1 with a joint solution.
        clock_offset: by which the times of tracks were corrected, s.
        inverted: scanners whose tracks were mirrored, as they are mounted the other way up than the root.
    """
    tracked = {name: tracks for name, tracks in followed.items() if isinstance(tracks, ScannerTracks)}
    names, averaged = initialization.names, initialization.solution
    clocks = initialization.average_clocks() if joint is None else joint.clocks
    remaining_offset = dict(zip(names, np.nan_to_num(clocks[:, 0]).tolist(), strict=True))
    samples = {
        name: resample_tracks(correct_tracks(one, clock_offset=remaining_offset.get(name, 0.0)))
        for name, one in tracked.items()
    }
    T_root_scanner = averaged.T_root_node if joint is None else joint.T_root_scanner
    planar = dict(zip(names, T_root_scanner, strict=True))
    matches = match_across_scanners(samples, planar)
    inliers = initialization.graph.select_edges(averaged.inliers)
    covariance = lift_covariance(
        averaged_variance * compute_joint_covariance(inliers, averaged.T_root_node)
        if joint is None
        else joint.pose_covariance
    )
    clocks[:, 1] *= np.sqrt(averaged_variance)
    clocks[:, 0] += [clock_offset.get(name, 0.0) for name in names]
    # A rotation by 180° about the x axis of the mirrored frame.
    flips = np.array([np.diag([1.0, -1.0, -1.0, 1.0]) if name in inverted else np.eye(4) for name in names])
    beam_views, fit = ((), {}) if joint is None else collect_beam_views(joint, names, start)
    T_root_sensor = se2.to_se3(T_root_scanner) @ flips
    budget = compute_error_budget(joint, names, T_root_sensor) if joint else None
    remedies = find_network_remedies(rig, joint, names, T_root_sensor) if joint else ()
    parents = find_parents(inliers, names)
    inlier_poses = {(names[i], names[j]): (T_root_scanner[i], T_root_scanner[j]) for i, j in inliers.edges}
    return Calibration(
        root=rig.root,
        sensors=_assemble_poses(
            rig, frames, parents, dict(zip(names, T_root_sensor, strict=True)),
            covariance, clocks, collect_findings(findings), budget, remedies,
        ),
        joint_covariance=covariance,
        systematic=joint.systematic.summarize(names) if joint and joint.systematic else (),
        budget=budget,
        evidence=Evidence(
            estimator="averaging" if joint is None else "joint",
            bodies=_describe_bodies(joint) if joint else None,
            tolerance=rig.tolerance,
            edges=tuple(
                build_edge(pair, found, inlier_poses, parents) for pair, found in initialization.pairs.items()
            ),
            captures=build_walk_rows(samples, matches, start),
            unconnected={
                name: explain_unconnected(name, rig.root, followed, initialization.pairs)
                for name in rig.sensors
                if name not in names
            },
            remarks=tuple(finding.text for finding in findings),
            residuals={"positions": matches.residuals.ravel()} if len(matches.residuals) else {},
            fit=fit,
            remedies=remedies,
            initial_poses={}
            if joint is None
            else dict(zip(names, se2.to_se3(averaged.T_root_node) @ flips, strict=True)),
        ),
        pictures=Pictures(floor_views=build_floor_views(tracked, samples, planar, start), beam_views=beam_views),
    )  # fmt: skip


def _assemble_poses(
    rig: Rig,
    frames: Mapping[str, str],
    parents: Mapping[str, str],
    T_root_sensor: Mapping[str, Array],
    covariance: Array,
    clocks: Array,
    reasons: Mapping[str, Sequence[str]],
    budget: ErrorBudget | None,
    remedies: Sequence[Remedy],
) -> tuple[SensorPose, ...]:
    """Graded poses, from their joint covariance (6n, 6n) and (n, 2) clock offsets with standard deviations, s."""
    stated = _collect_stated_poses(rig, T_root_sensor)
    return tuple(
        SensorPose(
            name=name,
            parent=parents.get(name),
            frame_id=rig.sensors[name].frame_id or frames[name] or name,
            kind="lidar2d",
            T_root_sensor=T,
            verdict=LONE_ROOT
            if len(T_root_sensor) == 1
            else grade_pose(
                name,
                "lidar2d",
                T,
                np.nan_to_num(block),  # what is not measured has no verdict
                reasons.get(name, ()),
                tolerance=rig.tolerance,
                settings=rig.settings.diagnostics.verdict,
                data="tracks",
                advice=_ADVICE,
                shares=budget.shares_by_source(k) if budget else {},
                remedy=next((one for one in remedies if one.sensor == name), None),
            ),
            stated=stated.get(name),
            clock_offset=_finite_or_none(offset),
            clock_offset_stddev=_finite_or_none(stddev),
        )
        for k, ((name, T), block, (offset, stddev)) in enumerate(
            zip(T_root_sensor.items(), diagonal_blocks(covariance, 6), clocks, strict=True)
        )
    )


def _describe_bodies(joint: NetworkSolution) -> ModelledBodies | None:
    if joint.solved is None or not (bodies := joint.solved.network.bodies):
        return None
    return ModelledBodies(bodies[0].kind, len(bodies))


def _collect_stated_poses(rig: Rig, T_root_sensor: Mapping[str, Array]) -> dict[str, StatedPose]:
    """What rig.yaml states of heights and tilts, for all scanners if for any."""
    specs = {name: spec for name, spec in rig.sensors.items() if isinstance(spec, Lidar2dSpec)}
    if all(value is None for one in specs.values() for value in (one.height, one.roll, one.pitch)):
        return {}
    root_inverted = specs[rig.root].mounting == "inverted"
    return {
        name: StatedPose(
            specs[name].height,
            float(np.radians(specs[name].roll or 0.0)),
            float(np.radians(specs[name].pitch or 0.0)),
            root_inverted != bool(T[2, 2] < 0),
        )
        for name, T in T_root_sensor.items()
    }


def _finite_or_none(value: float) -> float | None:
    return float(value) if np.isfinite(value) else None


def find_parents(inliers: PoseGraph, names: tuple[str, ...]) -> dict[str, str]:
    """Each scanner's neighbour on the way to the root, over the edges with the most information."""
    by_information = np.argsort(-np.linalg.eigvalsh(inliers.information)[:, 0], kind="stable")
    tree = walk_tree(len(names), inliers.edges[by_information].tolist(), [0])
    return {names[step.child]: names[step.parent] for step in tree}


def build_edge(
    pair: tuple[str, str],
    found: ScannerPairEstimate | Rejected,
    inlier_poses: Mapping[tuple[str, str], tuple[Array, Array]],
    parents: Mapping[str, str],
) -> Edge:
    """The evidence of a pair, or why there is none.

    Args:
        pair: names of its scanners.
        found: of it.
        inlier_poses: (3, 3) of both scanners of the pairs that agree with the solution.
        parents: of scanners in the tree.
    """
    a, b = pair
    if isinstance(found, Rejected):
        return Edge(a, b, 0, 0, in_tree=False, residuals=np.zeros(0), note=found.reason)
    poses = inlier_poses.get(pair)
    if poses is None:
        note = "contradicts the other pairs"
        shared = _count_shared(found.hypotheses[0])
        return Edge(a, b, shared, 0, in_tree=False, residuals=np.zeros(0), note=note)
    T_a_b = se2.inverse(poses[0]) @ poses[1]
    distance, nearest = min(
        ((float(np.linalg.norm(se2.difference(T_a_b, h.T_a_b)[:2])), h) for h in found.hypotheses),
        key=lambda candidate: candidate[0],
    )
    in_tree = parents.get(a) == b or parents.get(b) == a
    shared = _count_shared(nearest)
    return Edge(a, b, shared, nearest.observations, in_tree=in_tree, residuals=np.array([distance]))


def _count_shared(hypothesis: PoseHypothesis) -> int:
    """How many positions both scanners are expected to detect under the hypothesis."""
    return round(hypothesis.observations / hypothesis.matched_share)


def explain_unconnected(
    name: str, root: str, followed: Mapping[str, ScannerTracks | Rejected], pairs: ScannerPairs
) -> str:
    """Why a scanner has no pose, from its tracks and its pairs with all others."""
    tracks, of_root = followed[name], followed[root]
    if isinstance(tracks, Rejected):
        return tracks.reason
    if isinstance(of_root, Rejected):
        return f"the root {root} is not calibrated: {of_root.reason}"
    # Reasons that differ in numbers only are one, in the words of the first partner.
    partners_by_reason: dict[str, tuple[str, list[str]]] = {}
    for (a, b), found in pairs.items():
        if name in (a, b) and isinstance(found, Rejected):
            _, partners = partners_by_reason.setdefault(_DIGITS.sub("", found.reason), (found.reason, []))
            partners.append(b if a == name else a)
    # In large networks, most partners have a reason that all distant scanners have: rare reasons come first.
    by_number = sorted(partners_by_reason.values(), key=lambda item: len(item[1]))
    stated, more = select_reasons(
        [f"{_list_partners(partners)}: {reason}" for reason, partners in by_number], where="in the report"
    )
    reasons = "; ".join([*stated, *more])
    count = len(tracks.tracks)
    if not count:
        return f"no person was tracked; {reasons or 'no other sensor has any'}"
    return f"has {count} track{'s' * (count != 1)}, but {reasons or 'no other sensor has any'}"


def _list_partners(names: Sequence[str]) -> str:
    """Names of scanners; the number of those beyond the first ones."""
    listed = ", ".join(names[:_LISTED_PARTNERS])
    return f"{listed} and {len(names) - _LISTED_PARTNERS} others" if len(names) > _LISTED_PARTNERS else listed


# Beams that are kept of a scanner, and in all: more do not change what a picture shows.
_MAX_BEAMS, _MAX_BEAMS_IN_ALL = 3000, 60_000
# That are collected for each of these at least, if a scanner has as many.
_ROWS_PER_BEAM = 4


def collect_beam_views(
    joint: NetworkSolution, names: Sequence[str], start: float
) -> tuple[tuple[BeamView, ...], dict[str, FitError]]:
    """Residuals of each scanner's inlier beams, thinned for pictures, and their number and RMS.

    Args:
        joint: the joint solution.
        names: of its scanners.
        start: of the recording by the root's clock, s.
    """
    if joint.solved is None:
        return (), {}
    solved = joint.solved
    measured = solved.network.count_beams()
    limit = min(_MAX_BEAMS, _MAX_BEAMS_IN_ALL // max(int(np.count_nonzero(measured)), 1))
    # Rows of one body are in order of time, those of all are not: each scanner's are thinned again.
    list_rows = partial(_list_inlier_rows, step=1 + measured // (_ROWS_PER_BEAM * limit))
    by_scanner: dict[int, list[tuple[int, float, Array]]] = {}
    for of_body in solved.batches.map(list_rows, solved.network, solved.state):
        for scanner, *of_scanner in of_body:
            by_scanner.setdefault(scanner, []).append(of_scanner)
    views, fit = [], {}
    for scanner, parts in sorted(by_scanner.items()):
        counts, squares, thinned = zip(*parts, strict=True)
        if count := sum(counts):
            rows = np.concatenate(thinned)
            fit[names[scanner]] = FitError(count, "m", float(np.sqrt(sum(squares) / count)))
            rows = rows[np.argsort(rows[:, 0], kind="stable")]
            rows = rows[:: len(rows) // limit + 1]
            times = rows[:, 0] - float(joint.clock_offset[scanner]) - start
            views.append(BeamView(names[scanner], times, rows[:, 1:3], rows[:, 3]))
    return tuple(views), fit


def _list_inlier_rows(
    network: NetworkProblem, state: NetworkState, body: BodyObservations, path: BodyPath, step: Index
) -> list[tuple[int, int, float, Array]]:
    """Each scanner's inlier beams on a body: their number, sum of squared residuals, and every n-th (S,) row.

    A row is time by the scanner's clock, end of the beam, and measured minus predicted range.
    """
    listed = []
    for beams in predict_beams(network, state, body, path):
        scans = beams.scans
        time, residual = scans.times[beams.scan] + scans.beam_delay, -beams.residual * beams.sigma
        rows = np.column_stack([time, scans.direction * scans.ranges[:, None], residual])[scans.weight > 0]
        thinned = rows[:: step[scans.scanner]].copy()
        listed.append((scans.scanner, len(rows), float(rows[:, 3] @ rows[:, 3]), thinned))
    return listed


# Sizes of the report, for pages of a few megabytes: whitened residuals of the histogram, static points and
# positions of the floor plan.
_MAX_RESIDUALS, _MAX_POINTS, _MAX_POSITIONS = 20_000, 12_000, 30_000
# Size of the cells that static points are thinned to, m, a pixel of the floor plan; lines of walks are split at
# longer gaps, ticks.
_CELL_SIZE = 0.03
_MAX_GAP_TICKS = 10


@dataclass(frozen=True, eq=False)
class CrossScannerMatches:
    """Positions that several scanners of a network detected at the same time."""

    distance: Mapping[str, Array]
    """(S,) by scanner, from each of its samples to its nearest match, m; infinite without a match."""
    others_active: Mapping[str, NDArray[np.bool_]]
    """(S,) by scanner, whether another scanner detected a person at that time, anywhere."""
    residuals: Array
    """(R, 2) differences of matched positions, in standard deviations."""


def match_across_scanners(
    samples: Mapping[str, TrackSamples], T_root_scanner: Mapping[str, Array]
) -> CrossScannerMatches:
    """Matches the samples of all pairs of connected scanners that detected anything near each other.

    Args:
        samples: by scanner; those without a pose are left out.
        T_root_scanner: poses (3, 3) of the connected scanners.
    """
    names = [name for name in samples if name in T_root_scanner]
    distance = {name: np.full(len(samples[name].tick), np.inf) for name in names}
    residuals = [np.zeros((0, 2))]
    for a, b in _list_near_scanners(names, samples, T_root_scanner):
        both = pair_samples(samples[a], samples[b])
        offset = se2.apply(T_root_scanner[a], both.x_a) - se2.apply(T_root_scanner[b], both.x_b)
        d = np.linalg.norm(offset, axis=-1)
        matched = np.flatnonzero(d < MAX_DISTANCE)
        matched = matched[both.are_mutual_nearest(matched, d[matched])] if len(matched) else matched
        np.minimum.at(distance[a], both.row_a[matched], d[matched])
        np.minimum.at(distance[b], both.row_b[matched], d[matched])
        residuals.append(_whiten(offset, both, matched, T_root_scanner[a], T_root_scanner[b]))
    pooled = np.concatenate(residuals)
    ticks, scanners = np.unique(
        np.concatenate([np.zeros(0, dtype=np.intp), *(np.unique(samples[name].tick) for name in names)]),
        return_counts=True,
    )
    others_active = {name: np.isin(samples[name].tick, ticks[scanners > 1]) for name in names}
    return CrossScannerMatches(distance, others_active, pooled[:: len(pooled) // _MAX_RESIDUALS + 1])


def _list_near_scanners(
    names: Sequence[str], samples: Mapping[str, TrackSamples], T_root_scanner: Mapping[str, Array]
) -> Iterator[tuple[str, str]]:
    """Pairs of scanners the bounding boxes of whose positions in the root frame are within the distance."""
    names = [name for name in names if len(samples[name].tick)]
    positions = [se2.apply(T_root_scanner[name], samples[name].positions) for name in names]
    low = np.array([x.min(axis=0) for x in positions]).reshape(-1, 2) - MAX_DISTANCE
    high = np.array([x.max(axis=0) for x in positions]).reshape(-1, 2)
    for k, name in enumerate(names):
        near = np.all((low[k + 1 :] <= high[k]) & (low[k] <= high[k + 1 :]), axis=1)
        yield from ((name, names[k + 1 + other]) for other in np.flatnonzero(near).tolist())


def _whiten(
    offset: Array, both: SimultaneousPairs, matched: NDArray[np.intp], T_root_a: Array, T_root_b: Array
) -> Array:
    R_a, R_b = T_root_a[:2, :2], T_root_b[:2, :2]
    S_a, S_b = both.a.covariances[both.row_a[matched]], both.b.covariances[both.row_b[matched]]
    root = np.linalg.cholesky(R_a @ S_a @ R_a.T + R_b @ S_b @ R_b.T)
    return np.asarray(np.linalg.solve(root, offset[matched, :, None])[..., 0])


def build_walk_rows(
    samples: Mapping[str, TrackSamples], matches: CrossScannerMatches, start: float
) -> tuple[CaptureRow, ...]:
    """One row for each scanner and walk, in order of time: whether another scanner detected it too, or why not.

    Args:
        samples: by scanner.
        matches: of the connected ones among them.
        start: of the recording, s.
    """
    rows = [
        (
            float(of_scanner.times[walk[0]]) - start,
            float(of_scanner.times[walk[-1]]) - start,
            name,
            *_assess_walk(name, walk, matches),
        )
        for name, of_scanner in samples.items()
        for walk in _split_walks(of_scanner)
    ]
    return tuple(CaptureRow(n, *row) for n, row in enumerate(sorted(rows, key=lambda row: row[:3])))


def _assess_walk(
    name: str, walk: NDArray[np.intp], matches: CrossScannerMatches
) -> tuple[bool, str, float | None]:
    """Whether the samples of a walk have matches, why not, and their RMS distance, m."""
    if name not in matches.distance:
        return False, "its sensor is not calibrated", None
    d = matches.distance[name][walk]
    d = d[np.isfinite(d)]
    if len(d) >= _MIN_SHARED_TICKS:
        return True, "", float(np.sqrt(np.mean(d**2)))
    if len(d):
        return False, f"another sensor detected it for less than {_MIN_SHARED_TICKS * TICK_PERIOD:g} s", None
    if matches.others_active[name][walk].any():
        return (
            False,
            f"other sensors detected people at that time, but not within {MAX_DISTANCE:g} m of it",
            None,
        )
    return False, "no other sensor detected a person at that time", None


def _split_walks(samples: TrackSamples) -> Iterator[NDArray[np.intp]]:
    """The rows of each walk, ascending in time."""
    order = np.argsort(samples.trajectory, kind="stable")
    cuts = np.flatnonzero(np.diff(samples.trajectory[order])) + 1
    return (rows for rows in np.split(order, cuts) if len(rows))


def build_floor_views(
    tracked: Mapping[str, ScannerTracks],
    samples: Mapping[str, TrackSamples],
    T_root_scanner: Mapping[str, Array],
    start: float,
) -> tuple[FloorView, ...]:
    """Static points and walks of each connected scanner in the root frame, thinned for a floor plan.

    Args:
        tracked: by scanner.
        samples: of the same.
        T_root_scanner: poses (3, 3) of the connected scanners.
        start: of the recording, s.
    """
    names = [name for name in tracked if name in T_root_scanner]
    lines = {name: list(_split_lines(samples[name], _MAX_POSITIONS // len(names))) for name in names}
    return tuple(
        FloorView(
            name,
            se2.apply(T_root_scanner[name], _thin_points(tracked[name].background, _MAX_POINTS // len(names))),
            tuple(se2.apply(T_root_scanner[name], samples[name].positions[rows]) for rows in lines[name]),
            tuple(np.asarray(samples[name].times[rows] - start) for rows in lines[name]),
        )
        for name in names
    )


def _thin_points(points: Array, limit: int) -> Array:
    """At most ``limit`` of the finite ones of points (M, 2), one in each cell."""
    points = points[np.isfinite(points).all(axis=1)]
    _, first = np.unique(np.round(points / _CELL_SIZE).astype(np.int64), axis=0, return_index=True)
    return np.asarray(points[np.sort(first)][:: len(first) // max(limit, 1) + 1])


def _split_lines(samples: TrackSamples, limit: int) -> Iterator[NDArray[np.intp]]:
    """Rows of the lines of all walks, thinned to at most ``limit`` samples in total."""
    step = max(3, len(samples.tick) // max(limit, 1) + 1)
    for rows in _split_walks(samples):
        for part in np.split(rows, np.flatnonzero(np.diff(samples.tick[rows]) > _MAX_GAP_TICKS) + 1):
            if len(part) > step:
                yield part[::step]
