"""Whichever of the two stories a rig is for."""

from calgraph.calibrate.network import calibrate_network
from calgraph.calibrate.options import Options, Progress, no_progress
from calgraph.calibrate.rig import calibrate_rig
from calgraph.config import Cylinder, People, Rig
from calgraph.recording import Recording
from calgraph.result import Calibration


def calibrate(rig: Rig, recording: Recording, options: Options, progress: Progress = no_progress) -> Calibration:
    """Calibrates a robot with a board, or a network with people, whichever the rig's target is.

    Args, Returns and Raises as for :func:`calgraph.calibrate.calibrate_rig`.
    """
    story = calibrate_network if isinstance(rig.target, People | Cylinder) else calibrate_rig
    return story(rig, recording, options, progress)
