"""The papers' estimators, as published. Nothing on the default path imports from here."""

from calgraph.baselines.direct_ellipses import measure_direct_ellipses
from calgraph.baselines.hypergraph import HypergraphSolution, solve_hypergraph
from calgraph.baselines.mean_plane import estimate_mean_plane
from calgraph.baselines.pose_averaging import RotationAveraging, average_poses_by_rotations

__all__ = [
    "HypergraphSolution",
    "RotationAveraging",
    "average_poses_by_rotations",
    "estimate_mean_plane",
    "measure_direct_ellipses",
    "solve_hypergraph",
]
