"""Vehicles in the sweeps of a levelled sensor: rigid bodies of unknown outline, registered to maps of themselves.

What moves and is larger than a person is followed by its centroid, and each of its sweeps is then registered to a
map of the body that grows with them. This gives the motion of a point that is fixed to the body, while centroids
follow the side that faces the sensor. Which point it is, another sensor does not know: see ``vehicle_pairs.py``.

Sources: Chen and Medioni, "Object modelling by registration of multiple range images", 1992, for distances from
planes; Lange, Little and Taylor, "Robust statistical modeling using the t distribution", 1989, for the weights.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial import cKDTree

from calgraph.config.settings import TrackingSettings
from calgraph.geometry import Array, Index, se3
from calgraph.network.space.bodies import cluster
from calgraph.network.space.observations import BodyTrack, SpaceObservations
from calgraph.network.space.static_directions import MovingPoints
from calgraph.network.tracking.association import associate
from calgraph.network.tracking.clusters import Clusters
from calgraph.network.tracking.track_scanner import is_moving_target
from calgraph.surfaces.flat_cells import sum_moments

# Heights of points, m: above wheels and forks, up to the roofs of vans.
_HEIGHTS = (0.25, 3.0)
# Edge of cells, m, of which those at most two apart are of one vehicle: rings on a roof are up to 0.6 m apart.
_CELL = 0.25
# Least points in a sweep, and most that are registered.
_MIN_POINTS, _MAX_POINTS = 25, 150
# Length of what is no person in the median sweep, m: a person who steps and swings arms is up to 0.9 m long.
_MIN_LENGTH = 1.0
# Standard deviation of centroids about a point of the body, m, as the visible side changes.
_CENTROID_STDDEV = 0.25
# Least time between registered sweeps, s: at 1.5 m/s a vehicle drives 0.3 m.
_INTERVAL = 0.15
# Longest time between sweeps of one track, s.
_MAX_GAP = 0.7
# Time after which a map begins again, s: registrations drift by some centimetres until then.
_MAX_STAY = 8.0
# Edge of cells of the map, m, sweeps after which it is made again, and neighbours that give a normal.
_MAP_CELL, _GROWTH, _NEIGHBORS = 0.07, 8, 10
# Distances of points from the map up to which they match, m, by iteration; standard deviations of these along
# normals, and along others, where the nearest point is any of the surface.
_MATCHES = (0.5, 0.4, 0.3, 0.25, 0.2, 0.2)
_ALONG_NORMAL, _TO_POINT = 0.03, 0.3
# Horizontal part of normals of sides.
_UPRIGHT = 0.7
_FREEDOM = 4.0
# Changes of velocity between registered sweeps by which poses differ from predicted ones: m and rad.
_CHANGE = np.array([0.1, 0.1, 0.1])
# Median distance from sides in the map beyond which a body is not rigid, m.
_MAX_DISTANCE = 0.03
# Least standard deviation of a registered place, m.
_LEAST = 0.003
# Distance from the middle of a vehicle up to which what moves with it is a part of it, m.
_NEAR = 2.0


@dataclass(frozen=True, eq=False)
class _Map:
    """Points of a body in its frame, with normals of sides."""

    points: Array
    """(M, 3)."""
    normals: Array
    """(M, 2) horizontal, 0 of tops and edges."""
    tree: cKDTree

    @classmethod
    def of(cls, points: Array) -> "_Map":
        """A map of points (N, 3)."""
        means = sum_moments(points, _MAP_CELL).mean
        tree = cKDTree(means)
        near = tree.query(means, min(_NEIGHBORS, len(means)))[1].reshape(len(means), -1)
        off = means[near] - means[near].mean(axis=1, keepdims=True)
        values, vectors = np.linalg.eigh(np.einsum("nki,nkj->nij", off, off))
        normals = vectors[:, :2, 0]
        length = np.linalg.norm(normals, axis=1)
        flat = (length > _UPRIGHT) & (values[:, 0] < 0.1 * values[:, 1])
        return cls(means, normals / np.maximum(length, 1e-9)[:, None] * flat[:, None], tree)


def find_vehicles(
    moving: MovingPoints, T_floor_sensor: Array, settings: TrackingSettings
) -> tuple[BodyTrack, ...]:
    """Tracks of what moves as a rigid body, and is larger than a person."""
    levelled = moving.points @ T_floor_sensor[:3, :3].T + T_floor_sensor[:3, 3]
    used = (levelled[:, 2] > _HEIGHTS[0]) & (levelled[:, 2] < _HEIGHTS[1])
    points, sweep, times = levelled[used], moving.sweep[used], moving.times[used]
    if not len(points):
        return ()
    label = cluster(points[:, :2], sweep, _CELL)
    order = np.lexsort((times, label))
    points, sweep, times, label = points[order], sweep[order], times[order], label[order]
    count = np.bincount(label)
    kept = (count >= _MIN_POINTS)[label]
    points, sweep, times, label = points[kept], sweep[kept], times[kept], label[kept]
    first = np.flatnonzero(np.diff(label, prepend=-1))
    if not len(first):
        return ()
    count = np.diff(first, append=len(label))
    mean_times = np.add.reduceat(times - times[0], first) / count + times[0]
    objects = Clusters(
        points[:, :2], first, count, sweep[first], mean_times, times, np.zeros(len(first)),
        np.zeros(len(first), dtype=np.bool_),
    )  # fmt: skip
    size = np.maximum.reduceat(points[:, :2], first) - np.minimum.reduceat(points[:, :2], first)
    length = np.hypot(*size.T)
    tracks = []
    for members in associate(objects, _CENTROID_STDDEV, settings.acceleration_density):
        if not is_moving_target(objects, members, settings.motion) or np.median(length[members]) < _MIN_LENGTH:
            continue
        stay = np.floor((mean_times[members] - mean_times[members[0]]) / _MAX_STAY)
        breaks = (np.diff(mean_times[members]) > _MAX_GAP) | (np.diff(stay) > 0)
        for part in np.split(members, np.flatnonzero(breaks) + 1):
            chosen = _thin(mean_times[part])
            if len(chosen) >= settings.motion.min_detections:
                rows = [np.arange(first[k], first[k] + count[k]) for k in part[chosen]]
                track = _register([points[r] for r in rows], mean_times[part[chosen]], T_floor_sensor)
                if track is not None:
                    tracks.append(track)
    return tuple(sorted(tracks, key=lambda track: float(track.times[0])))


def leave_out_vehicles(observed: SpaceObservations) -> SpaceObservations:
    """Without tracks of bodies that are parts of vehicles."""
    apart = tuple(one for one in observed.tracks if not any(_is_part(one, other) for other in observed.vehicles))
    return replace(observed, tracks=apart)


def _is_part(track: BodyTrack, vehicle: BodyTrack) -> bool:
    """Whether most of a track is near the middle of a vehicle."""
    inside = (track.times >= vehicle.times[0]) & (track.times <= vehicle.times[-1])
    if inside.mean() < 0.5:
        return False
    at = np.column_stack([np.interp(track.times[inside], vehicle.times, column) for column in vehicle.centers.T])
    return bool(np.median(np.linalg.norm(track.centers[inside] - at, axis=1)) < _NEAR)


def _thin(times: Array) -> Index:
    """Numbers of times (T,) at least an interval apart."""
    chosen = [0]
    for k, time in enumerate(times.tolist()):
        if time - times[chosen[-1]] >= _INTERVAL:
            chosen.append(k)
    return np.array(chosen)


def _register(sweeps: Sequence[Array], times: Array, T_floor_sensor: Array) -> BodyTrack | None:
    """The motion of a body by its sweeps (P, 3), m; None where it is not rigid."""
    sweeps = [one[:: len(one) // _MAX_POINTS + 1] for one in sweeps]
    K = len(sweeps)
    poses, information = np.zeros((K, 3)), np.zeros((K, 3, 3))
    poses[0, :2] = sweeps[0][:, :2].mean(axis=0)
    distances = np.zeros(K)
    body = [_to_body(sweeps[0], poses[0])]
    for k in range(1, K):
        if (k - 1) % _GROWTH == 0 or k < _GROWTH:
            grown = _Map.of(np.concatenate(body))
        rate = 0.0
        if k > 1:
            rate = (poses[k - 1] - poses[k - 2]) / (times[k - 1] - times[k - 2])
        expected = poses[k - 1] + rate * (times[k] - times[k - 1])
        if k == 1:
            expected = poses[0] + np.append(sweeps[1][:, :2].mean(axis=0) - sweeps[0][:, :2].mean(axis=0), 0)
        poses[k], _, _ = _align(sweeps[k], grown, expected, np.diag(_CHANGE**-2.0))
        body.append(_to_body(sweeps[k], poses[k]))
    # Once more to the whole map, which the first sweeps did not have.
    whole = _Map.of(np.concatenate(body))
    for k in range(K):
        poses[k], information[k], distances[k] = _align(sweeps[k], whole, poses[k], np.diag(_CHANGE**-2.0) * 0.1)
    if np.median(distances) > _MAX_DISTANCE:
        return None
    low, high = np.quantile(whole.points[:, :2], [0.01, 0.99], axis=0)
    middle = np.append((low + high) / 2, whole.points[:, 2].mean())
    c, s = np.cos(poses[:, 2]), np.sin(poses[:, 2])
    R = np.stack([c, -s, s, c], axis=-1).reshape(-1, 2, 2)
    centers = np.column_stack([poses[:, :2] + R @ middle[:2], np.full(K, middle[2])])
    covariance = np.linalg.inv(information)[:, :2, :2]
    sight = centers[:, :2] / np.linalg.norm(centers[:, :2], axis=1, keepdims=True)
    across = np.column_stack([-sight[:, 1], sight[:, 0]])
    radial, tangential = (
        np.sqrt(np.einsum("ni,nij,nj->n", one, covariance, one) + _LEAST**2) for one in (sight, across)
    )
    return BodyTrack(
        times,
        se3.apply(se3.inverse(T_floor_sensor), centers),
        radial,
        tangential,
        np.zeros(K, dtype=np.intp),
        poses[:, 2],
    )


def _to_body(points: Array, pose: Array) -> Array:
    """Points (P, 3) in the frame of a body at (3,): x, y and yaw."""
    c, s = np.cos(pose[2]), np.sin(pose[2])
    off = points[:, :2] - pose[:2]
    return np.column_stack([off @ np.array([[c, -s], [s, c]]), points[:, 2]])


def _align(points: Array, body: _Map, expected: Array, information: Array) -> tuple[Array, Array, float]:
    """The pose (3,) of a body, its information (3, 3), and the median distance of points from its sides, m."""
    pose = expected.copy()
    for gate in _MATCHES:
        c, s = np.cos(pose[2]), np.sin(pose[2])
        R = np.array([[c, -s], [s, c]])
        distance, near = body.tree.query(_to_body(points, pose), distance_upper_bound=gate)
        found = np.isfinite(distance)
        if not found.any():
            return pose, information, np.inf
        at, normal = body.points[near[found], :2], body.normals[near[found]] @ R.T
        arm = at @ R.T
        error = points[found, :2] - pose[:2] - arm
        # Of the body's place and yaw, the derivatives of errors along x, and along y.
        by_x = np.column_stack([-np.ones(len(arm)), np.zeros(len(arm)), arm[:, 1]])
        by_y = np.column_stack([np.zeros(len(arm)), -np.ones(len(arm)), -arm[:, 0]])
        r = np.einsum("ni,ni->n", normal, error)
        J = normal[:, :1] * by_x + normal[:, 1:] * by_y
        side = normal.any(axis=1)
        weight = side * (_FREEDOM + 1) / (_FREEDOM + (r / _ALONG_NORMAL) ** 2) / _ALONG_NORMAL**2
        H = information + (J * weight[:, None]).T @ J + (by_x.T @ by_x + by_y.T @ by_y) / _TO_POINT**2
        g = information @ (pose - expected) + J.T @ (weight * r)
        g += (by_x.T @ error[:, 0] + by_y.T @ error[:, 1]) / _TO_POINT**2
        pose = pose - np.linalg.solve(H, g)
    return pose, H, float(np.median(np.abs(r[side]))) if side.any() else np.inf
