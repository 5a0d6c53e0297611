"""What options choose by name: the default, or a part of the paper, imported only where it is chosen."""

from calgraph.boards.camera import PlaneEstimator
from calgraph.config.settings import PlaneMethod, RigStart
from calgraph.graph.averaging import select_averaging
from calgraph.graph.spanning_tree import SpanningTree
from calgraph.rig.bundle.problem import Problem
from calgraph.rig.bundle.solution import RigSolution
from calgraph.rig.pairs.board_pair import select_successful
from calgraph.rig.pairs.rig_initialization import Initialization


def select_initialization(start: RigStart) -> Initialization:
    """How a rig's start poses are computed."""
    if start == "tree" or start == "identity":
        return start
    return select_averaging(start) or "consensus"


def select_plane_estimator(method: PlaneMethod) -> PlaneEstimator | None:
    """The estimator of a board's plane from its tags; None for one PnP over all corners."""
    if method == "pnp":
        return None
    from calgraph.rig.published.mean_plane import estimate_mean_plane

    return estimate_mean_plane


def solve_baseline(problem: Problem, tree: SpanningTree) -> RigSolution:
    """The solution of a rig by the hypergraph of MSG-Cal."""
    from calgraph.rig.published.hypergraph import solve_hypergraph

    solution = solve_hypergraph(
        tree,
        select_successful(problem.pairs),
        problem.captures.detections,
        keep=problem.solver.keep,
        settings=problem.rig.settings,
    )
    return RigSolution(
        "hypergraph",
        solution.T_root_sensor,
        solution.joint_covariance,
        solution.residuals,
        converged=solution.converged,
    )
