"""The pose of a planar board from its corners in one image: PnP with outlier rejection, and its covariance."""

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.special import chdtri

from calgraph.boards.detections import InconsistentTags
from calgraph.errors import Rejected
from calgraph.geometry import Array, plane, se3, so3
from calgraph.sensors import CameraModel
from calgraph.solver.levenberg_marquardt import DenseLinearization, minimize

_RAYLEIGH_MEDIAN = 1.1774
"""Median length of a 2-D normal error, in standard deviations of one coordinate."""
_SAME_POSE = 1e-5
"""Largest difference of two minima that are one, m and rad: the iteration ends with smaller errors."""
_MIN_WIDTH_RATIO = 1e-3
"""Corners whose extents have a smaller ratio lie on one line (numerical rank)."""
_MIN_COSINE = 0.05
"""Least cosine of rays and the direction of the board: a pinhole's coordinates are bounded by its inverse. No
board spans more than 174°."""
_TOLERANCE, _RELATIVE_TOLERANCE = 1e-14, 1e-9
"""Predicted decrease of the squared reprojection error to stop at, pixels² and relative: 1e-4 of the noise."""


@dataclass(frozen=True, eq=False)
class BoardPose:
    """A board's pose and the corners that it was estimated from."""

    T_camera_board: Array
    """(4, 4)."""
    covariance: Array
    """(6, 6) in the camera's fixed axes (translation, rotation)."""
    rms: float
    """Root mean square reprojection error of the corners used, per coordinate, pixels."""
    inliers: NDArray[np.bool_]
    """(M, k) the corners of each mark that were used."""


@dataclass(frozen=True, eq=False)
class _PoseFit:
    """A local minimum of the reprojection error."""

    T: Array
    cost: float
    """Sum of squares, pixels²."""
    information: Array
    """(6, 6) JᵀJ."""


# Maximum number of rounds of solving and rejecting corners: they end where the inliers stay the same.
_MAX_REJECTION_ROUNDS = 5
# Corners farther from their prediction, in standard deviations, are outliers: 4e-6 of the right ones are.
OUTLIER_SIGMAS = 5.0
# Limit on Levenberg–Marquardt steps from the start values of IPPE: most solutions take 2 to 10; 0.2 % of those in
# the tests reach it.
_MAX_STEPS = 30
# Maximum RMS reprojection error, in stated standard deviations: beyond it size or intrinsics are wrong, as motion
# blur triples the noise at most.
_MAX_RMS_SIGMAS = 10.0
# Both tilts of a planar PnP are rejected as ambiguous if their squared errors differ by fewer variances: a
# likelihood ratio of exp(4.5) = 90.
_AMBIGUITY_CHI2 = 9.0


