"""2-D scanners, spinning 2-D scanners and multi-beam LiDARs as patterns of beams."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from calgraph.geometry import Array, so3


@dataclass(frozen=True, eq=False)
class BeamPattern:
    """The beams of one scan or sweep, in the order in which they are measured."""

    origins: Array
    """(N, 3) origins of the beams, or (1, 3) where all share one, sensor frame, m."""
    directions: Array
    """(N, 3) unit vectors, sensor frame."""
    sideways: Array
    """(N, 3) unit vectors, derivative of the direction by the beam angle."""
    times: Array
    """(N,) ascending, s from the stamp."""
    neighbours: NDArray[np.intp]
    """(N,) index of the beam that is next to each in the direction of its angle."""
    angles: Array
    """(N,) beam angles of a 2-D scanner, rad."""
    rings: NDArray[np.int32] | None = None
    """(N,) for a multi-beam LiDAR."""

    def select(self, kept: NDArray[np.bool_]) -> "BeamPattern":
        """The beams of a mask (N,). Those without their neighbour have themselves as neighbours."""
        after = np.cumsum(kept) - 1
        return BeamPattern(
            self.origins if len(self.origins) == 1 else self.origins[kept],
            self.directions[kept],
            self.sideways[kept],
            self.times[kept],
            np.where(kept[self.neighbours], after[self.neighbours], after)[kept],
            self.angles[kept],
            None if self.rings is None else self.rings[kept],
        )


def laser_pattern(field_of_view: float, resolution: float, scan_time: float) -> BeamPattern:
    """A 2-D scanner: angles from ``-field_of_view / 2`` counter-clockwise, one turn of its mirror a scan.

    Args:
        field_of_view: between the first and the last beam, rad.
        resolution: between beams, rad.
        scan_time: of a whole turn of the mirror, s.
    """
    count = round(field_of_view / resolution) + 1
    angles: Array = resolution * np.arange(count, dtype=np.float64) - field_of_view / 2
    directions, sideways = _planar_directions(angles)
    return BeamPattern(
        origins=np.zeros((1, 3)),
        directions=directions,
        sideways=sideways,
        times=np.arange(count, dtype=np.float64) * (scan_time * resolution / (2 * np.pi)),
        neighbours=np.minimum(np.arange(count) + 1, count - 1),
        angles=angles,
    )


def spinning_pattern(
    laser: BeamPattern, scan_period: float, tilt: float, offset: float, scans_per_degree: float, scan_angle: float
) -> BeamPattern:
    """A 2-D scanner that spins about the vertical axis (MSG-Cal, section VI-D and Fig. 4).

    With no tilt and offset the scanner's forward axis points up the axis of rotation and its scan plane is
    vertical. It turns continuously while it scans, so each beam has a different azimuth. A sweep starts at 0.

    Args:
        laser: the beams of the 2-D scanner.
        scan_period: between the starts of its scans, s.
        tilt: of the forward axis away from the vertical, out of the scan plane, rad.
        offset: of the scanner from the axis of rotation, along the direction of tilt, m.
        scans_per_degree: of rotation.
        scan_angle: that a whole sweep turns, rad.
    """
    # Whole scans that fit into the sweep; the small number absorbs rounding of the angle.
    scans = max(1, int(np.degrees(scan_angle) * scans_per_degree + 1e-9))
    speed = np.radians(1 / scans_per_degree) / scan_period
    times = (np.arange(scans)[:, None] * scan_period + laser.times).ravel()
    # At azimuth 0 the scanner's x is up and its y is the spin frame's y: the normal z points backwards.
    R_spin_upright = np.array([[0.0, 0, -1], [0, 1, 0], [1, 0, 0]])
    R_spin_laser = so3.exp(np.array([0.0, tilt, 0.0])) @ R_spin_upright
    R_sensor_spin = so3.exp(np.outer(speed * times, [0.0, 0.0, 1.0]))
    beams = len(laser.angles)

    def turned(vectors: Array) -> Array:
        return np.asarray((R_sensor_spin @ np.tile(vectors @ R_spin_laser.T, (scans, 1))[..., None])[..., 0])

    return BeamPattern(
        origins=R_sensor_spin @ np.array([offset, 0.0, 0.0]),
        directions=turned(laser.directions),
        sideways=turned(laser.sideways),
        times=times,
        neighbours=(beams * np.arange(scans)[:, None] + laser.neighbours).ravel(),
        angles=np.tile(laser.angles, scans),
    )


def multibeam_pattern(elevations: Array, azimuth_resolution: float, period: float) -> BeamPattern:
    """A LiDAR whose column of beams turns once a period; all beams of a column fire together.

    Args:
        elevations: (rings,) of the beams above the horizontal, rad.
        azimuth_resolution: between columns, rad.
        period: of a turn, s.
    """
    columns, rings = round(2 * np.pi / azimuth_resolution), len(elevations)
    azimuths = np.repeat(azimuth_resolution * np.arange(columns), rings)
    flat, sideways = _planar_directions(azimuths)
    up = np.tile(elevations, columns)[:, None]
    count = columns * rings
    return BeamPattern(
        origins=np.zeros((1, 3)),
        directions=np.cos(up) * flat + np.sin(up) * [0.0, 0.0, 1.0],
        sideways=sideways,
        times=np.repeat(np.arange(columns) * period / columns, rings),
        neighbours=(np.arange(count) + rings) % count,
        angles=azimuths,
        rings=np.tile(np.arange(rings, dtype=np.int32), columns),
    )


def _planar_directions(angles: Array) -> tuple[Array, Array]:
    """Unit vectors (N, 3) at angles in the plane z = 0, and their derivatives by the angle."""
    c, s, zero = np.cos(angles), np.sin(angles), np.zeros_like(angles)
    return np.stack([c, s, zero], axis=-1), np.stack([-s, c, zero], axis=-1)
