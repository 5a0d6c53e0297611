"""Poses of a network's scanners, in their common plane or in space, with their joint covariance.

They are results, and priors from an earlier calibration.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from calgraph.errors import InputError
from calgraph.geometry import Array, Index, se2, se_n
from calgraph.network.joint.scanner_matrix import ScannerMatrix
from calgraph.result import Calibration
from calgraph.sensors.kinds import KINDS

PLANAR_AXES = np.array([0, 1, 5])
"""x, y and yaw among the components of poses in SE(3)."""
# Variance of unobserved directions, m² and rad²: an infinite one could not be inverted.
_UNOBSERVED_VARIANCE = 1e6


@dataclass(frozen=True, eq=False)
class NetworkPoses:
    """Poses of N scanners in the frame of the first one, the root: d = 3 numbers each in a plane, 6 in space."""

    names: tuple[str, ...]
    T_root_scanner: Array
    """(N, 3, 3) or (N, 4, 4)."""
    covariance: Array
    """(dN, dN) of the errors in the root's fixed axes; zero for the root."""

    @property
    def size(self) -> int:
        """Of a pose: d numbers."""
        return len(self.covariance) // len(self.names)

    def covariance_rows(self, names: Sequence[str]) -> Index:
        """(dM,) rows of these scanners in the covariance."""
        first = self.size * np.array([self.names.index(name) for name in names], dtype=np.intp)
        return np.asarray(first[:, None] + np.arange(self.size), dtype=np.intp).ravel()

    def select(self, names: Sequence[str]) -> "NetworkPoses":
        """The poses of some scanners, of which the first has to be the root."""
        rows = self.covariance_rows(names)
        T = self.T_root_scanner[rows[:: self.size] // self.size]
        return NetworkPoses(tuple(names), T, self.covariance[np.ix_(rows, rows)])

    def express_in(self, name: str, T_frame_root: Array, covariance: Array) -> "NetworkPoses":
        """Expresses the poses in another frame, which becomes the first and the root, the present one the second.

        Args:
            name: of the frame.
            T_frame_root: (n+1, n+1) pose of the present root in it, n = 2 or 3, m.
            covariance: (d, d) of the error of that pose, by which all move together, m² and rad², along and about
                the fixed axes of the new frame.
        """
        T = T_frame_root @ self.T_root_scanner
        turned = np.kron(np.eye(len(T)), se_n.rotation_adjoint(se_n.rotation(T_frame_root)))
        n, moved = T.shape[-1] - 1, np.tile(np.eye(self.size), (len(T), 1, 1))
        moved[:, :n, n:] = se_n.rotation_jacobian(se_n.translation(T) - se_n.translation(T_frame_root))
        by_root = moved.reshape(-1, self.size)
        joint = turned @ self.covariance @ turned.T + by_root @ covariance @ by_root.T
        return NetworkPoses((name, *self.names), np.stack([np.eye(n + 1), *T]), np.pad(joint, (self.size, 0)))

    def change_root(self, name: str) -> "NetworkPoses":
        """The same poses in the frame of another scanner, which becomes the first and the root."""
        reordered = self.select([name, *(other for other in self.names if other != name)])
        T, count = reordered.T_root_scanner, len(self.names)
        by_new_root, by_scanner = se_n.relative_pose_jacobians(np.broadcast_to(T[0], T.shape), T)
        J = np.kron(np.eye(count), by_scanner[0])
        J[:, : self.size] += by_new_root.reshape(-1, self.size)
        return NetworkPoses(reordered.names, se_n.inverse(T[0]) @ T, J @ reordered.covariance @ J.T)


def lift_covariance(planar: Array) -> Array:
    """Covariance (6N, 6N) of poses in SE(3) from that in SE(2) (3N, 3N), of which the first is the root's.

    NaN in rows and columns of z, roll and pitch of all others, which are not measured.
    """
    rows = _planar_rows(len(planar) // 3)
    covariance = np.full((2 * len(planar), 2 * len(planar)), np.nan)
    covariance[np.ix_(rows, rows)] = planar
    covariance[:6, rows] = covariance[rows, :6] = 0.0
    covariance[:6, :6] = 0.0
    return covariance


def project_to_plane(T: Array) -> Array:
    """Poses (..., 3, 3) in SE(2) from those in SE(3) (..., 4, 4): height and tilt are dropped."""
    return se2.pose(se2.angle(T), T[..., :2, 3])


def extract_poses(calibration: Calibration, source: str = "") -> NetworkPoses:
    """The poses of a network's calibration: in space if 3-D LiDARs measured them, otherwise as planar ones.

    Args and Raises as for :func:`extract_planar_poses`.
    """
    if all(KINDS[sensor.kind].detects != "plane" for sensor in calibration.sensors):
        return extract_planar_poses(calibration, source)
    T: Array = np.array([sensor.T_root_sensor for sensor in calibration.sensors])
    names = tuple(sensor.name for sensor in calibration.sensors)
    return NetworkPoses(names, T, complete_covariance(calibration.joint_covariance, 6))


def extract_planar_poses(calibration: Calibration, source: str = "") -> NetworkPoses:
    """The planar poses of a network's calibration.

    Correlations of scanners are taken as zero where some of them are unknown.

    Args:
        calibration: of a network.
        source: the option that it was given by, with a colon, for the error.

    Raises:
        InputError: the calibration is not that of a network of 2-D scanners.
    """
    detected = {KINDS[sensor.kind].detects for sensor in calibration.sensors}
    if detected != {"line"} or not (calibration.planar or len(calibration.sensors) == 1):
        raise InputError(f"{source}needs the calibration of a network of 2-D scanners in one plane")
    count = len(calibration.sensors)
    rows = _planar_rows(count)
    T = project_to_plane(np.array([sensor.T_root_sensor for sensor in calibration.sensors]))
    covariance = complete_covariance(calibration.joint_covariance[np.ix_(rows, rows)])
    covariance = np.nan_to_num(covariance, posinf=_UNOBSERVED_VARIANCE)
    return NetworkPoses(tuple(sensor.name for sensor in calibration.sensors), T, covariance)


def complete_covariance(covariance: Array, size: int = 3) -> Array:
    """A covariance (dN, dN) of poses, without correlations of scanners if some of them are unknown, NaN.

    With zeros in the place of those only, it might not be positive definite.
    """
    if not np.isnan(covariance).any():
        return covariance
    own = np.kron(np.eye(len(covariance) // size, dtype=np.bool_), np.ones((size, size), dtype=np.bool_))
    return np.where(own, covariance, 0.0)


def _planar_rows(count: int) -> Index:
    """(3N,) rows of x, y and yaw among the 6N of poses in SE(3)."""
    return np.asarray((6 * np.arange(count)[:, None] + PLANAR_AXES).ravel(), dtype=np.intp)


@dataclass(frozen=True, eq=False)
class NearCovariances:
    """Covariances of n errors of each of S scanners, for E pairs of scanners; unknown for others."""

    count: int
    """S."""
    pairs: Index
    """(E, 2) scanners, the first not after the second; each scanner with itself is one of them."""
    blocks: Array
    """(E, n, n), with the first scanner's rows."""

    @property
    def own(self) -> Array:
        """(S, n, n) of each scanner."""
        first, second = self.pairs.T
        own = np.empty((self.count, *self.blocks.shape[1:]))
        own[first[first == second]] = self.blocks[first == second]
        return own

    @property
    def stddev(self) -> Array:
        """(S, n)."""
        return np.asarray(np.sqrt(np.diagonal(self.own, axis1=1, axis2=2)))

    def scale(self, factor: float | Array) -> "NearCovariances":
        """The covariances with all variances times a factor, or those of each scanner times one of (S,)."""
        first, second = np.sqrt(np.broadcast_to(factor, self.count))[self.pairs].T
        return replace(self, blocks=(first * second)[:, None, None] * self.blocks)

    def select_errors(self, errors: Index) -> "NearCovariances":
        """Those of some of the n errors."""
        return replace(self, blocks=self.blocks[:, errors[:, None], errors])

    def list_near(self, scanner: int) -> Index:
        """Scanners whose covariance with this one is known, itself among them, ascending."""
        first, second = self.pairs.T
        return np.union1d(second[first == scanner], first[second == scanner])

    def select_scanners(self, scanners: Index) -> "NearCovariances":
        """Those of some scanners, ascending."""
        number = np.full(self.count, -1)
        number[scanners] = np.arange(len(scanners))
        pairs = number[self.pairs]
        inside = (pairs >= 0).all(axis=1)
        return NearCovariances(len(scanners), pairs[inside], self.blocks[inside])

    def expand(self, unknown: float = np.nan) -> Array:
        """(nS, nS), scanner by scanner, with a value for what is not known."""
        n = self.blocks.shape[1]
        dense = np.full((self.count, n, self.count, n), unknown)
        first, second = self.pairs.T
        dense[first, :, second] = self.blocks
        dense[second, :, first] = self.blocks.swapaxes(1, 2)
        return dense.reshape(self.count * n, -1)


# Least standard deviation of a prior, m and rad, by numbers of a pose: a covariance of 0 would be singular.
_MIN_SIGMA = {3: (1e-5, 1e-5, 1e-6), 6: (1e-5, 1e-5, 1e-5, 1e-6, 1e-6, 1e-6)}


@dataclass(frozen=True, eq=False)
class ScannerPrior:
    """Joint Gaussian prior of K scanners' poses in the root frame, of d = 3 numbers in a plane or 6 in space."""

    nodes: Index
    """(K,)."""
    T_root_scanner: Array
    """(K, 3, 3) or (K, 4, 4)."""
    information: Array
    """(dK, dK) in the root's fixed axes."""

    def express_in(self, T_world_root: Array) -> "ScannerPrior":
        """The same of poses in another frame, where the root has a pose that is known."""
        turn = np.kron(np.eye(len(self.nodes)), se_n.rotation_adjoint(se_n.rotation(T_world_root)))
        return ScannerPrior(self.nodes, T_world_root @ self.T_root_scanner, turn @ self.information @ turn.T)

    def add_to_equations(self, T_root_scanner: Array, H: ScannerMatrix, g: Array) -> float:
        """Adds the term at poses (S, 3, 3) to normal equations over all scanners (US), in place; its cost."""
        error = se_n.difference(T_root_scanner[self.nodes], self.T_root_scanner).ravel()
        gradient = self.information @ error
        K, U = len(self.nodes), H.order.unknowns
        block = np.zeros((K, U, K, U))
        block[:, :3, :, :3] = self.information.reshape(K, 3, K, 3)
        H.add(self.nodes, block.reshape(K * U, K * U))
        g.reshape(-1, U)[self.nodes, :3] += gradient.reshape(K, 3)
        return 0.5 * float(error @ gradient)


def build_scanner_prior(poses: NetworkPoses, names: Sequence[str]) -> ScannerPrior:
    """The prior of those scanners of a network that have an earlier pose, in the frame of its root, the first.

    Where the correlations of their errors are unknown (all zero), the prior is weaker than for any correlations.
    """
    shared = [name for name in names[1:] if name in poses.names]
    selected = poses.select([names[0], *shared])
    d = selected.size
    covariance = selected.covariance[d:, d:] + np.diag(np.tile(np.square(_MIN_SIGMA[d]), len(shared)))
    own = np.kron(np.eye(len(shared), dtype=np.bool_), np.ones((d, d), dtype=np.bool_))
    if not covariance[~own].any():
        # Unknown correlations: no joint covariance with these blocks exceeds their number times them.
        covariance *= len(shared)
    # Scaled to correlations before the inversion: variances of unobserved directions are up to 1e6 m².
    scale = np.sqrt(np.diag(covariance))
    information = np.linalg.inv(covariance / np.outer(scale, scale)) / np.outer(scale, scale)
    nodes = np.array([names.index(name) for name in shared], dtype=np.intp)
    return ScannerPrior(nodes, selected.T_root_scanner[1:], (information + information.T) / 2)
