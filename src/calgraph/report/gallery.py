"""Every capture with small pictures of what each sensor measured, and why that was used or not."""

from collections.abc import Mapping, Sequence

import numpy as np

from calgraph.geometry import Array
from calgraph.report.formatting import escaped, fixed, length
from calgraph.report.thumbnails import thumbnail
from calgraph.result import Calibration, CaptureRow, Snapshot

# Pictures on the page at most, and captures that are shown without asking.
_MOST, _OPEN = 1000, 6


def gallery(calibration: Calibration) -> str:
    """A card for each capture of which there are pictures; nothing where there are none."""
    taken = {(s.capture, s.sensor): s for s in calibration.pictures.snapshots}
    rows: dict[int, list[CaptureRow]] = {}
    for row in calibration.evidence.captures:
        rows.setdefault(row.capture, []).append(row)
    pictured = [capture for capture in rows if any((capture, row.sensor) in taken for row in rows[capture])]
    if not pictured:
        return ""
    each = max(len(rows[capture]) for capture in pictured)
    shown = pictured[:: len(pictured) * each // _MOST + 1]
    boards = {(view.capture, view.sensor): view.measured for view in calibration.pictures.board_views}
    cards = [_card(capture, rows[capture], taken, boards) for capture in shown]
    some = "" if len(shown) == len(rows) else f" Shown are {len(shown)} of {len(rows)}, evenly."
    rest = "".join(cards[_OPEN:])
    more = f"<details><summary>{len(cards) - _OPEN} more captures</summary>\
<div class='gallery'>{rest}</div></details>"
    return (
        f"<h3>What it looked like</h3><p>Frames are blue where a measurement was used, and orange where it was "
        f"not. Scans are seen from above, clouds from the LiDAR; what was taken for the board is orange.{some}</p>"
        f'<div class="gallery">{"".join(cards[:_OPEN])}</div>{more if rest else ""}'
    )


def _card(
    capture: int,
    rows: Sequence[CaptureRow],
    taken: Mapping[tuple[int, str], Snapshot],
    boards: Mapping[tuple[int, str], Array],
) -> str:
    when = f"{fixed(rows[0].start, 1)} – {fixed(rows[0].end, 1)} s"
    thumbs = "".join(
        _thumb(row, taken.get((capture, row.sensor)), boards.get((capture, row.sensor), np.empty((0, 3))))
        for row in rows
    )
    return (
        f'<article class="capture"><h4>Capture {capture}<span>{when}</span></h4>'
        f'<div class="thumbs">{thumbs}</div></article>'
    )


def _thumb(row: CaptureRow, taken: Snapshot | None, board: Array) -> str:
    url = thumbnail(taken, board) if taken else ""
    image = f'<img alt="" loading="lazy" src="{url}">' if url else ""
    outcome = "used" if row.used else "rejected"
    words = f"used{'' if row.residual is None else f', {length(row.residual)}'}" if row.used else row.reason
    return (
        f'<figure class="{outcome}"><div class="frame">{image}</div>'
        f"<figcaption><b>{escaped(row.sensor)}</b>{escaped(words)}</figcaption></figure>"
    )
