"""``calgraph live``: records a running robot, with feedback meanwhile, and calibrates it."""

import asyncio
import shlex
import sys
from collections.abc import Collection
from contextlib import closing
from pathlib import Path
from typing import Annotated

import typer
from rich.markup import escape

from calgraph.cli.common_options import everyday, tuning
from calgraph.cli.console import console
from calgraph.cli.setting_options import SetOption, load_rig_with
from calgraph.config import Rig, load_rig
from calgraph.errors import InputError
from calgraph.io.termination import add_cleanup, allow_interrupts, remove_cleanup
from calgraph.live.link import format_link
from calgraph.live.live_rig import prepare_live_rig
from calgraph.live.live_session import FinalCalibration, LiveOptions, run_session
from calgraph.live.open_source import open_source
from calgraph.live.replay import ReplaySource
from calgraph.live.server import DEFAULT_HOST, DEFAULT_PORT, PageServer
from calgraph.live.session_folder import SessionFolder, create_session, resume_session
from calgraph.live.source import Source
from calgraph.result import Calibration, load_calibration

_INTERRUPTED = 128 + 2
"""Exit code as shells give it for SIGINT."""
# With the interpreter of this process: PATH may have another one, or none.
_CALGRAPH = (sys.executable, "-c", "from calgraph.cli import main; main()")


def live(
    rig_file: Annotated[
        Path | None, typer.Argument(metavar="[RIG.yaml]", help="Sensors and target; not with --resume.")
    ] = None,
    source: Annotated[
        str | None,
        everyday(
            metavar="SOURCE",
            help="ws://HOST:PORT of a Foxglove bridge, ros2:// or ros2://DOMAIN/NAMESPACE, or a recording.",
        ),
    ] = None,
    out: Annotated[
        Path | None, everyday("--out", "-o", metavar="SESSION", help="New folder for recording and result.")
    ] = None,
    resume: Annotated[
        Path | None, everyday(metavar="SESSION", help="Go on with a session that was interrupted.")
    ] = None,
    host: Annotated[
        str,
        everyday(
            metavar="ADDRESS", help="Address of the page; 0.0.0.0: also for phones, with a token in the link."
        ),
    ] = DEFAULT_HOST,
    port: Annotated[
        int, everyday(metavar="N", min=0, max=65535, help="Port of the page; 0: any free one.")
    ] = DEFAULT_PORT,
    manual: Annotated[bool, everyday("--manual", help="Board: capture only when the button is pressed.")] = False,
    speed: Annotated[
        float | None,
        tuning(metavar="X", help="Of a replayed recording: 1 is real time, 0 as fast as nothing is skipped."),
    ] = None,
    overrides: SetOption = None,
) -> None:
    """Record a running robot, watch sensors and captures on a phone, and calibrate.

    Records the topics of RIG.yaml into SESSION/recording, and shows captures, standard deviations and the next
    board pose on a page; of a robot that drives, how it has turned and travelled, and what to drive. When the
    operator or the source ends the session, the recording is calibrated into SESSION/result as calgraph calibrate
    does it with SESSION/rig.yaml.

    Exit code: that of calgraph calibrate; 130 if it was interrupted by Ctrl-C.
    """
    if resume:
        _check_alone(rig_file, out, overrides)
        folder = resume_session(resume)
    else:
        folder = _create_session(rig_file, source, out, speed, overrides)
    with closing(folder):
        rig = load_rig(folder.rig_file)
        opened = _open_source(source or folder.source, rig, speed, *folder.find_last())
        options = LiveOptions(host, port, manual, _calibrate, _announce, _print_line)
        allow_interrupts()
        try:
            code = run_session(rig, opened, folder, options)
        except KeyboardInterrupt:
            _explain_interruption(folder)
            code = _INTERRUPTED
    raise typer.Exit(code)


def _create_session(
    rig_file: Path | None, source: str | None, out: Path | None, speed: float | None, overrides: list[str] | None
) -> SessionFolder:
    """The folder of a new session; nothing is written if the source cannot be one."""
    needed = {"RIG.yaml": rig_file, "--source": source, "-o": out}
    missing = [name for name, value in needed.items() if value is None]
    if rig_file is None or source is None or out is None:
        raise InputError(
            f"{', '.join(missing)}: missing; a new session needs RIG.yaml --source SOURCE -o SESSION, and "
            "one that was interrupted --resume SESSION"
        )
    rig = load_rig_with(rig_file, overrides)
    _open_source(source, rig, speed)
    return create_session(out, rig_file, prepare_live_rig(rig), source)


