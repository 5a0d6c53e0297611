"""Whether given extrinsics still hold, by a drive: which sensor has moved, without a board."""

from calgraph.config import Rig
from calgraph.drive.options import DriveOptions
from calgraph.drive.pipeline import calibrate_drive
from calgraph.parallel.progress import Progress, no_progress
from calgraph.recording import Recording
from calgraph.result import Calibration, ExtrinsicsFile
from calgraph.verdict.comparison import ExtrinsicsComparison
from calgraph.verdict.contradicted_poses import compare_with_contradictions


def compare_drive_extrinsics(
    rig: Rig, recording: Recording, given: ExtrinsicsFile, options: DriveOptions, progress: Progress = no_progress
) -> tuple[Calibration, ExtrinsicsComparison]:
    """Comparison of given extrinsics with the calibration of a drive, by the rig's tolerance.

    Raises:
        InputError: the extrinsics lack the root, or nothing fixed connects the sensors there; and as for
            :func:`calgraph.drive.pipeline.calibrate_drive`.
    """
    calibration = calibrate_drive(rig, recording, options, progress)
    return calibration, compare_with_contradictions(rig, calibration, given, "motions")
