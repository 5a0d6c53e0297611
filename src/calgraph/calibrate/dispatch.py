"""The calibration of any kind of rig, chosen by its target."""

from typing import TYPE_CHECKING

from calgraph.config import Rig
from calgraph.errors import InputError
from calgraph.parallel.progress import Progress, no_progress
from calgraph.recording import Recording
from calgraph.result import Calibration

if TYPE_CHECKING:
    from calgraph.drive.options import DriveOptions
    from calgraph.network.options import NetworkOptions
    from calgraph.rig.options import RigOptions


def calibrate(
    rig: Rig,
    recording: Recording,
    options: "RigOptions | NetworkOptions | DriveOptions",
    progress: Progress = no_progress,
) -> Calibration:
    """Calibrates a robot with a board, a network with people, or a robot that drives, by the rig's target.

    Args, Returns and Raises as for :func:`calgraph.calibrate_rig`; the options are those of the target.
    """
    # A wing is imported where it is used: each takes half a second.
    if rig.is_network:
        from calgraph.network.options import NetworkOptions
        from calgraph.network.pipeline import calibrate_network

        if isinstance(options, NetworkOptions):
            return calibrate_network(rig, recording, options, progress)
    elif rig.is_drive:
        from calgraph.drive.options import DriveOptions
        from calgraph.drive.pipeline import calibrate_drive

        if isinstance(options, DriveOptions):
            return calibrate_drive(rig, recording, options, progress)
    else:
        from calgraph.rig.options import RigOptions
        from calgraph.rig.pipeline import calibrate_rig

        if isinstance(options, RigOptions):
            return calibrate_rig(rig, recording, options, progress)
    kind = "NetworkOptions" if rig.is_network else "DriveOptions" if rig.is_drive else "RigOptions"
    raise InputError(f"options: must be {kind} for this target, got {type(options).__name__}")
