"""Matches with segments of a 2-D scanner: plane–line (MSG-Cal, IV.B) and line–line (coplanarity; our addition)."""

import itertools
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property, partial

import numpy as np
from numpy.typing import NDArray

from calgraph.geometry import Array, plane, se3, se_n, so3
from calgraph.graph.pairwise_estimate import Linearization
from calgraph.solver.levenberg_marquardt import DenseLinearization, minimize_batch

# Singular values of the linear solution are at least this, which keeps its inverse finite; samples of which the
# least one is below this share of the largest have no solution.
_MIN_SINGULAR_VALUE, _RANK_TOLERANCE = 1e-9, 1e-6


# Maximum number of least-squares steps for the pose of a sample: bounds the time, and the best pose is refined
# later.
_SAMPLE_STEPS = 12
# Penalty on the rotation from an axis-aligned mounting, m/rad: selects among minima that fit equally well. From
# three upright boards with 3 mm of noise, 98 % of solutions are right with it, and 86 % without.
_ROTATION_PENALTY = 0.02
# The same for the search of other minima from axis-aligned rotations, up to 63 degrees off: their results are not
# refined.
_SEARCH_STEPS = 40
# The same for a direction of plane–line translations, which keep their start value where it is smaller.
_MIN_TRANSLATION_SPREAD = 0.05
# Number of axis-aligned rotations that are refined for each plane–line sample, of 24: the best quarter.
_REFINED_STARTS = 6
# Change of the residuals' RMS per unit of a direction (m or rad) that a sample determines at least.
_MIN_RMS_SLOPE = 0.03
# Minimum effect of every unknown of the linear plane–line solution on the residuals (RMS), over its effect on a
# single point: below it noise decides the unknown, and poses are searched from axis-aligned mountings instead.
_MIN_CONDITION = 0.02


