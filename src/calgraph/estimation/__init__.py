"""Joint estimators over all sensors, and the problem that they solve."""

from typing import TYPE_CHECKING

from calgraph.lazy_names import import_on_use

if TYPE_CHECKING:
    from calgraph.estimation.intrinsics.estimate import IntrinsicsEstimate, estimate_intrinsics
    from calgraph.estimation.network.estimate import NetworkSolution, SolvedNetwork, solve_network
    from calgraph.estimation.network.scanner_prior import ScannerPrior
    from calgraph.estimation.rig.camera_boards import locate_boards, scale_boards
    from calgraph.estimation.rig.estimate import cramer_rao, solve_bundle, solve_poses
    from calgraph.estimation.rig.print_symmetry import align_symmetric_prints
    from calgraph.estimation.rig.priors import PosePrior, PriorFile, RigidFile, RigidGroup, attach_by_priors
    from calgraph.estimation.rig.problem import Estimator, Problem, SolverOptions, check_problem, with_prior_poses
    from calgraph.estimation.rig.problem_file import load_problem, round_trip, save_problem
    from calgraph.estimation.rig.solution import MeasuredNoise, RigSolution, SolvedBundle
else:
    __getattr__ = import_on_use(
        __name__,
        [
            "rig.problem",
            "rig.priors",
            "rig.solution",
            "rig.camera_boards",
            "rig.print_symmetry",
            "rig.estimate",
            "rig.problem_file",
            "intrinsics.estimate",
            "network.scanner_prior",
            "network.estimate",
        ],
    )

__all__ = [
    "Estimator", "IntrinsicsEstimate", "MeasuredNoise", "NetworkSolution", "PosePrior", "PriorFile", "Problem",
    "RigSolution", "RigidFile", "RigidGroup", "ScannerPrior", "SolvedBundle", "SolvedNetwork", "SolverOptions",
    "align_symmetric_prints", "attach_by_priors", "check_problem", "cramer_rao", "estimate_intrinsics",
    "load_problem", "locate_boards", "round_trip", "save_problem", "scale_boards", "solve_bundle",
    "solve_network", "solve_poses", "with_prior_poses",
]  # fmt: skip
