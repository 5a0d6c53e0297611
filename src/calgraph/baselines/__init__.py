"""The papers' estimators, as published. Nothing on the default path imports from here."""

from calgraph.baselines.hypergraph import solve_hypergraph
from calgraph.baselines.pose_averaging import RotationAveraging, average_poses_by_rotations

__all__ = ["RotationAveraging", "average_poses_by_rotations", "solve_hypergraph"]
