"""Three scanners of a network, and what they measure of a body on a known path."""

import numpy as np

from calgraph.estimation.network.ellipse_raycast import raycast_ellipses
from calgraph.estimation.network.problem import BodyPath, BodyScans
from calgraph.estimation.network.splines import Knots, evaluate_spline
from calgraph.geometry import Array, se2

SIGMA = 0.01
T_ROOT = np.stack([np.eye(3), se2.pose(2.5, np.array([6.0, 1.0])), se2.pose(-1.5, np.array([3.0, 5.0]))])
OFFSET = np.array([0.0, 0.03, -0.02])


def glimpses(scanner: int, knots: Knots, motion: BodyPath, times: Array, rng: np.random.Generator) -> BodyScans:
    """Nine beams a scan on a body's middle, with noise, in scans at times (V,) of the root's clock."""
    beams = 9
    at = np.repeat(times, beams)
    pose = evaluate_spline(motion.control, *knots.basis_at(at)[:2])
    T = T_ROOT[scanner]
    arm = pose[:, :2] - T[:2, 2]
    aim = np.arctan2(arm[:, 1], arm[:, 0]) + np.tile(np.linspace(-0.5, 0.5, beams), len(times)) * (
        0.15 / np.linalg.norm(arm, axis=1)
    )
    direction = np.column_stack([np.cos(aim), np.sin(aim)])
    origin, radii = (np.broadcast_to(x, direction.shape) for x in (T[:2, 2], motion.radii))
    ranges = raycast_ellipses(origin, direction, pose[:, :2], pose[:, 2], radii).ranges + rng.normal(
        0, SIGMA, len(at)
    )
    own = direction @ T[:2, :2]
    start = beams * np.arange(len(times))
    return BodyScans(scanner, times + OFFSET[scanner], start, own, ranges, np.zeros(len(at)), np.ones(len(at)))
