"""The two stories, one screen each: from a recording to a calibrated tree of transforms."""

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any, Literal, get_args

import numpy as np

from calgraph.captures import (
    ActivityMeter,
    Captured,
    Timeline,
    as_scans,
    check_timeline,
    details,
    detectors,
    find_holds,
    gather,
    is_snapshots,
    learn_backgrounds,
    observe,
    survey,
    thinned,
)
from calgraph.detection import Averaging
from calgraph.errors import CalibrationError, InputError
from calgraph.graph import Method, SpanningTree, Start, average_network, network_graph, start_poses, trust
from calgraph.pairwise import TrackPair, estimate_network_pairs, estimate_pairs, estimated, reconsider_pairs
from calgraph.recording import Recording, read_cameras
from calgraph.refinement import (
    Audit,
    Estimable,
    Estimator,
    Filter,
    Joint,
    PriorFile,
    Problem,
    RigidFile,
    Scatter,
    Solver,
    Tolerance,
    agreed_prior,
    assemble,
    assemble_network,
    attached,
    audit,
    audit_network,
    earlier_poses,
    extended,
    knowing,
    replayable,
    resample,
    save_problem,
    solve_bundle,
    solve_hypergraph,
    solve_network,
    with_outlook,
    without,
)
from calgraph.result import Calibration, KnownPoses
from calgraph.rig import CameraSpec, Cylinder, Lidar2dSpec, People, Rig
from calgraph.sensors import LaserScan, Record
from calgraph.tracking import Feature, Tracked, Untracked, track_scanner

# How far off along the sight the centres may lie that each feature gives, as a standard deviation, m. A centre of
# mass lies three quarters of the radius before the centre.
DEPTHS: Mapping[Feature, float] = {"com": 0.2, "ellipse": 0.05, "nls": 0.03}

NetworkEstimator = Literal["joint", "averaging"]
Weights = Literal["uniform", "weighted"]
Progress = Callable[[str, float], None]
"""Called with the name of the step under way and how much of it is done, 0..1."""


def silent(_step: str, _done: float) -> None:
    """Progress for nobody."""


@dataclass(frozen=True)
class Options:
    """How to calibrate."""

    estimator: Estimator | NetworkEstimator | None = None
    """The joint solution. Rigs: bundle, in the units that are measured, or the paper's hypergraph. Networks:
    joint, with clocks and paths, or the paper's averaging of pairs. If left out, the first of them."""
    estimate: tuple[Estimable, ...] = ()
    """What a rig's joint solution estimates besides poses: range biases, intrinsics, tags' places."""
    prior: PriorFile | None = None
    """Where a rig's sensors are about."""
    rigid: tuple[RigidFile, ...] = ()
    """Which of a rig's sensors are fixed to each other, and how."""
    keep: Filter = "ransac"
    """Which matches of two sensors to use: those that agree (ransac), or all (none)."""
    folds: int = Solver().folds
    """In how many parts a rig's captures are left out for cross-validation; 0 for none."""
    start: Start = "tree"
    """Where a rig's joint solution starts: its spanning tree, the identity, or all pairs averaged by a method."""
    tags: Averaging = "pnp"
    """A camera's plane: one PnP over all tags' corners, or the paper's average over tags (mean_plane)."""
    feature: Feature = "nls"
    """What of a person is followed: centre of mass, direct ellipse, or ellipse of fixed radii (nls)."""
    average: Method = "consensus"
    """How a network's pairs become poses: consensus over trees, or one of the published rotation averagings."""
    weights: Weights = "weighted"
    """Trust in a network's pairs: by the evidence for each, or uniform."""
    icp: bool = True
    """Whether a network's walls are matched, too."""
    extend: Calibration | None = None
    """An earlier calibration of a network, to which recordings or scanners are added."""
    moved: tuple[str, ...] = ()
    """Scanners that have moved since, and are found anew."""
    seed: int = 0
    """Of the random samples; the same seed gives the same result."""
    dump: Path | None = None
    """File to write a rig's joint problem to before it is solved."""


def calibrate(rig: Rig, recording: Recording, options: Options, progress: Progress = silent) -> Calibration:
    """Calibrates a robot with a board, or a network with people, whichever the rig's target is.

    Args, Returns and Raises as for :func:`calibrate_rig`.
    """
    story = calibrate_network if isinstance(rig.target, People | Cylinder) else calibrate_rig
    return story(rig, recording, options, progress)


