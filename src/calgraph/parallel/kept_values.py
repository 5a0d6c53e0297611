"""Values that calls take, and that stay where these run."""

from collections.abc import Callable, Sequence
from itertools import count
from typing import Any, TypeVar
from weakref import WeakValueDictionary

from calgraph.parallel.mapped_arrays import ArrayMemory, LimitedValue

Result = TypeVar("Result")

_numbers = count()
existing: WeakValueDictionary[int, "Kept"] = WeakValueDictionary()
"""All kept values of this process by number; a process that is forked has them as well."""


class Kept:
    """Stands for a value among the arguments of calls and of other kept values, not within other arguments.

    The value is computed where calls take it, and stays there for as long as this object exists. Where it is lost,
    it is computed again.

    Args:
        function: defined at module level; what it returns depends on its arguments only.
        arguments: of the function.
    """

    def __init__(self, function: Callable[..., Any], *arguments: Any) -> None:
        self.number = next(_numbers)
        self._recipe = function, arguments
        self._computed: LimitedValue | None = None
        existing[self.number] = self

    @classmethod
    def of(cls, value: Any) -> "Kept":
        """One whose value is there already."""
        return cls(_return, value)

    @property
    def recipe(self) -> tuple[Callable[..., Any], tuple[Any, ...]]:
        """A function and its arguments, which compute the value."""
        return (_return, (self._computed.value,)) if self._computed else self._recipe

    def compute(self, memory: ArrayMemory) -> Any:
        """The value, which is kept in the memory."""
        if self._computed is None:
            function, arguments = self._recipe
            self._computed = memory.keep(call_with_values(function, arguments, memory))
            self._recipe = _return, ()
        return self._computed.value


def call_with_values(function: Callable[..., Result], arguments: Sequence[Any], memory: ArrayMemory) -> Result:
    """The result of a call whose arguments may be kept values."""
    return function(*(one.compute(memory) if isinstance(one, Kept) else one for one in arguments))


def _return(value: Any) -> Any:
    return value
