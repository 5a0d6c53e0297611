"""Folders of live sessions: what they refuse, what a resumed session finds, and windows that are left out."""

import asyncio
import signal
import subprocess
import sys
from contextlib import closing
from dataclasses import replace
from pathlib import Path

import pytest

from calgraph.config import Rig, load_rig
from calgraph.config.settings import LimitSettings, RecorderSettings
from calgraph.errors import InputError
from calgraph.live.live_rig import make_trigger, prepare_live_rig
from calgraph.live.recorder import Recorder
from calgraph.live.session_folder import SessionFolder, create_session, resume_session

USER_RIG = """\
# of the robot in the hall
root: lidar
target: {kind: board, size: [1.0, 0.8], family: tag36h11, tags: [{id: 3, size: 0.1, center: [0.1, 0.2]}]}
capture: {exclude: [[31.0, 34.5]]}
settings: {captures: {min_hold: 1.7}, limits: {min_free_disk: 0}}
tolerance: {translation: 0.01, rotation: 0.3}
sensors:
  lidar: {kind: lidar3d, topic: /points, noise: {range: 0.0213}}
  camera: {kind: camera, topic: /image, camera_info: /camera_info}
"""
LAST = 1_700_000_003_123_456_789


def write_rig(folder: Path) -> tuple[Path, Rig]:
    file = folder / "rig.yaml"
    file.write_text(USER_RIG, encoding="utf-8")
    return file, prepare_live_rig(load_rig(file))


@pytest.fixture
def session(tmp_path: Path) -> Path:
    """A session that has ended before its first message."""
    path = tmp_path / "a session"
    create_session(path, *write_rig(tmp_path), "ws://robot:8765").close()
    return path


def record_trigger(folder: SessionFolder) -> None:
    async def run() -> None:
        recorder = Recorder(folder.recording, RecorderSettings(), LimitSettings(min_free_disk=0))
        await recorder.write(make_trigger(0.0, (LAST - 10**9) / 1e9))
        late = make_trigger(1.0, 0.0)
        await recorder.write(type(late)(late.channel, LAST, late.data))
        await recorder.close()

    asyncio.run(run())


def test_the_rig_of_the_session_is_written_completely(tmp_path: Path) -> None:
    file, rig = write_rig(tmp_path)
    with closing(create_session(tmp_path / "new" / "session", file, rig, "ws://robot:8765")) as folder:
        assert load_rig(folder.rig_file) == rig
        assert folder.recording.parent == folder.result.parent == folder.path
        assert str(file) in folder.rig_file.read_text(encoding="utf-8")


def test_settings_of_the_command_line_are_those_of_the_session(tmp_path: Path) -> None:
    file, rig = write_rig(tmp_path)
    captures = rig.settings.captures.model_copy(update={"min_hold": 2.3})
    changed = rig.model_copy(update={"settings": rig.settings.model_copy(update={"captures": captures})})
    with closing(create_session(tmp_path / "session", file, changed, "ros2:")) as folder:
        assert load_rig(folder.rig_file) == changed


def test_a_resumed_session_knows_its_source_and_rig(session: Path) -> None:
    with closing(resume_session(session)) as folder:
        assert folder.source == "ws://robot:8765"
        assert load_rig(folder.rig_file).settings.captures.min_hold == 1.7


def test_a_discarded_capture_is_left_out_when_the_session_is_calibrated(session: Path) -> None:
    window = (40.1 + 0.2, 43.000000000000014)
    with closing(resume_session(session)) as folder:
        before = load_rig(folder.rig_file)
        folder.exclude(window)
        folder.exclude((50.0, 51.0))
    with closing(resume_session(session)) as folder:
        rig = load_rig(folder.rig_file)
    assert rig.capture.exclude == ((31.0, 34.5), window, (50.0, 51.0))
    assert rig.model_copy(update={"capture": before.capture}) == before


def test_the_last_arrival_is_exact(session: Path) -> None:
    with closing(resume_session(session)) as folder:
        assert folder.last_arrival() == -1
        record_trigger(folder)
        assert folder.last_arrival() == LAST


