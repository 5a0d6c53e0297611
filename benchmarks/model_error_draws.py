"""Systematic errors drawn from the priors that rig.yaml states by default, for model_errors.py."""

from dataclasses import replace

import numpy as np

from calgraph.config import Board, CameraSpec, Lidar2dSpec, Lidar3dSpec, Rig
from calgraph.geometry import Array
from calgraph.sensors import CameraModel
from calgraph.simulation import World, world_rig
from calgraph.simulation.robot import MountedCamera, MountedScanner
from model_error_rigs import cameras_of, ring_count, scanners_of
from rig_errors import BoardErrors, CameraErrors, ModelErrors, ScannerErrors


def draw_errors(world: World, rng: np.random.Generator) -> ModelErrors:
    """Every systematic error from its prior in rig.yaml, with the default standard deviations."""
    rig = world_rig(world)
    return ModelErrors(
        _draw_board_errors(rig.boards[0], rng),
        cameras={camera.name: _draw_camera_errors(camera, rig, rng) for camera in cameras_of(world)},
        scanners={scanner.name: _draw_scanner_errors(scanner, rig, rng) for scanner in scanners_of(world)},
    )


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
