"""The joint solution: trajectory, surfaces, poses, clocks and range errors of all sensors of a drive.

For each measured point k of sensor i on surface j,

    r = n_j · (T_wr(t_k - o_i) T_ri ((1 - s_i) ρ_k - β_i) u_k - c_j) - (1, u, v) · (f_j + b_ij)

with the trajectory ``T_wr`` a spline, the flat patch ``f_j`` of a cell (offset and slopes), and the view bias
``b_ij``, by which the patch that one sensor measures differs from that of the others: surfaces are not planes, and
ranges depend on incidence. View biases and surfaces are eliminated by group and cell, then the trajectory of each
part of the drive; what remains are the errors of the sensors.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import cho_factor, cho_solve
from scipy.sparse import csr_array

from calgraph.geometry import STDDEV_PER_MAD, Array, Index, measure_lengths, se_n
from calgraph.surfaces.flat_cells import FlatCells, fit_flat_cells, sum_moments
from calgraph.surfaces.trajectory import SplineTrajectory


@dataclass(frozen=True, eq=False)
class SensorState:
    """What is estimated of a sensor."""

    T_root_sensor: Array
    """(n+1, n+1)."""
    clock_offset: float = 0.0
    """Its clock minus the root's, s."""
    range_bias: float = 0.0
    """By which it measures too far, m."""
    range_scale: float = 0.0
    """And relative to the distance."""

    def moved(self, step: Array) -> "SensorState":
        """The state after a step (n + d + 3,): pose along the root's axes, clock, bias, scale."""
        pose = len(step) - 3
        return SensorState(
            se_n.retract(self.T_root_sensor, step[:pose]),
            self.clock_offset + float(step[pose]),
            self.range_bias + float(step[pose + 1]),
            self.range_scale + float(step[pose + 2]),
        )


@dataclass(frozen=True, eq=False)
class SensorPoints:
    """Points that a sensor measured during a part of the drive."""

    points: Array
    """(N, n) in its frame, m."""
    times: Array
    """(N,) by its clock, s."""


@dataclass(frozen=True, eq=False)
class DrivePart:
    """A part of the drive with a separate world."""

    points: Sequence[SensorPoints]
    """By sensor; the first is the root."""
    trajectory: SplineTrajectory
    """Of the root, by its clock."""


@dataclass(frozen=True)
class AdjustmentPriors:
    """Standard deviations of what is known before, by sensor."""

    pose: Array
    """(S, n+d); the root's are 0: fixed."""
    clock: Array
    """(S,) s."""
    range_bias: Array
    """(S,) m."""
    range_scale: Array
    """(S,)."""

    @property
    def stddev(self) -> Array:
        """(S, n + d + 3)."""
        return np.column_stack([self.pose, self.clock, self.range_bias, self.range_scale])


@dataclass(frozen=True, eq=False)
class NoiseModel:
    """Standard deviations of residuals."""

    white: Array
    """(S,) of each point of a sensor along the normal, m."""
    view: float
    """Of the offset of a patch as one sensor measures it, and of its slopes at one standard deviation of the
    points from the middle, m."""


@dataclass(frozen=True, eq=False)
class Adjustment:
    """The joint solution."""

    states: Sequence[SensorState]
    parts: Sequence[DrivePart]
    covariance: Array
    """(P, P) of the parameters (S, n + d + 3) that are free, in their order."""
    free: NDArray[np.bool_]
    """(S, n + d + 3): which these are."""
    noise: NoiseModel
    shared_cells: Array
    """(S, S) number of surfaces that both sensors measured."""
    residual_rms: Array
    """(S,) m, of the points on surfaces."""
    point_counts: Array
    """(S,) number of these."""
    squared_step: float
    """Squared last step of the sensors' parameters, in their standard deviations."""


@dataclass(frozen=True)
class CellLimits:
    """What counts as a surface."""

    cell: float
    """Edge length, m."""
    min_count: int
    """Least number of points in a cell."""
    min_extent: float
    """Least standard deviation along each direction, m."""