@dataclass(frozen=True, eq=False)
class PlaneLineMatches:
    """M matches between planes measured by a and segments measured by b."""

    planes: Array
    """(M, 4), frame a."""
    covariances_a: Array
    """(M, 3, 3) in the chart of plane.retract."""
    centers_a: Array
    """(M, 3) centres of a's detections, m."""
    endpoints: Array
    """(M, 2, 3), frame b, z = 0."""
    covariances_b: Array
    """(M, 6, 6) of the end points."""
    max_center_distance: float
    """Largest distance between the two centres: the board's diagonal, m."""

    @property
    def sample_size(self) -> int:
        """Five as in the paper; three if the boards' poses do not determine the linear solution."""
        return 5 if self._determined else 3

    def solve(self, samples: NDArray[np.intp]) -> Array:
        """Minimizes the end points' distances to the planes (eq. 4), with no initial estimate.

        As z = 0 in the scan plane, ``n · (R x + t) + d`` is linear in R's first two columns and t: five segments
        give ten equations for the nine unknowns (Zhang and Pless 2004). If the boards' poses do not determine
        these, Gauss–Newton starts from all axis-aligned rotations, and unobservable directions keep their values.
        """
        n = np.repeat(self.planes[samples, :3], 2, axis=1)
        d = np.repeat(self.planes[samples, 3], 2, axis=1)
        x = self.endpoints[samples].reshape(len(samples), -1, 3)
        A = np.concatenate([x[..., :1] * n, x[..., 1:2] * n, n], axis=-1)
        U, s, Vt = np.linalg.svd(A, full_matrices=False)
        if self._determined:
            h = np.einsum("kij,ki,kli,kl->kj", Vt, 1 / np.maximum(s, _MIN_SINGULAR_VALUE), U, -d)
            R = se_n.nearest_rotation(np.stack([h[:, :3], h[:, 3:6], np.cross(h[:, :3], h[:, 3:6])], axis=-1))
            T, _ = self._minimize(R, n, d, x, _SAMPLE_STEPS)
            T[s[:, -1] < _RANK_TOLERANCE * s[:, 0]] = np.nan
            return T
        starts = self._select_rotations(axis_aligned_rotations(), n, d, x)
        count = starts.shape[1]
        n, d, x = (np.repeat(v, count, axis=0) for v in (n, d, x))
        R = starts.reshape(-1, 3, 3)
        T, cost = self._minimize(R, n, d, x, _SAMPLE_STEPS)
        # Of solutions with similar residuals, the one with the smallest rotation from its start.
        angle = np.linalg.norm(so3.log(T[:, :3, :3] @ se_n.transpose(R)), axis=-1)
        best = np.argmin((cost + (_ROTATION_PENALTY * angle) ** 2).reshape(-1, count), axis=1)
        return np.asarray(T.reshape(-1, count, 4, 4)[np.arange(len(samples)), best])

    def find_local_minima(self, chosen: NDArray[np.bool_]) -> Array:
        """Finds local minima (K, 4, 4) of the chosen matches' distances, from all axis-aligned rotations.

        Distances from planes change little if a scanner is turned over or tilted the opposite way: with few
        captures several poses fit.
        """
        starts = axis_aligned_rotations()
        n = np.broadcast_to(np.repeat(self.planes[chosen, :3], 2, axis=0), (len(starts), 2 * int(chosen.sum()), 3))
        d = np.broadcast_to(np.repeat(self.planes[chosen, 3], 2), n.shape[:2])
        x = np.broadcast_to(self.endpoints[chosen].reshape(-1, 3), n.shape)
        return self._minimize(starts, n, d, x, _SEARCH_STEPS)[0]

    def _select_rotations(self, starts: Array, n: Array, d: Array, x: Array) -> Array:
        """Selects for each sample the rotations (K, k, 3, 3) of (S, 3, 3) that fit best with some translation."""
        r = np.einsum("kpi,sij,kpj->ksp", n, starts, x, optimize=True) + d[:, None]
        inverse = np.linalg.pinv(n, rcond=_MIN_TRANSLATION_SPREAD)
        r -= np.einsum("kpi,kiq,ksq->ksp", n, inverse, r, optimize=True)
        order = np.argsort(np.sum(r**2, axis=-1), axis=1, kind="stable")
        return starts[order[:, :_REFINED_STARTS]]

    def _minimize(self, R: Array, n: Array, d: Array, x: Array, iterations: int) -> tuple[Array, Array]:
        """Poses (K, 4, 4) from start rotations, and mean squared distances (K,).

        Start translations are zero in directions that the normals do not determine.
        """
        r = np.sum(n * (x @ se_n.transpose(R)), axis=-1) + d
        inverse = np.linalg.pinv(n, rcond=_MIN_TRANSLATION_SPREAD)
        start = se3.pose(R, -(inverse @ r[..., None])[..., 0])
        residuals = partial(_evaluate_plane_distances, n=n, d=d, x=x)
        return gauss_newton(start, residuals, _MIN_RMS_SLOPE, iterations)

    @cached_property
    def _determined(self) -> bool:
        """Whether all matches jointly determine the linear solution."""
        n = np.repeat(self.planes[:, :3], 2, axis=0)
        x = self.endpoints.reshape(-1, 3)
        s = np.linalg.svd(np.concatenate([x[:, :1] * n, x[:, 1:2] * n, n], axis=-1), compute_uv=False)
        return bool(len(s) == 9 and s[-1] > _MIN_CONDITION * np.sqrt(len(n)))

    def linearize(self, T_a_b: Array) -> Linearization:
        """Computes the distances of the two end points from the plane."""
        n = np.broadcast_to(self.planes[:, None, :3], self.endpoints.shape)
        x_a = se3.apply(T_a_b[:, None], self.endpoints)
        arm = x_a - T_a_b[:, None, None, :3, 3]
        n_a = np.broadcast_to(n, x_a.shape)
        jacobian = np.concatenate([n_a, np.cross(arm, n_a)], axis=-1)
        by_a = plane.distance_jacobian(self.planes, x_a)
        covariance = by_a @ self.covariances_a @ se_n.transpose(by_a)
        n_b = np.einsum("kji,mj->kmi", T_a_b[:, :3, :3], self.planes[:, :3])
        blocks = self.covariances_b.reshape(-1, 2, 3, 2, 3)
        covariance = covariance + np.einsum("kmi,mpiqj,kmj->kmpq", n_b, blocks, n_b)
        return Linearization(plane.distance(self.planes, x_a), jacobian, covariance)

    def feasible(self, T_a_b: Array) -> NDArray[np.bool_]:
        """Tests whether the distance from the segment's midpoint to the plane's centre is at most a board."""
        midpoints = se3.apply(T_a_b, self.endpoints.mean(axis=1))
        return np.asarray(np.linalg.norm(midpoints - self.centers_a, axis=-1) <= self.max_center_distance)


