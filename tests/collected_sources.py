"""What a source gives, collected."""

import asyncio
from collections.abc import Collection

from calgraph.live.source import LiveMessage, Notice, Source


def collect(source: Source, topics: Collection[str]) -> list[LiveMessage | Notice]:
    """All that a source gives until it ends."""

    async def run() -> list[LiveMessage | Notice]:
        return [one async for one in source.stream(topics) if one is not None]

    return asyncio.run(run())


def messages(given: Collection[LiveMessage | Notice]) -> list[LiveMessage]:
    return [one for one in given if isinstance(one, LiveMessage)]


def notices(given: Collection[LiveMessage | Notice]) -> list[Notice]:
    return [one for one in given if isinstance(one, Notice)]
