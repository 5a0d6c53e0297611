"""``calgraph view``: a calibration in the browser, as a 3-D scene."""

import webbrowser
from dataclasses import replace
from pathlib import Path
from typing import Annotated

import typer

from calgraph.config import load_rig
from calgraph.errors import InputError
from calgraph.io.termination import allow_interrupts
from calgraph.result import calibrated_cameras, load_calibration, load_scene


def view(
    result: Annotated[Path, typer.Argument(metavar="OUT", help="Folder that calibrate wrote.")],
    port: Annotated[int, typer.Option(metavar="N", min=1, max=65535, help="Port, or the next free one.")] = 8080,
    host: Annotated[
        str, typer.Option(help="Address to serve at; 0.0.0.0: also for other machines.")
    ] = "127.0.0.1",
    browser: Annotated[bool, typer.Option("--browser/--no-browser", help="Open the page.")] = True,
) -> None:
    """Show a calibration in the browser: sensors, measurements, and residuals when one is moved.

    Serves until Ctrl-C.
    """
    from calgraph.viewer import Viewer  # takes seconds, which --help should not

    if not result.is_dir():
        raise InputError(f"{result}: is no folder; give the one that calibrate wrote with -o")
    calibration = load_calibration(result)
    rig = load_rig(result / "rig.resolved.yaml")
    calibration = replace(calibration, pictures=load_scene(result / "scene.npz", rig.settings.limits))
    with Viewer(calibration, calibrated_cameras(calibration, rig), host, port) as viewer:
        typer.echo(f"{result} is shown at {viewer.url}; Ctrl-C ends it")
        if browser:
            webbrowser.open(viewer.url)
        allow_interrupts()
        try:
            viewer.serve()
        except KeyboardInterrupt:
            typer.echo()
