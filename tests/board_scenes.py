"""Boards around a robot, and their detections: ground truth plus the stated noise."""

from collections.abc import Callable, Mapping, Sequence

import numpy as np

from calgraph.boards.detections import Detection, PlanePatch, Segment, to_beams
from calgraph.geometry import Array, plane, se3, so3

SIZE = (1.2, 0.9)


def random_pose(rng: np.random.Generator, translation: float = 0.3, rotation: float = 3.0) -> Array:
    axis = rng.normal(size=3)
    return se3.pose(
        so3.exp(axis / np.linalg.norm(axis) * rng.uniform(0, rotation)), rng.normal(size=3) * translation
    )


def make_boards(rng: np.random.Generator, count: int, tilt: float = 0.6) -> Array:
    """Boards 1.5–3 m away all around frame a, facing it, turned by up to ``tilt`` about each axis."""
    poses = []
    for _ in range(count):
        bearing, radius = rng.uniform(-np.pi, np.pi), rng.uniform(1.5, 3.0)
        outward = np.array([np.cos(bearing), np.sin(bearing), 0])
        facing = np.stack([np.cross([0, 0, 1.0], -outward), [0, 0, 1.0], -outward], axis=1)
        poses.append(
            se3.pose(
                so3.exp(rng.uniform(-tilt, tilt, 3)) @ facing, radius * outward + [0, 0, rng.uniform(-0.2, 0.2)]
            )
        )
    return np.array(poses)


def make_patch(T_s_board: Array, rng: np.random.Generator, sigma: float = 0.003) -> PlanePatch:
    truth = plane.towards_origin(plane.from_pose(T_s_board))
    # Turned and shifted about the board's centre, as a fit to points on the board is.
    about_center = np.eye(3)
    about_center[2, :2] = -T_s_board[:3, 3] @ plane.tangent_basis(truth[:3])
    root = about_center * [sigma / 0.3, sigma / 0.3, sigma]
    noisy = plane.retract(truth, root @ rng.normal(size=3))
    return PlanePatch(noisy, root @ root.T, np.empty(0), np.empty((0, 3)), T_s_board[:3, 3])


def make_segment(T_s_board: Array, rng: np.random.Generator, sigma: float = 0.003) -> Segment | None:
    """The intersection of the board with z = 0; None if the scan plane misses it."""
    corners = se3.apply(
        T_s_board, np.array([[x, y, 0] for x, y in ((-0.6, -0.45), (0.6, -0.45), (0.6, 0.45), (-0.6, 0.45))])
    )
    cuts = [
        p + (q - p) * p[2] / (p[2] - q[2])
        for p, q in zip(corners, np.roll(corners, -1, axis=0), strict=True)
        if p[2] * q[2] < 0
    ]
    if len(cuts) != 2 or np.linalg.norm(cuts[0] - cuts[1]) < 0.2:
        return None
    ends = np.array(cuts)
    ends[:, :2] += rng.normal(size=(2, 2)) * sigma
    return Segment(ends, np.diag([sigma**2, sigma**2, 1e-8] * 2), *to_beams(ends))


def detect_boards(
    kind: str, T_s_root: Array, boards_root: Array, rng: np.random.Generator, sigma: float = 0.003
) -> dict[int, tuple[Detection, ...]]:
    detect: Callable[..., Detection | None] = make_patch if kind == "plane" else make_segment
    detections = {i: detect(T_s_root @ T, rng, sigma) for i, T in enumerate(boards_root)}
    return {i: (d,) for i, d in detections.items() if d is not None}


def segment_endpoints(candidates: Mapping[int, Sequence[Detection]], capture: int) -> Array:
    """End points (2, 3) of the segment detected in one capture."""
    (segment,) = candidates[capture]
    assert isinstance(segment, Segment)
    return segment.endpoints
