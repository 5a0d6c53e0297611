"""Live sessions whose other processes work in this one, and messages of simulated recordings."""

from collections import deque
from collections.abc import Callable, Collection, Iterator
from concurrent.futures import Executor, Future
from typing import Any

from calgraph.config import Rig
from calgraph.live.rig_session import RigSession, Solve
from calgraph.live.sensor_solution import Solution
from calgraph.live.session import Session, SessionPools
from calgraph.live.source import LiveMessage, make_message
from calgraph.live.state import Action, SensorState, SessionState
from calgraph.recording import Recording
from calgraph.sensors import Message


class ImmediateExecutor(Executor):
    """Computes where results are wanted, so that tests do not depend on time."""

    def submit(self, fn: Callable[..., Any], /, *args: Any, **kwargs: Any) -> Future[Any]:
        future: Future[Any] = Future()
        try:
            future.set_result(fn(*args, **kwargs))
        except Exception as error:
            future.set_exception(error)
        return future


class WaitingExecutor(Executor):
    """Computes nothing until it is told to; calls are counted."""

    def __init__(self) -> None:
        self.calls: list[tuple[Future[Any], Callable[..., Any], tuple[Any, ...]]] = []

    def submit(self, fn: Callable[..., Any], /, *args: Any, **_: Any) -> Future[Any]:
        future: Future[Any] = Future()
        self.calls.append((future, fn, args))
        return future

    def finish(self, result: object) -> None:
        """The last call returns, or raises."""
        future = self.calls[-1][0]
        if isinstance(result, Exception):
            future.set_exception(result)
        else:
            future.set_result(result)


class GivenSession(Session[Solution]):
    """A session of a state that it is given; it computes nothing, and keeps what the operator wants."""

    def __init__(self, rig: Rig, state: SessionState, print_line: Callable[[str], object]) -> None:
        pools = SessionPools(ImmediateExecutor(), 1, ImmediateExecutor(), lambda function: function())
        super().__init__(rig, "given", pools, print_line)
        self.given = state
        self.actions: list[Action] = []

    def describe(self) -> SessionState:
        return self.given

    def list_sensor_states(self) -> Iterator[SensorState]:
        return (SensorState(name, spec.kind) for name, spec in self.rig.sensors.items())

    def act(self, action: Action) -> None:
        self.actions.append(action)

    def feed(self, message: LiveMessage) -> None:
        """Nothing is computed."""

    def advance(self) -> None:
        """Nothing is computed."""


def make_live_message(topic: str, message: Message, arrival: float) -> LiveMessage:
    """A message as a bridge sends it."""
    return make_message(topic, message, round(arrival * 1e9))


def send_messages(recording: Recording, topics: Collection[str] | None = None) -> Iterator[LiveMessage]:
    """The messages of a recording as they arrive."""
    for record in recording.records(topics):
        yield make_live_message(record.topic, record.decode(), record.arrival)


def start_session(
    rig: Rig, solve: Solve | None = None, exclude: Callable[[tuple[float, float]], object] = lambda _: None
) -> tuple[RigSession, deque[LiveMessage]]:
    """A session that computes at once, and the triggers that it records."""
    pools = SessionPools(ImmediateExecutor(), 1, ImmediateExecutor(), lambda function: function())
    session = RigSession(rig, "simulated", pools, solve, exclude=exclude, print_line=lambda _: None)
    return session, session.triggers
