"""Corners of boards that cameras of a simulated drive would detect, without rendering their images."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from calgraph.config import Board
from calgraph.geometry import Array, se3
from calgraph.sensors import CameraModel
from calgraph.simulation import SimulatedDrive
from calgraph.simulation.drive_boards import WallBoard
from calgraph.simulation.drive_motion import Motion
from calgraph.simulation.drive_robot import DriveMount
from calgraph.simulation.solids import Surface, cast_rays

_MIN_TAG_PIXELS, _MIN_COSINE, _MAX_BLUR = 22.0, 0.35, 5.0
"""Tags that are smaller, more slanted, or blurred by more pixels are not detected."""
_OUTLIERS = 0.01
"""Probability that a blurred or badly lit view has corners that are wrong together."""
_OUTLIER_SIZE = 1.5
"""Standard deviation of their displacement, pixels."""


@dataclass(frozen=True, eq=False)
class SimulatedView:
    """The corners of a board in one image."""

    stamp: float
    """By the camera's clock, s."""
    board: int
    ids: NDArray[np.intp]
    """(M,) of the tags."""
    pixels: Array
    """(M, 4, 2)."""


def detect_views(drive: SimulatedDrive) -> dict[str, list[SimulatedView]]:
    """What each camera would detect of boards."""
    return {
        mount.sensor.name: detect_corners(drive, mount, np.random.default_rng((drive.scenario.seed, 100 + index)))
        for index, mount in enumerate(drive.truth.mounts)
        if mount.sensor.kind == "camera"
    }


def detect_corners(drive: SimulatedDrive, mount: DriveMount, rng: np.random.Generator) -> list[SimulatedView]:
    """The corners that a camera would detect: with noise, blur, rows that are read one after another."""
    scenario, motion, found = drive.scenario, drive.truth.motion, drive.truth.boards
    camera, errors = found.cameras[mount.sensor.name].true, scenario.camera_errors
    surfaces = drive.truth.world.without_boards
    clock = mount.clock
    times = np.arange(clock.phase, scenario.duration, clock.period)
    stamps = scenario.start_time + clock.stamps(times) + rng.normal(0, errors.stamp_jitter, len(times))
    views = []
    for number, board in enumerate(found.boards):
        nominal = _tag_corners(board.board)
        points = board.T_world_board[:3, :3] @ board.bend(nominal).reshape(-1, 3).T
        points = points.T + board.T_world_board[:3, 3]
        pixels = _project_at(motion, mount, camera, times, points)
        # Each row is measured at its own time; the stamp is of the middle one.
        late = np.nan_to_num((pixels[..., 1] / camera.height - 0.5) * errors.readout)
        late = np.clip(late, -errors.readout, errors.readout)
        pixels = pixels + late[..., None] * _flow(motion, mount, camera, times, points)
        blur = np.linalg.norm(_flow(motion, mount, camera, times, points), axis=-1) * errors.exposure
        visible = _select_tags(pixels, blur, camera, motion, mount, times, board, surfaces)
        for k in np.flatnonzero(visible.any(axis=1)):
            tags = np.flatnonzero(visible[k])
            noise = errors.corner * (1 + 0.7 * blur[k].reshape(-1, 4)[tags, :, None])
            measured = pixels[k].reshape(-1, 4, 2)[tags] + noise * rng.normal(size=(len(tags), 4, 2))
            # Blur and light displace the corners of a view together.
            measured = measured + 0.04 * (1 + blur[k].mean()) * rng.normal(size=2)
            if rng.random() < _OUTLIERS:
                measured = measured + _OUTLIER_SIZE * rng.normal(size=2)
            views.append(
                SimulatedView(
                    float(stamps[k]), number, np.array([tag.id for tag in board.board.tags])[tags], measured
                )
            )
    return sorted(views, key=lambda view: view.stamp)


def _tag_corners(board: Board) -> Array:
    """(M, 4, 3) clockwise from the top left."""
    unit = np.array([[-0.5, 0.5, 0], [0.5, 0.5, 0], [0.5, -0.5, 0], [-0.5, -0.5, 0]])
    return np.array([[*tag.center, 0.0] + tag.size * unit for tag in board.tags])


def _project_at(motion: Motion, mount: DriveMount, camera: CameraModel, times: Array, points: Array) -> Array:
    """(N, P, 2) pixels of points (P, 3) at times; NaN behind the camera."""
    T = se3.inverse(mount.poses(motion, times))
    local = np.einsum("nij,pj->npi", T[:, :3, :3], points) + T[:, None, :3, 3]
    return camera.project(local.reshape(-1, 3)).reshape(len(times), -1, 2)


def _flow(motion: Motion, mount: DriveMount, camera: CameraModel, times: Array, points: Array) -> Array:
    """(N, P, 2) velocities of the images of points, pixels per second."""
    step = 1e-3
    after, before = (_project_at(motion, mount, camera, times + s, points) for s in (step, -step))
    return (after - before) / (2 * step)


def _select_tags(
    pixels: Array,
    blur: Array,
    camera: CameraModel,
    motion: Motion,
    mount: DriveMount,
    times: Array,
    board: WallBoard,
    surfaces: Sequence[Surface],
) -> NDArray[np.bool_]:
    """(N, M) which tags are detected in each image."""
    N = len(times)
    inside = camera.contains(pixels.reshape(-1, 2)).reshape(N, -1, 4).all(axis=2)
    edges = np.linalg.norm(np.diff(pixels.reshape(N, -1, 4, 2), axis=2), axis=-1)
    T = mount.poses(motion, times)
    toward = T[:, :3, 3] - board.T_world_board[:3, 3]
    distance = np.linalg.norm(toward, axis=1)
    cosine = toward @ board.T_world_board[:3, 2] / distance
    visible = inside & (edges.min(axis=2) > _MIN_TAG_PIXELS) & (blur.reshape(N, -1, 4).max(axis=2) < _MAX_BLUR)
    visible &= (cosine > _MIN_COSINE)[:, None]
    candidates = np.flatnonzero(visible.any(axis=1))
    if len(candidates):
        toward_board = -toward[candidates] / distance[candidates, None]
        hidden = cast_rays(surfaces, T[candidates, :3, 3], toward_board).ranges < distance[candidates] - 0.1
        visible[candidates[hidden]] = False
    return np.asarray(visible)
