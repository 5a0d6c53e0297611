"""Rigs: from one recording of a board carried around a robot to its tree of transforms."""

import logging
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import partial
from types import MappingProxyType

import numpy as np

from calgraph.config import Cylinder, People, Rig, Surroundings
from calgraph.config.settings import RigStart
from calgraph.errors import CalgraphError, InputError, Rejected
from calgraph.geometry import Array
from calgraph.graph.averaging import select_averaging
from calgraph.graph.spanning_tree import SpanningTree
from calgraph.parallel.engine import parallel_call
from calgraph.parallel.processes import forked_jobs
from calgraph.parallel.progress import Progress, no_progress
from calgraph.recording import Recording, convert_images, resolve_intrinsics
from calgraph.recording.sensor_topics import check_sensor_topics
from calgraph.result import Calibration
from calgraph.result.finding import Finding
from calgraph.rig.bundle.camera_boards import align_symmetric_prints, locate_boards
from calgraph.rig.bundle.estimate import solve_bundle
from calgraph.rig.bundle.priors import attach_by_priors
from calgraph.rig.bundle.problem import Problem, SolverOptions, explain_singular_equations, with_prior_poses
from calgraph.rig.bundle.problem_file import round_trip, save_problem
from calgraph.rig.bundle.solution import RigSolution
from calgraph.rig.capture_collection import collect_captures, correct_late_views, separate_snapshots
from calgraph.rig.captures.clock_alignment import correct_by_arrival
from calgraph.rig.captures.detect import CaptureSet, state_estimated_intrinsics
from calgraph.rig.captures.empty_start import resolve_background
from calgraph.rig.captures.from_detections import GivenDetections, captures_from_detections
from calgraph.rig.checks.assemble import assemble_rig
from calgraph.rig.checks.bump_tests import describe_bumps, discard_earlier, find_bumps
from calgraph.rig.checks.cross_validation import cross_validate
from calgraph.rig.checks.drift_tests import include_drifts, measure_drifts
from calgraph.rig.checks.next_best_pose import add_drifts, add_suggestions, suggest_board_poses
from calgraph.rig.checks.pose_steps import PoseStep
from calgraph.rig.checks.remedies import find_remedies
from calgraph.rig.options import RigOptions, check_estimator
from calgraph.rig.pairs.board_pair import PairwiseEstimates, estimate_pairs, select_successful
from calgraph.rig.pairs.rig_initialization import Initialization, initialize_rig
from calgraph.rig.sensor_admission import admit_sensors, agree_mostly, refuse_impossible
from calgraph.sensors import CameraModel
from calgraph.verdict.grades import exceeds_tolerance

_log = logging.getLogger("calgraph")


def calibrate_rig(
    rig: Rig, recording: Recording, options: RigOptions = RigOptions(), progress: Progress = no_progress
) -> Calibration:
    """Calibrates a robot's sensors from one recording of a board carried around it (MSG-Cal).

    Args:
        rig: sensors, target and captures.
        recording: open recording with the rig's topics.
        options: how to calibrate.
        progress: called with the step and the fraction done.

    Returns:
        Poses, covariances and evidence of all sensors that are connected to the root; of the others, why not.

    Raises:
        InputError: the rig does not fit the recording.
        CalibrationError: there is nothing to calibrate: one sensor alone, or a board that never rests.
    """
    return _save_and_solve(build_problem(rig, recording, options, progress), options, progress)


def calibrate_detections(
    rig: Rig,
    detections: Mapping[str, Mapping[int, GivenDetections]],
    options: RigOptions = RigOptions(),
    cameras: Mapping[str, CameraModel] | None = None,
    progress: Progress = no_progress,
) -> Calibration:
    """Calibrates a robot's sensors from detections of another program, without a recording.

    Args:
        rig: sensors and board; topics and captures do not matter.
        detections: of the board, by sensor and capture; see
            :func:`calgraph.board_corners_from_pixels`,
            :func:`calgraph.plane_patch_from_points` and :func:`calgraph.segment_from_points`.
        options: how to calibrate.
        cameras: intrinsics by camera; those of the rig if left out.
        progress: called with the step and the fraction done.

    Raises:
        InputError: detections and rig do not fit together.
    """
    check_board(rig)
    captures, rng = captures_from_detections(rig, detections, cameras), np.random.default_rng(options.seed)
    return _save_and_solve(build_problem_from_captures(rig, captures, options, rng, progress), options, progress)


def _save_and_solve(problem: Problem, options: RigOptions, progress: Progress) -> Calibration:
    if options.dump:
        save_problem(problem, options.dump)
    return solve_problem(problem, options.engine.jobs, progress)


