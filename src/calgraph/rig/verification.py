"""Verification of a rig: a bootstrap over captures, and comparison with given extrinsics."""

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from calgraph.config import Tolerance
from calgraph.config.settings import VerdictSettings
from calgraph.errors import CalibrationError
from calgraph.geometry import Array
from calgraph.parallel.progress import Progress, no_progress
from calgraph.result import Calibration, ExtrinsicsFile
from calgraph.rig.bundle.bundle_solver import Bundle, BundleState, minimize_bundle, view_state
from calgraph.rig.bundle.problem import Problem
from calgraph.rig.bundle.solution import SolvedBundle
from calgraph.rig.checks.assemble import assemble_rig
from calgraph.rig.checks.bootstrap import BootstrapScatter, bootstrap_poses
from calgraph.rig.checks.remedies import find_remedies
from calgraph.rig.pipeline import solve_jointly
from calgraph.verdict.comparison import ExtrinsicsComparison, ResidualComparison, compare_poses, match_poses


def bootstrap_covariances(
    problem: Problem, rounds: int, rng: np.random.Generator, progress: Progress = no_progress
) -> tuple[Calibration, dict[str, BootstrapScatter]]:
    """Calibrates, and returns the scatter of each sensor's pose in a bootstrap over captures.

    Raises:
        CalibrationError: no two sensors detected the board in common captures.
    """
    problem = replace(problem, solver=problem.solver.model_copy(update={"estimator": "bundle"}))
    joint, tree = solve_jointly(problem)
    if joint.solved_bundle is None:
        raise CalibrationError(
            f"there is nothing to verify: no sensor is connected to the root {problem.rig.root}"
        )
    scatter = bootstrap_poses(joint.solved_bundle, rounds, rng, lambda done: progress("resampling", done))
    return assemble_rig(problem, tree, joint), scatter


def compare_extrinsics(problem: Problem, given: ExtrinsicsFile) -> tuple[Calibration, ExtrinsicsComparison]:
    """Comparison of given extrinsics with a calibration without them as priors, by the rig's tolerance.

    Raises:
        InputError: the extrinsics lack the root, or nothing fixed connects the sensors there.
    """
    unknowing = {"estimator": "bundle", "priors": (), "groups": ()}
    problem = replace(problem, solver=problem.solver.model_copy(update=unknowing))
    joint, tree = solve_jointly(problem)
    solved = joint.solved_bundle
    # As in the covariance here, there are no drifts in what remedies leave; board poses would take seconds.
    remedies = find_remedies(problem.rig, joint, solved, None) if solved else ()
    calibration = assemble_rig(problem, tree, joint, remedies=remedies)
    return calibration, compare_rig_poses(
        calibration, solved, given, problem.rig.tolerance, problem.rig.settings.diagnostics.verdict
    )


def compare_rig_poses(
    estimated: Calibration,
    solved: SolvedBundle | None,
    given: ExtrinsicsFile,
    tolerance: Tolerance,
    settings: VerdictSettings,
) -> ExtrinsicsComparison:
    """Compares given extrinsics with estimated ones, see :func:`calgraph.verdict.comparison.compare_poses`.

    Args:
        estimated: the calibration from the recording.
        solved: its solution, for the residuals; None where there is none.
        given: the extrinsics to compare.
        tolerance: largest acceptable error.
        settings: the probability of a false alarm.

    Raises:
        InputError: the root or all other sensors are not in the file, or nothing fixed connects them there.
    """
    matched = match_poses(estimated, given, tolerance, settings)
    return compare_poses(matched, _compare_residuals(solved, matched.T_root_sensor) if solved else {})


def _compare_residuals(solved: SolvedBundle, T_root_sensor: Mapping[str, Array]) -> dict[str, ResidualComparison]:
    """RMS residual by sensor under given and estimated poses, with boards located under each."""
    bundle, state = solved.bundle, solved.minimized.state
    views = tuple(
        of_sensor.select(np.full(len(of_sensor.board), name in T_root_sensor))
        for name, of_sensor in zip(bundle.sensors, bundle.views, strict=True)
    )
    fixed = replace(bundle.without_outlines(), views=views, body=np.zeros(len(views), dtype=np.intp), priors=())
    poses = [T_root_sensor.get(n, T) for n, T in zip(bundle.sensors, state.T_root_sensor, strict=True)]
    given = _rms_residuals(fixed, replace(state, T_root_sensor=np.array(poses)))
    estimated = _rms_residuals(fixed, state)
    return {
        name: ResidualComparison(views[s].unit, given[s], estimated[s])
        for s, name in enumerate(bundle.sensors)
        if len(views[s].board)
    }


def _rms_residuals(fixed: Bundle, state: BundleState) -> list[float]:
    """RMS residual of each sensor with sensor poses fixed and boards located by least squares, px or m."""
    try:
        located = minimize_bundle(fixed, state).state
    except CalibrationError:
        # The poses put boards behind a camera.
        return [float("inf")] * len(fixed.views)
    rms = []
    for s, views in enumerate(fixed.views):
        residual = views.unwhiten(views.linearize(*view_state(fixed, located, s)).residual)
        rms.append(float(np.sqrt(np.mean(residual**2))) if residual.size else 0.0)
    return rms
