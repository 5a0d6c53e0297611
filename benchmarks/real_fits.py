"""Estimates from parts of a real recording, compared through the priors of parameters that they share."""

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from calgraph.config import Rig
from calgraph.geometry import Array, Index
from calgraph.result import Calibration, PriorErrors
from calgraph.rig.bundle.bundle_solver import Bundle, BundleState, linearize_bundle, retract_state
from calgraph.rig.bundle.covariances import prior_error_derivatives
from calgraph.rig.bundle.problem import Problem
from calgraph.rig.bundle.solution import RigSolution, SolvedBundle
from calgraph.rig.captures.detect import CaptureSet
from calgraph.rig.options import RigOptions
from calgraph.rig.pipeline import build_problem_from_captures, solve_jointly, solve_problem


@dataclass(frozen=True, eq=False)
class Fit:
    """Calibration from some captures."""

    captures: CaptureSet
    """As given."""
    problem: Problem
    joint: RigSolution

    @cached_property
    def calibration(self) -> Calibration:
        """The result, with its verdicts."""
        return solve_problem(self.problem)


def fit_captures(rig: Rig, captures: CaptureSet) -> Fit:
    """Calibrates through the library."""
    problem = build_problem_from_captures(rig, captures, RigOptions(), np.random.default_rng(0))
    return Fit(captures, problem, solve_jointly(problem)[0])


def cross_covariance(a: RigSolution, b: RigSolution, sensor: str) -> Array:
    """Cross-covariance (6, 6) of two estimates of one pose, through the priors of systematic parameters."""
    if a.solved_bundle is None or b.solved_bundle is None:
        return np.zeros((6, 6))
    return _prior_errors(a.solved_bundle, sensor).cross_covariance(_prior_errors(b.solved_bundle, sensor))


def _prior_errors(solved: SolvedBundle, sensor: str) -> PriorErrors:
    """Errors of one sensor's pose."""
    bundle, minimized = solved.bundle, solved.minimized
    row = 6 * bundle.sensors.index(sensor)
    return PriorErrors(
        tuple((one.of, one.quantity) for one in bundle.extra_parameters),
        prior_error_derivatives(bundle, minimized.state, minimized.equations)[row : row + 6],
    )


def apply_systematic(solved: SolvedBundle, bundle: Bundle, state: BundleState) -> BundleState:
    """The state of another bundle with the systematic parameters of a solution, where that has them."""
    pairs = zip(solved.bundle.extra_parameters, solved.minimized.state.extra, strict=True)
    estimated = {(one.of, one.quantity): value for one, value in pairs}
    extra = [
        estimated.get((one.of, one.quantity), value)
        for one, value in zip(bundle.extra_parameters, state.extra, strict=True)
    ]
    return replace(state, extra=np.array(extra, dtype=np.float64))


def locate_boards(bundle: Bundle, state: BundleState, boards: Index, steps: int) -> BundleState:
    """The state after some Gauss-Newton steps of some boards, for fixed poses of sensors."""
    fixed = np.zeros(bundle.parameter_count)
    for _ in range(steps):
        at = linearize_bundle(bundle, state)
        step = np.zeros_like(at.g_board)
        step[boards] = np.linalg.solve(at.H_board[boards], -at.g_board[boards][..., None])[..., 0]
        state = retract_state(bundle, state, fixed, step)
    return state
