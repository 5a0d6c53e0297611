"""Points that a sensor measured during a drive, in the world of their part."""

import numpy as np

from calgraph.geometry import Array
from calgraph.result import DrivePath, DriveView
from calgraph.surfaces.trajectory import Track


def place_points(view: DriveView, path: DrivePath, T_root_sensor: Array, delay: float = 0.0) -> Array:
    """The points (N, 3) of a view in the world of its part, m.

    Args:
        view: of a sensor.
        path: of the part.
        T_root_sensor: (4, 4).
        delay: by which the points are taken to have been measured later, s.
    """
    T = Track(path.times, path.T_world_root).at(view.times + delay) @ T_root_sensor
    return np.asarray(np.einsum("nij,nj->ni", T[:, :3, :3], view.points.astype(np.float64)) + T[:, :3, 3])


def find_incidence(view: DriveView, path: DrivePath, T_root_sensor: Array) -> Array:
    """(N,) angles between the beams of a view and the normals of their surfaces, degrees."""
    R = Track(path.times, path.T_world_root).at(view.times)[:, :3, :3] @ T_root_sensor[:3, :3]
    beams = np.einsum("nij,nj->ni", R, view.points.astype(np.float64))
    cosine = np.einsum("ni,ni->n", beams, view.normals) / np.maximum(np.linalg.norm(beams, axis=1), 1e-9)
    return np.asarray(np.degrees(np.arccos(np.clip(np.abs(cosine), 0, 1))))
