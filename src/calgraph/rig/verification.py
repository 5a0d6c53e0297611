"""Verification of a rig: a bootstrap over captures, and comparison with given extrinsics."""

from dataclasses import replace

import numpy as np

from calgraph.errors import CalibrationError
from calgraph.parallel.progress import Progress, no_progress
from calgraph.result import Calibration, ExtrinsicsFile
from calgraph.rig.bundle.problem import Problem
from calgraph.rig.checks.assemble import assemble_rig
from calgraph.rig.checks.bootstrap import BootstrapScatter, bootstrap_poses
from calgraph.rig.checks.extrinsics_check import compare_rig_poses
from calgraph.rig.pipeline import solve_jointly
from calgraph.verdict.comparison import ExtrinsicsComparison


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
    pass
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
    calibration = assemble_rig(problem, tree, joint)
    return calibration, compare_rig_poses(
        calibration, joint.solved_bundle, given, problem.rig.tolerance, problem.rig.settings.diagnostics.verdict
    )
