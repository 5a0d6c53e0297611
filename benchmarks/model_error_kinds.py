"""Everything in which a world may differ from rig.yaml, one thing at a time, for model_errors.py."""

import zlib
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from calgraph.sensors import CameraModel
from calgraph.simulation import World
from calgraph.simulation.robot import MountedCamera, MountedScanner
from ideal_detections import IdealDetectorOptions
from model_error_rigs import cameras_of, rig_world, ring_count, scanners_of
from rig_errors import BoardErrors, Bump, CameraErrors, ModelErrors, ScannerErrors


@dataclass(frozen=True, eq=False)
class Wrong:
    """A world in which one thing is wrong."""

    errors: ModelErrors = field(default_factory=ModelErrors)
    scenario: tuple[tuple[str, Any], ...] = ()
    """Changes to the scenario."""
    options: IdealDetectorOptions = field(default_factory=IdealDetectorOptions)


Make = Callable[[float, World, np.random.Generator], Wrong | None]
"""The errors of a size in a world; None where the rig has no such sensor."""


@dataclass(frozen=True)
class Kind:
    """A kind of error in several sizes."""

    sizes: tuple[float, ...]
    """SI units, rad, pixels, or ratios."""
    unit: str
    """For display."""
    factor: float
    """Of sizes, to this unit."""
    make: Make

    def label(self, size: float) -> str:
        """A size with its unit."""
        return f"{self.factor * size:g} {self.unit}"


def wrong_world(kind: str, size: float, rig: str, seed: int) -> Wrong | None:
    """The errors of one run; sensor, sign and direction are drawn, the same for all sizes of a kind."""
    rng = np.random.default_rng((seed, zlib.crc32(f"{kind} {rig}".encode())))
    return KINDS[kind].make(size, rig_world(rig, seed), rng)


def _sign(rng: np.random.Generator) -> float:
    return float(rng.choice([-1.0, 1.0]))


def _direction(rng: np.random.Generator, dimension: int) -> Any:
    """A random unit vector as a tuple."""
    v = rng.standard_normal(dimension)
    return tuple((v / np.linalg.norm(v)).tolist())


def _scaled(size: float, vector: tuple[float, ...]) -> Any:
    return tuple(size * x for x in vector)


Draw = Callable[[float, np.random.Generator], Any]
"""The value of an error of a size."""


def _either_sign(size: float, rng: np.random.Generator) -> float:
    return _sign(rng) * size


def _along(*direction: float) -> Draw:
    """Along a vector, to either side."""
    return lambda size, rng: _scaled(_sign(rng) * size, direction)


def _any_direction(dimension: int) -> Draw:
    return lambda size, rng: _scaled(size, _direction(rng, dimension))


def _board(name: str, draw: Draw = _either_sign) -> Make:
    """An error of the board."""
    return lambda size, _world, rng: Wrong(ModelErrors(BoardErrors(**{name: draw(size, rng)})))


def _camera(make: Callable[[float, MountedCamera, np.random.Generator], CameraErrors]) -> Make:
    """One camera is wrong."""

    def of_world(size: float, world: World, rng: np.random.Generator) -> Wrong | None:
        camera = cameras_of(world)[rng.integers(len(cameras_of(world)))]
        return Wrong(ModelErrors(cameras={camera.name: make(size, camera, rng)}))

    return of_world


def _lens(name: str, draw: Draw) -> Make:
    """An error of one camera."""
    return _camera(lambda size, _camera, rng: CameraErrors(**{name: draw(size, rng)}))


def _scanner(name: str, fits: Callable[[MountedScanner], bool] = lambda _scanner: True) -> Make:
    """An error of one scanner of those that fit; of each ring, if it is one of rings."""

    def of_world(size: float, world: World, rng: np.random.Generator) -> Wrong | None:
        candidates = [s for s in scanners_of(world) if fits(s)]
        if not candidates:
            return None
        scanner = candidates[rng.integers(len(candidates))]
        of_rings = name.startswith("ring_")
        value: Any = tuple(rng.normal(0, size, ring_count(scanner)).tolist()) if of_rings else _sign(rng) * size
        return Wrong(ModelErrors(scanners={scanner.name: ScannerErrors(**{name: value})}))

    return of_world


