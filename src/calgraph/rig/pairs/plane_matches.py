"""Plane–plane matches: both sensors measure the plane of the board (MSG-Cal, IV.A)."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from calgraph.geometry import Array, plane, se3, se_n
from calgraph.graph.pairwise_estimate import Linearization

# Minimum singular value of the normals of three planes, over the largest, for a sample to have a solution.
_MIN_NORMAL_SPREAD = 0.01
# Angle between the normals of two planes above which they are not one board, rad (30 degrees): far more than the
# error of a plane through a distant board, and less than the angle between most surfaces of a room.
_MAX_NORMAL_ANGLE = float(np.radians(30))


@dataclass(frozen=True, eq=False)
class PlanePlaneMatches:
    """M matches between planes measured by a and planes measured by b."""

    planes_a: Array
    """(M, 4), frame a."""
    covariances_a: Array
    """(M, 3, 3) in the chart of plane.retract."""
    centers_a: Array
    """(M, 3) centres of a's detections, m."""
    planes_b: Array
    covariances_b: Array
    centers_b: Array
    comparison_radius: float
    """Distance from the centre at which planes are compared: half of the board's shorter side, m."""
    max_center_distance: float
    """Largest distance between the two centres: the board's diagonal, m."""

    sample_size: int = 3

    def solve(self, samples: NDArray[np.intp]) -> Array:
        """Solves for rotations by Kabsch on the normals, then for translations by least squares (eqs. 1–3)."""
        n_a, d_a = self.planes_a[samples, :3], self.planes_a[samples, 3]
        n_b, d_b = self.planes_b[samples, :3], self.planes_b[samples, 3]
        R = se_n.nearest_rotation(np.einsum("kmi,kmj->kij", n_a, n_b))
        # n_i · t + d_i - d_j = 0; coplanar normals do not determine the translation.
        normal_matrix = np.einsum("kmi,kmj->kij", n_a, n_a)
        eigenvalues = np.linalg.eigvalsh(normal_matrix)
        solvable = eigenvalues[:, 0] > _MIN_NORMAL_SPREAD**2 * eigenvalues[:, 2]
        safe = np.where(solvable[:, None, None], normal_matrix, np.eye(3))
        t = np.linalg.solve(safe, np.einsum("kmi,km->ki", n_a, d_b - d_a)[..., None])[..., 0]
        t[~solvable] = np.nan
        return se3.pose(R, t)

    def linearize(self, T_a_b: Array) -> Linearization:
        """Computes distances from plane a to three points of plane b around its centre."""
        angles = 2 * np.pi * np.arange(3) / 3
        circle = self.comparison_radius * np.stack([np.cos(angles), np.sin(angles)])
        basis_b = plane.tangent_basis(self.planes_b[:, :3])
        x_b = self.centers_b[:, None] + se_n.transpose(basis_b @ circle)
        x_a = se3.apply(T_a_b[:, None], x_b)
        n_a = np.broadcast_to(self.planes_a[:, None, :3], x_a.shape)
        arm = x_a - T_a_b[:, None, None, :3, 3]
        jacobian = np.concatenate([n_a, np.cross(arm, n_a)], axis=-1)
        by_a = plane.distance_jacobian(self.planes_a, x_a)
        by_b = plane.distance_jacobian(self.planes_b, x_b)
        covariance = by_a @ self.covariances_a @ se_n.transpose(by_a)
        covariance = covariance + by_b @ self.covariances_b @ se_n.transpose(by_b)
        return Linearization(plane.distance(self.planes_a, x_a), jacobian, covariance)

    def feasible(self, T_a_b: Array) -> NDArray[np.bool_]:
        """Tests whether the angle between the normals and the distance between the centres are small enough."""
        x_a = se3.apply(T_a_b, self.centers_b)
        n_a = self.planes_b[:, :3] @ se_n.transpose(T_a_b[:, :3, :3])
        close = np.linalg.norm(x_a - self.centers_a, axis=-1) <= self.max_center_distance
        return np.asarray(close & (np.sum(n_a * self.planes_a[:, :3], axis=-1) > np.cos(_MAX_NORMAL_ANGLE)))
