"""Systematic errors drawn from the priors that rig.yaml states by default, for model_errors.py."""

from dataclasses import replace
from typing import Any

import numpy as np

from calgraph.config import Board, CameraSpec, Lidar2dSpec, Lidar3dSpec, Rig, SensorSpec
from calgraph.geometry import Array
from calgraph.sensors import CameraModel
from calgraph.simulation import World, world_rig
from calgraph.simulation.robot import MountedCamera, MountedScanner
from model_error_rigs import cameras_of, ring_count, scanners_of
from rig_errors import BoardErrors, Bump, CameraErrors, ModelErrors, ScannerErrors


def draw_errors(world: World, rng: np.random.Generator, scale: float = 1.0) -> ModelErrors:
    """Every systematic error from its prior in rig.yaml, with ``scale`` times the default standard deviations."""
    rig = scale_uncertainty(world_rig(world), scale)
    return ModelErrors(
        _draw_board_errors(rig.boards[0], rng),
        cameras={camera.name: _draw_camera_errors(camera, rig, rng) for camera in cameras_of(world)},
        scanners={scanner.name: _draw_scanner_errors(scanner, rig, rng) for scanner in scanners_of(world)},
    )


# Usual view bias of rig/bundle/variance_components.py, m; a tilt displaces the edges of the board by as much.
_VIEW_BIAS = 0.0015
# Small drifts, m and rad, and multiples of a large one, as in rig/checks/drift_tests.py and its settings.
_SMALL_DRIFT = 1e-4, float(np.radians(0.01))
_LARGE_MULTIPLES = 5.0, 100.0


def draw_changes(world: World, errors: ModelErrors, rng: np.random.Generator) -> ModelErrors:
    """The errors with view biases and changes of all poses, drawn from what the covariance of a rig assumes.

    All sensors drift or are bumped a little. One of them may be so by much, in place, direction or both; that none
    is, and that a certain one is, are equally likely. Edges of the board have no bias from view to view.
    """
    lever = max(world.scenario.board.size) / 2
    large = int(rng.integers(-1, len(world.robot)))
    parts = np.array([(True, True), (False, True), (True, False)])[rng.integers(3)]
    multiple = np.exp(rng.uniform(*np.log(_LARGE_MULTIPLES)))
    drifts, time = rng.random() < 0.5, float(rng.integers(2, 5)) / 6
    after, duration = (0.0, 1.0) if drifts else (time, 0.0)
    bumps = {}
    for k, sensor in enumerate(world.robot):
        sizes = np.where(parts & (k == large), multiple, 1.0) * _SMALL_DRIFT
        translation, rotation = (tuple(rng.normal(0, size, 3).tolist()) for size in sizes)
        bumps[sensor.name] = Bump(after, duration, translation, rotation)
    return ModelErrors(
        replace(errors.board, view_bias=_VIEW_BIAS, view_tilt=_VIEW_BIAS / lever),
        {name: replace(one, bump=bumps[name]) for name, one in errors.cameras.items()},
        {name: replace(one, bump=bumps[name]) for name, one in errors.scanners.items()},
    )


def scale_uncertainty(rig: Rig, factor: float) -> Rig:
    """The rig with other standard deviations of the systematic errors of its sensors and its board."""

    def scale(part: SensorSpec | Board) -> dict[str, Any]:
        scaled = {name: factor * value for name, value in part.uncertainty if isinstance(value, float)}
        return {"uncertainty": part.uncertainty.model_copy(update=scaled)}

    sensors = {name: spec.model_copy(update=scale(spec)) for name, spec in rig.sensors.items()}
    boards = tuple(board.model_copy(update=scale(board)) for board in rig.boards)
    return rig.model_copy(update={"sensors": sensors, "target": boards[0] if len(boards) == 1 else boards})


def _draw_board_errors(board: Board, rng: np.random.Generator) -> BoardErrors:
    prior = board.uncertainty
    return BoardErrors(
        print_scale=rng.normal(0, prior.print_scale),
        print_aspect=rng.normal(0, prior.print_aspect),
        print_position=(rng.normal(0, prior.print_position), rng.normal(0, prior.print_position)),
        print_rotation=rng.normal(0, 2 * prior.print_position / max(board.size)),
        tag_size=rng.normal(0, prior.tag_size),
        tag_position={
            tag.id: (rng.normal(0, prior.tag_position), rng.normal(0, prior.tag_position)) for tag in board.tags
        },
        tag_rotation={tag.id: rng.normal(0, 2 * prior.tag_position / tag.size) for tag in board.tags},
        bow=(rng.normal(0, prior.bow), rng.normal(0, prior.bow), 0.0),
        size=(rng.normal(0, prior.size), rng.normal(0, prior.size)),
    )


def _draw_camera_errors(camera: MountedCamera, rig: Rig, rng: np.random.Generator) -> CameraErrors:
    spec, model = rig.sensors[camera.name], camera.camera
    assert isinstance(spec, CameraSpec)
    prior = spec.uncertainty
    scale, aspect = 1 + rng.normal(0, prior.focal_length), rng.normal(0, prior.pixel_aspect)
    effect = _displacement_at_corner(model)
    return CameraErrors(
        focal_length=(scale * (1 + aspect / 2) - 1, scale * (1 - aspect / 2) - 1),
        principal_point=(rng.normal(0, prior.principal_point), rng.normal(0, prior.principal_point)),
        distortion=tuple((rng.normal(0, prior.distortion, len(effect)) / effect).tolist()),
    )


def _displacement_at_corner(camera: CameraModel) -> Array:
    """(n,) displacement of the corner of the image by each distortion coefficient, pixels per unit.

    Wide lenses may have no ray at the corner: the farthest pixel towards it that has one counts.
    """
    rays = camera.rays(np.linspace(0.0, 0.9, 10)[:, None] * camera.principal_point)
    ray = rays[np.isfinite(rays).all(axis=1)][:1]
    step = 1e-6
    moved = [
        replace(camera, distortion=camera.distortion + step * unit).project(ray)[0]
        for unit in np.eye(len(camera.distortion))
    ]
    return np.asarray(np.linalg.norm(np.reshape(moved, (-1, 2)), axis=1) / step)


def _draw_scanner_errors(scanner: MountedScanner, rig: Rig, rng: np.random.Generator) -> ScannerErrors:
    spec = rig.sensors[scanner.name]
    assert isinstance(spec, Lidar2dSpec | Lidar3dSpec)
    prior = spec.uncertainty
    angle_scale = rng.normal(0, spec.uncertainty.angle_scale) if isinstance(spec, Lidar2dSpec) else 0.0
    rings = ()
    if isinstance(spec, Lidar3dSpec):
        rings = tuple(rng.normal(0, spec.uncertainty.ring_bias, ring_count(scanner)).tolist())
    return ScannerErrors(
        range_bias=rng.normal(0, prior.range_bias),
        range_scale=rng.normal(0, prior.range_scale),
        angle_scale=angle_scale,
        ring_bias=rings,
    )