# Lines need fewer points than planes; a patch must extend far enough for slopes to be determined.
CELL_LIMITS = {2: CellLimits(0.5, 8, 0.08), 3: CellLimits(1.0, 15, 0.12)}
# Distances from a surface within which points are of it, m, by iteration: from errors of the start to noise.
_GATES = (0.3, 0.2, 0.15, 0.12, 0.1, *[0.09] * 8)
# Thickness (standard deviation) up to which a cell is flat at a gate, which then holds 99.7 % of its points.
_THICKNESS_PER_GATE = 1 / 3
# Start values of standard deviations, m: range noise of LiDARs, and what plaster and doors deviate from planes.
_START_WHITE, _START_VIEW = 0.02, 0.01
# Least ones: quantised ranges, and walls that are better than any.
_MIN_WHITE, _MIN_VIEW = 0.002, 0.0005
# Time for which a sensor measures a cell from one place, s: a robot moves by the size of a cell. On 15 minutes of
# real scans of an office, 0.5 to 4 s give median errors of 7.4 to 8.9 mm, 0.2 s 10.3, and one view in all 9.9.
_VIEW_DURATION = 1.0
# Degrees of freedom of Student's t for view biases: a few are of furniture, or of something that moved. The fourth
# moment of those of an office is 13 to 30 times the squared second; errors with 2, 4 and many differ by 20 %.
_FREEDOM = 4.0
# Accelerations of a robot's motion, m/s² and rad/s², which bind the spline where nothing is measured.
_ACCELERATION, _TURN_ACCELERATION = 5.0, 10.0
# Standard deviation with which the middle control point is held, m and rad: it only fixes the world, which
# the poses of sensors do not depend on.
_GAUGE = 1e-3
# Scale of the robust weights, in standard deviations (Geman–McClure): 99.7 % of normal errors are nearer, others
# are of something before the surface.
_ROBUST = 3.0


def adjust_drive(
    parts: Sequence[DrivePart],
    states: Sequence[SensorState],
    priors: AdjustmentPriors,
    progress: Callable[[float], None] = lambda _: None,
) -> Adjustment:
    """Solves for all sensors, surfaces and the trajectory jointly, by Gauss–Newton with surfaces found again.

    Args:
        parts: of the drive.
        states: start values by sensor; the first is the root.
        priors: of these.
        progress: called with the fraction done.
    """
    prior = priors.stddev
    free = prior > 0
    start = states
    noise = NoiseModel(np.full(len(states), _START_WHITE), _START_VIEW)
    parts = list(parts)
    reduced: list[_Reduced] = []
    step: Array = np.zeros(int(free.sum()))
    H: Array = np.eye(len(step), dtype=np.float64)
    for k, gate in enumerate(_GATES):
        reduced = [_reduce_part(part, states, noise, gate, free) for part in parts]
        H = sum((one.information for one in reduced), np.diag(prior[free] ** -2.0))
        deviation = _deviation(states, start)
        g = sum((one.gradient for one in reduced), deviation[free] / prior[free] ** 2)
        step = -np.asarray(np.linalg.solve(H, g), dtype=np.float64)
        full = np.zeros(free.shape)
        full[free] = step
        states = [state.moved(one) for state, one in zip(states, full, strict=True)]
        parts = [
            replace(part, trajectory=part.trajectory.moved(one.back_substitute(step)))
            for part, one in zip(parts, reduced, strict=True)
        ]
        noise = _estimate_noise(reduced, noise)
        progress((k + 1) / len(_GATES))
    return Adjustment(
        states, parts, _invert(H), free, noise,
        shared_cells=np.sum([one.shared for one in reduced], axis=0),
        residual_rms=noise.white,
        point_counts=np.sum([one.white[:, 1] for one in reduced], axis=0),
        squared_step=float(step @ H @ step),
    )  # fmt: skip


def _deviation(states: Sequence[SensorState], start: Sequence[SensorState]) -> Array:
    """(S, n + d + 3) of the states from those of the prior."""
    return np.array([
        [
            *se_n.difference(state.T_root_sensor, first.T_root_sensor),
            state.clock_offset - first.clock_offset,
            state.range_bias,
            state.range_scale,
        ]
        for state, first in zip(states, start, strict=True)
    ])  # fmt: skip


