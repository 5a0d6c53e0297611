"""``calgraph export``: a calibration in the format of another program."""

import shlex
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Literal

import typer

from calgraph.cli.common_options import list_choices
from calgraph.cli.console import console
from calgraph.config import Rig, load_rig
from calgraph.errors import CalibrationError, InputError
from calgraph.io.atomic import write_text
from calgraph.io.yaml_reading import read_text
from calgraph.result import Calibration, SensorPose, load_calibration
from calgraph.result import export as export_text
from calgraph.result.calibration_reading import find_calibration
from calgraph.result.exports import Parents

Format = Literal["launch", "tf", "urdf", "kalibr", "camera_info", "corrections", "json"]
_WITH_INTRINSICS = ("kalibr", "camera_info")
_PUBLISH = {
    "launch": "; to publish it: ros2 launch {file}",
    "tf": "; to publish it: ros2 topic pub --qos-durability transient_local /tf_static tf2_msgs/msg/TFMessage "
    '"$(cat {file})"',
}
"""What to do with a file of a format."""


def export(
    result: Annotated[Path, typer.Argument(metavar="RESULT", help="OUT of calibrate, or a calibration.yaml.")],
    format: Annotated[
        Format,
        typer.Option(
            "--format",
            "-f",
            metavar=list_choices(Format),
            help="launch: ROS 2 static transform publishers; tf: tf2_msgs/TFMessage as YAML; urdf: links and "
            "fixed joints; kalibr: camchain of the cameras; camera_info: their intrinsics for ROS; corrections: "
            "of ranges and angles, as YAML; json: the whole result.",
        ),
    ],
    urdf: Annotated[
        Path | None, typer.Option(metavar="FILE", help="urdf: correct the joints of this one.")
    ] = None,
    parents: Annotated[
        Parents | None,
        typer.Option(
            metavar=list_choices(Parents),
            help="launch, tf, new urdf: every frame has the root's as its parent (default), or that of the "
            "sensor's parent in the spanning tree.",
        ),
    ] = None,
    joints: Annotated[
        list[str] | None,
        typer.Option(
            "--joint",
            metavar="SENSOR=JOINT",
            help="urdf with --urdf: correct this joint for a sensor, instead of the one above its frame; as of a "
            "camera whose driver publishes camera_link to the optical frame. Repeatable.",
        ),
    ] = None,
    only: Annotated[
        Literal["good"] | None,
        typer.Option(metavar="good", help="Leave out poses that are weak or not observable, and name them."),
    ] = None,
    rig: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE",
            help="kalibr, camera_info: rig with the cameras' intrinsics; rig.resolved.yaml next to RESULT if "
            "left out.",
        ),
    ] = None,
    distance: Annotated[
        float | None,
        typer.Option(
            metavar="M",
            min=0.01,
            max=1000.0,
            help="corrections: working distance at which they are judged; the median of the board's if left out.",
        ),
    ] = None,
    force: Annotated[
        bool, typer.Option("--force", help="Export poses that are weak or not observable, too.")
    ] = False,
    out: Annotated[
        Path | None, typer.Option("--out", "-o", metavar="FILE", help="File to write; stdout if left out.")
    ] = None,
) -> None:
    """Write a calibration as launch file, tf2 YAML, URDF, Kalibr camchain, ROS camera_info, corrections or JSON.

    Exit code 1: a pose is not good; give --only good to leave it out, or --force to export it as it is.
    """
    for name, value, formats in (
        ("--urdf", urdf, ("urdf",)),
        ("--rig", rig, _WITH_INTRINSICS),
        ("--distance", distance, ("corrections",)),
    ):
        if value and format not in formats:
            raise InputError(f"{name}: goes with --format {' or '.join(formats)}, got --format {format}")
    if parents and (urdf or format not in ("launch", "tf", "urdf")):
        raise InputError("--parents: goes with --format launch, tf, and urdf without --urdf")
    if joints and not urdf:
        raise InputError("--joint: goes with --urdf, whose joints it names")
    if only and force:
        raise InputError("--only: goes without --force, which exports all poses")
    file = find_calibration(result)
    calibration = load_calibration(file)
    joint_of_sensor = _parse_joints(joints or [])
    if only:
        _print_left_out(calibration)
    elif not force and format != "json":  # which states the verdicts
        _check_poses_are_good(calibration)
    cameras_rig = _rig(rig, file) if format in _WITH_INTRINSICS else None
    urdf_text = read_text(urdf) if urdf else None
    try:
        text = export_text(
            calibration, format, rig=cameras_rig, urdf=urdf_text, joints=joint_of_sensor,
            parents=parents or "root", only=only, distance=distance,
        )  # fmt: skip
    except InputError as error:
        raise InputError(f"{urdf or file}: {error}") from error
    if out:
        write_text(out, text)
        next_step = _PUBLISH.get(format, "").format(file=shlex.quote(str(out)))
        console(stderr=True).print(f"Wrote {out}{next_step}", markup=False, soft_wrap=True)
    else:
        typer.echo(text, nl=not text.endswith("\n"))


def _check_poses_are_good(calibration: Calibration) -> None:
    """Raises CalibrationError if a pose is not good."""
    poor = [
        f"{line}; give --force to export it as it is, or --only good to leave it out"
        for line in _list_poor(calibration, calibration.sensors)
    ]
    if poor:
        raise CalibrationError("\n".join(poor))


def _print_left_out(calibration: Calibration) -> None:
    """Names the sensors that are not exported, with the reason."""
    left_out = _list_poor(calibration, [s for s in calibration.sensors if s.parent is not None])
    left_out += [f"{name} is not connected: {why}" for name, why in calibration.evidence.unconnected.items()]
    for line in left_out:
        console(stderr=True).print(f"Left out: {line}", markup=False, soft_wrap=True)


def _list_poor(calibration: Calibration, sensors: Sequence[SensorPose]) -> list[str]:
    """Those of sensors, and the vehicle's frame, that are not good, with the reason."""
    verdicts = {sensor.name: sensor.verdict for sensor in sensors}
    if calibration.base:
        verdicts[calibration.base.frame] = calibration.base.verdict
    return [f"{name} is {one.grade}: {one.reason}" for name, one in verdicts.items() if one.grade != "good"]


def _parse_joints(pairs: Sequence[str]) -> dict[str, str]:
    """The joint of each sensor, from SENSOR=JOINT."""
    found: dict[str, str] = {}
    for pair in pairs:
        sensor, equals, joint = pair.partition("=")
        if not (sensor and equals and joint):
            raise InputError(f"--joint: must be SENSOR=JOINT, such as camera=camera_joint, got {pair!r}")
        if sensor in found:
            raise InputError(f"--joint: {sensor} has {found[sensor]} already, one sensor has one joint")
        found[sensor] = joint
    return found


def _rig(given: Path | None, calibration: Path) -> Rig | None:
    """The rig given, else the one that was written beside the calibration, if any."""
    beside = calibration.with_name("rig.resolved.yaml")
    file = given or (beside if beside.is_file() else None)
    return load_rig(file) if file else None