def test_the_last_message_of_the_source_is_found_behind_a_trigger(session: Path) -> None:
    """Triggers have the arrival of the message before, which is not exact."""
    with closing(resume_session(session)) as folder:
        assert folder.find_last() == (-1, frozenset())

        async def run() -> None:
            recorder = Recorder(folder.recording, RecorderSettings(), LimitSettings(min_free_disk=0))
            trigger = make_trigger(1.0, 0.0)
            for topic, arrival in (("/a", LAST - 10**6), ("/b", LAST), ("/c", LAST)):
                await recorder.write(
                    replace(trigger, channel=replace(trigger.channel, topic=topic), arrival=arrival)
                )
            await recorder.write(replace(trigger, arrival=LAST + 200))
            await recorder.close()

        asyncio.run(run())
        assert folder.find_last() == (LAST, frozenset({"/b", "/c"}))


def test_a_session_is_not_overwritten(session: Path) -> None:
    with closing(resume_session(session)) as folder:
        record_trigger(folder)
    before = {file.name: file.read_bytes() for file in session.rglob("*") if file.is_file()}
    with pytest.raises(InputError, match=r"continue it with `resume` .*a session"):
        create_session(session, *write_rig(session.parent), "ros2:")
    assert {file.name: file.read_bytes() for file in session.rglob("*") if file.is_file()} == before


def test_a_session_that_has_recorded_nothing_is_begun_again(session: Path) -> None:
    (session / "recording").mkdir()
    with closing(create_session(session, *write_rig(session.parent), "ros2:")) as folder:
        assert folder.source == "ros2:"
    (session / "notes.txt").touch()
    with pytest.raises(InputError, match="is the folder of a live session"):
        create_session(session, *write_rig(session.parent), "ros2:")


@pytest.mark.parametrize("content", [b"", b"\x89MC", b"\x89MCAP0\r\n"])
def test_a_session_that_was_killed_before_its_first_message_goes_on(session: Path, content: bytes) -> None:
    (session / "recording").mkdir()
    (session / "recording" / "recording_0.mcap.part").write_bytes(content)
    with closing(resume_session(session)) as folder:
        assert folder.last_arrival() == -1
        record_trigger(folder)
        assert folder.last_arrival() == LAST


def test_other_files_are_no_session(tmp_path: Path) -> None:
    file, rig = write_rig(tmp_path)
    with pytest.raises(InputError, match="is not empty"):
        create_session(tmp_path, file, rig, "ros2:")
    with pytest.raises(InputError, match=r"it has no session\.yaml"):
        resume_session(tmp_path)
    with pytest.raises(InputError, match="is a file"):
        create_session(file, file, rig, "ros2:")
    assert [one.name for one in tmp_path.iterdir()] == ["rig.yaml"]


def test_a_folder_that_cannot_be_made_is_named(tmp_path: Path) -> None:
    file, rig = write_rig(tmp_path)
    with pytest.raises(InputError, match="cannot be written to"):
        create_session(file / "session", file, rig, "ros2:")


HOLDER = """
import os, sys
from pathlib import Path
from calgraph.live.session_folder import resume_session
folder = resume_session(Path(sys.argv[1]))
# A worker lives on.
if os.fork():
    print("held", flush=True)
sys.stdin.read()
"""


@pytest.mark.skipif(sys.platform == "win32", reason="SIGKILL")
def test_one_process_uses_a_session_until_it_is_killed(session: Path) -> None:
    with subprocess.Popen(
        [sys.executable, "-c", HOLDER, str(session)], stdin=subprocess.PIPE, stdout=subprocess.PIPE
    ) as holder:
        assert holder.stdout is not None
        assert holder.stdout.readline() == b"held\n"
        with pytest.raises(InputError, match="is in use by another live session"):
            resume_session(session)
        holder.send_signal(signal.SIGKILL)
        holder.wait()
    resume_session(session).close()