def fit_pose(
    ids: NDArray[np.intp], corners: Array, pixels: Array, camera: CameraModel, sigma: float
) -> BoardPose | Rejected:
    """One PnP over all corners of all marks, with rejection of outliers.

    Marks that fit together only with another size, common to all, are fitted with it: whether a print differs
    from its stated size is decided by all images.

    Both poses that the image of a plane allows (Collins and Bartoli, "Infinitesimal plane-based pose
    estimation", IJCV 2014) are refined; if both fit equally well, the board is rejected. The covariance is
    ``max(sigma, rms)² (JᵀJ)⁻¹``.

    Args:
        ids: (M,) id of each mark; of marks with the same id at most one is used.
        corners: (M, k, 3) the marks' corners in the board frame, z = 0, m.
        pixels: (M, k, 2) where they were detected, as measured (distorted).
        camera: the intrinsics.
        sigma: standard deviation of a corner in x and in y, pixels.
    """
    rays = camera.rays(pixels.reshape(-1, 2)).reshape(*pixels.shape[:2], 3)
    in_view = np.asarray(np.isfinite(rays).all(axis=(1, 2)))
    consistent = _select_consistent_marks(ids, corners, pixels, rays, in_view, camera, sigma)
    if isinstance(consistent, Rejected):
        return consistent
    marks, minima, corners = consistent
    inliers = np.repeat(marks[:, None], pixels.shape[1], axis=1)
    readmittable = in_view & ~np.isin(ids, ids[marks])
    for _ in range(_MAX_REJECTION_ROUNDS):
        if not minima:
            return Rejected("the corners detected do not determine a pose: too few of them, or all on one line")
        distance = _compute_reprojection_errors(minima[0].T, corners, pixels, camera)
        # In a blurred image the noise is larger than stated: it is estimated from the residuals.
        noise = max(sigma, float(np.median(distance[inliers])) / _RAYLEIGH_MEDIAN)
        near = distance < OUTLIER_SIGMAS * noise
        # A tag with one wrong corner fails as a whole; with three inliers it is readmitted.
        new_inliers = near & (marks | (readmittable & (near.sum(axis=1) >= 3)))[:, None]
        if (new_inliers == inliers).all():
            break
        inliers = new_inliers
        minima = _find_minima(corners[inliers], pixels[inliers], rays[inliers], camera, sigma)
    if not minima:
        return Rejected("the corners detected contradict each other")
    best = minima[0]
    rms = float(np.sqrt(best.cost / (2 * inliers.sum())))
    if rms > _MAX_RMS_SIGMAS * sigma:
        return Rejected(
            f"its corners fit a board of the stated size only to {rms:.1f} px, {sigma:g} px expected: "
            "wrong sizes, or wrong intrinsics"
        )
    variance = max(sigma, rms) ** 2
    if len(minima) > 1 and _is_ambiguous(best, minima[1], _AMBIGUITY_CHI2 * variance):
        tilt = np.degrees(np.arccos(np.clip(minima[1].T[:3, 2] @ best.T[:3, 2], -1, 1)))
        return Rejected(f"too small in the image: two poses {tilt:.0f}° apart fit its corners equally well")
    return BoardPose(best.T, np.asarray(variance * np.linalg.inv(best.information)), rms, inliers)


def plane_covariance(T_camera_board: Array, covariance: Array) -> Array:
    """Covariance (3, 3) of a board's plane, in the chart of ``plane.retract``, from that of its pose (6, 6)."""
    n, t = T_camera_board[:3, 2], T_camera_board[:3, 3]
    J = np.zeros((3, 6))
    J[:2, 3:] = -plane.tangent_basis(n).T @ so3.hat(n)
    J[2, :3], J[2, 3:] = -n, -np.cross(n, t)
    return np.asarray(J @ covariance @ J.T)


def _is_ambiguous(best: _PoseFit, other: _PoseFit, limit: float) -> bool:
    """Whether ``other`` fits as well as ``best`` but for ``limit``, pixels², and lies outside its covariance."""
    difference = se3.difference(other.T, best.T)
    within_covariance = difference @ best.information @ difference < limit
    return bool(other.cost - best.cost < limit and not within_covariance)


# Probability that a correct tag fails the χ² test against the pose of another tag: one in 10,000 is lost.
_CONSENSUS_SIGNIFICANCE = 1e-4
# Noise over the stated one with which tags are compared again if none agree: corners of blurred images.
_BLUR_NOISE_RATIO = 3.0


def _select_consistent_marks(
    ids: NDArray[np.intp],
    corners: Array,
    pixels: Array,
    rays: Array,
    in_view: NDArray[np.bool_],
    camera: CameraModel,
    sigma: float,
) -> tuple[NDArray[np.bool_], list[_PoseFit], Array] | Rejected:
    """The largest set of marks (M,) that lie on one plane as printed, the minima of its error, and all corners.

    Corners (M, k, 3) are the stated ones, unless all marks agree on another size.
    """
    unique = len(np.unique(ids[in_view])) == in_view.sum()
    minima = _find_minima(corners[in_view], pixels[in_view], rays[in_view], camera, sigma) if unique else []
    if pixels.shape[1] < 4 or in_view.sum() <= 1:
        return in_view, minima, corners
    limit = OUTLIER_SIGMAS * sigma
    if minima:
        if _compute_reprojection_errors(minima[0].T, corners[in_view], pixels[in_view], camera).max() < limit:
            return in_view, minima, corners
        size = _fit_size(minima[0].T, corners[in_view], pixels[in_view], camera)
        resized = _resize_marks(corners, size)
        minima = _find_minima(resized[in_view], pixels[in_view], rays[in_view], camera, sigma)
        if minima and (
            _compute_reprojection_errors(minima[0].T, resized[in_view], pixels[in_view], camera).max() < limit
        ):
            return in_view, minima, resized
    # A blurred image has noisier corners than stated; the stated noise is tried first.
    gate = float(chdtri(2 * pixels.shape[1], _CONSENSUS_SIGNIFICANCE))
    for scale in (1.0, _BLUR_NOISE_RATIO):
        consensus = _find_largest_consensus(ids, corners, pixels, rays, in_view, camera, scale * sigma, gate)
        if consensus.sum() > 1 or (consensus.any() and len(np.unique(ids[in_view])) == 1):
            minima = _find_minima(corners[consensus], pixels[consensus], rays[consensus], camera, sigma)
            return consensus, minima, corners
    tags = tuple(np.unique(ids[in_view]).tolist())
    names = ", ".join(map(str, tags))
    return InconsistentTags(f"tags {names} do not lie on one board as printed: no two of them agree", tags)


