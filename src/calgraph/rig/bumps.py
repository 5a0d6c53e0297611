"""Calibration after bumps: sensors that moved during the recording are calibrated from their captures after it."""

from collections.abc import Callable, Collection, Sequence
from dataclasses import replace

import numpy as np

from calgraph.config import Rig
from calgraph.errors import CalgraphError
from calgraph.graph.spanning_tree import SpanningTree
from calgraph.result.finding import Finding
from calgraph.rig.bundle.problem import Problem
from calgraph.rig.bundle.solution import RigSolution
from calgraph.rig.captures.detect import CaptureSet
from calgraph.rig.checks.bump_tests import Bump, find_bumps
from calgraph.rig.options import RigOptions

_EARLIER_CAPTURE = "before the sensor moved"


def solve_after_bumps(
    problem: Problem,
    joint: RigSolution,
    tree: SpanningTree,
    build: Callable[[Rig, CaptureSet, RigOptions, np.random.Generator], Problem],
    solve: Callable[[Problem], tuple[RigSolution, SpanningTree]],
) -> tuple[Problem, RigSolution, SpanningTree]:
    """Searches for sensors that moved during the recording, and calibrates them from their captures afterwards.

    Args:
        problem: all captures.
        joint: its solution.
        tree: that the solution started from.
        build: makes a problem from captures.
        solve: makes the solution of a problem and its tree.

    Returns:
        The problem, without the captures of moved sensors before they moved where the others suffice, and with a
        finding for each bump; its solution and tree.
    """
    bumps = find_bumps(problem, joint)
    if not bumps:
        return problem, joint, tree
    later = _solve_later_captures(problem, joint, bumps, build, solve)
    resolved = later is not None
    problem, joint, tree = later or (problem, joint, tree)
    # Sensors that move more than once drift, or another error of the model changes with time.
    again = find_bumps(problem, joint) if resolved else ()
    unsteady = {
        name for i, bump in enumerate(bumps) for other in bumps[:i] for name in {*bump.sensors} & {*other.sensors}
    }
    unsteady |= {name for bump in again for name in bump.sensors}
    findings = [_describe(bump, problem.rig, joint, unsteady, resolved=resolved) for bump in [*bumps, *again]]
    captures = replace(problem.captures, findings=(*problem.captures.findings, *findings))
    return replace(problem, captures=captures), joint, tree


def _solve_later_captures(
    problem: Problem,
    joint: RigSolution,
    bumps: Sequence[Bump],
    build: Callable[[Rig, CaptureSet, RigOptions, np.random.Generator], Problem],
    solve: Callable[[Problem], tuple[RigSolution, SpanningTree]],
) -> tuple[Problem, RigSolution, SpanningTree] | None:
    """The problem of the captures after the bumps, its solution and tree; None if it lacks a sensor."""
    options = RigOptions(estimator=problem.solver.estimator, keep=problem.solver.keep)
    try:
        later = build(problem.rig, _discard_earlier(problem.captures, bumps), options, np.random.default_rng(0))
        later = replace(later, solver=problem.solver)
        solution, tree = solve(later)
    except (CalgraphError, np.linalg.LinAlgError):
        return None
    return (later, solution, tree) if set(joint.T_root_sensor) <= set(solution.T_root_sensor) else None


def _discard_earlier(captures: CaptureSet, bumps: Sequence[Bump]) -> CaptureSet:
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


def _describe(bump: Bump, rig: Rig, joint: RigSolution, unsteady: Collection[str], *, resolved: bool) -> Finding:
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
