"""What options choose by name: the default, or a published baseline, which is imported only where it is chosen."""

from functools import partial
from typing import TYPE_CHECKING

from calgraph.calibrate.options import AveragingMethod, CenterFeature, PlaneMethod, RigStart
from calgraph.config.settings import BaselineSettings
from calgraph.detection.camera import PlaneEstimator
from calgraph.estimation.rig.problem import Problem
from calgraph.estimation.rig.solution import RigSolution
from calgraph.graph.pose_graph import PoseAveraging
from calgraph.graph.rig_initialization import Initialization
from calgraph.graph.spanning_tree import SpanningTree
from calgraph.pairwise.board_pair import select_successful

if TYPE_CHECKING:
    from calgraph.tracking.features import CenterEstimator


def select_averaging(method: AveragingMethod, settings: BaselineSettings) -> PoseAveraging | None:
    """The averaging of a network's pairs; None for the consensus."""
    if method == "consensus":
        return None
    from calgraph.baselines.pose_averaging import average_poses_by_rotations

    return partial(average_poses_by_rotations, method=method, settings=settings)


def select_initialization(start: RigStart, settings: BaselineSettings) -> Initialization:
    """How a rig's start poses are computed."""
    if start == "tree" or start == "identity":
        return start
    return select_averaging(start, settings) or "consensus"


def select_plane_estimator(method: PlaneMethod) -> PlaneEstimator | None:
    """The estimator of a board's plane from its tags; None for one PnP over all corners."""
    if method == "pnp":
        return None
    from calgraph.baselines.mean_plane import estimate_mean_plane

    return estimate_mean_plane


def select_center_estimator(feature: CenterFeature, settings: BaselineSettings) -> "CenterEstimator | None":
    """The estimator of the centres of tracked objects; None for ellipses of fixed radii."""
    match feature:
        case "nls":
            return None
        case "com":
            from calgraph.tracking.features import measure_centroids

            return measure_centroids
        case "ellipse":
            from calgraph.baselines.direct_ellipses import measure_direct_ellipses

            return partial(measure_direct_ellipses, limits=settings)


def select_depth_stddev(feature: CenterFeature, settings: BaselineSettings) -> float | None:
    """Standard deviation of the distance from tracked to true centres, m; None for ellipses of fixed radii."""
    match feature:
        case "nls":
            return None
        case "com":
            return settings.centroid_depth_stddev
        case "ellipse":
            return settings.direct_ellipse_depth_stddev


def solve_baseline(problem: Problem, tree: SpanningTree) -> RigSolution:
    """The solution of a rig by the hypergraph of MSG-Cal."""
    from calgraph.baselines.hypergraph import solve_hypergraph

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