def build_problem(
    rig: Rig, recording: Recording, options: RigOptions = RigOptions(), progress: Progress = no_progress
) -> Problem:
    """Builds the joint problem from a recording; arguments and errors are those of :func:`calibrate_rig`."""
    check_board(rig)
    options.select_method(rig.settings.published)  # checked before minutes are spent on detection
    check_sensor_topics(rig, recording)
    rng = np.random.default_rng(options.seed)
    rig, recording = convert_images(rig, recording)
    rig, recording, clocks, corrected = correct_by_arrival(rig, recording, options.cache)
    recording = separate_snapshots(rig, recording)
    rig, background = resolve_background(rig, recording, options.cache)
    findings = (*corrected, *background)

    def build(recording: Recording, findings: Sequence[Finding]) -> Problem:
        captures = collect_captures(rig, recording, options, rng, progress, clocks)
        captures = replace(captures, findings=(*findings, *captures.findings))
        stated = state_estimated_intrinsics(resolve_intrinsics(rig, recording), captures)
        return build_problem_from_captures(stated, captures, options, rng, progress)

    problem = build(recording, findings)
    if rig.capture.trigger and not agree_mostly(problem):
        recording, late = correct_late_views(rig, recording, options, clocks)
        problem = build(recording, (*findings, *late)) if late else problem
    return problem


def check_board(rig: Rig) -> None:
    """Raises InputError if the target is not a board."""
    if isinstance(rig.target, People | Cylinder | Surroundings):
        raise InputError(f"target.kind: must be board for the poses of a rig, got {rig.target.kind}")


@explain_singular_equations()
def build_problem_from_captures(
    rig: Rig,
    captures: CaptureSet,
    options: RigOptions,
    rng: np.random.Generator,
    progress: Progress = no_progress,
    known: Mapping[str, Array] = MappingProxyType({}),
) -> Problem:
    """Builds the joint problem from detections: relative poses of all pairs, and the spanning tree.

    Poses ``known`` (4, 4) from an earlier solution take the place of RANSAC where most captures agree with them.
    """
    _log_captures(captures)
    captures = locate_boards(rig, captures)
    settings = rig.settings.pairwise.board
    method = options.select_method(rig.settings.published)
    pairs = estimate_pairs(
        captures.detections, rig.board_size, rng, lambda done: progress("pairing", done),
        settings=settings, known=known,
    )  # fmt: skip
    rig, captures, pairs = admit_sensors(rig, captures, pairs, rng.spawn(1)[0], options)
    start = _select_initialization(method.start)
    tree = initialize_rig(rig.root, select_successful(pairs), start, rng, settings.max_stddev)
    captures = align_symmetric_prints(rig, captures, tree.T_root_sensor)
    _log_pairs(pairs)
    solver = SolverOptions(estimator=method.estimator, keep=method.keep, folds=options.folds)
    return round_trip(with_prior_poses(Problem(rig, captures, pairs, tree, solver), options.prior, options.rigid))


@explain_singular_equations()
def solve_problem(problem: Problem, jobs: int = 1, progress: Progress = no_progress) -> Calibration:
    """Solves the joint problem: the calibration of all sensors, bit-identical for one problem.

    Args:
        problem: to solve.
        jobs: maximum number of processes; see :class:`calgraph.parallel.engine.Processes`.
        progress: called with the step and the fraction done.

    Raises:
        CalibrationError: its equations are singular.
    """
    progress("solving", 0.0)
    problem, joint, tree = solve_after_bumps(problem)
    progress("solving", 1.0)
    if joint.solved_bundle is None:
        return assemble_rig(problem, tree, joint)
    rig, folds, solved = problem.rig, problem.solver.folds, joint.solved_bundle
    settings = rig.settings.diagnostics
    # Candidate board poses are sampled with a fixed seed: the result depends little on the sample.
    kinds = {name: rig.sensors[name].kind for name in solved.bundle.sensors}
    suggesting = (solved, kinds, rig.board_size, np.random.default_rng(0), rig.tolerance, settings)
    # Suggestions are for poses that are not good: those of certain ones wait for the verdict.
    uncertain = any(
        exceeds_tolerance(T, joint.covariance[name], rig.tolerance, settings.verdict)
        for name, T in joint.T_root_sensor.items()
    )
    checked = partial(progress, "checking")
    checked(0.0)
    with parallel_call(suggest_board_poses, suggesting, forked_jobs(jobs) if uncertain else 1) as suggestions:
        held_out = cross_validate(solved, folds, max(jobs - uncertain, 1), checked) if folds else {}
        drifts, without = measure_drifts(solved), joint
        joint = include_drifts(joint, solved, drifts, settings)
        suggested = suggestions() if uncertain else ()
        remedies = find_remedies(rig, joint, solved, drifts, suggested)
        calibration = assemble_rig(problem, tree, joint, held_out, drifts, remedies)
        good = all(sensor.verdict.grade == "good" for sensor in calibration.sensors)
        if not good:
            suggested = add_drifts(suggested or suggestions(), kinds, without, joint, drifts.serial_correlation)
            calibration = add_suggestions(calibration, suggested)
        checked(1.0)
        return calibration


