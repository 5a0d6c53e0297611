"""Detections of a rig in which one sensor is impossible: mirrored, with another camera's intrinsics, and so on.

Detections are those of ideal detectors, made impossible afterwards: mirrored images are of a checkerboard, as
mirrored tags are not found.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np

from calgraph.boards.detections import BoardCorners, Detection, PlanePatch, Segment
from calgraph.config import Board, CameraSpec, Checkerboard, Intrinsics, RangeNoise, Rig
from calgraph.errors import Rejected
from calgraph.geometry import Array
from calgraph.rig.captures.detect import CaptureSet
from calgraph.rig.detection.from_measurements import (
    board_corners_from_pixels,
    plane_patch_from_points,
    segment_from_points,
)
from calgraph.sensors import CameraModel
from ideal_detections import simulate_detections
from model_error_rigs import rig_world

Change = Callable[[Detection], Detection | Rejected]
OTHER_RESOLUTION, OTHER_UNIT = 0.5, 1.1
"""Factors of wrong intrinsics, and of ranges in another unit."""
CHECKERBOARD = Checkerboard(kind="checkerboard", columns=7, rows=6, square=0.12)


@dataclass(frozen=True)
class World:
    """Detections of a rig, of which one sensor is impossible."""

    rig: Rig
    captures: CaptureSet
    impossible: str


@lru_cache(maxsize=4)
def simulate(rig: str, seed: int, *, coded: bool = True) -> tuple[Rig, CaptureSet]:
    """Right detections; of a checkerboard if not ``coded``."""
    changes = () if coded else (("board", Board(size=(1.2, 0.9), pattern=CHECKERBOARD)),)
    return simulate_detections(rig_world(rig, seed, changes), seed)[:2]


def make_world(kind: str, rig: str, seed: int, impossible: str) -> World:
    """A world with an impossible sensor."""
    return KINDS[kind](World(*simulate(rig, seed, coded=kind != "mirrored_image"), impossible))


def change_detections(world: World, change: Change) -> World:
    """The world with changed detections of the impossible sensor."""
    found = {
        capture: [new for one in candidates if not isinstance(new := change(one), Rejected)]
        for capture, candidates in world.captures.detections[world.impossible].items()
    }
    return with_detections(world, {capture: tuple(few) for capture, few in found.items() if few})


def with_detections(world: World, found: Mapping[int, tuple[Detection, ...]]) -> World:
    """The world with other detections of the impossible sensor."""
    name, captures = world.impossible, world.captures
    before = {capture for capture in captures.detections[name] if capture not in found}
    lost = {(capture, name): "the board was not found" for capture in before}
    detections = {**captures.detections, name: dict(found)}
    changed = replace(captures, detections=detections, rejections={**captures.rejections, **lost})
    return replace(world, captures=changed)


def project_image(world: World, project: Callable[[Array], Array], flip: float = 1.0) -> World:
    """The world with other pixels (N, 2), of a board whose x coordinates are flipped where images are mirrored."""
    camera, noise = world.captures.cameras[world.impossible], world.rig.cameras()[world.impossible].noise

    def change(one: Detection) -> Detection | Rejected:
        assert isinstance(one, BoardCorners)
        return board_corners_from_pixels(one.corners_board * [flip, 1, 1], project(one.pixels), camera, noise)

    return change_detections(world, change)


def flip_image(world: World, axes: tuple[bool, bool]) -> World:
    """The world with an image that is mirrored, or turned by 180° where it is flipped along both axes."""
    camera = world.captures.cameras[world.impossible]
    size = np.array([camera.width, camera.height]) - 1.0
    return project_image(
        world, lambda pixels: np.where(axes, size - pixels, pixels), -1.0 if axes[0] != axes[1] else 1.0
    )


def with_intrinsics(world: World, change: Callable[[CameraModel], CameraModel]) -> World:
    """The world with other intrinsics of the impossible camera, with which its boards are located."""
    name = world.impossible
    camera, spec = change(world.captures.cameras[name]), world.rig.sensors[name]
    assert isinstance(spec, CameraSpec)
    spec = spec.model_copy(update={"intrinsics": Intrinsics.from_camera(camera), "camera_info": None})
    rig = world.rig.model_copy(update={"sensors": {**world.rig.sensors, name: spec}})
    captures = replace(world.captures, cameras={**world.captures.cameras, name: camera})
    return project_image(replace(world, rig=rig, captures=captures), lambda pixels: pixels)


def scale_intrinsics(world: World, focal: float, center: float = 1.0) -> World:
    """The world with intrinsics times factors."""
    K = np.array([[focal, 1.0, center], [1.0, focal, center], [1.0, 1.0, 1.0]])
    return with_intrinsics(world, lambda camera: replace(camera, K=K * camera.K))


def fit_points(world: World, one: Detection, points: Array) -> PlanePatch | Segment | Rejected:
    """The detection of the impossible scanner with other points (N, 3)."""
    noise = world.rig.sensors[world.impossible].noise
    assert isinstance(noise, RangeNoise)
    if isinstance(one, PlanePatch):
        return plane_patch_from_points(points, noise)
    return segment_from_points(points, noise)


def map_points(world: World, matrix: Array) -> World:
    """The world with linearly mapped points of the impossible scanner."""

    def change(one: Detection) -> Detection | Rejected:
        assert not isinstance(one, BoardCorners)
        new, edges = fit_points(world, one, one.points @ matrix.T), one.edges @ matrix.T
        if isinstance(new, Rejected):
            return new
        return replace(new, edges=edges / np.linalg.norm(edges, axis=-1, keepdims=True))

    return change_detections(world, change)


def shuffle_times(world: World) -> World:
    """The world with the detections of one sensor in other captures."""
    found = world.captures.detections[world.impossible]
    order = np.random.default_rng((0, 34)).permutation(len(found))
    few = list(found.values())
    return with_detections(world, {capture: few[i] for capture, i in zip(found, order.tolist(), strict=True)})


def without_sensor(world: World) -> World:
    """The world without the impossible sensor; another root if that is the root."""
    rig, name = world.rig, world.impossible
    sensors = {n: spec for n, spec in rig.sensors.items() if n != name}
    root = rig.root if rig.root != name else next(iter(sensors))
    captures = world.captures
    left = replace(
        captures,
        detections={n: found for n, found in captures.detections.items() if n != name},
        rejections={at: why for at, why in captures.rejections.items() if at[1] != name},
        frames={n: f for n, f in captures.frames.items() if n != name},
        cameras={n: c for n, c in captures.cameras.items() if n != name},
    )
    return replace(world, rig=rig.model_copy(update={"sensors": sensors, "root": root}), captures=left)


KINDS: Mapping[str, Callable[[World], World]] = {
    "mirrored_image": lambda world: flip_image(world, (True, False)),
    "turned_image": lambda world: flip_image(world, (True, True)),
    "other_resolution": lambda world: scale_intrinsics(world, OTHER_RESOLUTION, OTHER_RESOLUTION),
    # As of a 2-D scanner that is mounted upside-down.
    "reversed_scan": lambda world: map_points(world, np.diag([1.0, -1.0, 1.0])),
    "other_unit": lambda world: map_points(world, OTHER_UNIT * np.eye(3)),
    "shuffled_times": shuffle_times,
}
