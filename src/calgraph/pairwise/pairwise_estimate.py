"""Interface of matches between the detections of two sensors, and the estimate of their relative pose."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal, Protocol

import numpy as np
from numpy.typing import NDArray

from calgraph.geometry import Array, se3, so3

# Two detections agree if they differ by no more than this many standard deviations ...
_INLIER_GATE = 3.0
# ... of their noise together with what no noise model knows: the board's bend, range bias, stamps (m).
MODEL_ERROR = 0.01
# How far a board is from a plane, m.
_FLATNESS = 0.002
# Steps at most from a minimal sample's pose to that of all inliers, and the standard deviation (m and rad) beyond
# which a direction is left as it is: the inliers' noise would move it anywhere.
_MAX_STEPS = 20
_MAX_STDDEV = 0.1
# A pose fits as well as another if its sum of squared whitened residuals is at most so much larger (times their
# scatter), and it is another one if turned by more than this, rad.
_AMBIGUITY_MARGIN = 12.0
_MIN_ALTERNATIVE_ANGLE = np.radians(5)


MatchFilter = Literal["ransac", "none"]
"""Matches that the joint solution uses: the inliers (``ransac``), or the first candidates of each capture."""


@dataclass(frozen=True, eq=False)
class PairwiseEstimate:
    """Relative pose of two sensors from the captures in which both detected the board."""

    sensor_a: str
    sensor_b: str
    T_a_b: Array
    """(4, 4)."""
    information: Array
    """(6, 6) inverse covariance of T_a_b's error in the fixed axes of a; singular in unobservable directions."""
    matches: NDArray[np.intp]
    """(M, 3) of all candidate matches: capture, index of the detection in a, index in b."""
    inliers: NDArray[np.bool_]
    """(M,) mask of the matches consistent with T_a_b: at most one of each group of alternatives."""
    residuals: Array
    """(M,) RMS distance between the two detections under T_a_b, m."""
    alternative_pose_angle: float = 0.0
    """Angle to an alternative pose that fits the inliers equally well, rad; 0 if there is none."""
    normalized_rms: float = 1.0
    """RMS of the inliers' residuals whitened by their covariances: 1 if these explain the residuals."""

    @property
    def squared_error(self) -> float:
        """Sum of the inliers' squared residuals, m²: the paper's weight of this edge in the spanning tree."""
        return float(np.sum(self.residuals[self.inliers] ** 2))

    def inverse(self) -> "PairwiseEstimate":
        """Returns the same estimate as ``T_b_a``."""
        R = self.T_a_b[:3, :3]
        # Inverse of se3.inverse_covariance's Jacobian: a perturbation of T_b_a as one of T_a_b.
        J = np.zeros((6, 6))
        J[:3, :3] = J[3:, 3:] = -R
        J[:3, 3:] = -so3.hat(self.T_a_b[:3, 3]) @ R
        return PairwiseEstimate(
            self.sensor_b, self.sensor_a, se3.inverse(self.T_a_b), J.T @ self.information @ J,
            self.matches[:, [0, 2, 1]], self.inliers, self.residuals,
            self.alternative_pose_angle, self.normalized_rms,
        )  # fmt: skip


@dataclass(frozen=True, eq=False)
class Linearization:
    """Residuals of all matches at one pose, with their Jacobian and covariance."""

    residuals: Array
    """(M, k) distances, m."""
    jacobian: Array
    """(M, k, 6) derivatives by a perturbation of T_a_b along the fixed axes of a."""
    covariance: Array
    """(M, k, k) propagated from the covariances of both detections, m²."""


class Matches(Protocol):
    """M matches of detections of one (kind, kind)."""

    @property
    def sample_size(self) -> int:
        """Number of matches in a minimal sample."""

    def solve(self, samples: NDArray[np.intp]) -> Array:
        """Solves for poses T_a_b (K, 4, 4) of samples (K, m) of the matches; NaN for those without solution."""

    def linearize(self, T_a_b: Array) -> Linearization:
        """Residuals of all matches under poses (K, 4, 4), with a leading axis K on every field."""

    def feasible(self, T_a_b: Array) -> NDArray[np.bool_]:
        """(K, M) whether both detections can lie on one board of the given size."""


def squared_residual_function(matches: Matches) -> Callable[[Array], Array]:
    """Returns the map from poses to squared residuals (K, M) over the squared gate; infinite if not feasible."""

    def evaluate(T_a_b: Array) -> Array:
        at = matches.linearize(T_a_b)
        variance = np.diagonal(at.covariance, axis1=-2, axis2=-1) + MODEL_ERROR**2
        r2 = np.mean(at.residuals**2 / variance, axis=-1) / _INLIER_GATE**2
        return np.asarray(np.where(matches.feasible(T_a_b), r2, np.inf))

    return evaluate


