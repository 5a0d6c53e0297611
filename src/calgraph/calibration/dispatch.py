"""The calibration of any kind of rig, and its comparison with given poses, chosen by the target."""

from pathlib import Path
from typing import TYPE_CHECKING

from calgraph.config import Rig, load_rig
from calgraph.errors import InputError
from calgraph.parallel.engine import THIS_PROCESS, Engine
from calgraph.parallel.progress import Progress, no_progress
from calgraph.recording import NO_CACHE, Recording, RecordingCache, open_recording
from calgraph.result import Calibration, ExtrinsicsFile

if TYPE_CHECKING:
    from calgraph.drive.options import DriveOptions
    from calgraph.network.options import NetworkOptions
    from calgraph.rig.options import RigOptions
    from calgraph.verdict.comparison import ExtrinsicsComparison


def calibrate(
    rig: Rig | Path | str,
    recording: Recording | Path | str,
    options: "RigOptions | NetworkOptions | DriveOptions | None" = None,
    progress: Progress = no_progress,
) -> Calibration:
    """Calibrates a robot with a board, a network with people, or a robot that drives, by the rig's target.

    Args:
        rig: sensors and target, or the path of a rig.yaml.
        recording: open recording with the rig's topics, or the path of one.
        options: those of the target; their defaults if left out.
        progress: called with the step and the fraction done.

    Returns and Raises as for :func:`calgraph.calibrate_rig`.
    """
    rig = rig if isinstance(rig, Rig) else load_rig(rig)
    if isinstance(recording, Path | str):
        with open_recording(recording, rig.settings.limits) as opened:
            return calibrate(rig, opened, options, progress)
    # A wing is imported where it is used: each takes half a second.
    if rig.is_network:
        from calgraph.network.options import NetworkOptions
        from calgraph.network.pipeline import calibrate_network

        if isinstance(options, NetworkOptions | None):
            return calibrate_network(rig, recording, options or NetworkOptions(), progress)
    elif rig.is_drive:
        from calgraph.drive.options import DriveOptions
        from calgraph.drive.pipeline import calibrate_drive

        if isinstance(options, DriveOptions | None):
            return calibrate_drive(rig, recording, options or DriveOptions(), progress)
    else:
        from calgraph.rig.options import RigOptions
        from calgraph.rig.pipeline import calibrate_rig

        if isinstance(options, RigOptions | None):
            return calibrate_rig(rig, recording, options or RigOptions(), progress)
    kind = "NetworkOptions" if rig.is_network else "DriveOptions" if rig.is_drive else "RigOptions"
    raise InputError(f"options: must be {kind} for this target, got {type(options).__name__}")


def compare(
    rig: Rig,
    recording: Recording,
    given: ExtrinsicsFile,
    *,
    seed: int,
    engine: Engine = THIS_PROCESS,
    cache: RecordingCache = NO_CACHE,
    progress: Progress = no_progress,
) -> "tuple[Calibration, ExtrinsicsComparison, Rig]":
    """The calibration from a recording, the comparison of given poses with it, and the rig with its intrinsics."""
    if rig.is_network:
        from calgraph.network.options import NetworkOptions
        from calgraph.network.pipeline import compare_network_extrinsics

        of_network = NetworkOptions(seed=seed, engine=engine, cache=cache)
        return *compare_network_extrinsics(rig, recording, given, of_network, progress), rig
    if rig.is_drive:
        from calgraph.drive.options import DriveOptions
        from calgraph.drive.pipeline import compare_drive_extrinsics

        return *compare_drive_extrinsics(
            rig, recording, given, DriveOptions(seed=seed, engine=engine), progress
        ), rig
    from calgraph.rig.options import RigOptions
    from calgraph.rig.pipeline import build_problem
    from calgraph.rig.verification import compare_extrinsics

    problem = build_problem(rig, recording, RigOptions(seed=seed, engine=engine, cache=cache), progress)
    return *compare_extrinsics(problem, given), problem.rig
