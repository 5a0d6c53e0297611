"""Points of sensors on flat patches of their surroundings: where patches are, and residuals with derivatives."""

from dataclasses import dataclass

import numpy as np

from calgraph.geometry import Array, Index
from calgraph.surfaces.flat_cells import CellLimits, FlatCells, fit_flat_cells, sum_moments_within

# Lines need fewer points than planes; a patch must extend far enough for slopes to be determined.
CELL_LIMITS = {2: CellLimits(0.5, 8, 0.08), 3: CellLimits(1.0, 15, 0.12)}
# Thickness (standard deviation) up to which a cell is flat at a gate, which then holds 99.7 % of its points.
THICKNESS_PER_GATE = 1 / 3
# Least cosine of incidence by which it is found where a beam meets a surface: it is metres away at less.
_MIN_INCIDENCE = 0.05


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


def meet_surfaces(world: Array, beams: Array, surfaces: FlatCells, cell: Index) -> tuple[Array, Array, Array]:
    """Distances (N,) of points from the surfaces of cells, cosines (N,) of incidence, and lengths (N,) to these.

    Derivatives are those of the places where beams meet surfaces: the noise of a range moves a point away from
    its surface and, at oblique incidence, along it. At measured places both belong together, so that floors seem
    to fall away from the sensor, as ranges that are too long make them.

    Args:
        world: (N, n) points, m.
        beams: (N, n) their unit vectors.
        surfaces: of the world.
        cell: (N,) of each point.

    Returns:
        Distances, m, along the normals; cosines, positive; lengths by which beams go on to their surfaces, m.
    """
    normals = surfaces.normals[cell]
    distance = np.einsum("ni,ni->n", normals, world - surfaces.center[cell])
    slant = np.einsum("ni,ni->n", normals, beams)
    incidence = np.abs(slant)
    return distance, incidence, -distance / np.copysign(np.maximum(incidence, _MIN_INCIDENCE), slant)


def differentiate_patches(met: Array, incidence: Array, surfaces: FlatCells, cell: Index) -> Array:
    """:attr:`SurfacePoints.patch` of places (N, n) where beams meet surfaces of cells, at cosines (N,)."""
    along = np.einsum("ni,nij->nj", met - surfaces.center[cell], surfaces.axes[cell][:, :, 1:])
    return np.column_stack([np.ones(len(met)), along / surfaces.extent[cell], incidence])
