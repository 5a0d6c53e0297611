"""The calibration of any kind of rig, and its comparison with given poses, chosen by the target."""

from dataclasses import fields
from pathlib import Path
from typing import TYPE_CHECKING, Any

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

    Options = RigOptions | NetworkOptions | DriveOptions

# A wing is imported where it is used: each takes half a second.


def make_options(rig: Rig, **stated: Any) -> "Options":
    """The options of calibrations for this target; those that other targets alone have are left out.

    Args:
        rig: that states the target.
        stated: options by name.

    Raises:
        TypeError: a name is an option of no target.
    """
    from calgraph.drive.options import DriveOptions
    from calgraph.network.options import NetworkOptions
    from calgraph.rig.options import RigOptions

    known = {field.name for kind in (RigOptions, NetworkOptions, DriveOptions) for field in fields(kind)}
    if unknown := sorted(stated.keys() - known):
        raise TypeError(f"no options of calibrations: {', '.join(unknown)}")
    kind = _options_type(rig)
    return kind(**{field.name: stated[field.name] for field in fields(kind) if field.name in stated})


def _options_type(rig: Rig) -> "type[Options]":
    if rig.is_network:
        from calgraph.network.options import NetworkOptions

        return NetworkOptions
    if rig.is_drive:
        from calgraph.drive.options import DriveOptions

        return DriveOptions
    from calgraph.rig.options import RigOptions

    return RigOptions


def calibrate(
    rig: Rig | Path | str,
    recording: Recording | Path | str,
    options: "Options | None" = None,
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
    kind = _options_type(rig)
    if not isinstance(options, kind | None):
        raise InputError(f"options: must be {kind.__name__} for this target, got {type(options).__name__}")
    chosen: Any = options or kind()
    if rig.is_network:
        from calgraph.network.pipeline import calibrate_network

        return calibrate_network(rig, recording, chosen, progress)
    if rig.is_drive:
        from calgraph.drive.pipeline import calibrate_drive

        return calibrate_drive(rig, recording, chosen, progress)
    from calgraph.rig.pipeline import calibrate_rig

    return calibrate_rig(rig, recording, chosen, progress)


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
    options: Any = make_options(rig, seed=seed, engine=engine, cache=cache)
    if rig.is_network:
        from calgraph.network.pipeline import compare_network_extrinsics

        return *compare_network_extrinsics(rig, recording, given, options, progress), rig
    if rig.is_drive:
        from calgraph.drive.pipeline import compare_drive_extrinsics

        return *compare_drive_extrinsics(rig, recording, given, options, progress), rig
    from calgraph.rig.pipeline import build_problem
    from calgraph.rig.verification import compare_extrinsics

    problem = build_problem(rig, recording, options, progress)
    return *compare_extrinsics(problem, given), problem.rig
