"""Tests of steps in the poses of sensors: a sensor that was bumped during the recording, and what follows."""

from collections.abc import Collection, Sequence
from dataclasses import dataclass, replace

import numpy as np

from calgraph.config import Rig
from calgraph.geometry import Index
from calgraph.result.finding import Finding
from calgraph.rig.bundle.board_observations import add_unambiguous_detections, group_detections
from calgraph.rig.bundle.bundle_setup import rebuild_bundle
from calgraph.rig.bundle.bundle_solver import COARSE_TOLERANCE, Bundle, MinimizedBundle, minimize_bundle
from calgraph.rig.bundle.priors import without_priors
from calgraph.rig.bundle.problem import Problem
from calgraph.rig.bundle.solution import RigSolution, SolvedBundle
from calgraph.rig.captures.detect import CaptureSet
from calgraph.rig.checks.pose_steps import PoseStep, find_pose_steps
from calgraph.rig.pairs.board_pair import select_successful


@dataclass(frozen=True)
class Bump:
    """A step in the pose of a sensor between two of its captures."""

    sensors: tuple[str, ...]
    """The sensor; several if the captures do not determine which of them moved."""
    before: tuple[int, ...]
    """Captures in which it detected the board before the step,"""
    after: tuple[int, ...]
    """and after it. Captures that may lie on either side are in neither."""
    interval: tuple[float, float]
    """Time of the step: between these, s from the start of the recording."""
    translation: float
    """Displacement of the sensor, m."""
    rotation: float
    """Its rotation, rad."""
    deviations: float
    """Mahalanobis distance of the step from none."""


def find_bumps(problem: Problem, solution: RigSolution) -> tuple[Bump, ...]:
    """Sensors whose pose changed between two captures, the most significant change first.

    A score test of all sensors and times, with the variances of the solution, selects one step. As these variances
    contain the effect of the step, they are estimated again with it, which selects again; then it is tested by its
    covariance. All detections take part that are unambiguous, as those after a bump may be outliers of the
    solution without it. Further steps are searched beside those that were found.

    Source: Andrews, "Tests for parameter instability and structural change with unknown change point", 1993; for
    the probability that any step is reported, Bonferroni's bound over sensors and times.

    Args:
        problem: with all detections.
        solution: its joint solution.
    """
    if solution.solved_bundle is None:
        return ()
    bundle, minimized, captures = _include_all_views(problem, solution.solved_bundle)
    steps = find_pose_steps(bundle, minimized)
    return tuple(_describe(problem, captures, step) for step in steps)


def _include_all_views(problem: Problem, solved: SolvedBundle) -> tuple[Bundle, MinimizedBundle, Index]:
    """The bundle with all unambiguous detections, its solution, and the captures (C,) of its boards.

    Variances are those of the solved bundle.
    """
    names = solved.bundle.sensors
    pairs = [e for e in select_successful(problem.pairs) if e.sensor_a in names and e.sensor_b in names]
    inliers = group_detections([(pair, pair.inliers) for pair in pairs])
    boards = add_unambiguous_detections(inliers, problem.captures.detections, names)
    without_outlines = without_priors(_remove_outlines(solved.bundle))
    state = solved.minimized.state
    if sum(len(board.detection_index) for board in boards) == sum(len(v.board) for v in solved.bundle.views):
        bundle, captures, cache = without_outlines, solved.captures, solved.minimized.equations.cache[: len(names)]
    else:
        bundle, state = rebuild_bundle(problem.rig, problem.captures, boards, without_outlines, state)
        bundle = without_priors(bundle)
        captures, cache = np.array([board.capture for board in boards]), ()
    solution = minimize_bundle(bundle, state, cache, tolerance=COARSE_TOLERANCE, exact=False)
    return bundle, solution, captures


def _remove_outlines(bundle: Bundle) -> Bundle:
    """The bundle without outlines and their parameters."""
    sensors = len(bundle.views)
    kept = tuple(
        replace(one, view_sets=tuple(k for k in one.view_sets if k < sensors)) for one in bundle.extra_parameters
    )
    return replace(bundle.without_outlines(), extra_parameters=kept)


def _describe(problem: Problem, captures: Index, step: PoseStep) -> Bump:
    """The bump of a step between two captures."""
    holds, start = {hold.index: hold for hold in problem.captures.holds}, problem.captures.start
    before, after = captures[step.before].tolist(), captures[step.after].tolist()
    return Bump(
        step.sensors,
        tuple(before),
        tuple(after),
        (holds[before[-1]].end - start, holds[after[0]].start - start),
        float(np.linalg.norm(step.step[:3])),
        float(np.linalg.norm(step.step[3:])),
        float(np.sqrt(step.squared)),
    )


_EARLIER_CAPTURE = "before the sensor moved"


def discard_earlier(captures: CaptureSet, bumps: Sequence[Bump]) -> CaptureSet:
    """The captures without detections of sensors that moved afterwards."""
    first = {name: max(b.after[0] for b in bumps if name in b.sensors) for bump in bumps for name in bump.sensors}
    earlier = {
        (capture, name): _EARLIER_CAPTURE
        for name, until in first.items()
        for capture in captures.detections[name]
        if capture < until
    }
    detections = {
        name: {capture: found for capture, found in by_capture.items() if (capture, name) not in earlier}
        for name, by_capture in captures.detections.items()
    }
    return replace(captures, detections=detections, rejections={**captures.rejections, **earlier})


def describe_bumps(
    bumps: Sequence[Bump], again: Sequence[Bump], rig: Rig, joint: RigSolution, *, resolved: bool
) -> tuple[Finding, ...]:
    """A finding for each bump: what moved, when, and what follows.

    Args:
        bumps: of the solution of all captures.
        again: of the solution of the captures after them.
        rig: the rig.
        joint: the solution that is published.
        resolved: whether it is that of the captures after the bumps.
    """
    # Sensors that move more than once drift, or another error of the model changes with time.
    unsteady = {
        name for i, bump in enumerate(bumps) for other in bumps[:i] for name in {*bump.sensors} & {*other.sensors}
    }
    unsteady |= {name for bump in again for name in bump.sensors}
    return tuple(_describe_bump(bump, rig, joint, unsteady, resolved=resolved) for bump in [*bumps, *again])


def _describe_bump(
    bump: Bump, rig: Rig, joint: RigSolution, unsteady: Collection[str], *, resolved: bool
) -> Finding:
    """What moved, when, and what follows."""
    names, which = (
        " or ".join(bump.sensors),
        "" if len(bump.sensors) == 1 else ", these captures do not determine which,",
    )
    begin, end = bump.interval
    # Detections that were made elsewhere have no times.
    when = f" ({begin:.1f} to {end:.1f} s from the start)" if end > begin else ""
    moved = (
        f"{names}{which} moved by {1000 * bump.translation:.1f} mm and {np.degrees(bump.rotation):.2f}° "
        f"between captures {bump.before[-1]} and {bump.after[0]}{when}"
    )
    if resolved and not set(bump.sensors) & set(unsteady):
        count = len(bump.after)
        return Finding(f"{moved}: the result is its pose after that, from {count} captures")
    weak = tuple(joint.T_root_sensor) if rig.root in bump.sensors else bump.sensors
    if resolved:
        return Finding(f"{moved}, and not only then: fix it to the robot, and record again", weak)
    return Finding(f"{moved}, and the captures after that do not suffice: record again", weak)
