"""A live session, from its first message until its recording is complete and calibrated."""

import asyncio
from collections.abc import Awaitable, Callable, Iterator
from contextlib import AbstractAsyncContextManager, aclosing, contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any, cast

from calgraph.config import Rig
from calgraph.errors import CalibrationError, RecordingError
from calgraph.io.termination import handle_interrupt
from calgraph.live.drive_session import DriveSession
from calgraph.live.job_queue import Post, run_until_one_ends
from calgraph.live.live_rig import list_intrinsics_topics
from calgraph.live.network_session import NetworkSession
from calgraph.live.recorder import Recorder
from calgraph.live.rig_session import RigSession, count_analysis_processes
from calgraph.live.rig_solution import solve_captures
from calgraph.live.server import PageServer, serve_page
from calgraph.live.session import Session, SessionPools
from calgraph.live.session_folder import SessionFolder
from calgraph.live.source import LiveMessage, Notice, Source
from calgraph.parallel.engine import Processes
from calgraph.parallel.processes import worker_pool
from calgraph.recording import open_recording

# Time between two looks at whether other processes still work, s: much less than their calls take.
_IDLE_CHECK = 0.002


async def record_session(
    source: Source, write: Callable[[LiveMessage], Awaitable[None]], session: Session[Any]
) -> None:
    """Records and feeds messages until the source or the recording ends, or the operator wants to finish.

    Args:
        source: of the messages.
        write: records a message, which it gets before the session does; raises RecordingError where the recording
            has ended, with the reason.
        session: takes the messages, and notices of the source; has the operator's wish to finish.

    Raises:
        InputError: the source cannot be used.
        RecordingError: what the source reads is damaged.
    """
    rig = session.rig
    sensors = frozenset(rig.topics.values())
    # Cameras have one of several, or none where rig.yaml is to state the intrinsics.
    intrinsics = frozenset(topic for topics in list_intrinsics_topics(rig).values() for topic in topics)
    # Networks and drives are calibrated again from the whole recording.
    max_wait = 0.0 if rig.is_network or rig.is_drive else rig.settings.live.capture.timeout

    async def receive() -> None:
        # A generator, whose connection is closed with it.
        stream = cast(AbstractAsyncContextManager[Any], aclosing(cast(Any, source.stream(sensors | intrinsics))))
        async with stream as items:
            async for item in items:
                if isinstance(item, Notice):
                    if item.kind != "missing" or item.topic in sensors:
                        session.note(item)
                elif item and not await record(item):
                    return
        with suppress(TimeoutError):
            await asyncio.wait_for(wait_until_idle(), max_wait)

    async def record(message: LiveMessage) -> bool:
        try:
            await record_triggers()
            await write(message)
        except RecordingError as error:
            session.note(Notice("ended", str(error)))
            return False
        session.feed(message)
        if not source.max_lead:
            await wait_until_idle()
        elif session.lag > source.max_lead:
            while session.lag:
                await asyncio.sleep(_IDLE_CHECK)
        return True

    async def record_triggers() -> None:
        while session.triggers:
            await write(session.triggers.popleft())

    async def wait_until_idle() -> None:
        while session.busy:
            await asyncio.sleep(_IDLE_CHECK)

    await run_until_one_ends(receive(), session.finish_wanted.wait())
    with suppress(RecordingError):  # the page shows it already
        await record_triggers()


# Exit code of commands that calibrate nothing.
_NOT_CALIBRATED = 1
_NO_CAPTURES = (
    "No capture was taken. The recording is kept: resume the session and hold the board still at each place, or "
    "calibrate the recording with your rig.yaml, which finds shorter rests"
)


@dataclass(frozen=True)
class FinalCalibration:
    """How the calibration of the whole recording ended."""

    exit_code: int
    """Of ``calgraph calibrate``."""
    message: str
    """One sentence: which sensors are calibrated, or why none is."""
    report: Path | None
    """The report, if there is a result."""
    done: bool = False
    """Whether all poses are good."""


