"""Cuts the walks of bodies through many scanners into parts, which the joint solution takes as bodies."""

from collections.abc import Iterator, Sequence

import numpy as np

from calgraph.config.settings import BodyPartSettings
from calgraph.network.joint.track_association import BodyTracks


def cut_bodies(bodies: Sequence[BodyTracks], settings: BodyPartSettings) -> list[BodyTracks]:
    """The bodies, with parts of equal duration in the place of those that many scanners measured.

    Parts that fewer than two scanners measured are left out.
    """
    return [part for body in bodies for part in _cut_body(body, settings)]


def _cut_body(body: BodyTracks, settings: BodyPartSettings) -> Iterator[BodyTracks]:
    count = int(np.ceil((body.end - body.start) / settings.max_duration))
    if count < 2 or len(body.by_scanner()) < settings.min_scanners:
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
