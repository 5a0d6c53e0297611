"""What options choose by name: the default, or a published baseline, which is imported only where it is chosen."""

from functools import partial

from calgraph.calibrate.options import AveragingMethod, RigStart
from calgraph.graph import Initialization, PoseAveraging


def select_averaging(method: AveragingMethod) -> PoseAveraging | None:
    """The averaging of a network's pairs; None for the consensus."""
    if method == "consensus":
        return None
    from calgraph.baselines import average_poses_by_rotations

    return partial(average_poses_by_rotations, method=method)


def select_initialization(start: RigStart) -> Initialization:
    """How a rig's start poses are computed."""
    if start == "tree" or start == "identity":
        return start
    return select_averaging(start) or "consensus"
