"""Views of boards by cameras whose intrinsics are not known, from all captures of a recording."""

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np

from calgraph.errors import Rejected
from calgraph.io.columns import Arrays
from calgraph.parallel.engine import THIS_PROCESS, Engine
from calgraph.rig.captures.hold_messages import Messages, search_holds
from calgraph.rig.captures.holds import Hold
from calgraph.rig.captures.previews import PreviewSize
from calgraph.rig.detection.board_views import BoardView, BoardViewFinder
from calgraph.sensors import Message


def find_views_in_holds(
    messages: Messages,
    holds: Sequence[Hold],
    topics: Mapping[str, str],
    finders: Mapping[str, BoardViewFinder],
    *,
    engine: Engine = THIS_PROCESS,
    progress: Callable[[float], None] | None = None,
) -> dict[str, dict[int, tuple[BoardView, ...]]]:
    """Finds the marks of boards in the images of every hold.

    Args:
        messages: of all cameras.
        holds: with the stamps of the messages to use.
        topics: topic by camera.
        finders: by camera.
        engine: searches.
        progress: called with the number of holds and cameras done.

    Returns:
        The views by camera and capture, in the order of the captures.
    """
    found: dict[str, dict[int, tuple[BoardView, ...]]] = {name: {} for name in topics}
    searched = search_holds(_find, finders, messages, holds, topics, engine=engine)
    for done, (capture, name, views) in enumerate(searched, start=1):
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


def encode_views(views: Mapping[int, Sequence[BoardView]]) -> tuple[dict[str, Any], Arrays]:
    """The views of one camera, by capture, as a JSON object and arrays, to the last bit."""
    listed = [(capture, view) for capture, of_capture in views.items() for view in of_capture]
    content = {"views": [[capture, view.board, *view.size, *view.pixels.shape[:2]] for capture, view in listed]}
    arrays = {
        "ids": np.concatenate([np.zeros(0, np.intp), *(view.ids for _, view in listed)]),
        "corners": np.concatenate([np.zeros((0, 3)), *(view.flat_corners for _, view in listed)]),
        "pixels": np.concatenate([np.zeros((0, 2)), *(view.flat_pixels for _, view in listed)]),
    }
    return content, arrays


def decode_views(content: Mapping[str, Any], arrays: Arrays) -> dict[int, tuple[BoardView, ...]]:
    """The views from what :func:`encode_views` gives.

    Raises:
        KeyError: a key or an array is missing.
        ValueError: an array has another size than the views.
    """
    views: dict[int, tuple[BoardView, ...]] = {}
    marks = points = 0
    for capture, board, width, height, count, k in content["views"]:
        end = points + count * k
        view = BoardView(
            arrays["ids"][marks : marks + count].copy(),
            arrays["corners"][points:end].reshape(count, k, 3).copy(),
            arrays["pixels"][points:end].reshape(count, k, 2).copy(),
            (width, height),
            board,
        )
        views[capture] = (*views.get(capture, ()), view)
        marks, points = marks + count, end
    return views