@dataclass(frozen=True)
class LiveOptions:
    """How a session is shown and ended."""

    host: str
    """Address of the page; see :func:`calgraph.live.server.serve_page`."""
    port: int
    manual: bool
    """Whether captures are only taken with the button, until the operator states otherwise."""
    calibrate: Callable[[SessionFolder], Awaitable[FinalCalibration]]
    """Calibrates the whole recording into the folder of the result."""
    announce: Callable[[PageServer], object]
    """Reports where the page is."""
    print_line: Callable[[str], object]
    """Takes a line on what has happened."""


def run_session(rig: Rig, source: Source, folder: SessionFolder, options: LiveOptions) -> int:
    """Records and calibrates until the operator or the source ends it; then calibrates the whole recording.

    The page shows the result until the program is interrupted, if it was ever open.

    Args:
        rig: of the session's folder.
        source: of the messages.
        folder: of the session; what it has recorded before is continued.
        options: of page and end.

    Returns:
        The exit code of ``calgraph calibrate`` on the recording.

    Raises:
        InputError: the source, the folder or the page's address cannot be used.
        RecordingError: the recording that is replayed is damaged.
        CalibrationError: nothing was recorded, or processes cannot be started.
        KeyboardInterrupt: the program was interrupted; the recording is complete until then.
    """
    with asyncio.Runner() as runner, _open_pools(rig, runner.get_loop().call_soon_threadsafe) as pools:
        session = _make_session(rig, source.name, folder, pools, options.print_line)
        if options.manual:
            session.command("manual")
        try:
            return runner.run(_run(rig, source, folder, session, options))
        except asyncio.CancelledError:
            raise KeyboardInterrupt from None


@contextmanager
def _open_pools(rig: Rig, post: Post) -> Iterator[SessionPools]:
    """The processes of a session; those that detect are of no use to networks."""
    with worker_pool(1) as solving:
        if rig.is_network:
            yield SessionPools(solving, 1, solving, post)
            return
        processes = 1 if rig.is_drive else count_analysis_processes(rig)
        with worker_pool(processes) as analysis:
            yield SessionPools(analysis, processes, solving, post)


def _make_session(
    rig: Rig, source: str, folder: SessionFolder, pools: SessionPools, print_line: Callable[[str], object]
) -> Session[Any]:
    """A session that goes on where the recording in the folder ends."""
    if rig.is_network:
        return NetworkSession(rig, source, pools, folder.recording, print_line)
    if rig.is_drive:
        return DriveSession(rig, source, pools, folder.recording, print_line)
    session = RigSession(rig, source, pools, solve_captures, exclude=folder.exclude, print_line=print_line)
    if folder.last_arrival() >= 0:
        with open_recording(folder.recording, rig.settings.limits) as recording:
            session.rebuild(recording, Processes(pools.analysis_processes))
    return session


async def _run(
    rig: Rig, source: Source, folder: SessionFolder, session: Session[Any], options: LiveOptions
) -> int:
    loop, task = asyncio.get_running_loop(), asyncio.current_task()
    assert task
    handle_interrupt(lambda: loop.call_soon_threadsafe(task.cancel))
    async with serve_page(session, options.host, options.port, settings=rig.settings.live.page) as server:
        recorder = Recorder(folder.recording, rig.settings.live.recorder, rig.settings.limits)
        session.show_recorder(lambda: recorder.state)
        try:
            options.announce(server)
            await record_session(source, recorder.write, session)
        finally:
            session.close()
            with suppress(RecordingError):  # its state has the error
                await recorder.close()
        if recorder.state.problem:
            options.print_line(recorder.state.problem)
        if folder.last_arrival() < 0:
            raise CalibrationError(f"{folder.recording}: no message was recorded")
        session.show_end("finishing", "The whole recording is being calibrated")
        if rig.is_network or rig.is_drive or session.state().captures:
            end = await options.calibrate(folder)
        else:
            end = FinalCalibration(_NOT_CALIBRATED, _NO_CAPTURES, None)
            options.print_line(_NO_CAPTURES)
        session.show_end("finished" if end.report else "failed", end.message, end.report, done=end.done)
        if refused := server.refusals.describe():
            options.print_line(f"the page's server {refused}")
        if server.pages_opened():
            options.print_line("the page shows the result until Ctrl-C")
            with suppress(asyncio.CancelledError):
                await asyncio.Event().wait()
    return end.exit_code