def _bump(name: str, start: float = 0.5, duration: float = 0.0) -> Make:
    """One sensor is bumped, the root as likely as any other."""

    def of_world(size: float, world: World, rng: np.random.Generator) -> Wrong | None:
        sensor = world.robot[rng.integers(len(world.robot))]
        bump = Bump(start, duration, **{name: _scaled(size, _direction(rng, 3))})
        if isinstance(sensor, MountedCamera):
            return Wrong(ModelErrors(cameras={sensor.name: CameraErrors(bump=bump)}))
        return Wrong(ModelErrors(scanners={sensor.name: ScannerErrors(bump=bump)}))

    return of_world


def _is_2d(scanner: MountedScanner) -> bool:
    return scanner.kind == "lidar2d"


def _has_rings(scanner: MountedScanner) -> bool:
    return scanner.pattern.rings is not None


def _displaced_tag(size: float, world: World, rng: np.random.Generator) -> Wrong:
    tag = world.scenario.board.tags[rng.integers(len(world.scenario.board.tags))]
    return Wrong(ModelErrors(BoardErrors(tag_position={tag.id: _scaled(size, _direction(rng, 2))})))


def _shift_image(size: float, camera: MountedCamera, rng: np.random.Generator) -> CameraErrors:  # noqa: ARG001
    return CameraErrors(image_shift=_scaled(size, _direction(rng, 2)), image_shift_after=0.5)


def _undistorted(size: float, camera: MountedCamera, rng: np.random.Generator) -> CameraErrors:  # noqa: ARG001
    """The lens has radial distortion that camera_info leaves out."""
    lens = replace(camera.camera, distortion=camera.camera.distortion + np.array([-size, 0.3 * size, 0, 0, 0]))
    return CameraErrors(lens=lens)


def _rational(size: float, camera: MountedCamera, rng: np.random.Generator) -> CameraErrors:  # noqa: ARG001
    """A rational polynomial, of which camera_info states the numerator as plumb_bob."""
    stated = camera.camera.distortion
    return CameraErrors(lens=replace(camera.camera, distortion=np.concatenate([stated, [size, 0.2 * size, 0.0]])))


def _fisheye(size: float, camera: MountedCamera, rng: np.random.Generator) -> CameraErrors:  # noqa: ARG001
    """An equidistant lens that looks like the stated one at the axis; ``size`` is its k1."""
    stated = camera.camera
    return CameraErrors(
        lens=CameraModel("fisheye", stated.width, stated.height, stated.K, np.array([size, 0, 0, 0]))
    )


def _late(size: float, world: World, rng: np.random.Generator) -> Wrong:
    """One clock is 50 ms late while the board moves at ``size`` m/s in every capture."""
    sensor, board = world.robot[rng.integers(len(world.robot))], BoardErrors(speed=size)
    if isinstance(sensor, MountedCamera):
        return Wrong(ModelErrors(board, cameras={sensor.name: CameraErrors(delay=0.05)}))
    return Wrong(ModelErrors(board, scanners={sensor.name: ScannerErrors(delay=0.05)}))


def _footprints(size: float, world: World, rng: np.random.Generator) -> Wrong:  # noqa: ARG001
    scanners = {scanner.name: ScannerErrors(divergence=size) for scanner in scanners_of(world)}
    return Wrong(ModelErrors(scanners=scanners))