def _fit_size(T: Array, corners: Array, pixels: Array, camera: CameraModel) -> float:
    """The size of marks over the stated one that fits pixels (M, k, 2) best, with the pose, from a pose (4, 4)."""
    arms = (corners - corners.mean(axis=1, keepdims=True)).reshape(-1, 3)

    def linearize(state: tuple[Array, float], _: DenseLinearization | None) -> DenseLinearization:
        T, size = state
        at = _linearize(T, _resize_marks(corners, size).reshape(-1, 3), pixels.reshape(-1, 2), camera)
        by_point = at.jacobian[:, :3].reshape(-1, 2, 3)
        by_size = by_point @ (arms @ T[:3, :3].T)[..., None]
        return DenseLinearization(at.residual, np.column_stack([at.jacobian, by_size.ravel()]))

    start = (T, 1.0)
    minimum = minimize(
        start,
        linearize,
        lambda state, step: (se3.retract(state[0], step[:6]), state[1] + float(step[6])),
        iterations=_MAX_STEPS,
        tolerance=_TOLERANCE,
        relative_tolerance=_RELATIVE_TOLERANCE,
    )
    return minimum.state[1]


def _resize_marks(corners: Array, size: float) -> Array:
    """Corners (M, k, 3) of marks of ``size`` times theirs about their centres."""
    center = corners.mean(axis=1, keepdims=True)
    return np.asarray(center + size * (corners - center))


def _find_largest_consensus(
    ids: NDArray[np.intp],
    corners: Array,
    pixels: Array,
    rays: Array,
    in_view: NDArray[np.bool_],
    camera: CameraModel,
    sigma: float,
    gate: float,
) -> NDArray[np.bool_]:
    """The largest set of marks (M,) that the pose of one mark predicts, within that pose's covariance.

    Every mark is tried with both its poses, so no sampling is needed.
    """
    best, best_score = np.zeros(len(ids), dtype=bool), -np.inf
    for mark in np.flatnonzero(in_view):
        for fit in _find_minima(corners[mark], pixels[mark], rays[mark], camera, sigma):
            d2 = np.array(
                [_squared_mahalanobis(fit, c, p, camera, sigma) for c, p in zip(corners, pixels, strict=True)]
            )
            d2[~in_view] = np.inf
            chosen = np.zeros(len(ids), dtype=bool)
            for mark_id in np.unique(ids):
                same = np.flatnonzero(ids == mark_id)
                # Of several marks with the id of the hypothesis, the hypothesis itself is taken.
                candidate = mark if mark_id == ids[mark] else same[np.argmin(d2[same])]
                chosen[candidate] = d2[candidate] < gate
            score = float(chosen.sum() - d2[chosen].sum() / (gate * len(ids)))
            if score > best_score:
                best, best_score = chosen, score
    return best


def _squared_mahalanobis(fit: _PoseFit, corners: Array, pixels: Array, camera: CameraModel, sigma: float) -> float:
    """Squared Mahalanobis distance of a mark's corners from their prediction by a pose and its covariance."""
    at = _linearize(fit.T, corners, pixels, camera)
    residuals, J = at.residual, at.jacobian
    if not np.isfinite(residuals).all():
        return np.inf
    S = sigma**2 * (np.eye(len(residuals)) + J @ np.linalg.inv(fit.information) @ J.T)
    return float(residuals @ np.linalg.solve(S, residuals))


# Error of the other pose of IPPE, over that of the better one and in variances, above which it is not refined:
# where both fit equally well after refinement, they differ by less before, in 12,000 random views.
_MAX_START_RATIO, _MAX_START_CHI2 = 10.0, 100.0


