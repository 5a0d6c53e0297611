"""Tests of steps in the poses of sensors: a sensor that was bumped during the recording."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from calgraph.diagnostics.rig.pose_steps import PoseStep, find_pose_steps, set_noise
from calgraph.estimation.rig.board_observations import BoardObservation, group_detections
from calgraph.estimation.rig.bundle_solver import (
    COARSE_TOLERANCE,
    Bundle,
    BundleState,
    MinimizedBundle,
    minimize_bundle,
)
from calgraph.estimation.rig.estimate import build_bundle
from calgraph.estimation.rig.priors import without_priors
from calgraph.estimation.rig.problem import Problem
from calgraph.estimation.rig.solution import RigSolution, SolvedBundle
from calgraph.geometry import Array, Index
from calgraph.pairwise import PairwiseEstimate, select_successful


@dataclass(frozen=True)
class Bump:
    """A step in the pose of a sensor between two of its captures."""

    sensors: tuple[str, ...]
    """The sensor; several if the captures cannot tell which of them moved."""
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
    contain the effect of the step, they are estimated anew with it, which selects again; then it is tested by its
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
    steps = find_pose_steps(bundle, minimized, problem.rig.settings.diagnostics.bumps)
    return tuple(_describe(problem, captures, step) for step in steps)


def _include_all_views(problem: Problem, solved: SolvedBundle) -> tuple[Bundle, MinimizedBundle, Index]:
    """The bundle with all unambiguous detections, its solution, and the captures (C,) of its boards.

    Variances are those of the solved bundle.
    """
    names = solved.bundle.sensors
    pairs = [e for e in select_successful(problem.pairs) if e.sensor_a in names and e.sensor_b in names]
    boards = group_detections([(pair, _select_unambiguous(problem, pair)) for pair in pairs])
    without_outlines = without_priors(_remove_outlines(solved.bundle))
    state = solved.minimized.state
    if sum(len(board.detection_index) for board in boards) == sum(len(v.board) for v in solved.bundle.views):
        bundle, captures, cache = without_outlines, solved.captures, solved.minimized.equations.cache[: len(names)]
    else:
        T_root_sensor = dict(zip(names, state.T_root_sensor, strict=True))
        bundle, state = _build_like(problem, without_outlines, state, boards, T_root_sensor)
        captures, cache = np.array([board.capture for board in boards]), ()
    solution = minimize_bundle(bundle, state, cache, tolerance=COARSE_TOLERANCE, exact=False)
    return bundle, solution, captures


def _select_unambiguous(problem: Problem, pair: PairwiseEstimate) -> NDArray[np.bool_]:
    """Mask (M,) of a pair's matches: its inliers, and matches of captures in which either has one detection."""
    single = [
        len(problem.captures.detections[pair.sensor_a][capture]) == 1
        and len(problem.captures.detections[pair.sensor_b][capture]) == 1
        for capture in pair.matches[:, 0].tolist()
    ]
    return np.asarray(pair.inliers | np.array(single, dtype=np.bool_))


def _remove_outlines(bundle: Bundle) -> Bundle:
    """The bundle without outlines and their parameters."""
    sensors = len(bundle.views)
    kept = tuple(
        replace(one, view_sets=tuple(k for k in one.view_sets if k < sensors)) for one in bundle.extra_parameters
    )
    return replace(bundle.without_outlines(), extra_parameters=kept)


def _build_like(
    problem: Problem,
    solved: Bundle,
    state: BundleState,
    boards: Sequence[BoardObservation],
    T_root_sensor: dict[str, Array],
) -> tuple[Bundle, BundleState]:
    """The bundle of these boards, with variances and parameters of a solved one, and its start values."""
    bundle, start = build_bundle(problem.rig, problem.captures, boards, T_root_sensor)
    bundle = replace(without_priors(bundle), bias_variance=solved.bias_variance)
    value = {(p.of, p.quantity): x for p, x in zip(solved.extra_parameters, state.extra, strict=True)}
    extra = np.array([value.get((p.of, p.quantity), 0.0) for p in bundle.extra_parameters])
    start = replace(start, extra=extra)
    return set_noise(bundle, start, [views.noise_scale for views in solved.views]), start


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
