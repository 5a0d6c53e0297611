"""``calgraph intrinsics``: the intrinsics of every camera of a recording."""

import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import numpy as np
import typer
from rich.markup import escape

from calgraph.cli.cache import open_cache
from calgraph.cli.common_options import (
    ClusterOption,
    ForceOption,
    JobsOption,
    NoCacheOption,
    check_not_overwriting,
    open_engine,
)
from calgraph.cli.console import console, make_table
from calgraph.cli.progress import progress_bars
from calgraph.cli.setting_options import SetOption, load_rig_with, override_settings, parse_limits
from calgraph.config import CameraSpec, Rig
from calgraph.config.draft import name_sensors
from calgraph.errors import CalibrationError, InputError, Rejected
from calgraph.io.atomic import replace_folder_atomically, write_text
from calgraph.io.text_writing import format_json
from calgraph.io.yaml_limits import MAX_RIG_VALUES
from calgraph.io.yaml_reading import read_yaml
from calgraph.recording import Recording, find_topics, open_recordings
from calgraph.result.exports.camera_info import to_camera_info
from calgraph.result.exports.kalibr import to_single_camchain
from calgraph.sensors import DISTORTION_NAMES

if TYPE_CHECKING:
    from calgraph.rig.intrinsics.estimate import IntrinsicsEstimate

_FORMAT = "calgraph-intrinsics/1"
_SUMMARY = "intrinsics.json"


def intrinsics(
    board: Annotated[
        Path, typer.Argument(metavar="RIG.yaml", help="The rig; or the target alone, as calgraph board prints it.")
    ],
    recordings: Annotated[
        list[str], typer.Argument(metavar="RECORDING...", help="Anything that calibrate reads, with images.")
    ],
    out: Annotated[Path, typer.Option("--out", "-o", metavar="OUT", help="Folder for the results.")],
    camera: Annotated[
        list[str] | None,
        typer.Option(metavar="TOPIC", help="Only this camera: its topic, or its name in RIG.yaml; repeatable."),
    ] = None,
    force: ForceOption = False,
    jobs: JobsOption = None,
    cluster: ClusterOption = None,
    overrides: SetOption = None,
    no_cache: NoCacheOption = False,
    json: Annotated[bool, typer.Option("--json", help=f"Print {_SUMMARY}.")] = False,
) -> None:
    """Estimate the intrinsics of cameras from images of a board, which may move.

    Writes into OUT, by camera, camera_info.yaml (ROS) and camchain.yaml (Kalibr), and intrinsics.json.

    Exit code 0: estimated; 1: the images of a camera do not determine its intrinsics; 2: invalid input.
    """
    from calgraph.rig.intrinsics.pipeline import calibrate_intrinsics  # takes seconds, which --help should not

    check_not_overwriting(out, [_SUMMARY], force=force)
    with replace_folder_atomically(out, _SUMMARY) as folder:
        with open_recordings(recordings, parse_limits(overrides)) as recording, progress_bars() as progress:
            rig = _select_cameras(_read_rig(board, recording, overrides), camera or [])
            with open_engine(jobs, cluster, rig.settings.cluster) as engine:
                found = calibrate_intrinsics(rig, recording, engine, progress, open_cache(unused=no_cache))
        content = format_json(_summarize(rig, found), indent=1)
        write_text(folder / _SUMMARY, content + "\n")
        remarks = [*_write_files(rig, found, folder)]
    if json:
        typer.echo(content)
    else:
        _print(found)
        for remark in remarks:
            console().print(f"[yellow]![/] {escape(remark)}")
        console().print(f"Results are in {escape(str(out))}")
    failures = [f"{name}: {one.reason}" for name, one in found.items() if isinstance(one, Rejected)]
    if failures:
        raise CalibrationError("\n".join(failures))


def _read_rig(file: Path, recording: Recording, overrides: Sequence[str] | None) -> Rig:
    """The rig, or the board with all cameras of the recording."""
    if file.is_dir() or "sensors" in read_yaml(file, MAX_RIG_VALUES):
        return load_rig_with(file, overrides)
    from calgraph.printing import read_boards

    kinds = {topic.name: topic.kind for topic in find_topics(recording) if topic.kind == "camera" and topic.count}
    if not kinds:
        raise InputError(f"{recording.path}: has no images")
    names = name_sensors(kinds)
    boards = read_boards(file)
    rig = Rig(
        root=next(iter(names.values())),
        target=boards if len(boards) > 1 else boards[0],
        sensors={name: CameraSpec(topic=topic) for topic, name in names.items()},
    )
    return override_settings(rig, overrides)


