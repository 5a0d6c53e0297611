"""Calls for each body of a network, in batches that an engine evaluates."""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Any

from calgraph.network.joint.problem import BodyObservations, NetworkProblem, NetworkState
from calgraph.parallel.engine import THIS_PROCESS, MapEngine
from calgraph.parallel.kept_values import Kept

# Beams of a batch: their equations take about 20 ms, of which calls and results are a tenth.
_BATCH_BEAMS = 20_000
# Batches of a part: enough for many processes, and five million numbers if there is one for each beam.
_BATCHES_PER_PART = 250


@dataclass(frozen=True, eq=False)
class KeptValues:
    """One value for each body, which stays where the calls for it run."""

    batches: tuple[Kept, ...]
    """A list of them by batch."""


@dataclass(frozen=True, eq=False)
class BodyBatches:
    """The bodies of a network in batches, which do not depend on the engine."""

    engine: MapEngine
    bodies: tuple[slice, ...]
    """Of each batch, among those of the network."""
    kept: tuple[Kept, ...]
    """The bodies of each batch."""

    @classmethod
    def place(cls, bodies: Sequence[BodyObservations], engine: MapEngine = THIS_PROCESS) -> "BodyBatches":
        """Hands bodies to an engine."""
        bounds, beams = [0], 0
        for index, body in enumerate(bodies):
            beams += sum(len(scans.ranges) for scans in body.scans)
            if beams >= _BATCH_BEAMS or index == len(bodies) - 1:
                bounds.append(index + 1)
                beams = 0
        slices = tuple(slice(*pair) for pair in pairwise(bounds))
        return cls(engine, slices, tuple(Kept.of(bodies[selected]) for selected in slices))

    def divide(self) -> Iterator["BodyBatches"]:
        """Parts of successive batches, whose results are in memory together."""
        for first in range(0, len(self.bodies), _BATCHES_PER_PART):
            part = slice(first, first + _BATCHES_PER_PART)
            yield replace(self, bodies=self.bodies[part], kept=self.kept[part])

    def thin(self, step: int) -> "BodyBatches":
        """Every n-th batch."""
        return replace(self, bodies=self.bodies[::step], kept=self.kept[::step])

    def map(
        self, function: Callable[..., Any], network: NetworkProblem, state: NetworkState, *others: Any
    ) -> list[Any]:
        """Calls a function with the network and the state, one body and its path, and further values of the body.

        Args:
            function: as for :meth:`MapEngine.map`; the network that it gets has no bodies and
                walls, and the state no paths.
            network: with these bodies.
            state: with their paths.
            others: one sequence or :class:`KeptValues` for each further argument.

        Returns:
            Results by body.
        """
        return self._call(self._list_work(function, network, state, others))

    def map_values(self, function: Callable[..., Any], *values: Any) -> list[Any]:
        """Calls a function with one of the values of each argument for each body, as of :meth:`map`."""
        return self._call([(function, (), *of_batch) for of_batch in self._select(values)])

    def keep(
        self, function: Callable[..., Any], network: NetworkProblem, state: NetworkState, *others: Any
    ) -> KeptValues:
        """The results of the same calls, which are computed where calls take them, and stay there."""
        work = self._list_work(function, network, state, others)
        return KeptValues(tuple(Kept(_call_each, *arguments) for arguments in work))

    def _call(self, work: Sequence[tuple[Any, ...]]) -> list[Any]:
        return [result for batch in self.engine.map(_call_each, work) for result in batch]

    def _list_work(
        self, function: Callable[..., Any], network: NetworkProblem, state: NetworkState, others: tuple[Any, ...]
    ) -> list[tuple[Any, ...]]:
        shared = Kept.of((replace(network, bodies=(), walls=(), prior=None), replace(state, paths=())))
        of_batches = self._select((KeptValues(self.kept), state.paths, *others))
        return [(function, shared, *of_batch) for of_batch in of_batches]

    def _select(self, values: tuple[Any, ...]) -> Iterator[list[Any]]:
        """The values of the bodies of each batch."""
        for n, selected in enumerate(self.bodies):
            yield [one.batches[n] if isinstance(one, KeptValues) else one[selected] for one in values]


def _call_each(function: Callable[..., Any], shared: tuple[Any, ...], *of_bodies: Sequence[Any]) -> list[Any]:
    return [function(*shared, *of_body) for of_body in zip(*of_bodies, strict=True)]