# Unobservable angle between the scan planes of two 2-D scanners, rad: small values bring the segments of each
# board near each other; near the least sine below, all lines would be coplanar.
_DIHEDRAL_ANGLE = 0.15
# Sine of the angle between two scan planes (3 degrees) below which coplanarity does not determine their pose: its
# residual, divided by this sine, multiplies noise by more than 20.
_MIN_SCAN_PLANE_SINE = 0.05
# Weight of the gap between the centres of two segments, in board diagonals, in addition to their coplanarity, in
# m: it determines the dihedral angle without an effect on directions that are observable.
_CENTER_GAP_WEIGHT = 0.001


@dataclass(frozen=True, eq=False)
class LineLineMatches:
    """M matches between segments measured by a and by b: two lines on one board are coplanar."""

    endpoints_a: Array
    """(M, 2, 3), frame a."""
    covariances_a: Array
    """(M, 6, 6)."""
    endpoints_b: Array
    covariances_b: Array
    max_center_distance: float
    """Largest distance between the two midpoints: the board's diagonal, m."""

    sample_size: int = 8

    def solve(self, samples: NDArray[np.intp]) -> Array:
        """Solves linearly, then refines by Gauss–Newton on coplanarity, regularized by the board's finite size.

        The rotation of one scanner about the intersection of the two scan planes keeps its start value: it moves
        no crossing point on that line, so it is unobservable (see :func:`evaluate_coplanarity`).
        """
        a, b = self.endpoints_a[samples], self.endpoints_b[samples]
        start = solve_coplanar_lines(a, b, _DIHEDRAL_ANGLE)
        weight = _CENTER_GAP_WEIGHT / self.max_center_distance
        residuals = partial(_regularized_coplanarity, a=a, b=b, gap_weight=weight)
        return gauss_newton(start, residuals, _MIN_RMS_SLOPE, _SAMPLE_STEPS)[0]

    def linearize(self, T_a_b: Array) -> Linearization:
        """Computes the distance of the two lines times the sine of their angle: zero if they are coplanar."""
        a, b = self.endpoints_a, self.endpoints_b
        r, jacobian, by_a, by_b = evaluate_coplanarity(T_a_b[:, None], a, b)
        covariance = np.einsum("kmi,mij,kmj->km", by_a, self.covariances_a, by_a)
        covariance = covariance + np.einsum("kmi,mij,kmj->km", by_b, self.covariances_b, by_b)
        return Linearization(r[..., None], jacobian[..., None, :], covariance[..., None, None])

    def feasible(self, T_a_b: Array) -> NDArray[np.bool_]:
        """Tests whether the distance between the midpoints of both segments is at most a board."""
        midpoints = se3.apply(T_a_b, self.endpoints_b.mean(axis=1))
        distance = np.linalg.norm(midpoints - self.endpoints_a.mean(axis=1), axis=-1)
        return np.asarray(distance <= self.max_center_distance)