def _check_alone(rig_file: Path | None, out: Path | None, overrides: list[str] | None) -> None:
    given = {"RIG.yaml": rig_file, "-o": out, "--set": overrides}
    if extra := [name for name, value in given.items() if value]:
        raise InputError(f"{', '.join(extra)}: not with --resume, which goes on with the session's own rig.yaml")


def _open_source(
    text: str, rig: Rig, speed: float | None, start_after: int = -1, but: Collection[str] | None = None
) -> Source:
    pace = 1.0 if speed is None else speed
    opened = open_source(text, rig.settings, speed=pace, start_after=start_after, but=but)
    if speed is not None and not isinstance(opened, ReplaySource):
        raise InputError(f"--speed: only for recordings, and {text} is an address")
    return opened


def _announce(server: PageServer) -> None:
    """Prints the links to the page, without delay in files and pipes."""
    typer.echo(format_link(server, sys.stdout.encoding))
    sys.stdout.flush()


def _print_line(text: str) -> None:
    """Prints a line on what has happened."""
    console().print(escape(text), soft_wrap=True)
    sys.stdout.flush()


async def _calibrate(folder: SessionFolder) -> FinalCalibration:
    """Calibrates the recording by another process, as the page is served by this one."""
    report = folder.result / "report.html"
    before = _read_time(report)
    arguments = [*map(str, ("calibrate", folder.rig_file, folder.recording, "-o", folder.result)), "--force"]
    _print_line(f"calgraph {shlex.join(arguments)}")
    process = await asyncio.create_subprocess_exec(*_CALGRAPH, *arguments, stderr=asyncio.subprocess.PIPE)
    assert process.stderr is not None
    add_cleanup(process, process.terminate)
    try:
        lines = []
        async for line in process.stderr:
            lines.append(line.decode(errors="replace").rstrip().removeprefix("calgraph: "))
            typer.echo(line.decode(errors="replace"), err=True, nl=False)
        code = await process.wait()
    finally:
        remove_cleanup(process)
        if process.returncode is None:
            process.terminate()
    if _read_time(report) == before:
        why = lines[-1] if lines else "The calibration failed"
        again = f"The recording is kept; when this is corrected: calgraph {shlex.join(arguments)}"
        return FinalCalibration(code, f"{why}. {again}", None)
    summary, done = _summarise(load_calibration(folder.result / "calibration.yaml"))
    return FinalCalibration(code, summary, report, done)


def _read_time(file: Path) -> int:
    """When a file was written, ns; 0 if there is none."""
    return file.stat().st_mtime_ns if file.is_file() else 0


def _summarise(calibration: Calibration) -> tuple[str, bool]:
    """One sentence on the verdicts, and whether all poses are good."""
    by_grade: dict[str, list[str]] = {}
    for sensor in calibration.sensors:
        if sensor.name != calibration.root:
            by_grade.setdefault(sensor.verdict.grade, []).append(sensor.name)
    by_grade["not calibrated"] = list(calibration.evidence.unconnected)
    good = len(by_grade.pop("good", []))
    others = "".join(
        f"; {', '.join(names)} {'is' if len(names) == 1 else 'are'} {grade}"
        for grade, names in by_grade.items()
        if names
    )
    count = len(calibration.sensors) + len(calibration.evidence.unconnected) - 1
    return (
        (f"{good} of {count} poses are good{others}", False) if others else (f"All {count} poses are good", True)
    )


def _explain_interruption(folder: SessionFolder) -> None:
    session, result = shlex.quote(str(folder.path)), shlex.quote(str(folder.result))
    rig, recording = shlex.quote(str(folder.rig_file)), shlex.quote(str(folder.recording))
    _print_line(
        f"\nInterrupted; what was recorded is kept. Go on: calgraph live --resume {session}; or calibrate: "
        f"calgraph calibrate {rig} {recording} -o {result}"
    )