def calibrate_rig(rig: Rig, recording: Recording, options: Options, progress: Progress = silent) -> Calibration:
    """Calibrates a robot's sensors from one recording of a board carried around it (MSG-Cal).

    Args:
        rig: sensors, target and captures.
        recording: open recording with the rig's topics.
        options: how to calibrate.
        progress: told how far each step is.

    Returns:
        Poses, covariances and evidence of all sensors that are connected to the root; of the others, why not.

    Raises:
        InputError: the rig does not fit the recording.
        CalibrationError: there is nothing to calibrate: one sensor alone, or a board that never rests.
    """
    problem = pose_problem(rig, recording, options, progress)
    if options.dump:
        save_problem(problem, options.dump)
    return solve_problem(problem)


def pose_problem(rig: Rig, recording: Recording, options: Options, progress: Progress = silent) -> Problem:
    """From a recording to the joint problem; arguments and errors are those of :func:`calibrate_rig`."""
    if isinstance(rig.target, People | Cylinder):
        raise InputError(f"target.kind: must be board for the poses of a rig, got {rig.target.kind}")
    if options.extend or options.moved:
        raise InputError("--extend and --moved: are for networks; a rig's earlier calibration is a --prior")
    _check_estimator(_rig_estimator(options), bool(options.prior or options.rigid), options.estimate)
    rng = np.random.default_rng(options.seed)
    captured = capture_board(rig, recording, options, rng, progress)
    return prepare(rig, captured, options, rng, progress)


def capture_board(
    rig: Rig, recording: Recording, options: Options, rng: np.random.Generator, progress: Progress = silent
) -> Captured:
    """Finds the times at which the board rests, and the board in what every sensor measured then."""
    if len(rig.sensors) < 2:
        raise CalibrationError(
            f"{rig.root} is the only sensor: a rig.yaml needs two, one to calibrate the other to"
        )
    cameras = read_cameras(rig, recording)
    timeline = _survey(rig, recording, progress)
    check_timeline(rig, timeline, recording.end)
    holds = thinned(find_holds(timeline, rig.capture), rig)
    backgrounds = learn_backgrounds(_empty_room(rig, recording), rig)
    detect = detectors(rig, cameras, backgrounds, options.tags, rng)

    def detecting(done: float) -> None:
        progress("detecting", done / (len(holds) * len(rig.sensors)))

    observations = observe(
        recording.records(rig.topics.values()), holds, rig.topics, detect,
        keep=details(holds, rig), progress=detecting,
    )  # fmt: skip
    return gather(rig, timeline, holds, observations, cameras)


def prepare(
    rig: Rig, captured: Captured, options: Options, rng: np.random.Generator, progress: Progress = silent
) -> Problem:
    """From detections to the joint problem: every pair, and the tree they span."""
    seen = captured.detections
    pairs = estimate_pairs(seen, rig.board_size, rng, lambda done: progress("pairing", done))
    tree = start_poses(rig.root, estimated(pairs), options.start, rng)
    if options.keep == "ransac":
        # What three captures could not tell apart, all of them can: select once more under a joint solution.
        joint = solve_hypergraph(tree, estimated(pairs), seen, keep=options.keep)
        pairs = reconsider_pairs(pairs, joint.T_root_sensor, seen, rig.board_size)
        tree = start_poses(rig.root, estimated(pairs), options.start, rng)
    solver = Solver(
        estimator=_rig_estimator(options), keep=options.keep, folds=options.folds, estimate=options.estimate
    )
    return replayable(knowing(Problem(rig, captured, pairs, tree, solver), options.prior, options.rigid))


def solve_problem(problem: Problem) -> Calibration:
    """From the joint problem to a calibration: all sensors at once. The same problem gives the same bits."""
    joint, tree = _solved(problem)
    rig, calibration = problem.rig, assemble(problem.rig, problem.captured, problem.pairs, tree, joint)
    if joint.adjusted is None:
        return calibration
    # The boards that are tried need no seed of the user's: any draw of so many serves.
    return with_outlook(
        calibration, joint.adjusted, rig.board_size, problem.solver.folds, np.random.default_rng(0)
    )


