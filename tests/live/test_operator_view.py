"""What the page shows of a session besides its captures, and which commands reach it."""

from dataclasses import replace
from pathlib import Path

import pytest

from calgraph.live.live_session import OperatorView
from calgraph.live.source import Notice
from calgraph.live.state import RecorderState, SessionState
from live_pages import GivenSession

STATE = SessionState("rig", "ready", "Hold the board still in a new pose", "ws://robot:8765")


def make_view(printed: list[str] | None = None) -> tuple[OperatorView, GivenSession]:
    session, lines = GivenSession(STATE), [] if printed is None else printed
    return OperatorView(session, lines.append), session


def test_notices_are_shown_newest_first_and_printed() -> None:
    printed: list[str] = []
    view, _ = make_view(printed)
    for number in range(7):
        view.note(Notice("refused", f"notice {number}"))
    assert view.state().notices == ("notice 6", "notice 5", "notice 4", "notice 3", "notice 2")
    assert printed == [f"notice {number}" for number in range(7)]


def test_notices_of_the_session_follow() -> None:
    view, session = make_view()
    session.show(replace(STATE, notices=("computed every 40 s",)))
    view.note(Notice("connected", "connected to ws://robot:8765"))
    assert view.state().notices == ("connected to ws://robot:8765", "computed every 40 s")


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
def test_the_connection_is_that_of_the_last_notice_on_it(kinds: list[str], connected: bool) -> None:
    view, _ = make_view()
    for kind in kinds:
        view.note(Notice(kind, kind))  # type: ignore[arg-type]
    assert view.state().connected is connected


def test_messages_that_the_source_lost_are_counted_with_those_recorded() -> None:
    view, _ = make_view()
    view.show_recorder(lambda: RecorderState(messages=12))
    view.note(Notice("lost", "3 messages lost", "/scan", 3))
    view.note(Notice("lost", "2 messages lost", "/scan", 2))
    view.note(Notice("refused", "not a message", "/scan", 7))
    assert view.state().recorder == RecorderState(messages=12, lost=5)


def test_connections_that_broke_are_counted_once_each() -> None:
    view, _ = make_view()
    for kind in ("disconnected", "connected", "disconnected", "disconnected", "connected"):
        view.note(Notice(kind, kind))
    assert view.state().recorder.gaps == 1


def test_commands_reach_the_session_until_it_ends() -> None:
    view, session = make_view()
    view.command("trigger")
    view.show_end("finishing", "The whole recording is being calibrated")
    view.command("discard")
    assert session.commands.qsize() == 1


def test_finish_is_for_who_owns_the_session() -> None:
    view, session = make_view()
    view.command("finish")
    assert view.finish_wanted.is_set()
    assert session.commands.empty()


def test_the_end_and_its_report_are_shown(tmp_path: Path) -> None:
    view, _ = make_view()
    view.show_end("finishing", "The whole recording is being calibrated")
    assert (view.state().phase, view.state().report, view.report()) == ("finishing", False, None)
    view.show_end("finished", "All 4 poses are good", tmp_path / "report.html", done=True)
    state = view.state()
    assert (state.phase, state.headline, state.report) == ("finished", "All 4 poses are good", True)
    assert state.done
    assert view.report() == tmp_path / "report.html"
