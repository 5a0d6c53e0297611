"""Live sessions whose other processes work in this one, and messages of simulated recordings."""

from collections.abc import Callable, Collection, Iterator
from concurrent.futures import Executor, Future
from functools import cache
from typing import Any

from rosbags.typesys import Stores, get_typestore

from calgraph.config import Rig
from calgraph.live.rig_session import RigSession, SessionOutputs, SessionPools, Solve
from calgraph.live.source import Channel, LiveMessage
from calgraph.recording import Recording
from calgraph.recording.message_types import ros2_definition
from calgraph.recording.writer import serialize_message
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


def make_live_message(topic: str, message: Message, arrival: float) -> LiveMessage:
    """A message as a bridge sends it."""
    ros_type, data = serialize_message(_load_store(), message)
    definition = ros2_definition(ros_type)
    assert definition is not None
    return LiveMessage(
        Channel(topic, ros_type, "cdr", "ros2msg", definition.text), round(arrival * 1e9), bytes(data)
    )


@cache
def _load_store() -> Any:
    return get_typestore(Stores.ROS2_HUMBLE)


def send_messages(recording: Recording, topics: Collection[str] | None = None) -> Iterator[LiveMessage]:
    """The messages of a recording as they arrive."""
    for record in recording.records(topics):
        yield make_live_message(record.topic, record.decode(), record.arrival)


def start_session(
    rig: Rig, solve: Solve | None = None, exclude: Callable[[tuple[float, float]], object] = lambda _: None
) -> tuple[RigSession, list[LiveMessage]]:
    """A session that computes at once, and the triggers that it records."""
    triggers: list[LiveMessage] = []
    pools = SessionPools(ImmediateExecutor(), 1, ImmediateExecutor(), lambda function: function())
    return RigSession(rig, "simulated", pools, SessionOutputs(triggers.append, exclude), solve), triggers
