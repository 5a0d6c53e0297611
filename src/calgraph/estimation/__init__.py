"""Joint estimators over all sensors, and the problem that they solve."""

from calgraph.estimation.network.estimate import JointNetwork, solve_network
from calgraph.estimation.network.scanner_prior import ScannerPrior
from calgraph.estimation.rig.estimate import cramer_rao, solve_bundle
from calgraph.estimation.rig.extra_parameters import Estimable
from calgraph.estimation.rig.priors import PosePrior, PriorFile, RigidFile, RigidGroup, attached
from calgraph.estimation.rig.problem import Estimator, Problem, Solver, check_problem, knowing
from calgraph.estimation.rig.problem_file import load_problem, replayable, save_problem
from calgraph.estimation.rig.solution import Adjusted, Joint, MeasuredNoise

__all__ = [
    "Adjusted",
    "Estimable",
    "Estimator",
    "Joint",
    "JointNetwork",
    "MeasuredNoise",
    "PosePrior",
    "PriorFile",
    "Problem",
    "RigidFile",
    "RigidGroup",
    "ScannerPrior",
    "Solver",
    "attached",
    "check_problem",
    "cramer_rao",
    "knowing",
    "load_problem",
    "replayable",
    "save_problem",
    "solve_bundle",
    "solve_network",
]
