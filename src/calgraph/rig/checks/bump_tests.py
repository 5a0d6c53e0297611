"""Tests of steps in the poses of sensors: a sensor that was bumped during the recording, and what follows."""

from collections.abc import Collection, Sequence
from dataclasses import replace

import numpy as np

from calgraph.geometry import Index
from calgraph.result.finding import Finding
from calgraph.rig.bundle.bundle_setup import rebuild_bundle
from calgraph.rig.bundle.bundle_solver import COARSE_TOLERANCE, Bundle, MinimizedBundle, minimize_bundle
from calgraph.rig.bundle.priors import without_priors
from calgraph.rig.bundle.problem import Problem
from calgraph.rig.bundle.solution import RigSolution, SolvedBundle
from calgraph.rig.captures.detect import CaptureSet
from calgraph.rig.checks.pose_steps import PoseStep, find_pose_steps


def find_bumps(problem: Problem, solution: RigSolution) -> tuple[PoseStep, ...]:
    """Sensors whose pose changed between two captures, the most significant change first.

    A score test of all sensors and times, with the variances of the solution, selects one step. As these variances
    contain the effect of the step, they are estimated again with it, which selects again; then it is tested by its
    covariance. All detections take part that the solution judged, as those after a bump may be outliers of the
    solution without it. Further steps are searched beside those that were found.

    Source: Andrews, "Tests for parameter instability and structural change with unknown change point", 1993; for
    the probability that any step is reported, Bonferroni's bound over sensors and times.
    """
    if solution.solved_bundle is None:
        return ()
    bundle, minimized, captures = _include_all_views(problem, solution.solved_bundle)
    steps = find_pose_steps(bundle, minimized)
    return tuple(replace(step, before=captures[step.before], after=captures[step.after]) for step in steps)


def _include_all_views(problem: Problem, solved: SolvedBundle) -> tuple[Bundle, MinimizedBundle, Index]:
    """The bundle with all unambiguous detections, its solution, and the captures (C,) of its boards.

    Variances are those of the solved bundle.
    """
    boards, state = solved.boards, solved.minimized.state
    without_outlines = without_priors(solved.bundle.without_outlines())
    if sum(len(board.detection_index) for board in boards) == sum(len(v.board) for v in solved.bundle.views):
        bundle, captures = without_outlines, solved.captures
        cache = solved.minimized.equations.cache[: len(bundle.views)]
    else:
        bundle, state = rebuild_bundle(problem.rig, problem.captures, boards, without_outlines, state)
        bundle = without_priors(bundle)
        captures, cache = np.array([board.capture for board in boards]), ()
    solution = minimize_bundle(bundle, state, cache, tolerance=COARSE_TOLERANCE, exact=False)
    return bundle, solution, captures


_EARLIER_CAPTURE = "before the sensor moved"


def discard_earlier(captures: CaptureSet, bumps: Sequence[PoseStep]) -> CaptureSet:
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
    bumps: Sequence[PoseStep], again: Sequence[PoseStep], problem: Problem, joint: RigSolution, *, resolved: bool
) -> tuple[Finding, ...]:
    """A finding for each bump: what moved, when, and what follows.

    Args:
        bumps: of the solution of all captures.
        again: of the solution of the captures after them.
        problem: that was solved.
        joint: the solution that is published.
        resolved: whether it is that of the captures after the bumps.
    """
    # Sensors that move more than once drift, or another error of the model changes with time.
    unsteady = {
        name for i, bump in enumerate(bumps) for other in bumps[:i] for name in {*bump.sensors} & {*other.sensors}
    }
    unsteady |= {name for bump in again for name in bump.sensors}
    return tuple(_describe_bump(bump, problem, joint, unsteady, resolved=resolved) for bump in [*bumps, *again])


def _describe_bump(
    bump: PoseStep, problem: Problem, joint: RigSolution, unsteady: Collection[str], *, resolved: bool
) -> Finding:
    """What moved, when, and what follows."""
    names, which = (
        " or ".join(bump.sensors),
        "" if len(bump.sensors) == 1 else ", these captures do not determine which,",
    )
    holds, start = {hold.index: hold for hold in problem.captures.holds}, problem.captures.start
    begin, end = holds[bump.before[-1]].end - start, holds[bump.after[0]].start - start
    # Detections that were made elsewhere have no times.
    when = f" ({begin:.1f} to {end:.1f} s from the start)" if end > begin else ""
    mm, degrees = 1000 * np.linalg.norm(bump.step[:3]), np.degrees(np.linalg.norm(bump.step[3:]))
    moved = (
        f"{names}{which} moved by {mm:.1f} mm and {degrees:.2f}° "
        f"between captures {bump.before[-1]} and {bump.after[0]}{when}"
    )
    if resolved and not set(bump.sensors) & set(unsteady):
        count = len(bump.after)
        return Finding(f"{moved}: the result is its pose after that, from {count} captures")
    weak = tuple(joint.T_root_sensor) if problem.rig.root in bump.sensors else bump.sensors
    if resolved:
        return Finding(f"{moved}, and not only then: fix it to the robot, and record again", weak)
    return Finding(f"{moved}, and the captures after that do not suffice: record again", weak)
