"""Cuts the walks of bodies through many scanners into parts, which the joint solution takes as bodies."""

from collections.abc import Iterator, Sequence

import numpy as np

from calgraph.network.joint.track_association import BodyTracks


def cut_bodies(bodies: Sequence[BodyTracks]) -> list[BodyTracks]:
    """The bodies, with parts of equal duration in the place of those that many scanners measured.

    Parts that fewer than two scanners measured are left out.
    """
    return [part for body in bodies for part in _cut_body(body)]


# Maximum duration of a part, s: people walk through the views of a dozen scanners in this time. A cut loses the
# smoothness of two control points out of 300. Parts of 20 s make the clocks 4 % less certain.
_MAX_DURATION = 60.0
# Bodies that fewer scanners measured are not cut: they cost little.
_MIN_SCANNERS = 9


def _cut_body(body: BodyTracks) -> Iterator[BodyTracks]:
    count = int(np.ceil((body.end - body.start) / _MAX_DURATION))
    if count < 2 or len(body.by_scanner()) < _MIN_SCANNERS:
        yield body
        return
    cuts = np.linspace(body.start, body.end, count + 1)[1:-1].tolist()
    for begin, end in zip([-np.inf, *cuts], [*cuts, np.inf], strict=True):
        # A scan at the cut is of the later part.
        selected = [(scanner, track.select((begin, np.nextafter(end, -np.inf)))) for scanner, track in body.tracks]
        tracks = tuple((scanner, track) for scanner, track in selected if len(track.times))
        if len({scanner for scanner, _ in tracks}) >= 2:
            start = min(float(track.times[0]) for _, track in tracks)
            yield BodyTracks(tracks, start, max(float(track.times[-1]) for _, track in tracks))
