"""Arrivals of robots whose clock is not that of the computer that records."""

import asyncio
from collections.abc import AsyncIterator, Collection, Sequence

import numpy as np
import pytest

from calgraph.config.settings import ConnectionSettings
from calgraph.live.open_source import AlignedSource
from calgraph.live.source import LiveMessage, Notice
from calgraph.sensors import LaserScan, Trigger
from collected_sources import collect, messages, notices
from live_sessions import make_live_message

NOW = 1_790_000_000.0


class GivenSource:
    """Gives messages, the last ones a little later than the others."""

    name = "ws://robot"
    max_lead = float("inf")

    def __init__(self, given: Sequence[LiveMessage | Notice], late: Sequence[LiveMessage] = ()) -> None:
        self._given, self._late = given, late
        self.closed = False

    async def stream(self, topics: Collection[str]) -> AsyncIterator[LiveMessage | Notice]:
        assert "/scan" in topics
        try:
            for one in self._given:
                yield one
            if self._late:
                await asyncio.sleep(0.05)
            for one in self._late:
                yield one
        finally:
            self.closed = True


def scan(topic: str, offset: float, arrival: float = NOW) -> LiveMessage:
    """A scan that arrives ``offset`` s after its stamp."""
    message = LaserScan(arrival - offset, "laser", np.linspace(-1, 1, 5), np.full(5, 2.0), 0.0)
    return make_live_message(topic, message, arrival)


@pytest.fixture(autouse=True)
def align_quickly(monkeypatch: pytest.MonkeyPatch) -> None:
    """A hundredth of a second of messages decides."""
    monkeypatch.setattr("calgraph.live.open_source._ALIGNMENT_TIME", 0.01)


def arrivals(source: GivenSource) -> list[float]:
    given = collect(AlignedSource(source, ConnectionSettings()), ["/scan"])
    return [one.arrival / 1e9 for one in messages(given)]


@pytest.mark.parametrize("offset", [-30.0, 5.0, 9e7])
def test_arrivals_are_by_the_clock_of_the_stamps(offset: float) -> None:
    source = GivenSource([scan("/scan", offset)], [scan("/scan", offset + 0.1, NOW + 1)])
    assert arrivals(source) == pytest.approx([NOW - offset, NOW + 1 - offset], abs=1e-6)


def test_the_difference_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("calgraph.live.open_source._ALIGNMENT_TIME", 0)
    source = AlignedSource(GivenSource([scan("/scan", -30.0)]), ConnectionSettings())
    (notice,) = notices(collect(source, ["/scan"]))
    assert "stamps are 30.0 s ahead of the clock of arrivals" in notice.text


def test_latencies_change_no_arrival(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("calgraph.live.open_source._ALIGNMENT_TIME", 0)
    source = AlignedSource(GivenSource([scan("/scan", 0.4)]), ConnectionSettings())
    given = collect(source, ["/scan"])
    assert [one.arrival for one in messages(given)] == [round(NOW * 1e9)]
    assert notices(given) == []


def test_one_sensor_with_a_wrong_clock_does_not_decide() -> None:
    first = [scan("/a", 1e8), scan("/b", 7.0), scan("/c", 7.1)]
    assert arrivals(GivenSource(first, [scan("/b", 7.0, NOW + 1)]))[-1] == pytest.approx(NOW + 1 - 7.1, abs=1e-6)


def test_of_two_sensors_the_one_nearer_to_the_arrivals_decides() -> None:
    first = [scan("/a", 1e8), scan("/b", 0.2)]
    assert arrivals(GivenSource(first, [scan("/b", 0.2, NOW + 1)])) == [NOW, NOW, NOW + 1]


def test_messages_without_header_get_the_same_difference_in_their_order() -> None:
    trigger = make_live_message("/trigger", Trigger(NOW), NOW)
    source = AlignedSource(GivenSource([trigger, scan("/scan", 50.0)]), ConnectionSettings())
    given = messages(collect(source, ["/scan", "/trigger"]))
    assert [one.channel.topic for one in given] == ["/trigger", "/scan"]
    assert [one.arrival / 1e9 for one in given] == pytest.approx([NOW - 50.0] * 2, abs=1e-6)


def test_messages_of_a_source_that_ends_early_are_given_too(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("calgraph.live.open_source._ALIGNMENT_TIME", 100)
    assert arrivals(GivenSource([scan("/scan", 50.0)])) == [NOW - 50.0]


def test_the_connection_is_closed_with_the_stream() -> None:
    source = GivenSource([Notice("connected", "connected"), scan("/scan", 0.0)])

    async def begin() -> None:
        stream = AlignedSource(source, ConnectionSettings()).stream(["/scan"])
        await anext(stream)
        await stream.aclose()  # type: ignore[attr-defined]

    asyncio.run(begin())
    assert source.closed
