"""Values that calls take, and that stay where these run."""

from collections.abc import Callable, Sequence
from itertools import count
from typing import Any, TypeVar
from weakref import WeakValueDictionary

from calgraph.parallel.mapped_arrays import ArrayMemory

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
        self.recipe = function, arguments
        """A function and its arguments, which compute the value."""
        self._is_computed = False
        existing[self.number] = self

    @classmethod
    def of(cls, value: Any) -> "Kept":
        """One whose value is there already."""
        return cls(_return, value)

    def compute(self, memory: ArrayMemory) -> Any:
        """The value, which is kept in the memory."""
        if not self._is_computed:
            self.recipe = _return, (memory.keep(call_with_values(*self.recipe, memory), self),)
            self._is_computed = True
        return self.recipe[1][0]


def call_with_values(function: Callable[..., Result], arguments: Sequence[Any], memory: ArrayMemory) -> Result:
    """The result of a call whose arguments may be kept values."""
    return function(*(one.compute(memory) if isinstance(one, Kept) else one for one in arguments))


def _return(value: Any) -> Any:
    return value
