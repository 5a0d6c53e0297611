"""What the page shows of a session besides its captures, and which commands reach it."""

from dataclasses import replace
from pathlib import Path

import pytest

from calgraph.config import Rig
from calgraph.live.source import Notice
from calgraph.live.state import RecorderState, SessionState
from live_sessions import GivenSession

STATE = SessionState("rig", "ready", "Hold the board still in a new pose", "ws://robot:8765")


RIG = Rig.model_validate(
    {
        "root": "a",
        "target": {"kind": "people"},
        "sensors": {"a": {"kind": "lidar2d", "topic": "/a", "noise": {"range": 0.01}}},
    }
)


@pytest.fixture
def printed() -> list[str]:
    return []


@pytest.fixture
def session(printed: list[str]) -> GivenSession:
    return GivenSession(RIG, STATE, printed.append)


def test_notices_are_shown_newest_first_and_printed(session: GivenSession, printed: list[str]) -> None:
    for number in range(7):
        session.note(Notice("refused", f"notice {number}"))
    assert session.state().notices == ("notice 6", "notice 5", "notice 4", "notice 3", "notice 2")
    assert printed == [f"notice {number}" for number in range(7)]


def test_notices_of_the_session_follow(session: GivenSession) -> None:
    session.given = replace(STATE, notices=("computed every 40 s",))
    session.note(Notice("connected", "connected to ws://robot:8765"))
    assert session.state().notices == ("connected to ws://robot:8765", "computed every 40 s")


@pytest.mark.parametrize(
    ("kinds", "connected"),
    [
        ([], False),
        (["connected"], True),
        (["connected", "disconnected"], False),
        (["connected", "ended"], False),
        (["connected", "missing", "lost", "refused"], True),
    ],
)
def test_the_connection_is_that_of_the_last_notice_on_it(
    session: GivenSession, kinds: list[str], connected: bool
) -> None:
    for kind in kinds:
        session.note(Notice(kind, kind))  # type: ignore[arg-type]
    assert session.state().connected is connected


def test_messages_that_the_source_lost_are_counted_with_those_recorded(session: GivenSession) -> None:
    session.show_recorder(lambda: RecorderState(messages=12))
    session.note(Notice("lost", "3 messages lost", "/scan", 3))
    session.note(Notice("lost", "2 messages lost", "/scan", 2))
    session.note(Notice("refused", "not a message", "/scan", 7))
    assert session.state().recorder == RecorderState(messages=12, lost=5)


def test_connections_that_broke_are_counted_once_each(session: GivenSession) -> None:
    for kind in ("disconnected", "connected", "disconnected", "disconnected", "connected"):
        session.note(Notice(kind, kind))
    assert session.state().recorder.gaps == 1


def test_commands_reach_the_session_until_it_ends(session: GivenSession) -> None:
    session.command("trigger")
    session.show_end("finishing", "The whole recording is being calibrated")
    session.command("discard")
    assert session.actions == ["trigger"]


def test_finish_is_for_who_owns_the_session(session: GivenSession) -> None:
    session.command("finish")
    assert session.finish_wanted.is_set()
    assert session.actions == []


def test_the_end_and_its_report_are_shown(session: GivenSession, tmp_path: Path) -> None:
    session.show_end("finishing", "The whole recording is being calibrated")
    assert (session.state().phase, session.state().report, session.report()) == ("finishing", False, None)
    session.show_end("finished", "All 4 poses are good", tmp_path / "report.html", done=True)
    state = session.state()
    assert (state.phase, state.headline, state.report) == ("finished", "All 4 poses are good", True)
    assert state.done
    assert session.report() == tmp_path / "report.html"
