"""Whether a stationary LiDAR moved: its pose after a moment relative to that before, from what stands still.

If a sensor moves by t and turns by r, the range of a point p on a plane with normal n, along the beam u, changes
by ``-(n · t + (p x n) · r) / (n · u)``. Least squares over all directions give t and r, with the weights of
Student's t for what moved itself.
"""

import numpy as np
from scipy.special import chdtri

from calgraph.geometry import Array
from calgraph.network.space.observations import StaticPoints, StaticStep
from calgraph.solver.clustered_covariance import SCATTER_FACTOR
from calgraph.surfaces.surface_points import fit_surfaces

# Least measurements of a direction before and after a step, and least number of such directions.
_MIN_COUNT, _MIN_DIRECTIONS = 8, 200
# Standard deviation of surfaces that are planes, and distance up to which points are on them, m.
_THICKNESS, _NEAR = 0.03, 0.09
# Standard deviation of a point from its surface beside the noise of ranges, m, assumed: at grazing incidence that
# noise is next to nothing across the surface.
_SURFACE_STDDEV = 0.0005
# Degrees of freedom of Student's t, and fits with weights from the residuals of the one before.
_FREEDOM, _ROUNDS = 4.0, 8
# Probability with which a step is found where there is none, by errors that are independent.
_FALSE_ALARM = 0.001
# Steps that count, m and rad (0.03°): half of it is an error of the pose, which is known to some millimetres.
# Simulated sensors that rest, 50 of them, beside glass, stairs and crowds, have steps of up to 0.8 mm and 0.007°.
_MIN_SHIFT, _MIN_TURN = 0.002, float(np.radians(0.03))


def find_step(static: StaticPoints, count: Array, total: Array, begin: Array) -> StaticStep | None:
    """The most significant step between periods, if there is one that counts.

    Args:
        static: of N directions.
        count: (K, N) measurements of these in each period.
        total: (K, N) sums of their ranges, m.
        begin: (K,) of periods, s.
    """
    surfaces = fit_surfaces(static.points, np.zeros(len(static.points), dtype=np.intp), _THICKNESS)
    cell = surfaces.find(static.points)
    on = np.flatnonzero(cell >= 0)
    distance = np.einsum("ni,ni->n", static.points[on] - surfaces.center[cell[on]], surfaces.normals[cell[on]])
    on = on[np.abs(distance) < _NEAR]
    points, normals = static.points[on], surfaces.normals[cell[on]]
    incidence = np.einsum("ni,ni->n", points, normals) / np.linalg.norm(points, axis=1)
    by_motion = -np.column_stack([normals, np.cross(points, normals)])
    count, total = np.cumsum(count[:, on], axis=0), np.cumsum(total[:, on], axis=0)
    found, largest = None, SCATTER_FACTOR * float(chdtri(6, _FALSE_ALARM))
    for k in range(len(begin) - 1):
        n_before, n_after = count[k], count[-1] - count[k]
        used = np.flatnonzero((n_before >= _MIN_COUNT) & (n_after >= _MIN_COUNT))
        if len(used) < _MIN_DIRECTIONS:
            continue
        n_before, n_after = n_before[used], n_after[used]
        change = (total[-1] - total[k])[used] / n_after - total[k, used] / n_before
        noise = static.stddev[on[used]] * np.sqrt(1 / n_before + 1 / n_after)
        stddev = np.hypot(incidence[used] * noise, _SURFACE_STDDEV)
        step, information = _fit_robustly(by_motion[used], incidence[used] * change, stddev)
        significance = float(step @ information @ step)
        shift, turn = float(np.linalg.norm(step[:3])), float(np.linalg.norm(step[3:]))
        if significance > largest and (shift > _MIN_SHIFT or turn > _MIN_TURN):
            found, largest = StaticStep(float(begin[k + 1]), shift, turn), significance
    return found


def _fit_robustly(A: Array, b: Array, stddev: Array) -> tuple[Array, Array]:
    """The solution (6,) of ``A x = b`` with errors of Student's t, and its information (6, 6)."""
    weight = np.ones(len(b))
    for _ in range(_ROUNDS):
        weighted = A * (weight / stddev**2)[:, None]
        information = weighted.T @ A + np.eye(6)
        x = np.linalg.solve(information, weighted.T @ b)
        weight = (_FREEDOM + 1) / (_FREEDOM + ((b - A @ x) / stddev) ** 2)
    return np.asarray(x), np.asarray(information)
