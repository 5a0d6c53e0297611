"""From the scans of one stationary scanner to the objects that moved through its view."""

import logging
from collections.abc import Iterable, Sequence

import numpy as np
from numpy.typing import NDArray

from calgraph.config import Cylinder, People, RangeNoise
from calgraph.errors import Rejected
from calgraph.sensors import LaserScan
from calgraph.tracking.association import follow
from calgraph.tracking.clusters import Clusters, clusters, foreground
from calgraph.tracking.features import Centres, Feature, Walks, centres, radii_of, width_of
from calgraph.tracking.periods import Piece, cut_into_periods
from calgraph.tracking.scan_stack import ScanRun, in_runs, watched
from calgraph.tracking.smoothing import smooth_all, with_unmodelled_noise
from calgraph.tracking.static_scene import learn_static_scene
from calgraph.tracking.track import Hits, Track, Tracked

_log = logging.getLogger(__name__)

# Spectral density of a walker's acceleration, m²/s³: a turn of 1 m/s² that lasts for half a second.
_AGILITY = 0.5
# What is followed for less than this, s, or moves less than this, m, is no walker: a flickering edge, a chair.
_SHORTEST = 0.5
_TRAVEL = 0.4
_FEWEST = 5


def track_scanner(
    scans: Iterable[LaserScan], target: People | Cylinder, noise: RangeNoise, *, feature: Feature = "nls"
) -> Tracked | Rejected:
    """Follows everything that moves through the view of a stationary scanner (lrf-network, sections III-B and C).

    Args:
        scans: in order of time.
        target: what moves: people, or a cylinder.
        noise: of the scanner; the noise seen on the static surroundings is used instead where there are any.
        feature: how centres are measured, see :func:`calgraph.tracking.features.centres`.

    Returns:
        Tracks and background, or the reason why there are none.
    """
    return track_runs(in_runs(scans), target, noise, feature)


def track_runs(
    runs: Sequence[ScanRun], target: People | Cylinder, noise: RangeNoise, feature: Feature
) -> Tracked | Rejected:
    """The same from scans that are stacked already."""
    scene = learn_static_scene(runs)
    if scene is None:
        return Rejected("no scan has any beam")
    sigma = scene.sigma if np.isfinite(scene.sigma) else noise.range
    # Ranges come in steps; residuals of less than a few millimetres mean nothing.
    sigma = max(sigma, 0.003)
    found = clusters(foreground(runs, scene), width_of(target), sigma)
    if not len(found):
        return Rejected("nothing of the target's size stood out from the static surroundings in any scan")
    spread = 0.5 * float(np.mean(radii_of(target)))
    identities = [members for members in follow(found, spread, _AGILITY) if _walks(found, members)]
    pieces = cut_into_periods(identities, found.scan, found.times)
    walks = _first_pass(found, pieces, target, sigma)
    measured = centres(feature, found, target, walks, sigma)
    tracks = _tracks(pieces, found, measured)
    if not tracks:
        return Rejected(
            f"{len(found)} objects of the target's size were seen in {len(np.unique(found.scan))} scans, but none "
            f"could be followed for {_SHORTEST:g} s and {_TRAVEL:g} m"
        )
    _log.info("%d objects in %d tracks", len(identities), len(tracks))
    return Tracked(tracks, scene.points, sigma, watched(runs))


def _walks(found: Clusters, members: NDArray[np.intp]) -> bool:
    """Whether what was followed moved like a walker, rather than stood or flickered."""
    if len(members) < _FEWEST or found.times[members[-1]] - found.times[members[0]] < _SHORTEST:
        return False
    low, high = np.quantile(found.means[members], [0.05, 0.95], axis=0)
    return bool(np.hypot(*(high - low)) >= _TRAVEL)


def _first_pass(found: Clusters, pieces: Sequence[Piece], target: People | Cylinder, sigma: float) -> Walks:
    """Velocities of the objects by their centres of mass."""
    walks = Walks(np.zeros((len(found), 2)), np.full(len(found), np.inf))
    measured = centres("com", found, target, walks, sigma)
    for track in smooth_all([piece.members for piece in pieces], found.times, measured, _AGILITY):
        walks.velocities[track.members] = track.mean[:, 2:]
        walks.variances[track.members] = np.trace(track.covariance[:, 2:, 2:], axis1=1, axis2=2) / 2
    return walks


def _tracks(pieces: Sequence[Piece], found: Clusters, measured: Centres) -> tuple[Track, ...]:
    """Tracks of the pieces that hold enough measurements."""
    members = [piece.members for piece in pieces]
    measured = with_unmodelled_noise(members, found.times, measured, _AGILITY)
    smoothed = smooth_all(members, found.times, measured, _AGILITY)
    return tuple(
        Track(
            found.times[motion.members],
            motion.mean[:, :2],
            motion.mean[:, 2:],
            motion.covariance[:, :2, :2] + measured.bias[motion.members],
            piece.period,
            _hits(found, motion.members),
        )
        for piece, motion in zip(pieces, smoothed, strict=True)
        if len(motion.members) >= _FEWEST
    )


def _hits(found: Clusters, members: NDArray[np.intp]) -> Hits:
    """The beams of some clusters, in their order."""
    count = found.count[members]
    owner = np.repeat(np.arange(len(members)), count)
    within = np.arange(len(owner)) - np.repeat(np.cumsum(count) - count, count)
    point = found.first[members][owner] + within
    return Hits(found.points[point], found.point_times[point], owner)
