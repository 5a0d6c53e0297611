"""Bundles as one dense least-squares problem over sensors and boards: an oracle for the Schur complement."""

import numpy as np

from bundle_scenes import Scene, scene
from calgraph.geometry import Array
from calgraph.rig.bundle.bundle_solver import Bundle, BundleState, retract_state
from calgraph.rig.bundle.observations import relative_poses


def unbiased_scene(kinds: tuple[str, ...] = ("lidar", "camera", "laser"), boards: int = 8) -> Scene:
    return scene(kinds, boards).without_bias()


def residuals(bundle: Bundle, state: BundleState) -> Array:
    parts = [
        views.linearize(relative_poses(T, state.T_root_board[views.board]), np.zeros(0)).residual.ravel()
        for views, T in zip(bundle.views, state.T_root_sensor, strict=True)
    ]
    return np.concatenate(parts)


def residuals_after(bundle: Bundle, state: BundleState, step: Array) -> Array:
    """After a step of all sensors but the root, and of all boards."""
    split = bundle.parameter_count
    return residuals(bundle, retract_state(bundle, state, step[:split], step[split:].reshape(-1, 6)))


def dense_jacobian(bundle: Bundle, state: BundleState, at: Array | None = None) -> Array:
    """By all parameters, after a step from the state."""
    size = bundle.parameter_count + 6 * len(state.T_root_board)
    at = np.zeros(size) if at is None else at
    ahead, behind = (
        np.stack([residuals_after(bundle, state, at + step) for step in steps], axis=-1)
        for steps in (1e-6 * np.eye(size), -1e-6 * np.eye(size))
    )
    return np.asarray((ahead - behind) / 2e-6)