@dataclass(frozen=True, eq=False)
class _Points:
    """Points on surfaces, linearized: residuals with their derivatives."""

    sensor: Index
    """(N,)."""
    surface: Index
    """(N,)."""
    view: Index
    """(N,) number of the interval of time in which a sensor measured the point."""
    residual: Array
    """(N,) m."""
    patch: Array
    """(N, n) 1, and the places on the surface in standard deviations: the derivatives by offset and slopes."""
    first: Index
    """(N,) first control point."""
    by_control: Array
    """(N, 4 (n + d))."""
    by_sensor: Array
    """(N, n + d + 3)."""


def _linearize(part: DrivePart, states: Sequence[SensorState], gate: float) -> tuple[_Points, FlatCells]:
    """The residuals of the points of a part that are on surfaces."""
    at = [_evaluate(part, k, state) for k, state in enumerate(states)]
    world = np.concatenate([one.world for one in at])
    sensor = np.repeat(np.arange(len(at)), [len(one.world) for one in at])
    time = np.concatenate([one.time for one in at])
    view = np.floor((time - part.trajectory.start) / _VIEW_DURATION).astype(np.intp)
    n = world.shape[1]
    limits = CELL_LIMITS[n]
    surfaces = fit_flat_cells(
        sum_moments(world, limits.cell),
        limits.cell,
        max_thickness=gate * _THICKNESS_PER_GATE,
        min_extent=limits.min_extent,
        min_count=limits.min_count,
    )
    index = surfaces.find(world)
    hit = np.flatnonzero(index >= 0)
    offset = world[hit] - surfaces.center[index[hit]]
    axes = surfaces.axes[index[hit]]
    local = np.einsum("ni,nij->nj", offset, axes)
    near = np.abs(local[:, 0]) < gate
    hit, axes, local = hit[near], axes[near], local[near]
    cells = index[hit]
    patch = np.concatenate([np.ones((len(hit), 1)), local[:, 1:] / surfaces.extent[cells]], axis=1)
    normals = axes[:, :, 0]
    joined = {
        name: np.concatenate([getattr(one, name) for one in at])[hit]
        for name in ("first", "basis", "position_arm", "rotation_jacobian", "by_sensor")
    }
    turn = np.einsum(
        "ni,nij,njk->nk", normals, se_n.rotation_jacobian(joined["position_arm"]), joined["rotation_jacobian"]
    )
    # Noise is of the ranges as measured: residuals of ranges that are taken as smaller do not get smaller.
    scale = 1 + np.array([state.range_scale for state in states])[sensor[hit]]
    residual = local[:, 0] * scale
    by_pose = np.concatenate([normals, turn], axis=1) * scale[:, None]
    by_control = (joined["basis"][:, :, None] * by_pose[:, None, :]).reshape(len(hit), -1)
    by_sensor = np.einsum("ni,nij->nj", normals, joined["by_sensor"]) * scale[:, None]
    by_sensor[:, -1] += local[:, 0]
    return _Points(
        sensor[hit], cells, view[hit], residual, patch, joined["first"], by_control, by_sensor
    ), surfaces


@dataclass(frozen=True, eq=False)
class _Evaluated:
    """Points of one sensor in the world, with derivatives."""

    world: Array
    """(N, n) m."""
    time: Array
    """(N,) by the root's clock, s."""
    first: Index
    """(N,) first control point."""
    basis: Array
    """(N, 4) weights of control points."""
    position_arm: Array
    """(N, n) from the origin of the root, along the world's axes, m."""
    rotation_jacobian: Array
    """(N, d, d) of :class:`SplinePoses`."""
    by_sensor: Array
    """(N, n, n + d + 3) of the place in the world."""


