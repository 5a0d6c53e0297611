"""The messages of a simulated robot capture by capture, without those between and without a recording."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

from calgraph.sensors import Message
from calgraph.simulation import BoardTruth, World, ground_truth
from calgraph.simulation.rig_scenario import MEASUREMENTS_PER_HOLD
from calgraph.simulation.robot import RobotSensor
from calgraph.simulation.world import simulate_measurement


@dataclass(frozen=True, eq=False)
class SimulatedCapture:
    """The measurements of one hold."""

    board: BoardTruth
    messages: Mapping[str, tuple[Message, ...]]
    """By sensor, the measurements that lie fully in the hold."""


def simulate_background(world: World) -> Mapping[str, tuple[Message, ...]]:
    """By sensor, the measurements of the empty room."""
    return {
        s.name: _simulate_messages(world, s, s.clock.within(0, world.scenario.background)) for s in world.robot
    }


def simulate_captures(
    world: World, measurements: int | None = MEASUREMENTS_PER_HOLD, sensors: Sequence[str] | None = None
) -> Iterator[SimulatedCapture]:
    """Simulates capture by capture the measurements that lie in its hold, without writing a recording.

    Args:
        world: to measure in.
        measurements: number of the first measurements of each sensor to simulate; all if None.
        sensors: the names of those that measure; all if None.
    """
    chosen = [s for s in world.robot if sensors is None or s.name in sensors]
    for truth, hold in zip(ground_truth(world).boards, world.trajectory.holds, strict=True):
        indices = {s.name: s.clock.within(hold.start, hold.end)[:measurements] for s in chosen}
        yield SimulatedCapture(truth, {s.name: _simulate_messages(world, s, indices[s.name]) for s in chosen})


def _simulate_messages(world: World, sensor: RobotSensor, indices: range) -> tuple[Message, ...]:
    return tuple(simulate_measurement(world, sensor, index) for index in indices)
