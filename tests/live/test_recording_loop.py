"""The loop of a live session: what is recorded before what is fed, and what ends it."""

import asyncio
from collections.abc import AsyncIterator, Collection, Sequence

import pytest

from calgraph.config import Rig
from calgraph.errors import InputError, RecordingError
from calgraph.live.live_session import record_session
from calgraph.live.source import Channel, LiveMessage, Notice
from calgraph.live.state import SessionState
from live_sessions import GivenSession

RIG = Rig.model_validate(
    {
        "root": "laser",
        "target": {
            "kind": "board",
            "size": [1.0, 0.8],
            "family": "tag36h11",
            "tags": [{"id": 3, "size": 0.1, "center": [0, 0]}],
        },
        "sensors": {
            "laser": {"kind": "lidar2d", "topic": "/scan", "noise": {"range": 0.01}},
            "camera": {"kind": "camera", "topic": "/image"},
        },
    }
)


def message(number: int, topic: str = "/scan") -> LiveMessage:
    return LiveMessage(Channel(topic, "pkg/msg/Type", "cdr", "ros2msg", ""), number, b"")


class GivenSource:
    """Gives what it is given; an exception among it is raised, and None waits for ever."""

    name = "given"
    max_lead = float("inf")

    def __init__(self, *items: LiveMessage | Notice | Exception | None) -> None:
        self._items = items
        self.topics: set[str] = set()
        self.closed = False

    async def stream(self, topics: Collection[str]) -> AsyncIterator[LiveMessage | Notice]:
        self.topics = set(topics)
        try:
            for item in self._items:
                await asyncio.sleep(0)
                if item is None:
                    await asyncio.Event().wait()
                elif isinstance(item, Exception):
                    raise item
                else:
                    yield item
        finally:
            self.closed = True


class Loop(GivenSession):
    """A session, a recorder and a source in the loop; ``log`` has what happened in its order."""

    def __init__(
        self,
        *items: LiveMessage | Notice | Exception | None,
        disk: int = 100,
        busy: int = 0,
        lags: Sequence[float] = (),
        max_lead: float = float("inf"),
    ) -> None:
        self.log: list[str] = []
        super().__init__(RIG, SessionState("rig", "ready", "", "given"), self.log.append)
        self.source = GivenSource(*items)
        self.source.max_lead = max_lead
        self.trigger_after: int | None = None
        self._disk, self._busy, self.lags = disk, busy, list(lags)

    @property
    def busy(self) -> bool:
        self._busy -= 1
        return self._busy >= 0

    @property
    def lag(self) -> float:  # type: ignore[override]
        return self.lags.pop(0) if self.lags else 0.0

    async def write(self, one: LiveMessage) -> None:
        if len(self.log) >= self._disk:
            raise RecordingError("its disk is almost full")
        self.log.append(f"recorded {one.channel.topic} {one.arrival}")

    def feed(self, one: LiveMessage) -> None:
        self.log.append(f"fed {one.arrival}")
        if one.arrival == self.trigger_after:
            self.triggers.append(message(one.arrival, "/trigger"))
        if one.arrival == 99:
            self.command("finish")

    def run(self) -> None:
        asyncio.run(asyncio.wait_for(record_session(self.source, self.write, self), 30.0))


def test_each_message_is_recorded_before_the_session_has_it() -> None:
    loop = Loop(message(1), message(2))
    loop.run()
    assert loop.log == ["recorded /scan 1", "fed 1", "recorded /scan 2", "fed 2"]


def test_topics_of_intrinsics_are_wanted_too() -> None:
    loop = Loop()
    loop.run()
    assert {"/scan", "/image", "/camera_info"} <= loop.source.topics


def test_a_trigger_is_recorded_before_the_messages_that_follow_it() -> None:
    loop = Loop(message(1), message(2))
    loop.trigger_after = 1
    loop.run()
    assert loop.log == ["recorded /scan 1", "fed 1", "recorded /trigger 1", "recorded /scan 2", "fed 2"]


def test_the_last_trigger_is_recorded() -> None:
    loop = Loop(message(1))
    loop.trigger_after = 1
    loop.run()
    assert loop.log[-1] == "recorded /trigger 1"


def test_captures_under_way_are_waited_for_where_the_source_ends() -> None:
    loop = Loop(message(1), busy=2)
    loop.run()
    assert not loop.busy
    assert loop.log == ["recorded /scan 1", "fed 1"]


@pytest.mark.parametrize(("max_lead", "left"), [(1.0, 0), (3.0, 3), (float("inf"), 3)])
def test_messages_wait_until_the_session_has_caught_up(max_lead: float, left: int) -> None:
    loop = Loop(message(1), lags=[2.0, 1.0, 0.5, 0.0], max_lead=max_lead)
    loop.run()
    assert len(loop.lags) == left


def test_messages_wait_for_the_session_where_none_is_to_be_skipped() -> None:
    loop = Loop(message(1), message(2), busy=3, max_lead=0.0)
    loop.feed = lambda one: loop.log.append(f"fed {one.arrival}, {loop._busy}")  # type: ignore[method-assign]
    loop.run()
    assert loop.log == ["recorded /scan 1", "fed 1, 3", "recorded /scan 2", "fed 2, -1"]


def test_the_operator_ends_a_source_that_does_not_end() -> None:
    loop = Loop(message(99), None)
    loop.run()
    assert loop.source.closed


def test_a_full_disk_ends_the_session_with_a_word() -> None:
    loop = Loop(message(1), message(2), message(3), disk=2)
    loop.run()
    assert loop.log == ["recorded /scan 1", "fed 1", "its disk is almost full"]
    assert loop.source.closed


@pytest.mark.parametrize("error", [InputError("no such address"), RecordingError("damaged")])
def test_errors_of_the_source_reach_the_caller(error: Exception) -> None:
    loop = Loop(message(1), error)
    with pytest.raises(type(error), match=str(error)):
        loop.run()
    assert loop.source.closed


def test_only_missing_topics_of_sensors_are_named() -> None:
    loop = Loop(
        Notice("missing", "/scan is not served", "/scan"),
        Notice("missing", "/camera_info is not served", "/camera_info"),
    )
    loop.run()
    assert loop.log == ["/scan is not served"]