_PERCENT, _MM, _DEGREES, _PIXELS = ("%", 100.0), ("mm", 1e3), ("deg", float(np.degrees(1.0))), ("px", 1.0)
KINDS: Mapping[str, Kind] = {
    "print_scale": Kind((0.01, 0.02, 0.05, 0.1), *_PERCENT, _board("print_scale")),
    "print_aspect": Kind((0.005, 0.01), *_PERCENT, _board("print_aspect")),
    "tag_size": Kind((0.01, 0.05, 0.2), *_PERCENT, _board("tag_size")),
    "tag_position": Kind((0.003, 0.01), *_MM, _displaced_tag),
    "focal_length": Kind((0.01, 0.03, 0.1), *_PERCENT, _lens("focal_length", _along(1.0, 1.0))),
    "focal_length_x": Kind((0.01, 0.03, 0.1), *_PERCENT, _lens("focal_length", _along(1.0, 0.0))),
    "principal_point": Kind((10, 15, 20, 30), *_PIXELS, _lens("principal_point", _any_direction(2))),
    "distortion_dropped": Kind((0.05, 0.2), "k1", -1, _camera(_undistorted)),
    "rational_lens": Kind((0.02, 0.1), "k4", 1, _camera(_rational)),
    "fisheye_lens": Kind((0.0, 0.05), "k1", 1, _camera(_fisheye)),
    "range_bias": Kind((0.01, 0.03, 0.1), *_MM, _scanner("range_bias")),
    "range_scale": Kind((0.003, 0.01), *_PERCENT, _scanner("range_scale")),
    "angle_scale": Kind((0.002, 0.005, 0.01), *_PERCENT, _scanner("angle_scale", _is_2d)),
    "ring_bias": Kind((0.01, 0.02), *_MM, _scanner("ring_bias", _has_rings)),
    "ring_elevation": Kind((np.radians(0.1), np.radians(0.2)), *_DEGREES, _scanner("ring_elevation", _has_rings)),
    "bump_rotation": Kind((np.radians(0.3), np.radians(1.0), np.radians(3.0)), *_DEGREES, _bump("rotation")),
    "bump_translation": Kind((0.005, 0.02), *_MM, _bump("translation")),
    "bump_at_a_third": Kind((np.radians(1.0),), *_DEGREES, _bump("rotation", 1 / 3)),
    "drift": Kind((np.radians(0.3), np.radians(1.0)), *_DEGREES, _bump("rotation", 0.0, 1.0)),
    "image_shift": Kind((5, 15, 20), *_PIXELS, _camera(_shift_image)),
    "bent": Kind((0.002, 0.005, 0.01), *_MM, _board("bow", _along(1.0, 0.0, 0.0))),
    "saddle": Kind((0.002, 0.005, 0.01), *_MM, _board("bow", _along(1.0, -1.0, 0.0))),
    "twisted": Kind((0.005,), *_MM, _board("bow", _along(0.0, 0.0, 1.0))),
    "board_size": Kind((0.01, 0.03), *_MM, _board("size", _along(1.0, 1.0))),
    "print_position": Kind((0.003, 0.01), *_MM, _board("print_position", _any_direction(2))),
    "dark_tags": Kind((0.005, 0.02), *_MM, _board("tag_range_bias")),
    "noise": Kind(
        (3.0,), "times", 1, lambda s, _world, _rng: Wrong(options=IdealDetectorOptions(stated_noise_factor=1 / s))
    ),
    "footprint": Kind((0.003,), "mrad", 1e3, _footprints),
    "tremor": Kind((0.0005, 0.001), *_MM, _board("tremor", lambda size, _rng: size)),
    "slip": Kind((0.2, 0.5), *_PERCENT, lambda s, _world, _rng: Wrong(scenario=(("disturbed", s),))),
    "late_clock": Kind((0.05, 0.2), "m/s", 1, _late),
}


MODELLED = frozenset(
    {
        "print_scale", "print_aspect", "tag_size", "tag_position", "focal_length", "focal_length_x",
        "principal_point", "distortion_dropped", "range_bias", "range_scale", "angle_scale", "ring_bias", "bent",
        "saddle", "board_size", "print_position",
    }
)  # fmt: skip
"""Errors for which a bundle has a parameter."""


def cases(kinds: Iterator[str] | tuple[str, ...], sizes: tuple[float, ...] = ()) -> Iterator[tuple[str, float]]:
    """All kinds and sizes; only these sizes, in the units of the table, where any are given."""
    for kind in kinds:
        for size in KINDS[kind].sizes:
            if not sizes or any(np.isclose(abs(KINDS[kind].factor * size), one) for one in sizes):
                yield kind, size
