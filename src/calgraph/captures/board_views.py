"""Views of boards by cameras whose intrinsics are not known, from all captures of a recording."""

from collections.abc import Callable, Iterable, Mapping, Sequence

from calgraph.captures.detect import gather_messages
from calgraph.captures.holds import Hold
from calgraph.captures.previews import PreviewSize
from calgraph.detection import BoardView, BoardViewFinder
from calgraph.errors import Rejected
from calgraph.processes import parallel_stream
from calgraph.sensors import Message, RecordedMessage


def find_views_in_holds(
    records: Iterable[RecordedMessage],
    holds: Sequence[Hold],
    topics: Mapping[str, str],
    finders: Mapping[str, BoardViewFinder],
    *,
    jobs: int = 1,
    progress: Callable[[float], None] | None = None,
) -> dict[str, dict[int, tuple[BoardView, ...]]]:
    """Finds the marks of boards in the images of every hold.

    Args:
        records: all records of the cameras, streamed.
        holds: with the stamps of the messages to use.
        topics: topic by camera.
        finders: by camera.
        jobs: maximum number of processes, see :func:`calgraph.processes.parallel_stream`.
        progress: called with the number of holds and cameras done.

    Returns:
        The views by camera and capture, in the order of the captures.
    """
    found: dict[str, dict[int, tuple[BoardView, ...]]] = {name: {} for name in topics}
    work = gather_messages(records, holds, topics, {})
    for done, (capture, name, views) in enumerate(parallel_stream(_find, work, finders, jobs), start=1):
        if not isinstance(views, Rejected):
            found[name][capture] = views
        if progress:
            progress(done)
    return {name: dict(sorted(by_capture.items())) for name, by_capture in found.items()}


def _find(
    finders: Mapping[str, BoardViewFinder],
    capture: int,
    name: str,
    decoders: Sequence[Callable[[], Message]],
    size: PreviewSize | None,  # noqa: ARG001
) -> tuple[int, str, tuple[BoardView, ...] | Rejected]:
    return capture, name, finders[name].find([decode() for decode in decoders])
