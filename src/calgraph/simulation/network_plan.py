"""What the layout of a simulated building consists of."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from calgraph.geometry import Array
from calgraph.simulation.network_floor import Floor, rectangle


@dataclass(frozen=True, eq=False)
class Layout:
    """A building with its scanners."""

    floor: Floor
    mounts: Array
    """(N, 3) x, y, m, and yaw, rad, of the scanners."""
    stations: Array
    """(K, 2) goals that people walk to one after the other, m; without any, goals are random."""
    furniture_areas: Array
    """(A, 4) rectangles for furniture: x and y of the lower left, then of the upper right corner, m."""
    keep_clear: Array
    """(C, 3) circles without furniture, such as doorways: x, y, radius, m."""
    trip: float = np.inf
    """Distance within which people have random goals, along each axis, m."""


def wall(a: Sequence[float], b: Sequence[float], thickness: float = 0.15) -> Array:
    """(4, 2) a straight wall from a to b."""
    along = np.subtract(b, a)
    return rectangle(np.add(a, b) / 2, (float(np.hypot(*along)), thickness), float(np.arctan2(along[1], along[0])))
