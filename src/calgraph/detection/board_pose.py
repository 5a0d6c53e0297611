"""The pose of a planar board from its corners in one image: both starts, least squares, outliers, covariance."""

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.special import chdtri

from calgraph.errors import Rejected
from calgraph.geometry import Array, plane, se3, so3
from calgraph.sensors import CameraModel

_OUTLIER = 5.0
"""Corners further than this many standard deviations from where the pose puts them are not the board's."""
_RAYLEIGH_MEDIAN = 1.1774
"""Median length of a 2-D normal error, in standard deviations of one coordinate."""
_AGREEMENT = 1e-4
"""Chance that a true tag is taken for a false one."""
_AMBIGUOUS = 9.0
"""Two tilts whose squared errors differ by fewer variances (odds of about 1 : 90) cannot be told apart."""
_HOPELESS = 10.0
"""A fit with residuals of so many standard deviations is of another board, or through other intrinsics."""
_ITERATIONS = 30


@dataclass(frozen=True, eq=False)
class BoardPose:
    """A board's pose and what it rests on."""

    T_camera_board: Array
    """(4, 4)."""
    covariance: Array
    """(6, 6) in the camera's fixed axes (translation, rotation)."""
    rms: float
    """Root mean square reprojection error of the corners used, per coordinate, pixels."""
    used: NDArray[np.bool_]
    """(M, k) which corners of which marks it rests on."""


@dataclass(frozen=True, eq=False)
class _Fit:
    """A local minimum of the reprojection error."""

    T: Array
    cost: float
    """Sum of squares, pixels²."""
    information: Array
    """(6, 6) JᵀJ."""


def fit_pose(
    ids: NDArray[np.intp], corners: Array, pixels: Array, camera: CameraModel, sigma: float
) -> BoardPose | Rejected:
    """One PnP over all corners of all marks, without those that contradict the rest.

    Both poses that the image of a plane allows (Collins and Bartoli, "Infinitesimal plane-based pose
    estimation", IJCV 2014) are refined; if both fit equally well, the board is rejected. The covariance is
    ``max(sigma, rms)² (JᵀJ)⁻¹``.

    Args:
        ids: (M,) what each mark claims to be; of marks with the same id at most one is used.
        corners: (M, k, 3) the marks' corners in the board frame, z = 0, m.
        pixels: (M, k, 2) where they were seen, as measured (distorted).
        camera: the intrinsics.
        sigma: standard deviation of a corner in x and in y, pixels.

    """
    seen = np.isfinite(camera.rays(pixels.reshape(-1, 2)))
    in_view = np.asarray(seen.reshape(len(pixels), -1).all(axis=1))
    consistent = _consistent(ids, corners, pixels, in_view, camera, sigma)
    if isinstance(consistent, Rejected):
        return consistent
    marks, minima = consistent
    used = np.repeat(marks[:, None], pixels.shape[1], axis=1)
    readmissible = in_view & ~np.isin(ids, ids[marks])
    for _ in range(5):
        if not minima:
            return Rejected("the corners seen do not determine a pose: too few of them, or all on one line")
        distance = _distances(minima[0].T, corners, pixels, camera)
        # Where the picture is worse than stated (blur), the corners' own spread is the measure.
        spread = max(sigma, float(np.median(distance[used])) / _RAYLEIGH_MEDIAN)
        near = distance < _OUTLIER * spread
        # A true tag with one bad corner agreed with nothing as a whole; three good corners bring it back.
        kept = near & (marks | (readmissible & (near.sum(axis=1) >= 3)))[:, None]
        if (kept == used).all():
            break
        used = kept
        minima = _minima(corners[used], pixels[used], camera)
    if not minima:
        return Rejected("the corners seen contradict each other")
    best = minima[0]
    rms = float(np.sqrt(best.cost / (2 * used.sum())))
    if rms > _HOPELESS * sigma:
        return Rejected(
            f"its corners fit a board of the stated size only to {rms:.1f} px, {sigma:g} px expected: "
            "wrong sizes, or wrong intrinsics"
        )
    variance = max(sigma, rms) ** 2
    if len(minima) > 1 and _rivals(best, minima[1], variance):
        tilt = np.degrees(np.arccos(np.clip(minima[1].T[:3, 2] @ best.T[:3, 2], -1, 1)))
        return Rejected(f"too small in the image: two poses {tilt:.0f}° apart fit its corners equally well")
    return BoardPose(best.T, np.asarray(variance * np.linalg.inv(best.information)), rms, used)


