"""Problems."""

from collections.abc import Iterator

from frozen_rigs import Make


def list_network_problems() -> Iterator[tuple[str, Make]]:
    """Names and functions of all of them."""
    yield from ()
