"""An engine whose calls share nothing with this process, as those on a cluster."""

import pickle
from collections.abc import Callable, Iterable, Iterator
from contextlib import AbstractContextManager, nullcontext
from typing import Any, TypeVar
from weakref import WeakKeyDictionary

from calgraph.parallel.engine import MapEngine
from calgraph.parallel.kept_values import Kept
from calgraph.parallel.mapped_arrays import ArrayMemory

Result = TypeVar("Result")


class PicklingEngine:
    """Calls in this process whose functions, arguments and results are pickled."""

    jobs = 1
    workers = 2

    def __init__(self) -> None:
        self.sent: list[int] = []
        """Bytes of the arguments of each call, and before them of kept values that it is the first to take."""
        self._kept: WeakKeyDictionary[Kept, Any] = WeakKeyDictionary()

    def map(self, function: Callable[..., Result], work: Iterable[tuple[Any, ...]]) -> Iterator[Result]:
        for arguments in work:
            kept = [self._place(one) for one in arguments if isinstance(one, Kept)]
            others = iter(self._send([one for one in arguments if not isinstance(one, Kept)]))
            values = iter(kept)
            given = [next(values if isinstance(one, Kept) else others) for one in arguments]
            result = pickle.loads(pickle.dumps(function))(*given)  # noqa: S301
            yield pickle.loads(pickle.dumps(result))  # noqa: S301

    def keep_workers(self, max_kept_bytes: int) -> AbstractContextManager[MapEngine]:  # noqa: ARG002
        return nullcontext(self)

    def _place(self, kept: Kept) -> Any:
        if kept not in self._kept:
            self._kept[kept] = self._send(kept.compute(ArrayMemory()))
        return self._kept[kept]

    def _send(self, value: Any) -> Any:
        data = pickle.dumps(value)
        self.sent.append(len(data))
        return pickle.loads(data)  # noqa: S301