def plane_covariance(T_camera_board: Array, covariance: Array) -> Array:
    """Covariance (3, 3) of a board's plane, in the chart of ``plane.retract``, from that of its pose (6, 6)."""
    n, t = T_camera_board[:3, 2], T_camera_board[:3, 3]
    J = np.zeros((3, 6))
    J[:2, 3:] = -plane.tangent_basis(n).T @ so3.hat(n)
    J[2, :3], J[2, 3:] = -n, -np.cross(n, t)
    return np.asarray(J @ covariance @ J.T)


def _rivals(best: _Fit, other: _Fit, variance: float) -> bool:
    """Whether ``other`` fits about as well as ``best`` and is no part of its uncertainty."""
    apart = se3.difference(other.T, best.T)
    covered = apart @ best.information @ apart < _AMBIGUOUS * variance
    return bool(other.cost - best.cost < _AMBIGUOUS * variance and not covered)


def _consistent(
    ids: NDArray[np.intp],
    corners: Array,
    pixels: Array,
    in_view: NDArray[np.bool_],
    camera: CameraModel,
    sigma: float,
) -> tuple[NDArray[np.bool_], list[_Fit]] | Rejected:
    """Marks (M,) that lie on one plane as printed, and their poses: all marks, or most of them."""
    unique = len(np.unique(ids[in_view])) == in_view.sum()
    everything = _minima(corners[in_view], pixels[in_view], camera) if unique else []
    if pixels.shape[1] < 4 or in_view.sum() <= 1:
        return in_view, everything
    if everything:
        distance = _distances(everything[0].T, corners[in_view], pixels[in_view], camera)
        if distance.max() < _OUTLIER * sigma:
            return in_view, everything
    # A blurred picture has worse corners than stated; still, believe the statement first.
    for scale in (1.0, 3.0):
        agreeing = _largest_agreement(ids, corners, pixels, in_view, camera, scale * sigma)
        if agreeing.sum() > 1 or (agreeing.any() and len(np.unique(ids[in_view])) == 1):
            return agreeing, _minima(corners[agreeing], pixels[agreeing], camera)
    names = ", ".join(map(str, np.unique(ids[in_view])))
    return Rejected(f"tags {names} do not lie on one board as printed: no two of them agree")


def _largest_agreement(
    ids: NDArray[np.intp],
    corners: Array,
    pixels: Array,
    in_view: NDArray[np.bool_],
    camera: CameraModel,
    sigma: float,
) -> NDArray[np.bool_]:
    """The largest set of marks (M,) that one mark's own pose predicts, within that pose's uncertainty.

    Every mark is tried with both its poses, so there is nothing to sample.
    """
    best, best_score = np.zeros(len(ids), dtype=bool), -np.inf
    gate = float(chdtri(2 * pixels.shape[1], _AGREEMENT))
    for mark in np.flatnonzero(in_view):
        for fit in _minima(corners[mark], pixels[mark], camera):
            d2 = np.array([_mahalanobis2(fit, c, p, camera, sigma) for c, p in zip(corners, pixels, strict=True)])
            d2[~in_view] = np.inf
            chosen = np.zeros(len(ids), dtype=bool)
            for mark_id in np.unique(ids):
                same = np.flatnonzero(ids == mark_id)
                # Between copies of its own id the mark itself is the hypothesis.
                winner = mark if mark_id == ids[mark] else same[np.argmin(d2[same])]
                chosen[winner] = d2[winner] < gate
            score = float(chosen.sum() - d2[chosen].sum() / (gate * len(ids)))
            if score > best_score:
                best, best_score = chosen, score
    return best


def _mahalanobis2(fit: _Fit, corners: Array, pixels: Array, camera: CameraModel, sigma: float) -> float:
    """Squared Mahalanobis distance of a mark's corners from where a pose with its uncertainty puts them."""
    residuals, J = _linearise(fit.T, corners, pixels, camera)
    if not np.isfinite(residuals).all():
        return np.inf
    S = sigma**2 * (np.eye(len(residuals)) + J @ np.linalg.inv(fit.information) @ J.T)
    return float(residuals @ np.linalg.solve(S, residuals))