def evaluate_coplanarity(T_a_b: Array, a: Array, b: Array) -> tuple[Array, Array, Array, Array]:
    """``(u × R v) · (R m_b + t - m_a) / s`` for lines with unit directions u, v through the middles m_a, m_b.

    With the sine s of the angle between the scan planes z = 0 of a and b, this is the distance between the two
    points where the lines cross the scan planes' intersection, times the sines of the lines' angles with it.
    Without the division, any pose with coinciding scan planes would fit: all lines would be coplanar.
    Rotating b about that line has no effect: a pair of 2-D scanners alone determines five of its six unknowns.
    Nearly parallel scan planes hardly determine their pose: NaN.

    Args:
        T_a_b: (..., 4, 4).
        a: (..., 2, 3) end points in frame a, m.
        b: (..., 2, 3) end points in frame b, m.

    Returns:
        Residuals (...), m, and their derivatives by T_a_b (..., 6), by a (..., 6) and by b (..., 6).
    """
    R, t = T_a_b[..., :3, :3], T_a_b[..., :3, 3]
    u, by_u = _direction_with_jacobian(a)
    v, by_v = _direction_with_jacobian(b)
    Rv = (R @ v[..., None])[..., 0]
    Rm = (R @ b.mean(axis=-2)[..., None])[..., 0]
    normal = np.cross(u, Rv)
    gap = Rm + t - a.mean(axis=-2)
    r = np.sum(normal * gap, axis=-1)
    d_u, d_Rv = np.cross(Rv, gap), np.cross(gap, u)
    jacobian = np.concatenate([normal, np.cross(Rm, normal) + np.cross(Rv, d_Rv)], axis=-1)
    turn_a = (se_n.transpose(by_u) @ d_u[..., None])[..., 0]
    by_a = np.concatenate([-turn_a - normal / 2, turn_a - normal / 2], axis=-1)
    back = se_n.transpose(R)
    normal_b = (back @ normal[..., None])[..., 0]
    turn_b = (se_n.transpose(by_v) @ (back @ d_Rv[..., None]))[..., 0]
    by_b = np.concatenate([-turn_b + normal_b / 2, turn_b + normal_b / 2], axis=-1)
    z_b = R[..., :, 2]
    s = np.hypot(z_b[..., 0], z_b[..., 1])
    s = np.where(s < _MIN_SCAN_PLANE_SINE, np.nan, s)
    jacobian = jacobian / s[..., None]
    jacobian[..., 3:] += (r * z_b[..., 2] / s**3)[..., None] * np.cross(z_b, [0.0, 0.0, 1.0])
    return r / s, jacobian, np.broadcast_to(by_a / s[..., None], jacobian.shape), by_b / s[..., None]


def _direction_with_jacobian(segment: Array) -> tuple[Array, Array]:
    """Unit directions (..., 3) of segments (..., 2, 3) and their derivatives by the second end point."""
    along = segment[..., 1, :] - segment[..., 0, :]
    length = np.linalg.norm(along, axis=-1)[..., None]
    u = along / length
    return u, (np.eye(3) - u[..., :, None] * u[..., None, :]) / length[..., None]


def _evaluate_plane_distances(T: Array, n: Array, d: Array, x: Array) -> tuple[Array, Array]:
    """Computes distances (K, P) of transformed points x (K, P, 3) from planes (n, d), and their Jacobian by T."""
    Rx = x @ se_n.transpose(T[:, :3, :3])
    r = np.sum(n * (Rx + T[:, None, :3, 3]), axis=-1) + d
    return r, np.concatenate([n, np.cross(Rx, n)], axis=-1)


def _regularized_coplanarity(T: Array, a: Array, b: Array, gap_weight: float) -> tuple[Array, Array]:
    """Coplanarity residuals, and the weighted gaps between midpoints."""
    r, J, _, _ = evaluate_coplanarity(T[:, None], a, b)
    Rm = np.einsum("kij,kmj->kmi", T[:, :3, :3], b.mean(axis=2))
    gap = Rm + T[:, None, :3, 3] - a.mean(axis=2)
    J_gap = np.concatenate([np.broadcast_to(np.eye(3), (*Rm.shape, 3)), -so3.hat(Rm)], axis=-1)
    return (
        np.concatenate([r, gap_weight * gap.reshape(len(T), -1)], axis=1),
        np.concatenate([J, gap_weight * J_gap.reshape(len(T), -1, 6)], axis=1),
    )


# Sine or length below which two lines count as parallel, and a line as at infinity: keeps quotients finite.
_SMALL = 1e-6


