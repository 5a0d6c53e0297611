"""The averaging of pairs that an option chooses by name."""

from functools import partial

from calgraph.config.settings import AveragingMethod
from calgraph.graph.pose_graph import PoseAveraging


def select_averaging(method: AveragingMethod) -> PoseAveraging | None:
    """The averaging of pairs; None for the consensus. A published one is imported only where it is chosen."""
    if method == "consensus":
        return None
    from calgraph.graph.pose_averaging import average_poses_by_rotations

    return partial(average_poses_by_rotations, method=method)
