"""Points of sensors on flat patches of their surroundings: where patches are, and residuals with derivatives."""

from dataclasses import dataclass

from calgraph.geometry import Array, Index
from calgraph.surfaces.flat_cells import CellLimits, FlatCells, fit_flat_cells, sum_moments_within

# Lines need fewer points than planes; a patch must extend far enough for slopes to be determined.
CELL_LIMITS = {2: CellLimits(0.5, 8, 0.08), 3: CellLimits(1.0, 15, 0.12)}
# Thickness (standard deviation) up to which a cell is flat at a gate, which then holds 99.7 % of its points.
THICKNESS_PER_GATE = 1 / 3


@dataclass(frozen=True, eq=False)
class SurfacePoints:
    """Points on surfaces, linearized: residuals with their derivatives."""

    sensor: Index
    """(N,)."""
    surface: Index
    """(N,)."""
    time: Array
    """(N,) by a common clock, s."""
    view: Index
    """(N,) number of the interval of time in which a sensor measured the point."""
    residual: Array
    """(N,) m."""
    patch: Array
    """(N, n + 1) 1, the places on the surface in standard deviations, and the cosine of incidence: the derivatives
    by offset, slopes and relief."""
    first: Index
    """(N,) first of four control points, if there is a trajectory."""
    by_control: Array
    """(N, 4 (n + d)), or (N, 0) of sensors at rest."""
    by_sensor: Array
    """(N, Q) by the state of the sensor."""


def fit_surfaces(world: Array, view: Index, thickness: float) -> FlatCells:
    """The cells in which points (N, n) of each view (N,) have a standard deviation of this at most, m."""
    limits = CELL_LIMITS[world.shape[1]]
    return fit_flat_cells(sum_moments_within(world, view, limits.cell), limits, thickness)