def _minima(corners: Array, pixels: Array, camera: CameraModel) -> list[_Fit]:
    """One or two distinct poses, seen from the front, for corners (..., 3) at pixels (..., 2); the best first."""
    corners, pixels = corners.reshape(-1, 3), pixels.reshape(-1, 2)
    fits: list[_Fit] = []
    for start in _starts(corners, camera.rays(pixels)):
        fit = _refine(start, corners, pixels, camera)
        if fit is not None and plane.from_pose(fit.T)[3] > 0:
            fits.append(fit)
    fits.sort(key=lambda fit: fit.cost)
    same = len(fits) == 2 and np.abs(se3.difference(fits[1].T, fits[0].T)).max() < 1e-5
    return fits[:1] if same else fits


def _starts(corners: Array, rays: Array) -> list[Array]:
    """Both poses (4, 4) of infinitesimal plane-based pose estimation, in the direction of the rays (N, 3)."""
    if len(corners) < 4:
        return []
    spread = np.linalg.svd(corners - corners.mean(axis=0), compute_uv=False)
    if spread[1] < 1e-3 * spread[0]:
        return []
    # A pinhole looking at the board's middle: fisheye rays may be far from, or behind, the optical axis.
    axis = rays.sum(axis=0)
    axis /= np.linalg.norm(axis)
    R_view_camera = np.concatenate([plane.tangent_basis(axis).T, axis[None]])
    seen = rays @ R_view_camera.T
    if seen[:, 2].min() < 0.05:
        return []
    try:
        _, rotations, translations, _ = cv2.solvePnPGeneric(
            corners, seen[:, :2] / seen[:, 2:], np.eye(3), np.zeros(4), flags=cv2.SOLVEPNP_IPPE
        )
    except cv2.error:
        return []
    T_camera_view = se3.pose(R_view_camera.T, np.zeros(3))
    poses = [
        np.asarray(
            T_camera_view @ se3.pose(so3.exp(np.ravel(r).astype(np.float64)), np.ravel(t).astype(np.float64))
        )
        for r, t in zip(rotations, translations, strict=True)
    ]
    return [T for T in poses if np.isfinite(T).all()]


def _refine(T: Array, corners: Array, pixels: Array, camera: CameraModel) -> _Fit | None:
    """Levenberg–Marquardt on the reprojection error; None if the start or the geometry is of no use."""
    residuals, J = _linearise(T, corners, pixels, camera)
    cost, damping = float(residuals @ residuals), 1e-7
    if not np.isfinite(cost):
        return None
    for _ in range(_ITERATIONS):
        information, gradient = J.T @ J, J.T @ residuals
        try:
            step = -np.linalg.solve(information + damping * np.diag(np.diag(information)), gradient)
        except np.linalg.LinAlgError:
            return None
        T_new = se3.retract(T, np.asarray(step))
        residuals_new, J_new = _linearise(T_new, corners, pixels, camera)
        cost_new = float(residuals_new @ residuals_new)
        if cost_new < cost:
            converged = cost - cost_new < 1e-7 * cost
            T, residuals, J, cost, damping = T_new, residuals_new, J_new, cost_new, 0.1 * damping
            if converged:
                break
        else:
            damping = 30 * damping
            if np.abs(step).max() < 1e-9 or damping > 1e6:
                break
    information = J.T @ J
    scale = np.sqrt(np.diag(information))
    if not scale.all() or np.linalg.cond(information / np.outer(scale, scale)) > 1e12:
        return None
    return _Fit(T, cost, information)


def _linearise(T: Array, corners: Array, pixels: Array, camera: CameraModel) -> tuple[Array, Array]:
    """Residuals (2N,), pixels, and their derivatives (2N, 6) by the tangent vector of ``se3.retract``."""
    turned = corners @ T[:3, :3].T
    projected, J = camera.project_with_jacobian(turned + T[:3, 3])
    J = np.concatenate([J, -J @ so3.hat(turned)], axis=-1)
    return (projected - pixels).ravel(), J.reshape(-1, 6)


def _distances(T: Array, corners: Array, pixels: Array, camera: CameraModel) -> Array:
    """Distances (M, k) of corners from where the pose puts them, pixels; infinite where it cannot."""
    projected = camera.project(se3.apply(T, corners.reshape(-1, 3))).reshape(pixels.shape)
    distance = np.linalg.norm(projected - pixels, axis=-1)
    return np.where(np.isfinite(distance), distance, np.inf)