def _select_cameras(rig: Rig, wanted: Sequence[str]) -> Rig:
    """The rig with the wanted cameras alone; all if none is named."""
    cameras = rig.cameras()
    for one in wanted:
        if not any(one in (name, spec.topic) for name, spec in cameras.items()):
            listed = ", ".join(f"{name} ({spec.topic})" for name, spec in cameras.items()) or "none"
            raise InputError(f"--camera: there is no camera {one!r}; there are {listed}")
    chosen = {n: s for n, s in cameras.items() if not wanted or {n, s.topic} & set(wanted)}
    if not chosen:
        raise InputError("sensors: has no camera")
    return rig.model_copy(update={"root": next(iter(chosen)), "sensors": chosen})


def _summarize(rig: Rig, found: Mapping[str, "IntrinsicsEstimate | Rejected"]) -> dict[str, Any]:
    return {
        "format": _FORMAT,
        "cameras": {
            name: {"topic": rig.cameras()[name].topic}
            | ({"failure": one.reason} if isinstance(one, Rejected) else _summarize_estimate(one))
            for name, one in found.items()
        },
    }


def _summarize_estimate(estimate: "IntrinsicsEstimate") -> dict[str, Any]:
    camera, coverage = estimate.camera, estimate.coverage
    names = ("fx", "fy", "cx", "cy", *DISTORTION_NAMES[camera.model])
    values, stddev = camera.intrinsics.tolist(), estimate.stddev.tolist()
    return {
        "model": camera.model,
        "width": camera.width,
        "height": camera.height,
        "K": values[:4],
        "distortion": values[4:],
        "stddev": dict(zip(names, stddev, strict=False)),
        "rms": estimate.noise,
        "views": estimate.views,
        "views_used": len(estimate.detections),
        "coverage": {"cells": coverage.cells, "reach": coverage.reach, "tilt": float(np.degrees(coverage.tilt))},
        "other_models": estimate.rejected_models,
        "shortcomings": estimate.shortcomings,
    }


def _write_files(rig: Rig, found: Mapping[str, "IntrinsicsEstimate | Rejected"], folder: Path) -> Sequence[str]:
    """Writes the files of each camera; returns why some could not be written."""
    remarks = []
    for name, one in found.items():
        if isinstance(one, Rejected):
            continue
        # Names of sensors may have any character.
        place = folder / re.sub(r"[^\w-]", "_", name)
        place.mkdir(exist_ok=True)
        write_text(place / "camera_info.yaml", to_camera_info(name, one.camera))
        try:
            chain = to_single_camchain(name, one.camera, rig.cameras()[name].topic)
        except InputError as error:
            remarks.append(f"{error}; camchain.yaml is left out")
        else:
            write_text(place / "camchain.yaml", chain)
    return remarks


def _print(found: Mapping[str, "IntrinsicsEstimate | Rejected"]) -> None:
    output = console()
    for name, one in found.items():
        if isinstance(one, Rejected):
            continue
        camera, coverage = one.camera, one.coverage
        output.print(
            f"[bold]{escape(name)}[/]: {camera.model}, {camera.width} x {camera.height} pixels, from "
            f"{len(one.detections)} of {one.views} views, RMS {one.noise:.2f} px"
            + escape("".join(f"; {model}: {fit}" for model, fit in one.rejected_models.items()))
        )
        rows = []
        names = ("fx, px", "fy, px", "cx, px", "cy, px", *DISTORTION_NAMES[camera.model])
        for parameter, value, stddev in zip(names, camera.intrinsics, one.stddev, strict=False):
            decimals = max(1 - int(np.floor(np.log10(stddev))), 0) if 0 < stddev < np.inf else 3
            rows.append((parameter, f"{value:.{decimals}f}", f"{stddev:.{decimals}f}"))
        output.print(make_table(["parameter"], ("estimate", "σ"), rows, gap=2))
        output.print(
            f"Corners in {100 * coverage.cells:.0f} % of the image; a quarter of the views is tilted by more than "
            f"{np.degrees(coverage.tilt):.0f}°"
        )
        for shortcoming in one.shortcomings:
            output.print(f"[yellow]![/] {escape(f'{name}: {shortcoming}')}")
