"""How uncertain the poses that a bundle gives are, and how far off its views may be for that."""

import numpy as np

from calgraph.estimation.rig.bundle_solver import (
    BOARD_PRIOR_INFORMATION,
    Bundle,
    BundleEquations,
    BundleState,
    pose_jacobian,
)
from calgraph.geometry import Array


def pose_covariance(bundle: Bundle, state: BundleState, system: BundleEquations) -> Array:
    """Covariance (S·6, S·6) of all sensors' poses in the root's fixed axes; zero for those that are fixed."""
    by_unknowns = pose_jacobian(bundle, state)
    return np.asarray(by_unknowns @ parameter_covariance(system) @ by_unknowns.T)


def parameter_covariance(system: BundleEquations) -> Array:
    """Covariance (G, G) of the sensors' bodies and own unknowns."""
    H, _, _ = system.eliminate_boards()
    return np.asarray(np.linalg.inv(H))


def view_covariance_factors(bundle: Bundle, system: BundleEquations) -> list[Array]:
    """By sensor and outline, how far off the solution may have what views measure: factors ``F`` (V, q, G + 6).

    Of two views i and j of one board, also of two sensors, ``F_i @ F_j.T`` is the covariance of these errors. A
    board's error is ``e - K x``, where x are those of the sensors and e has the covariance ``inv(H_board)``.
    """
    H, _, K = system.eliminate_boards()
    inner, of_board = _inverse_root(H), _inverse_root(system.H_board + BOARD_PRIOR_INFORMATION * np.eye(6))
    found = []
    for k, (views, at) in enumerate(zip(bundle.all_views, system.views, strict=True)):
        by_unknowns = -at.J_board @ K[views.board, :, :-1]
        by_unknowns[..., bundle.columns(k)] += at.J_sensor
        found.append(np.concatenate([by_unknowns @ inner, at.J_board @ of_board[views.board]], axis=-1))
    return found


def _inverse_root(A: Array) -> Array:
    """``R`` (..., n, n) with ``R @ R.T`` the inverse of positive definite A, be it almost singular."""
    values, vectors = np.linalg.eigh(A)
    least = np.finfo(float).eps * values[..., -1:]
    return np.asarray(vectors / np.sqrt(np.maximum(values, least))[..., None, :])