def solve_coplanar_lines(a: Array, b: Array, dihedral_angle: float) -> Array:
    """Solves for poses under which the lines of each sample are coplanar.

    In coordinates (direction, moment) of lines in their scan planes, ``l_a @ E @ l_b = 0``. The last element of
    the matrix E is zero; seven pairs of lines determine the other eight up to scale. The intersection of the scan
    planes is coplanar with all lines of the other scan plane, so it spans E's null space on either side.

    Args:
        a: (K, m, 2, 3) end points of m >= 7 segments in K samples, frame a, z = 0, m.
        b: (K, m, 2, 3) end points of the matching segments, frame b, z = 0, m.
        dihedral_angle: unobservable angle between the scan planes, rad.

    Returns:
        T_a_b (K, 4, 4); NaN for samples whose intersection lies at infinity.
    """
    scale = np.sqrt(np.mean(a**2, axis=(1, 2, 3)) + np.mean(b**2, axis=(1, 2, 3)))[:, None]
    lines_a, lines_b = _lines(a, scale), _lines(b, scale)
    products = (lines_a[..., :, None] * lines_b[..., None, :]).reshape(*lines_a.shape[:2], 9)[..., :8]
    # An eigendecomposition of 8 x 8 is faster than the SVD; its lower accuracy does not matter before refinement.
    _, vectors = np.linalg.eigh(se_n.transpose(products) @ products)
    E = np.concatenate([vectors[..., 0], np.zeros((len(a), 1))], axis=1).reshape(-1, 3, 3)
    U, _, Vt = np.linalg.svd(E)
    axis_a, axis_b = _normalize_line(U[..., 2]), _normalize_line(Vt[:, 2])
    crossing_a, sine_a = _intersect_lines(lines_a, axis_a)
    crossing_b, sine_b = _intersect_lines(lines_b, axis_b)
    weights = (sine_a * sine_b) ** 2
    weights /= weights.sum(axis=1, keepdims=True)
    shift, residual = np.stack([_fit_shift(crossing_a, s * crossing_b, weights) for s in (1.0, -1.0)], axis=1)
    reversed_ = residual[1] < residual[0]
    axis_b = np.where(reversed_[:, None], -axis_b, axis_b)
    frame_a, frame_b = _line_frame(axis_a), _line_frame(axis_b)
    # The dihedral angle is such that both scanners observe the boards on the same side of the intersection.
    sides = np.sum(_signed_distances(a, axis_a, scale) * _signed_distances(b, axis_b, scale), axis=1)
    dihedral = np.where(sides < 0, np.pi - dihedral_angle, dihedral_angle)
    R = frame_a @ _rotation_about_x(dihedral) @ se_n.transpose(frame_b)
    origin_a = _closest_point(axis_a) + np.where(reversed_, shift[1], shift[0])[:, None] * frame_a[..., 0]
    return se3.pose(R, scale * (origin_a - (R @ _closest_point(axis_b)[..., None])[..., 0]))


def _lines(segments: Array, scale: Array) -> Array:
    """Lines (K, m, 3) through segments (K, m, 2, 3): unit direction and moment ``x × direction`` over scale."""
    along = segments[..., 1, :2] - segments[..., 0, :2]
    along = along / np.linalg.norm(along, axis=-1, keepdims=True)
    x = segments.mean(axis=-2)
    moment = (x[..., 0] * along[..., 1] - x[..., 1] * along[..., 0]) / scale
    return np.concatenate([along, moment[..., None]], axis=-1)


def _normalize_line(line: Array) -> Array:
    """Normalizes lines (K, 3) to unit directions; NaN for a line at infinity."""
    length = np.linalg.norm(line[:, :2], axis=1, keepdims=True)
    return line / np.where(length > _SMALL, length, np.nan)


def _intersect_lines(lines: Array, axis: Array) -> tuple[Array, Array]:
    """Coordinates along an axis (K, 3) at which lines (K, m, 3) cross it, and the sines of the angles there."""
    sine = lines[..., 0] * axis[:, None, 1] - lines[..., 1] * axis[:, None, 0]
    sine = np.where(np.abs(sine) < _SMALL, _SMALL, sine)
    cosine = np.sum(lines[..., :2] * axis[:, None, :2], axis=-1)
    return (axis[:, 2:] * cosine - lines[..., 2]) / sine, sine


def _fit_shift(crossing_a: Array, crossing_b: Array, weights: Array) -> tuple[Array, Array]:
    """Weighted mean shifts (K,) from crossings b to crossings a, and mean squared residuals (K,)."""
    gap = crossing_a - crossing_b
    shift = np.sum(weights * gap, axis=1)
    return shift, np.sum(weights * (gap - shift[:, None]) ** 2, axis=1)