def _evaluate(part: DrivePart, k: int, state: SensorState) -> _Evaluated:
    """The points of sensor k during the trajectory."""
    measured, trajectory = part.points[k], part.trajectory
    times = measured.times - state.clock_offset
    inside = (times >= trajectory.start) & (times <= trajectory.end)
    p, times = measured.points[inside], times[inside]
    ranges = measure_lengths(p) if p.shape[1] == 3 else np.hypot(*p.T)
    direction = p / ranges[:, None]
    p = direction * (ranges * (1 - state.range_scale) - state.range_bias)[:, None]
    at = trajectory.at(times)
    T = state.T_root_sensor
    R_world, R_sensor = se_n.rotation(at.poses), se_n.rotation(T)
    turned = p @ R_sensor.T
    x_root = turned + se_n.translation(T)
    arm = np.einsum("nij,nj->ni", R_world, x_root)
    beam = np.einsum("nij,nj->ni", R_world, direction @ R_sensor.T)
    spin = np.einsum("nij,nj->ni", se_n.rotation_jacobian(arm), at.turn_rate)
    by_sensor = np.concatenate(
        [
            R_world,
            R_world @ se_n.rotation_jacobian(turned),
            -(at.velocity + spin)[:, :, None],
            -beam[:, :, None],
            -(ranges[:, None] * beam)[:, :, None],
        ],
        axis=2,
    )
    return _Evaluated(
        arm + se_n.translation(at.poses), times, at.first, at.basis, arm, at.rotation_jacobian, by_sensor
    )


@dataclass(frozen=True, eq=False)
class _Reduced:
    """A part of the drive, with surfaces and trajectory eliminated."""

    information: Array
    """(P, P) of the free parameters of sensors."""
    gradient: Array
    """(P,)."""
    control_factor: tuple[Array, bool]
    """Cholesky factor of the control points' information."""
    control_sensor: Array
    """(C, P) information between both."""
    control_gradient: Array
    """(C,)."""
    columns: int
    """Numbers of a control point."""
    white: Array
    """(S, 2) standard deviation of residuals around patches, m, and number of points."""
    view: Array
    """(2,) sum of squared view biases, m², and their number."""
    shared: Array
    """(S, S) number of surfaces that both sensors measured."""

    def back_substitute(self, step: Array) -> Array:
        """(K, n + d) the change of the control points that goes with a step of the sensors."""
        change = -cho_solve(self.control_factor, self.control_gradient + self.control_sensor @ step)
        return np.asarray(change.reshape(-1, self.columns))


