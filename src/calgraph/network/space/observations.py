"""What one stationary sensor measured: its floor, static points, and tracks of bodies."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from calgraph.geometry import Array, Index


@dataclass(frozen=True, eq=False)
class StaticPoints:
    """What stands still: one point for each direction, over the whole recording."""

    points: Array
    """(N, 3) sensor frame, m: at the median range of the direction."""
    stddev: Array
    """(N,) of a single range about it, m."""
    count: Index
    """(N,) measurements of it."""


@dataclass(frozen=True, eq=False)
class BodyTrack:
    """One person, or vehicle, in one sensor over an interval without a break."""

    times: Array
    """(T,) s, by the sensor's clock, ascending: mean time of its points, the same for the slices of a sweep."""
    centers: Array
    """(T, 3) sensor frame, m: the middle of the silhouette of a slice of the body at the median horizontal range
    of its front surface, at the mean height of its points. Of a vehicle, the middle of its map."""
    radial_stddev: Array
    """(T,) first guess, m."""
    tangential_stddev: Array
    """(T,) first guess, m."""
    slices: Index
    """(T,) which slice of the body, from below; 0 of 2-D scanners, which have one, and of vehicles."""
    yaws: Array | None = None
    """(T,) rad, in the levelled frame, of a vehicle, whose centres are of one point of it; None of a person."""


@dataclass(frozen=True)
class StaticStep:
    """A moment after which what stands still is elsewhere: the sensor moved."""

    time: float
    """By the sensor's clock, s."""
    shift: float
    """m."""
    turn: float
    """rad."""


@dataclass(frozen=True, eq=False)
class SpaceObservations:
    """Of one sensor."""

    T_floor_sensor: Array
    """(4, 4) levelled: roll, pitch, and height over its floor; x, y and yaw are zero. Of a 2-D scanner, which does
    not measure its floor, what is stated or usual."""
    floor_covariance: Array
    """(3, 3) of the errors of roll and pitch, rad, and height, m, along the axes of the floor."""
    static: StaticPoints
    floor_points: NDArray[np.bool_]
    """(N,) which static points are of the floor."""
    tracks: tuple[BodyTrack, ...]
    coverage: Array
    """(W, 2) s, when it measured."""
    step: StaticStep | None = None
    vehicles: tuple[BodyTrack, ...] = ()
    """Which are used where people do not connect a network."""
    flat: bool = False
    """Whether it is a 2-D scanner: its points are of one plane in space, and show no surface by themselves."""
    untimed_sweep: float = 0.0
    """Time of a sweep without times of points, s: what it measured is up to that much later, or earlier, than its
    stamp; 0 with times."""
