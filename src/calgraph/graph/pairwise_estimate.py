"""Interface of matches between the detections of two sensors, and the estimate of their relative pose."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from calgraph.config.settings import BoardPairSettings, MatchFilter
from calgraph.geometry import Array, se3, so3

# Limit on Gauss-Newton steps from the pose of a minimal sample to that of all inliers: 3 to 5 suffice.
_MAX_STEPS = 20
# Relative decrease of the cost at which these steps have converged.
_TOLERANCE = 1e-6
# Added to the covariances for their information, m: keeps those of exact detections regular.
_MIN_STDDEV = 1e-4


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
        J[:3, 3:] = so3.hat(self.T_a_b[:3, 3]) @ R
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


# Standard deviation of errors that no noise model describes (bend of the board, range bias, stamps), m; added to
# the detections' covariances for RANSAC, which has to be lenient: its poses come from minimal samples.
MODEL_ERROR = 0.01
# Standard deviations up to which two detections of RANSAC agree: 99.7 % of a normal distribution.
_INLIER_GATE = 3.0


def squared_residual_function(matches: Matches) -> Callable[[Array], Array]:
    """Returns the map from poses to squared residuals (K, M) over the squared gate; infinite if not feasible."""

    def evaluate(T_a_b: Array) -> Array:
        at = matches.linearize(T_a_b)
        variance = np.diagonal(at.covariance, axis1=-2, axis2=-1) + MODEL_ERROR**2
        r2 = np.mean(at.residuals**2 / variance, axis=-1) / _INLIER_GATE**2
        return np.asarray(np.where(matches.feasible(T_a_b), r2, np.inf))

    return evaluate


def refine_pose(
    T_a_b: Array, matches: Matches, inliers: NDArray[np.bool_], stddev: float, settings: BoardPairSettings
) -> Array:
    """Refines a pose on all inliers by Gauss-Newton; unobservable directions keep their start value.

    Args:
        T_a_b: (4, 4) start value.
        matches: of the pair.
        inliers: (M,) of the start value.
        stddev: standard deviation of residuals besides the noise of the detections, m.
        settings: limit of the standard deviations of observable directions.
    """

    def evaluate(T: Array) -> tuple[Array, Array, float]:
        return _build_normal_equations(linearize_at(T, matches), inliers, stddev)

    min_information = settings.max_stddev**-2
    H, g, cost = evaluate(T_a_b)
    for _ in range(_MAX_STEPS):
        values, vectors = np.linalg.eigh(H)
        along = np.where(values > min_information, vectors.T @ g / np.maximum(values, min_information), 0.0)
        trial = se3.retract(T_a_b, -np.asarray(vectors @ along, dtype=np.float64))
        trial_H, trial_g, trial_cost = evaluate(trial)
        if not trial_cost < cost * (1 - _TOLERANCE):
            break
        T_a_b, H, g, cost = trial, trial_H, trial_g, trial_cost
    return T_a_b


# Standard deviation of a board's surface from its plane, m: a rigid panel of 1 m bends by 1 to 2 mm.
FLATNESS = 0.001
# Increase of chi-squared up to which another minimum fits as well: 95 % of 6 degrees of freedom (12.6).
_AMBIGUITY_MARGIN = 12.0
# Angle from which a second minimum counts as another pose, rad (5 degrees): above the error of a pose.
_MIN_ALTERNATIVE_ANGLE = float(np.radians(5))


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
    W = np.linalg.inv(covariance + FLATNESS**2 * np.eye(r.shape[2]))
    cost = np.einsum("pmk,pmkl,pml->p", r, W, r)
    cost[~matches.feasible(poses)[:, inliers].all(axis=1)] = np.inf
    best = int(np.argmin(cost))
    margin = _AMBIGUITY_MARGIN * max(1.0, cost[best] / max(r[0].size - 6, 1))
    if cost[0] <= cost[best] + margin:
        best = 0
    angle = np.linalg.norm(so3.log(poses[:, :3, :3] @ poses[best, :3, :3].T), axis=-1)
    ambiguous = (cost <= cost.min() + margin) & (angle > _MIN_ALTERNATIVE_ANGLE)
    return poses[best], float(np.max(angle, initial=0.0, where=ambiguous))


def linearize_at(T_a_b: Array, matches: Matches) -> Linearization:
    """Linearizes all matches at one pose (4, 4)."""
    at = matches.linearize(T_a_b[None])
    return Linearization(at.residuals[0], at.jacobian[0], at.covariance[0])


def compute_normalized_rms(at: Linearization, inliers: NDArray[np.bool_], flatness: float) -> float:
    """RMS of the inliers' residuals, whitened by their covariances and the board's flatness (m)."""
    _, _, chi2 = _build_normal_equations(at, inliers, flatness)
    return float(np.sqrt(chi2 / max(at.residuals[inliers].size - 6, 1)))


def compute_information(at: Linearization, inliers: NDArray[np.bool_]) -> Array:
    """Information (6, 6) of the inliers, divided by their reduced chi-squared where it exceeds 1."""
    H, _, chi2 = _build_normal_equations(at, inliers, _MIN_STDDEV)
    return np.asarray(H / max(1.0, chi2 / max(at.residuals[inliers].size - 6, 1)))


def _build_normal_equations(
    at: Linearization, inliers: NDArray[np.bool_], stddev: float
) -> tuple[Array, Array, float]:
    """Matrix (6, 6), gradient (6,) and chi-squared of the inliers, with an additional error per residual, m."""
    r, J, covariance = at.residuals[inliers], at.jacobian[inliers], at.covariance[inliers]
    W = np.linalg.inv(covariance + stddev**2 * np.eye(r.shape[1]))
    H = np.einsum("mki,mkl,mlj->ij", J, W, J)
    return H, np.einsum("mki,mkl,ml->i", J, W, r), float(np.einsum("mk,mkl,ml->", r, W, r))


def select_matches(pair: PairwiseEstimate, keep: MatchFilter) -> NDArray[np.bool_]:
    """Mask (M,) of the matches of a pair that the joint solution uses."""
    if keep == "ransac":
        return pair.inliers
    return np.asarray((pair.matches[:, 1] == 0) & (pair.matches[:, 2] == 0))
