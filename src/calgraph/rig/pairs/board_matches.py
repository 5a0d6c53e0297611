"""Matches of two sensors' detections of the board, which pairs and inliers are estimated from."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from calgraph.boards.detections import BoardCorners, Detection, PlanePatch, Segment, plane_of
from calgraph.errors import Rejected
from calgraph.geometry import Array, plane, se3, se_n
from calgraph.graph.pairwise_estimate import Linearization, Matches
from calgraph.rig.pairs.line_matches import LineLineMatches, PlaneLineMatches
from calgraph.solver.ransac import RansacResult

Candidates = Mapping[int, Sequence[Detection]]
"""Detections of one sensor by capture; several if it is ambiguous which of them is the board."""


@dataclass(frozen=True)
class Disagreement(Rejected):
    """A pair whose detections fit no relative pose in enough of the captures."""

    agreeing: int
    """In how many they fit the best pose."""


def explain_disagreement(a: Candidates, b: Candidates, min_inliers: int, found: RansacResult | None) -> Rejected:
    """Why a pair has no pose: too few inliers, or no sample whose boards determine one."""
    common, count = a.keys() & b.keys(), found.inlier_count if found else 0
    most = max(len(by[capture]) for by in (a, b) for capture in common)
    reason = (
        f"RANSAC found no relative pose with at least {min_inliers} inliers among {len(common)} shared "
        f"captures{f', with up to {most} candidates for the board in one' if most > 1 else ''}: "
        f"{count} agree at most"
    )
    return Disagreement(reason, count) if found else Rejected(reason)


def build_matches(
    candidates_a: Candidates, candidates_b: Candidates, size: tuple[float, float]
) -> tuple[NDArray[np.intp], Matches]:
    """The matches of two sensors by the geometric kinds of their detections, and their table (M, 3).

    Args:
        candidates_a: planes where one of the two sensors detects planes.
        candidates_b: planes or lines; with at least one common capture.
        size: width and height of the (largest) board, m.
    """
    table = tabulate_matches(candidates_a, candidates_b)
    a = [candidates_a[capture][i] for capture, i, _ in table]
    b = [candidates_b[capture][j] for capture, _, j in table]
    radius, diagonal = min(size) / 2, float(np.hypot(*size))
    match geometric_kind(a[0]), geometric_kind(b[0]):
        case "plane", "plane":
            return table, PlanePlaneMatches(*_stack_planes(a), *_stack_planes(b), radius, diagonal)
        case "plane", "line":
            return table, PlaneLineMatches(*_stack_planes(a), *_stack_segments(b), diagonal)
        case "line", "line":
            return table, LineLineMatches(*_stack_segments(a), *_stack_segments(b), diagonal)
        case kinds:
            raise ValueError(f"no matches between {' and '.join(kinds)}")


def tabulate_matches(candidates_a: Candidates, candidates_b: Candidates) -> NDArray[np.intp]:
    """Lists all pairs of candidates in common captures: (M, 3) rows of capture, index in a, index in b.

    Detections that cameras identified as different boards are not paired.
    """
    rows = [
        (capture, i, j)
        for capture in sorted(set(candidates_a) & set(candidates_b))
        for i, a in enumerate(candidates_a[capture])
        for j, b in enumerate(candidates_b[capture])
        if identified_board(a) is None or identified_board(b) is None or identified_board(a) == identified_board(b)
    ]
    return np.array(rows, dtype=np.intp).reshape(-1, 3)


def group_alternatives(
    table: NDArray[np.intp], candidates_a: Candidates, candidates_b: Candidates
) -> NDArray[np.intp]:
    """Numbers (M,) the groups of mutually exclusive matches: those of one capture, and board if identified."""
    groups: dict[tuple[int, frozenset[int | None]], int] = {}
    numbers = []
    for capture, i, j in table.tolist():
        boards = {identified_board(candidates_a[capture][i]), identified_board(candidates_b[capture][j])}
        numbers.append(groups.setdefault((capture, frozenset(boards)), len(groups)))
    return np.array(numbers, dtype=np.intp)


def identified_board(detection: Detection) -> int | None:
    """Index of the board in the rig, if the sensor can identify it."""
    return detection.board if isinstance(detection, BoardCorners) else None


def geometric_kind(detection: Detection) -> str:
    """``line`` or ``plane``: what the detection measures of the board."""
    return "line" if isinstance(detection, Segment) else "plane"


def _stack_planes(detections: Sequence[Detection]) -> tuple[Array, Array, Array]:
    with_plane = [d for d in detections if isinstance(d, PlanePatch | BoardCorners)]
    planes, covariances = zip(*(plane_of(d) for d in with_plane), strict=True)
    return np.array(planes), np.array(covariances), np.array([d.center for d in with_plane])


def _stack_segments(detections: Sequence[Detection]) -> tuple[Array, Array]:
    segments = [d for d in detections if isinstance(d, Segment)]
    return np.array([d.endpoints for d in segments]), np.array([d.covariance for d in segments])


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