def verify_problem(
    problem: Problem, rounds: int, rng: np.random.Generator, progress: Progress = silent
) -> tuple[Calibration, dict[str, Scatter]]:
    """A calibration, and by sensor how far its pose scatters when the captures are drawn anew.

    Raises:
        CalibrationError: no two sensors saw the board together.
    """
    problem = replace(problem, solver=problem.solver.model_copy(update={"estimator": "bundle"}))
    joint, tree = _solved(problem)
    if joint.adjusted is None:
        raise CalibrationError(
            f"there is nothing to verify: no sensor is connected to the root {problem.rig.root}"
        )
    scatter = resample(joint.adjusted, rounds, rng, lambda done: progress("resampling", done))
    return assemble(problem.rig, problem.captured, problem.pairs, tree, joint), scatter


def audit_problem(
    problem: Problem, given: KnownPoses, tolerance: Tolerance | None = None
) -> tuple[Calibration, Audit]:
    """What the captures say of given extrinsics: a calibration that knows nothing of them, and the comparison.

    Raises:
        InputError: the extrinsics lack the root, or nothing fixed connects the sensors there.
    """
    unknowing = {"estimator": "bundle", "priors": (), "groups": ()}
    problem = replace(problem, solver=problem.solver.model_copy(update=unknowing))
    joint, tree = _solved(problem)
    calibration = assemble(problem.rig, problem.captured, problem.pairs, tree, joint)
    return calibration, audit(calibration, joint.adjusted, given, tolerance)


def check_network(
    rig: Rig,
    recording: Recording,
    given: KnownPoses,
    options: Options,
    tolerance: Tolerance | None = None,
    progress: Progress = silent,
) -> tuple[Calibration, Audit]:
    """What a recording says of the given poses of a network, as :func:`audit_problem` does of a rig's."""
    calibration = calibrate_network(rig, recording, options, progress)
    return calibration, audit_network(calibration, given, tolerance)


def _solved(problem: Problem) -> tuple[Joint, SpanningTree]:
    """The joint solution, and the tree that it started from."""
    rig, captured, pairs, solver = problem.rig, problem.captured, problem.pairs, problem.solver
    _check_estimator(solver.estimator, bool(solver.priors or solver.groups), solver.estimate)
    tree = attached(problem.tree, estimated(pairs), solver.priors, solver.groups)
    if solver.estimator == "bundle":
        joint = solve_bundle(
            rig, captured, estimated(pairs), tree.T_root_sensor,
            keep=solver.keep, estimate=solver.estimate, priors=solver.priors, groups=solver.groups,
        )  # fmt: skip
    else:
        joint = solve_hypergraph(tree, estimated(pairs), captured.detections, keep=solver.keep)
    return joint, tree


def _rig_estimator(options: Options) -> Estimator:
    estimator: Estimator = _chosen(options.estimator, get_args(Estimator), "a rig with a board")
    return estimator


def _check_estimator(estimator: Estimator, known: bool, estimate: Sequence[Estimable]) -> None:
    if estimate and estimator != "bundle":
        raise InputError(f"--estimate: goes with --estimator bundle, got {estimator}")
    if known and estimator != "bundle":
        raise InputError(f"--prior and --rigid: go with --estimator bundle, got {estimator}")


