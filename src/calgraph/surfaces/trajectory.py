"""The trajectory of a moving frame: poses at times, and a smooth spline through them that data can correct."""

from dataclasses import dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np
from scipy.spatial.transform import Rotation, RotationSpline, Slerp

from calgraph.geometry import Array, Index, se_n, so3

if TYPE_CHECKING:
    # Takes as long to import as all of NumPy, and reports of all kinds import this module.
    from scipy.interpolate import CubicSpline


@dataclass(frozen=True, eq=False)
class Track:
    """Poses of a frame in a world of its own at ascending times, by its own clock; n = 2 or 3."""

    times: Array
    """(N,) s."""
    poses: Array
    """(N, n+1, n+1) ``T_world_frame``."""

    def at(self, times: Array) -> Array:
        """Poses (M, n+1, n+1) at times (M,), linear in between; the first or last one outside."""
        times = np.clip(times, self.times[0], self.times[-1])
        t = np.stack([np.interp(times, self.times, x) for x in se_n.translation(self.poses).T], axis=-1)
        return se_n.pose(self._rotations_at(times), t)

    def _rotations_at(self, times: Array) -> Array:
        R = se_n.rotation(self.poses)
        if R.shape[-1] == 2:
            return se_n.exp(np.interp(times, self.times, np.unwrap(se_n.log(R)[:, 0]))[:, None])
        return np.asarray(Slerp(self.times, Rotation.from_matrix(R))(times).as_matrix())

    def between(self, start: float, end: float) -> "Track":
        """The part within an interval."""
        inside = (self.times >= start) & (self.times <= end)
        return Track(self.times[inside], self.poses[inside])


@dataclass(frozen=True, eq=False)
class SplinePoses:
    """Poses of a spline at N times, and what their derivatives need."""

    poses: Array
    """(N, n+1, n+1) ``T_world_frame``."""
    velocity: Array
    """(N, n) of the origin, along the world's axes, m/s."""
    turn_rate: Array
    """(N, d) about the world's axes, rad/s."""
    first: Index
    """(N,) the first of the four control points that matter at each time."""
    basis: Array
    """(N, 4) their weights."""
    rotation_jacobian: Array
    """(N, d, d): a change of the correction by ``x`` turns the frame by ``rotation_jacobian @ x`` about the
    world's axes."""


@dataclass(frozen=True, eq=False)
class SplineTrajectory:
    """A cubic B-spline of positions, and of rotation vectors that correct a smooth reference rotation.

    ``p(t) = Σ B_k(t) c_k`` and ``R(t) = R_ref(t) exp(Σ B_k(t) φ_k)``: both are linear in the control points,
    except for the exponential of a small vector.
    """

    start: float
    """Time of the first knot with a full basis, s."""
    spacing: float
    """Time between knots, s."""
    control: Array
    """(K, n + d) positions, m, and corrections of the rotation, rad."""
    reference: Track
    """Its rotations, interpolated smoothly, are corrected."""

    @property
    def end(self) -> float:
        """Time of the last knot with a full basis, s."""
        return self.start + (len(self.control) - 3) * self.spacing

    @cached_property
    def _rotations(self) -> "RotationSpline | CubicSpline":
        from scipy.interpolate import CubicSpline

        R = se_n.rotation(self.reference.poses)
        if R.shape[-1] == 2:
            return CubicSpline(self.reference.times, np.unwrap(se_n.log(R)[:, 0]))
        return RotationSpline(self.reference.times, Rotation.from_matrix(R))

    def _reference_at(self, times: Array) -> tuple[Array, Array]:
        """Rotations (N, n, n) and turn rates (N, d) in the moving frame, rad/s."""
        spline = self._rotations
        if isinstance(spline, RotationSpline):
            return np.asarray(spline(times).as_matrix()), np.asarray(spline(times, 1))
        return se_n.exp(spline(times)[:, None]), np.asarray(spline(times, 1)[:, None])

    def at(self, times: Array) -> SplinePoses:
        """Poses and derivatives at times (N,) between start and end."""
        first, basis, slope = evaluate_basis((times - self.start) / self.spacing, len(self.control))
        window = self.control[first[:, None] + np.arange(4)]
        value = np.einsum("nk,nkd->nd", basis, window)
        rate = np.einsum("nk,nkd->nd", slope, window) / self.spacing
        n = self.reference.poses.shape[-1] - 1
        R_ref, turn = self._reference_at(times)
        phi, phi_rate = value[:, n:], rate[:, n:]
        correction = se_n.exp(phi)
        R = R_ref @ correction
        if n == 2:
            jacobian = np.ones((len(times), 1, 1))
            world_turn = turn + phi_rate
        else:
            # exp(φ + x) ≈ exp(φ) exp(J x) with the right Jacobian J(φ) = J_left(-φ).
            jacobian = R @ so3.left_jacobian(-phi)
            world_turn = (R_ref @ turn[..., None] + jacobian @ phi_rate[..., None])[..., 0]
        return SplinePoses(
            se_n.pose(R, value[:, :n]), rate[:, :n], np.asarray(world_turn), first, basis, np.asarray(jacobian)
        )

    def moved(self, change: Array) -> "SplineTrajectory":
        """The spline with changes (K, n + d) of its control points."""
        return replace(self, control=self.control + change)


def evaluate_basis(x: Array, count: int) -> tuple[Index, Array, Array]:
    """The uniform cubic B-spline at x (N,), in knots from the start, of ``count`` control points.

    Returns:
        (N,) the first control point that matters, (N, 4) weights and their derivatives by x (de Boor, "A practical
        guide to splines", 1978).
    """
    first = np.clip(np.floor(x).astype(np.intp), 0, count - 4)
    u = x - first
    weights = np.stack([(1 - u) ** 3, 3 * u**3 - 6 * u**2 + 4, -3 * u**3 + 3 * u**2 + 3 * u + 1, u**3], axis=1) / 6
    slopes = np.stack([-((1 - u) ** 2), 3 * u**2 - 4 * u, -3 * u**2 + 2 * u + 1, u**2], axis=1) / 2
    return first, weights, slopes


def fit_spline(track: Track, start: float, end: float, spacing: float) -> SplineTrajectory:
    """The spline with knots at a spacing, s, that follows a track from start to end."""
    from scipy.interpolate import CubicSpline

    intervals = max(int(np.ceil((end - start) / spacing)), 1)
    times = start + spacing * np.arange(intervals + 1, dtype=np.float64)
    # The reference has the knots of the corrections, which could not follow noise between them.
    sampled = Track(times, track.at(times))
    positions = se_n.translation(sampled.poses)
    n = positions.shape[1]
    control = np.zeros((intervals + 3, n + n * (n - 1) // 2))
    # Through the positions at the knots, with straight ends.
    control[:, :n] = _control_points(CubicSpline(times, positions, bc_type="natural"))
    return SplineTrajectory(start, spacing, control, sampled)


def _control_points(spline: "CubicSpline") -> Array:
    """Control points (K + 2, n) of a cubic spline with K uniform breakpoints, by its values and derivatives.

    On a uniform knot sequence ``c = p - h² p'' / 6`` at each knot, from ``p = (c₋ + 4 c + c₊)/6`` and
    ``h² p'' = c₋ - 2 c + c₊``.
    """
    knots = spline.x
    c = spline(knots) - (knots[1] - knots[0]) ** 2 * spline(knots, 2) / 6
    # The outer ones are straight on, as the second derivative is 0 at the ends.
    before, after = 2 * c[0] - c[1], 2 * c[-1] - c[-2]
    return np.concatenate([before[None], c, after[None]])
