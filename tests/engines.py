"""An engine whose calls share nothing with this process, as those on a cluster."""

import pickle
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import AbstractContextManager
from typing import Any, TypeVar

from calgraph.parallel.engine import THIS_PROCESS, MapEngine

Result = TypeVar("Result")


class PicklingEngine:
    """Calls in this process whose functions, arguments and results are pickled."""

    jobs = 1
    workers = 2

    def __init__(self) -> None:
        self.sent: list[int] = []
        """Bytes of the arguments of each call of a stream, and before them of what these share."""

    def map(
        self,
        function: Callable[..., Result],
        work: Sequence[tuple[Any, ...]],
        progress: Callable[[float], None] = lambda _done: None,
    ) -> list[Result]:
        return THIS_PROCESS.map(function, work, progress)

    def put(self, values: Sequence[Any]) -> list[Any]:
        return THIS_PROCESS.put(values)

    def map_and_keep(
        self, function: Callable[..., tuple[Result, Any]], work: Sequence[tuple[Any, ...]]
    ) -> tuple[list[Result], list[Any]]:
        return THIS_PROCESS.map_and_keep(function, work)

    def stream(
        self, function: Callable[..., Result], work: Iterable[tuple[Any, ...]], shared: Any
    ) -> Iterator[Result]:
        copied = self._send(shared)
        for arguments in work:
            result = pickle.loads(pickle.dumps(function))(copied, *self._send(arguments))  # noqa: S301
            yield pickle.loads(pickle.dumps(result))  # noqa: S301

    def keep_workers(self, max_kept_bytes: int) -> AbstractContextManager[MapEngine]:
        return THIS_PROCESS.keep_workers(max_kept_bytes)

    def _send(self, value: Any) -> Any:
        data = pickle.dumps(value)
        self.sent.append(len(data))
        return pickle.loads(data)  # noqa: S301