def solve_after_bumps(problem: Problem) -> tuple[Problem, RigSolution, SpanningTree]:
    """The joint solution of possible sensors; those that moved have only their captures afterwards.

    Returns:
        The problem, without the captures of moved sensors before they moved where the others suffice, and with a
        finding for each bump; its solution and tree.
    """
    joint, tree = solve_jointly(problem)
    if (possible := refuse_impossible(problem, joint)) is not problem:
        return solve_after_bumps(possible)
    bumps = find_bumps(problem, joint)
    if not bumps:
        return problem, joint, tree
    later = _solve_later_captures(problem, bumps)
    resolved = later is not None and set(joint.T_root_sensor) <= set(later[1].T_root_sensor)
    if later is not None and resolved:
        problem, joint, tree = later
    again = find_bumps(problem, joint) if resolved else ()
    findings = describe_bumps(bumps, again, problem, joint, resolved=resolved)
    captures = replace(problem.captures, findings=(*problem.captures.findings, *findings))
    return replace(problem, captures=captures), joint, tree


def _solve_later_captures(
    problem: Problem, bumps: Sequence[PoseStep]
) -> tuple[Problem, RigSolution, SpanningTree] | None:
    """The problem of the captures after the bumps, its solution and tree; None if they do not suffice."""
    options = RigOptions(estimator=problem.solver.estimator, keep=problem.solver.keep)
    captures = discard_earlier(problem.captures, bumps)
    try:
        later = build_problem_from_captures(problem.rig, captures, options, np.random.default_rng(0))
        later = replace(later, solver=problem.solver)
        return later, *solve_jointly(later)
    except (CalgraphError, np.linalg.LinAlgError):
        return None


def solve_jointly(problem: Problem) -> tuple[RigSolution, SpanningTree]:
    """The joint solution, and the tree that it started from.

    Raises:
        InputError: the estimator cannot use the priors.
    """
    rig, captures, pairs, solver = problem.rig, problem.captures, problem.pairs, problem.solver
    check_estimator(solver.estimator, bool(solver.priors or solver.groups))
    estimates, max_stddev = select_successful(pairs), rig.settings.pairwise.board.max_stddev
    tree = attach_by_priors(problem.tree, estimates, solver.priors, solver.groups, max_stddev)
    if solver.estimator == "bundle":
        joint = solve_bundle(
            rig, captures, estimates, tree.T_root_sensor,
            keep=solver.keep, priors=solver.priors, groups=solver.groups,
        )  # fmt: skip
    else:
        from calgraph.rig.published.hypergraph import solve_hypergraph

        joint = solve_hypergraph(tree, estimates, captures.detections, keep=solver.keep, settings=rig.settings)
    _log_solution(joint)
    return joint, tree


def _select_initialization(start: RigStart) -> Initialization:
    """How a rig's start poses are computed."""
    if start == "tree" or start == "identity":
        return start
    return select_averaging(start) or "consensus"


def _log_captures(captures: CaptureSet) -> None:
    """Logs the captures, and in how many of them each sensor detected the board."""
    _log.info("captures: %d", len(captures.holds))
    for name, detections in captures.detections.items():
        reasons = Counter(reason for (_, sensor), reason in captures.rejections.items() if sensor == name)
        missed = "".join(f"; {count} times: {reason}" for reason, count in reasons.most_common(1))
        _log.info("detections of %s: in %d of %d captures%s", name, len(detections), len(captures.holds), missed)


def _log_pairs(pairs: PairwiseEstimates) -> None:
    """Logs what each pair of sensors has in common, or why it has no pose."""
    for (a, b), pair in pairs.items():
        if isinstance(pair, Rejected):
            found = f"no pose, {pair.reason}"
        else:
            found = f"{pair.inliers.sum()} inliers of {len(pair.inliers)} matches"
        _log.info("pair %s, %s: %s", a, b, found)


def _log_solution(joint: RigSolution) -> None:
    """Logs the size of the joint solution of a rig, and its iterations."""
    solved = joint.solved_bundle
    if solved is None:
        _log.info("joint solution by %s: %d sensors", joint.estimator, len(joint.T_root_sensor))
        return
    bundle, minimized = solved.bundle, solved.minimized
    _log.info(
        "joint solution: %d sensors, %d boards, %d further parameters, %d detections, %d of them rejected; "
        "%d iterations, %s",
        len(bundle.sensors),
        len(solved.captures),
        bundle.parameter_count - 6 * bundle.body_count,
        sum(len(views.board) for views in bundle.views),
        len(joint.rejected),
        minimized.iterations,
        "converged" if joint.converged else "not converged",
    )
