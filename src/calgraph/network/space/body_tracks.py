"""Tracks of bodies of one levelled 3-D LiDAR, and the same as those of a planar scanner."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from calgraph.config.settings import TrackingSettings
from calgraph.geometry import Array, se3
from calgraph.network.space.bodies import Bodies
from calgraph.network.space.observations import BodyTrack, SpaceObservations
from calgraph.network.tracking.association import associate
from calgraph.network.tracking.clusters import Clusters
from calgraph.network.tracking.features import MeasuredCenters
from calgraph.network.tracking.smoothing import add_unmodeled_noise, smooth_segments
from calgraph.network.tracking.track import ScannerTracks, Track
from calgraph.network.tracking.track_scanner import is_moving_target

# Standard deviation of a centre about the body's, m: fronts of bodies that turn, and edges between beams.
_CENTER_STDDEV = 0.1
# Longest time between measurements of one track, s: four missed sweeps of 10 Hz.
_MAX_GAP = 0.45
# From the visible surface of a body to its axis, m: half the depth of a chest.
_BODY_RADIUS = 0.12
# Heights of walls over the floor, m: above tables and chairs, below ceilings.
_WALL_HEIGHTS = (0.5, 2.5)
# Angle of a cell of the walls' outline, rad (0.5°), and the least rows of elevation that agree on it.
_WALL_ANGLE = float(np.radians(0.5))
# Distance of neighbouring points of one wall, m, beyond which the outline breaks.
_WALL_GAP = 1.0


def track_bodies(bodies: Bodies, T_floor_sensor: Array, settings: TrackingSettings) -> tuple[BodyTrack, ...]:
    """Tracks of what moves, cut where another body is near."""
    if not len(bodies.sweep):
        return ()
    # ``associate`` takes clusters: one of one point for each body.
    count = len(bodies.times)
    objects = Clusters(
        bodies.centers[:, :2], np.arange(count), np.ones(count, dtype=np.intp), bodies.sweep, bodies.times,
        bodies.times, np.zeros(count), np.zeros(count, dtype=np.bool_),
    )  # fmt: skip
    identities = [
        members
        for members in associate(objects, _CENTER_STDDEV, settings.acceleration_density)
        if is_moving_target(objects, members, settings.motion)
    ]
    T_sensor_floor = se3.inverse(T_floor_sensor)
    pieces = [piece for members in identities for piece in _cut(members, bodies)]
    return tuple(
        BodyTrack(
            bodies.times[piece],
            se3.apply(T_sensor_floor, bodies.centers[piece]),
            bodies.stddev[piece, 0],
            bodies.stddev[piece, 1],
            bodies.counts[piece],
        )
        for piece in sorted(pieces, key=lambda piece: float(bodies.times[piece[0]]))
        if len(piece) >= settings.motion.min_detections
    )


def to_scanner_tracks(observations: SpaceObservations, settings: TrackingSettings) -> ScannerTracks:
    """The tracks in the levelled plane, at the axes of bodies, and walls, as those of a planar scanner there."""
    tracks = []
    for track in observations.tracks:
        centers = se3.apply(observations.T_floor_sensor, track.centers)[:, :2]
        distance = np.linalg.norm(centers, axis=1, keepdims=True)
        radius = _BODY_RADIUS if track.yaws is None else 0.0
        tracks.append((track, centers * (1 + radius / np.maximum(distance, _BODY_RADIUS))))
    smoothed = _smooth(tracks, settings)
    walls, stddev = _outline_walls(observations)
    return ScannerTracks(smoothed, walls, stddev, observations.coverage)


def _cut(members: NDArray[np.intp], bodies: Bodies) -> list[NDArray[np.intp]]:
    """The measured parts of an identity between others nearby, and long gaps."""
    met = np.cumsum(~bodies.alone[members])
    keep = bodies.alone[members] & bodies.whole[members]
    members, met = members[keep], met[keep]
    breaks = (np.diff(met) > 0) | (np.diff(bodies.times[members]) > _MAX_GAP)
    ascending = np.diff(bodies.times[members], prepend=-np.inf) > 0
    cuts = np.flatnonzero(breaks) + 1
    parts = zip(np.split(members, cuts), np.split(ascending, cuts), strict=True)
    return [part[later] for part, later in parts if len(part)]


def _smooth(tracks: Sequence[tuple[BodyTrack, Array]], settings: TrackingSettings) -> tuple[Track, ...]:
    if not tracks:
        return ()
    times = np.concatenate([track.times for track, _ in tracks])
    axes = np.concatenate([axis for _, axis in tracks])
    sight = axes / np.linalg.norm(axes, axis=1, keepdims=True)
    along = np.einsum("ti,tj->tij", sight, sight)
    radial, tangential = (
        np.concatenate([getattr(track, name) for track, _ in tracks])[:, None, None] ** 2
        for name in ("radial_stddev", "tangential_stddev")
    )
    noise = radial * along + tangential * (np.eye(2) - along)
    ends = np.cumsum([len(track.times) for track, _ in tracks])[:-1]
    segments = np.split(np.arange(len(times)), ends)
    measured = add_unmodeled_noise(segments, times, MeasuredCenters(axes, noise, np.zeros_like(noise)), settings)
    return tuple(
        Track(
            times[one.members],
            one.mean[:, :2],
            one.mean[:, 2:],
            one.covariance[:, :2, :2] + measured.bias[one.members],
            number,
        )
        for number, one in enumerate(smooth_segments(segments, times, measured, settings))
        if len(one.members) >= settings.motion.min_detections
    )


def _outline_walls(observations: SpaceObservations) -> tuple[Array, float]:
    """(M, 2) static points at the height of people by angle, NaN at breaks; and the noise of ranges, m."""
    static = observations.static
    levelled = se3.apply(observations.T_floor_sensor, static.points)
    low, high = _WALL_HEIGHTS
    wall = ~observations.floor_points & (levelled[:, 2] > low) & (levelled[:, 2] < high)
    stddev = float(np.median(static.stddev[wall])) if wall.any() else float(np.median(static.stddev))
    points = levelled[wall, :2]
    if not len(points):
        return np.zeros((0, 2)), stddev
    bearing = np.floor(np.arctan2(points[:, 1], points[:, 0]) / _WALL_ANGLE)
    distance = np.hypot(points[:, 0], points[:, 1])
    # The farthest of an angle: pillars and shelves are lower than walls, or before them.
    order = np.lexsort((-distance, bearing))
    outline = points[order][np.flatnonzero(np.diff(bearing[order], prepend=np.nan))]
    broken = np.linalg.norm(np.diff(outline, axis=0), axis=1) > _WALL_GAP
    return np.insert(outline, np.flatnonzero(broken) + 1, np.nan, axis=0), stddev