def calibrate_network(
    rig: Rig, recording: Recording, options: Options, progress: Progress = silent
) -> Calibration:
    """Calibrates stationary 2-D scanners from people who walk through their views (lrf-network).

    Args, Returns and Raises as for :func:`calibrate_rig`.
    """
    if options.dump:
        raise InputError("--dump: only the problem of a rig with a board can be written, not that of a network")
    if options.estimate:
        raise InputError("--estimate: is for rigs with a board, not for networks")
    if options.prior or options.rigid:
        raise InputError("--prior and --rigid: are for rigs with a board, not for networks")
    estimator = _chosen(options.estimator, get_args(NetworkEstimator), "a network")
    old = _earlier(rig, options, estimator)
    rng = np.random.default_rng(options.seed)
    followed, frames = follow_people(rig, recording, options, progress)
    tracked = {name: found for name, found in followed.items() if isinstance(found, Tracked)}
    depth = DEPTHS[options.feature]
    pairs = estimate_network_pairs(
        tracked, rng, icp=options.icp, depth=depth, progress=lambda done: progress("pairing", done)
    )
    known = [pair for pair in pairs.values() if isinstance(pair, TrackPair)]
    graph, names = network_graph(rig.root, known)
    weights = trust(names, known) if options.weights == "weighted" else None
    averaged, graph = average_network(graph, rng, options.average, weights)
    joint = prior = None
    # A root that nothing is connected to may not even have been followed.
    if estimator == "joint" and len(names) > 1:
        progress("solving", 0.0)
        solution = partial(solve_network, _walking(rig), [tracked[name] for name in names], averaged, graph)
        joint = solution()
        if old:
            prior = agreed_prior(earlier_poses(old, rig.root), names, joint)
            joint = solution(prior=prior)
        progress("solving", 1.0)
    found = assemble_network(rig, frames, followed, pairs, graph, names, averaged, recording.start, joint)
    if old is None:
        return found
    if prior is None:
        why = "; ".join(f"{name}: {reason}" for name, reason in found.unconnected.items())
        raise CalibrationError(f"nothing to extend with: no scanner is connected to the root {rig.root} ({why})")
    return extended(found, old, prior)


def _earlier(rig: Rig, options: Options, estimator: NetworkEstimator) -> Calibration | None:
    """What is to be extended, without what has moved since."""
    if options.extend is None:
        if options.moved:
            raise InputError("--moved: goes with --extend")
        return None
    if estimator != "joint":
        raise InputError(f"--extend: goes with --estimator joint, got {estimator}")
    earlier_poses(options.extend, rig.root)
    return without(options.extend, options.moved)


def _chosen(estimator: str | None, known: Sequence[str], what: str) -> Any:
    """The estimator that was asked for, the first one if none was."""
    if estimator not in (None, *known):
        raise InputError(f"--estimator: {what} has {' and '.join(known)}, got {estimator}")
    return estimator or known[0]


def follow_people(
    rig: Rig, recording: Recording, options: Options, progress: Progress = silent
) -> tuple[dict[str, Tracked | Untracked], dict[str, str]]:
    """What moved through each scanner's view, and the frames that their messages state."""
    target = _walking(rig)
    followed: dict[str, Tracked | Untracked] = {}
    frames: dict[str, str] = {}
    for done, (name, spec) in enumerate(rig.sensors.items()):
        progress("following", done / len(rig.sensors))
        if not isinstance(spec, Lidar2dSpec):
            raise InputError(f"sensors.{name}.kind: only 2-D scanners (lidar2d) follow people, got {spec.kind}")
        scans = partial(_scans, recording, spec.topic)
        frames[name] = next((scan.frame_id for scan in scans()), "")
        followed[name] = track_scanner(scans, target, spec.noise, feature=options.feature)
    progress("following", 1.0)
    return followed, frames


def _walking(rig: Rig) -> People | Cylinder:
    if not isinstance(rig.target, People | Cylinder):
        raise InputError("target.kind: a network needs people or cylinder")
    return rig.target


def _scans(recording: Recording, topic: str) -> Iterator[LaserScan]:
    return (scan for record in recording.records([topic]) for scan in as_scans([record.decode()]))


def _survey(rig: Rig, recording: Recording, progress: Progress) -> Timeline:
    """When every sensor measured; and where no trigger tells the holds, how much its view changed each time."""
    trigger = rig.capture.trigger
    watched = [*rig.topics.values(), *([trigger] if trigger else [])]

    def reading(arrival: float) -> None:
        progress("reading", (arrival - recording.start) / max(recording.end - recording.start, 1e-9))

    timeline = survey(recording.records(watched), recording.start, rig.topics, trigger, progress=reading)
    if trigger or is_snapshots(timeline):
        return timeline
    meters = {name: ActivityMeter() for name in rig.sensors}
    return survey(recording.records(watched), recording.start, rig.topics, None, meters=meters, progress=reading)


def _empty_room(rig: Rig, recording: Recording) -> Iterable[Record]:
    """What the scanners measured without target and operator."""
    window = rig.capture.background
    scanners = [spec.topic for spec in rig.sensors.values() if not isinstance(spec, CameraSpec)]
    return recording.records(scanners, *(recording.start + t for t in window)) if window else ()