def _find_minima(corners: Array, pixels: Array, rays: Array, camera: CameraModel, sigma: float) -> list[_PoseFit]:
    """One or two distinct poses with the face visible, the best first.

    Args:
        corners: (..., 3) in the board frame, m.
        pixels: (..., 2) where they were detected,
        rays: (..., 3) and their directions.
        camera: the intrinsics.
        sigma: standard deviation of a corner in x and in y, pixels.
    """
    corners, pixels = corners.reshape(-1, 3), pixels.reshape(-1, 2)
    starts = _solve_ippe(corners, rays.reshape(-1, 3))
    errors = [np.sum(_compute_reprojection_errors(T, corners, pixels, camera) ** 2) for T in starts]
    largest = _MAX_START_RATIO * min(errors, default=0.0) + _MAX_START_CHI2 * sigma**2
    fits: list[_PoseFit] = []
    for start, error in zip(starts, errors, strict=True):
        fit = _refine(start, corners, pixels, camera) if error <= largest else None
        if fit is not None and plane.from_pose(fit.T)[3] > 0:
            fits.append(fit)
    fits.sort(key=lambda fit: fit.cost)
    same = len(fits) == 2 and np.abs(se3.difference(fits[1].T, fits[0].T)).max() < _SAME_POSE
    return fits[:1] if same else fits


def _solve_ippe(corners: Array, rays: Array) -> list[Array]:
    """Both poses (4, 4) of infinitesimal plane-based pose estimation, in the direction of the rays (N, 3)."""
    if len(corners) < 4:
        return []
    singular_values = np.linalg.svd(corners - corners.mean(axis=0), compute_uv=False)
    if singular_values[1] < _MIN_WIDTH_RATIO * singular_values[0]:
        return []
    # A pinhole camera that points at the board: fisheye rays may be far from, or behind, the optical axis.
    axis = rays.sum(axis=0)
    axis /= np.linalg.norm(axis)
    R_view_camera = np.concatenate([plane.tangent_basis(axis).T, axis[None]])
    rays_view = rays @ R_view_camera.T
    if rays_view[:, 2].min() < _MIN_COSINE:
        return []
    try:
        _, rotations, translations, _ = cv2.solvePnPGeneric(
            corners, rays_view[:, :2] / rays_view[:, 2:], np.eye(3), np.zeros(4), flags=cv2.SOLVEPNP_IPPE
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


def _refine(T: Array, corners: Array, pixels: Array, camera: CameraModel) -> _PoseFit | None:
    """Levenberg–Marquardt on the reprojection error; None if the start cannot be projected or JᵀJ is singular."""
    try:
        minimum = minimize(
            T,
            lambda T, _: _linearize(T, corners, pixels, camera),
            se3.retract,
            iterations=_MAX_STEPS,
            tolerance=_TOLERANCE,
            relative_tolerance=_RELATIVE_TOLERANCE,
        )
    except np.linalg.LinAlgError:
        return None
    if not np.isfinite(minimum.linearization.cost):
        return None
    information = minimum.linearization.information
    scale = np.sqrt(np.diag(information))
    if not scale.all() or np.linalg.cond(information / np.outer(scale, scale)) > 1e12:
        return None
    return _PoseFit(minimum.state, float(2 * minimum.linearization.cost), information)


def _linearize(T: Array, corners: Array, pixels: Array, camera: CameraModel) -> DenseLinearization:
    """Reprojection errors (2N,), pixels, by the tangent vector of ``se3.retract``."""
    rotated = corners @ T[:3, :3].T
    projected, J = camera.project_with_jacobian(rotated + T[:3, 3])
    J = np.concatenate([J, -J @ so3.hat(rotated)], axis=-1)
    return DenseLinearization((projected - pixels).ravel(), J.reshape(-1, 6))


def _compute_reprojection_errors(T: Array, corners: Array, pixels: Array, camera: CameraModel) -> Array:
    """Reprojection errors (M, k), pixels; infinite where a corner cannot be projected."""
    projected = camera.project(se3.apply(T, corners.reshape(-1, 3))).reshape(pixels.shape)
    distance = np.linalg.norm(projected - pixels, axis=-1)
    return np.where(np.isfinite(distance), distance, np.inf)