def refine_pose(T_a_b: Array, matches: Matches, inliers: NDArray[np.bool_]) -> Array:
    """Refines a pose (4, 4) on all inliers by Gauss-Newton; unobservable directions keep their start value."""

    def build_normal_equations(T: Array) -> tuple[Array, Array, float]:
        at = matches.linearize(T[None])
        r, J, covariance = at.residuals[0][inliers], at.jacobian[0][inliers], at.covariance[0][inliers]
        W = np.linalg.inv(covariance + _FLATNESS**2 * np.eye(r.shape[1]))
        H = np.einsum("mki,mkl,mlj->ij", J, W, J)
        return H, np.einsum("mki,mkl,ml->i", J, W, r), float(np.einsum("mk,mkl,ml->", r, W, r))

    H, g, cost = build_normal_equations(T_a_b)
    for _ in range(_MAX_STEPS):
        values, vectors = np.linalg.eigh(H)
        along = np.where(values > _MAX_STDDEV**-2, vectors.T @ g / np.maximum(values, _MAX_STDDEV**-2), 0.0)
        trial = se3.retract(T_a_b, -np.asarray(vectors @ along, dtype=np.float64))
        trial_H, trial_g, trial_cost = build_normal_equations(trial)
        if not trial_cost < cost * (1 - 1e-6):
            break
        T_a_b, H, g, cost = trial, trial_H, trial_g, trial_cost
    return T_a_b


def resolve_ambiguity(
    T_a_b: Array, others: Array, matches: Matches, inliers: NDArray[np.bool_]
) -> tuple[Array, float]:
    """Selects the pose that fits all inliers best, and measures whether another fits equally well.

    Args:
        T_a_b: (4, 4) pose found by RANSAC; another is selected only if it fits clearly better.
        others: (K, 4, 4) other minima.
        matches: of the pair.
        inliers: (M,) of T_a_b.

    Returns:
        The pose, and the angle (rad) to the farthest other one that fits equally well; 0 if there is none.
    """
    poses = np.concatenate([T_a_b[None], others])
    at = matches.linearize(poses)
    r, covariance = at.residuals[:, inliers], at.covariance[:, inliers]
    W = np.linalg.inv(covariance + _FLATNESS**2 * np.eye(r.shape[2]))
    cost = np.einsum("pmk,pmkl,pml->p", r, W, r)
    cost[~matches.feasible(poses)[:, inliers].all(axis=1)] = np.inf
    best = int(np.argmin(cost))
    margin = _AMBIGUITY_MARGIN * max(1.0, cost[best] / max(r[0].size - 6, 1))
    if cost[0] <= cost[best] + margin:
        best = 0
    angle = np.linalg.norm(so3.log(poses[:, :3, :3] @ poses[best, :3, :3].T), axis=-1)
    ambiguous = (cost <= cost.min() + margin) & (angle > _MIN_ALTERNATIVE_ANGLE)
    return poses[best], float(np.max(angle, initial=0.0, where=ambiguous))


def compute_normalized_rms(at: Linearization, inliers: NDArray[np.bool_]) -> float:
    """RMS of the inliers' residuals, whitened by their covariances and the board's flatness."""
    r, covariance = at.residuals[inliers], at.covariance[inliers]
    W = np.linalg.inv(covariance + _FLATNESS**2 * np.eye(r.shape[1]))
    return float(np.sqrt(np.einsum("mk,mkl,ml->", r, W, r) / max(r.size - 6, 1)))


def compute_information(at: Linearization, inliers: NDArray[np.bool_]) -> Array:
    """Information (6, 6) of the inliers, divided by their reduced chi-squared where it exceeds 1."""
    r, J, covariance = at.residuals[inliers], at.jacobian[inliers], at.covariance[inliers]
    floor = 1e-8 * np.eye(r.shape[1])
    W = np.linalg.inv(covariance + floor)
    H = np.einsum("mki,mkl,mlj->ij", J, W, J)
    chi2 = float(np.einsum("mk,mkl,ml->", r, W, r))
    degrees_of_freedom = max(r.size - 6, 1)
    return np.asarray(H / max(1.0, chi2 / degrees_of_freedom))


def select_matches(pair: PairwiseEstimate, keep: MatchFilter) -> NDArray[np.bool_]:
    """Mask (M,) of the matches of a pair that the joint solution uses."""
    if keep == "ransac":
        return pair.inliers
    return np.asarray((pair.matches[:, 1] == 0) & (pair.matches[:, 2] == 0))
