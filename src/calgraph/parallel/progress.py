"""How calls report progress."""

from collections.abc import Callable

Progress = Callable[[str, float], None]
"""Called with the name of the step under way and how much of it is done, 0..1."""


def no_progress(_step: str, _done: float) -> None:
    """Ignores progress."""