def _reduce_part(
    part: DrivePart, states: Sequence[SensorState], noise: NoiseModel, gate: float, free: NDArray[np.bool_]
) -> _Reduced:
    """The normal equations of the sensors' free parameters from a part, at the present states."""
    at, surfaces = _linearize(part, states, gate)
    n = surfaces.center.shape[1]
    S, count = len(states), len(surfaces.keys)
    columns = part.trajectory.control.shape[1]
    C = part.trajectory.control.size
    views = int(at.view.max(initial=0)) + 1
    group_key = (at.surface * S + at.sensor) * views + at.view
    groups, group = np.unique(group_key, return_inverse=True)
    sigma = noise.white[at.sensor]
    # The weight of a point by its distance from the patch that its own group has.
    weight = sigma**-2.0
    weight = weight * _robust_weights(at, group, len(groups), sigma)
    # Columns: control points, then the free parameters of sensors.
    number = np.full(free.shape, -1)
    number[free] = np.arange(free.sum())
    P = int(free.sum())
    rows = np.arange(len(at.residual))
    control_columns = (at.first[:, None] * columns + np.arange(4 * columns)).ravel()
    sensor_columns = number[at.sensor]
    used = sensor_columns >= 0
    J = csr_array(
        (
            np.concatenate([at.by_control.ravel(), at.by_sensor[used]]),
            (
                np.concatenate([np.repeat(rows, 4 * columns), np.nonzero(used)[0]]),
                np.concatenate([control_columns, C + sensor_columns[used]]),
            ),
        ),
        shape=(len(rows), C + P),
    )
    patches = csr_array(
        ((at.patch * weight[:, None]).ravel(), ((group[:, None] * n + np.arange(n)).ravel(), np.repeat(rows, n))),
        shape=(len(groups) * n, len(rows)),
    )
    # Patch r = residual - patch · (surface + bias): derivatives by these are -patch.
    G = patches @ J
    h = (patches @ at.residual).reshape(-1, n)
    N = np.empty((len(groups), n, n))
    for a in range(n):
        for b in range(n):
            N[:, a, b] = np.bincount(group, weight * at.patch[:, a] * at.patch[:, b], len(groups))
    weighted = J.multiply(np.sqrt(weight)[:, None]).tocsr()
    H = (weighted.T @ weighted).toarray()
    g = J.T @ (weight * at.residual)
    # View biases.
    inverse = _invert(N + _view_information(N, h, groups // (S * views), count, noise.view))
    F = _block_rows(_upper_root(inverse)) @ G
    H -= (F.T @ F).toarray()
    solved = np.einsum("gij,gj->gi", inverse, h)
    g -= G.T @ solved.ravel()
    bias_of_surface = N @ inverse
    N_left = N - bias_of_surface @ N
    G_left = G - _block_rows(bias_of_surface) @ G
    h_left = h - np.einsum("gij,gj->gi", bias_of_surface, h)
    # Surfaces: sums over their groups.
    surface_of_group = groups // (S * views)
    N_surface = np.zeros((count, n, n))
    np.add.at(N_surface, surface_of_group, N_left)
    h_surface = np.zeros((count, n))
    np.add.at(h_surface, surface_of_group, h_left)
    gather = csr_array(
        (
            np.ones(len(groups) * n),
            ((surface_of_group[:, None] * n + np.arange(n)).ravel(), np.arange(len(groups) * n)),
        ),
        shape=(count * n, len(groups) * n),
    )
    G_surface = gather @ G_left
    # Nothing is known of a surface before; 1 m keeps cells without points solvable.
    surface_inverse = _invert(N_surface + np.eye(n))
    F = _block_rows(_upper_root(surface_inverse)) @ G_surface
    H -= (F.T @ F).toarray()
    fitted = np.einsum("gij,gj->gi", surface_inverse, h_surface)
    g -= G_surface.T @ fitted.ravel()
    _add_motion_prior(H, g, part.trajectory)
    # Trajectory.
    H_c, H_cp, H_p = H[:C, :C], H[:C, C:], H[C:, C:]
    factor = cho_factor(H_c, lower=True, check_finite=False)
    eliminated = cho_solve(factor, np.column_stack([H_cp, g[:C]]), check_finite=False)
    # Statistics of the noise, with the patches that are fitted at this linearization.
    bias = np.einsum("gij,gj->gi", inverse, h - np.einsum("gij,gj->gi", N, fitted[surface_of_group]))
    around = at.residual - np.einsum("nj,nj->n", at.patch, (fitted[surface_of_group] + bias)[group])
    white = np.zeros((S, 2))
    for k in range(S):
        own = at.sensor == k
        if own.any():
            white[k] = STDDEV_PER_MAD * np.median(np.abs(around[own])), own.sum()
    view = _view_statistics(surface_of_group, bias, inverse, surface_inverse, bias_of_surface, count)
    is_measured = np.zeros((S, count))
    is_measured[groups // views % S, surface_of_group] = 1
    return _Reduced(
        H_p - H_cp.T @ eliminated[:, :P],
        g[C:] - H_cp.T @ eliminated[:, P],
        factor, H_cp, g[:C], columns, white, view, is_measured @ is_measured.T,
    )  # fmt: skip


def _robust_weights(at: _Points, group: Index, count: int, sigma: Array) -> Array:
    """(N,) Geman–McClure weights of the distances from the median of each group's points."""
    order = np.lexsort((at.residual, group))
    sizes = np.bincount(group, minlength=count)
    middle = np.cumsum(sizes) - sizes + sizes // 2
    center = at.residual[order][middle]
    scaled = (at.residual - center[group]) / (_ROBUST * sigma)
    return np.asarray((1 + scaled**2) ** -2.0)


def _view_information(N: Array, h: Array, surface: Index, count: int, stddev: float) -> Array:
    """(G, n, n) information of view biases, smaller for those that are large: Student's t by reweighting.

    Args:
        N: (G, n, n) information of the points on the patch of each group.
        h: (G, n) and its gradient.
        surface: (G,) of each group.
        count: number of surfaces.
        stddev: of most biases, m.
    """
    n = h.shape[1]
    scale = np.ones(len(h))
    information = np.eye(n) * stddev**-2.0
    for _ in range(3):
        inverse = _invert(N + scale[:, None, None] * information)
        left = np.eye(n) - N @ inverse
        N_surface, h_surface = np.zeros((count, n, n)), np.zeros((count, n))
        np.add.at(N_surface, surface, left @ N)
        np.add.at(h_surface, surface, np.einsum("gij,gj->gi", left, h))
        fitted = np.linalg.solve(N_surface + np.eye(n), h_surface[..., None])[surface, :, 0]
        bias = np.einsum("gij,gj->gi", inverse, h - np.einsum("gij,gj->gi", N, fitted))
        scale = (_FREEDOM + n) / (_FREEDOM + np.sum(bias**2, axis=1) / stddev**2)
    return np.asarray(scale[:, None, None] * information)


def _view_statistics(
    surface_of_group: Index,
    bias: Array,
    inverse: Array,
    surface_inverse: Array,
    bias_of_surface: Array,
    count: int,
) -> Array:
    """(2,) expected squared view biases, and their number, of surfaces in several views (EM)."""
    several = np.bincount(surface_of_group, minlength=count) > 1
    used = several[surface_of_group]
    if not used.any():
        return np.zeros(2)
    # Posterior variance: of the bias given the surface, and of the surface.
    variance = inverse + np.swapaxes(bias_of_surface, -1, -2) @ surface_inverse[surface_of_group] @ bias_of_surface
    expected = bias**2 + np.diagonal(variance, axis1=-2, axis2=-1)
    return np.array([expected[used].sum(), expected[used].size])


def _add_motion_prior(H: Array, g: Array, trajectory: SplineTrajectory) -> None:
    """Adds what is known of accelerations, and holds the middle control point."""
    control = trajectory.control
    K, columns = control.shape
    n = trajectory.reference.poses.shape[-1] - 1
    stddev = np.repeat([_ACCELERATION, _TURN_ACCELERATION], [n, columns - n]) * trajectory.spacing**2
    second = np.diff(control, 2, axis=0) / stddev**2
    index = np.arange(K - 2)
    gradient = np.zeros_like(control)
    for a, wa in enumerate((1.0, -2.0, 1.0)):
        gradient[a : a + K - 2] += wa * second
        for b, wb in enumerate((1.0, -2.0, 1.0)):
            for c in range(columns):
                H[(index + a) * columns + c, (index + b) * columns + c] += wa * wb / stddev[c] ** 2
    g[: K * columns] += gradient.ravel()
    middle = K // 2 * columns + np.arange(columns)
    H[middle, middle] += _GAUGE**-2.0


def _invert(matrices: Array) -> Array:
    """Inverses of matrices (..., n, n)."""
    return np.asarray(np.linalg.inv(matrices), dtype=np.float64)


def _upper_root(matrices: Array) -> Array:
    """``U`` (..., n, n) with ``U.T @ U`` the matrices."""
    return se_n.transpose(np.asarray(np.linalg.cholesky(matrices), dtype=np.float64))


def _block_rows(blocks: Array) -> csr_array:
    """The block-diagonal matrix of blocks (B, n, n)."""
    B, n, _ = blocks.shape
    base = np.arange(B)[:, None, None] * n
    row = np.broadcast_to(base + np.arange(n)[:, None], blocks.shape)
    column = np.broadcast_to(base + np.arange(n), blocks.shape)
    return csr_array((blocks.ravel(), (row.ravel(), column.ravel())), shape=(B * n, B * n))


def _estimate_noise(reduced: Sequence[_Reduced], noise: NoiseModel) -> NoiseModel:
    """Standard deviations from the residuals of all parts."""
    white = np.array([one.white for one in reduced])
    counts = white[:, :, 1].sum(axis=0)
    mean = np.sum(white[:, :, 0] * white[:, :, 1], axis=0) / np.maximum(counts, 1)
    squares, number = np.sum([one.view for one in reduced], axis=0)
    view = np.sqrt(squares / number) if number else noise.view
    return NoiseModel(np.maximum(np.where(counts > 0, mean, noise.white), _MIN_WHITE), max(float(view), _MIN_VIEW))
