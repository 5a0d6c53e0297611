"""Of which sensors of a random rig a good pose is expected, by geometry alone."""

from collections.abc import Mapping

import numpy as np

from calgraph.geometry import Array, se3
from calgraph.simulation.robot import MountedCamera, MountedScanner, RobotSensor
from calgraph.simulation.solids import RectangleShape, Solid, cast_rays
from random_rig_draws import RandomRig, smallest_feature

MIN_CAPTURES: Mapping[str, int] = {"camera": 8, "lidar3d": 10, "lidar2d": 14}
"""Common views that a pair needs, the larger of those of both kinds; a 2-D scanner measures two of six dimensions
of a pose in each."""
_MIN_TILT_SPREAD = 0.15
"""Smallest singular value of the boards' normals over the root of their number: directions that span space."""
_MIN_PIXELS = 22.0
"""Edge of the smallest tag or marker, pixels, to be detected in noise and blur."""
_MIN_BEAMS_2D, _MIN_BEAMS_3D, _MIN_RINGS = 20, 60, 5
_MAX_NOISE = 0.015
"""Of ranges, m."""


def well_posed_sensors(rig: RandomRig) -> frozenset[str]:
    """Names of the sensors besides the root of which a good pose is expected."""
    labels = rig.labels
    noisy = any(isinstance(s, MountedScanner) and s.noise.range_noise > _MAX_NOISE for s in rig.robot)
    if labels["error"] != "none" or labels["noise"] != "right" or labels["outliers"] != "none" or noisy:
        return frozenset()
    if rig.stated.tolerance.translation < 0.01 or rig.gray_noise > 4:
        return frozenset()
    views = {sensor.name: _views(rig, sensor) for sensor in rig.robot}
    kinds = {sensor.name: sensor.kind for sensor in rig.robot}
    reached, waiting = {rig.stated.root}, [rig.stated.root]
    while waiting:
        a = waiting.pop()
        for b in views.keys() - reached:
            if _is_enough(views[a], views[b], max(MIN_CAPTURES[kinds[a]], MIN_CAPTURES[kinds[b]])):
                reached.add(b)
                waiting.append(b)
    return frozenset(reached - {rig.stated.root})


def _is_enough(a: Mapping[tuple[int, int], Array], b: Mapping[tuple[int, int], Array], least: int) -> bool:
    """Whether two sensors have enough common views of boards, with normals that span space."""
    common = sorted(a.keys() & b.keys())
    if len(common) < least:
        return False
    normals = np.array([a[one] for one in common])
    return bool(np.linalg.svd(normals, compute_uv=False)[-1] / np.sqrt(len(common)) > _MIN_TILT_SPREAD)


def _views(rig: RandomRig, sensor: RobotSensor) -> dict[tuple[int, int], Array]:
    """By capture and board that a sensor can detect, the board's normal (3,) in the world."""
    found = {}
    for k, shown in enumerate(rig.captures):
        for i, T_world_board in shown.boards.items():
            T = se3.inverse(sensor.T_world_sensor) @ T_world_board
            others = (
                *shown.people,
                *(Solid(RectangleShape(*rig.boards[j].size), other) for j, other in shown.boards.items()),
            )
            sees = _camera_detects if isinstance(sensor, MountedCamera) else _scanner_detects
            if sees(rig, sensor, i, T, others):  # type: ignore[arg-type]
                found[k, i] = T_world_board[:3, 2]
    return found


def _camera_detects(
    rig: RandomRig, camera: MountedCamera, index: int, T_camera_board: Array, others: tuple[Solid, ...]
) -> bool:
    """Whether the whole board lies in the image, faces the camera, and has a print large enough."""
    board, model = rig.boards[index], camera.camera
    half = 0.5 * np.array(board.size)
    edge = smallest_feature(board) / 2
    corners = np.array([[x, y, 0.0] for x in (-half[0], half[0]) for y in (-half[1], half[1])])
    middle = np.array([[-edge, 0.0, 0.0], [edge, 0.0, 0.0], [0.0, -edge, 0.0], [0.0, edge, 0.0]])
    with np.errstate(invalid="ignore"):
        pixels = model.project(se3.apply(T_camera_board, np.concatenate([corners, middle])))
    if not model.contains(pixels).all():
        return False
    across = min(float(np.linalg.norm(pixels[4] - pixels[5])), float(np.linalg.norm(pixels[6] - pixels[7])))
    to_camera = -T_camera_board[:3, 3] / np.linalg.norm(T_camera_board[:3, 3])
    facing = to_camera @ T_camera_board[:3, 2]
    return bool(across > _MIN_PIXELS and facing > 0.5) and not _is_hidden(
        camera, T_camera_board, board.size, others
    )


def _is_hidden(
    sensor: RobotSensor, T_sensor_board: Array, size: tuple[float, float], others: tuple[Solid, ...]
) -> bool:
    """Whether people or other boards cover a place of a board."""
    x, y = np.meshgrid(*(np.linspace(-0.45 * length, 0.45 * length, 7) for length in size))
    points = se3.apply(
        sensor.T_world_sensor @ T_sensor_board, np.stack([x.ravel(), y.ravel(), 0 * x.ravel()], axis=-1)
    )
    eye = sensor.T_world_sensor[:3, 3]
    distances = np.linalg.norm(points - eye, axis=1)
    hits = cast_rays(others, eye[None], (points - eye) / distances[:, None])
    return bool((hits.ranges < distances - 0.02).any())


def _scanner_detects(
    rig: RandomRig, scanner: MountedScanner, index: int, T_sensor_board: Array, others: tuple[Solid, ...]
) -> bool:
    """Whether enough beams end on the board."""
    size = rig.boards[index].size
    pattern = scanner.pattern
    ranges = cast_rays([Solid(RectangleShape(*size), T_sensor_board)], pattern.origins, pattern.directions).ranges
    on = np.flatnonzero(np.isfinite(ranges) & (ranges < 0.9 * scanner.noise.max_range))
    if scanner.kind == "lidar2d":
        enough = len(on) >= _MIN_BEAMS_2D
    else:
        enough = len(on) >= _MIN_BEAMS_3D and (
            pattern.rings is None or len(np.unique(pattern.rings[on])) >= _MIN_RINGS
        )
    incidence = abs(T_sensor_board[:3, 2] @ T_sensor_board[:3, 3]) / np.linalg.norm(T_sensor_board[:3, 3])
    return bool(enough and incidence > 0.4) and not _is_hidden(scanner, T_sensor_board, size, others)