def _line_frame(axis: Array) -> Array:
    """Unit vectors (K, 3, 3) along the axis, across it in the scan plane, and along the scan plane's normal z."""
    frame = np.zeros((len(axis), 3, 3))
    frame[:, 0, 0], frame[:, 1, 0] = axis[:, 0], axis[:, 1]
    frame[:, 0, 1], frame[:, 1, 1] = -axis[:, 1], axis[:, 0]
    frame[:, 2, 2] = 1
    return frame


def _rotation_about_x(angle: Array) -> Array:
    """Rotations (K, 3, 3) about the first axis."""
    R = np.zeros((len(angle), 3, 3))
    R[:, 0, 0] = 1
    R[:, 1, 1] = R[:, 2, 2] = np.cos(angle)
    R[:, 2, 1], R[:, 1, 2] = np.sin(angle), -np.sin(angle)
    return R


def _signed_distances(segments: Array, axis: Array, scale: Array) -> Array:
    """Signed distances (K, m) of the segments' midpoints from the axis, over scale."""
    x = segments.mean(axis=-2)[..., :2] / scale[..., None]
    return np.asarray(x[..., 1] * axis[:, None, 0] - x[..., 0] * axis[:, None, 1] + axis[:, None, 2])


def _closest_point(axis: Array) -> Array:
    """Points (K, 3) of the axes closest to the scanner."""
    return axis[:, 2:] * np.stack([axis[:, 1], -axis[:, 0], np.zeros(len(axis))], axis=1)


# Relative decrease of the cost at which a problem has converged; initial damping: many starts are far from a
# minimum.
_TOLERANCE, _INITIAL_DAMPING = 1e-9, 1e-4


def gauss_newton(
    T: Array, residuals: Callable[[Array], tuple[Array, Array]], min_rms_slope: float, iterations: int
) -> tuple[Array, Array]:
    """Minimizes K independent sums of squares over poses.

    Args:
        T: (K, 4, 4) start values.
        residuals: poses (K, 4, 4) to residuals (K, m) and their Jacobians (K, m, 6) for se3.retract; NaN for
            infeasible poses, to which no step is taken.
        min_rms_slope: change of the residuals' RMS per unit of a direction (m or rad) below which it keeps its
            start value.
        iterations: maximum number of steps.

    Returns:
        The poses (K, 4, 4) and their mean squared residuals (K,), infinite for infeasible start values.
    """

    def linearize(T: Array) -> _PoseLinearization:
        r, J = residuals(T)
        root = np.sqrt(r.shape[1])
        return _PoseLinearization(r / root, np.nan_to_num(J) / root, min_rms_slope)

    T, at = minimize_batch(
        T, linearize, se3.retract,
        iterations=iterations, relative_tolerance=_TOLERANCE, damping=_INITIAL_DAMPING,
    )  # fmt: skip
    return T, np.where(np.isnan(at.cost), np.inf, 2 * at.cost)


@dataclass(frozen=True, eq=False)
class _PoseLinearization(DenseLinearization):
    """Residuals of K problems, whose sum of squares is their mean square."""

    min_rms_slope: float

    def solve(self, damping: Array) -> tuple[Array, Array]:
        """Steps (K, 6) along the observable directions, and predicted decreases (K,)."""
        values, vectors = np.linalg.eigh(self.information)
        slope = (self.gradient[:, None] @ vectors)[:, 0]
        observable = values > self.min_rms_slope**2
        step = np.where(observable, slope / (values + damping[:, None]), 0.0)
        decrease = np.where(observable, step * (slope - 0.5 * values * step), 0.0)
        return -(vectors @ step[..., None])[..., 0], decrease.sum(axis=1)


def axis_aligned_rotations() -> Array:
    """The 24 rotations (24, 3, 3) that map axes to axes: start values for sensors of unknown mounting."""
    rotations = []
    for order in itertools.permutations(range(3)):
        for signs in itertools.product((1.0, -1.0), repeat=3):
            R = np.zeros((3, 3))
            R[np.arange(3), order] = signs
            if np.linalg.det(R) > 0:
                rotations.append(R)
    return np.array(rotations)
