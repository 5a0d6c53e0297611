"""Bundles of a small simulated rig, without detectors: cheap enough for a hundred noise realisations."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from calgraph.config import PixelNoise, RangeNoise
from calgraph.geometry import Array, se3, so3
from calgraph.rig.bundle.bundle_parameters import LocalParameters
from calgraph.rig.bundle.bundle_setup import _MIN_INCIDENCE_COSINE
from calgraph.rig.bundle.bundle_solver import Bundle, BundleState
from calgraph.rig.bundle.corner_observations import CornerObservations, PrintedCorners
from calgraph.rig.bundle.observations import BoardViews, relative_poses
from calgraph.rig.bundle.range_observations import RangeObservations
from calgraph.sensors import CameraModel
from calgraph.sensors.kinds.stated import RangeUncertainty

CAMERA = CameraModel("pinhole", 640, 480, np.array([[400, 0, 319.5], [0, 400, 239.5], [0, 0, 1]]), np.zeros(0))
PIXEL, RANGE = PixelNoise(pixel=0.3), RangeNoise(range=0.012, angle=1e-5)
WIDTH, HEIGHT = 1.2, 0.9
LEVER = 0.5 * WIDTH
# Four corners of each of three tags.
_SQUARE = 0.16 * np.array([[-1, 1, 0], [1, 1, 0], [1, -1, 0], [-1, -1, 0]])
CORNERS = np.concatenate([_SQUARE + center for center in ([-0.38, 0.2, 0], [0.38, 0.2, 0], [0, -0.2, 0])])
# Optical axes: z where the robot's x is.
_OPTICAL = np.array([[0.0, 0, 1], [-1, 0, 0], [0, -1, 0]])


@dataclass(frozen=True, eq=False)
class Scene:
    """Noiseless measurements of boards, and their true poses."""

    bundle: Bundle
    truth: BundleState

    def measured(self, rng: np.random.Generator, noise: float = 1.0, view_bias: float = 0.0) -> Bundle:
        """The bundle with ``noise`` times the stated noise, and a bias of each view of ``view_bias`` (m)."""
        with_bias = replace(self.bundle, bias_variance=bias_variances(len(self.bundle.sensors), view_bias))
        views = []
        for s, views_of_sensor in enumerate(self.bundle.views):
            T = relative_poses(self.truth.T_root_sensor[s], self.truth.T_root_board[views_of_sensor.board])
            spread = np.sqrt(with_bias.bias_variances(s).pose)
            T = se3.retract(T, spread * rng.normal(size=(len(T), 6)))
            views.append(remeasured(views_of_sensor, T, rng, noise))
        return replace(self.bundle, views=tuple(views))

    def without_bias(self) -> "Scene":
        """The scene with zero view bias."""
        return replace(
            self, bundle=replace(self.bundle, bias_variance=bias_variances(len(self.bundle.sensors), 0.0))
        )


def bias_variances(sensors: int, stddev: float) -> Array:
    """(S, 4) variances of a view bias: of the displacement, of the rotation that moves the board's rim by as much,
    and none of rings and stamps."""
    return np.tile(np.array([1, 1 / LEVER, 0, 0]) * stddev, (sensors, 1)) ** 2


def remeasured(views: BoardViews, T_sensor_board: Array, rng: np.random.Generator, noise: float) -> BoardViews:
    """The views with measurements of boards at other poses, and noise a multiple of the stated one."""
    error = views.linearize(T_sensor_board, np.zeros(views.parameters.count)).residual
    if isinstance(views, CornerObservations):
        sigma = views.noise.pixel * views.noise_scale
        return replace(views, pixels=views.pixels + sigma * (error + noise * rng.normal(size=error.shape)))
    assert isinstance(views, RangeObservations)
    drawn = error[:, 0] + noise * rng.normal(size=len(error))
    return replace(views, ranges=views.ranges + views.sigma * drawn)


def scene(sensors: Sequence[str] = ("lidar", "camera", "laser"), boards: int = 20, seed: int = 0) -> Scene:
    """Boards before a robot, all observed by all sensors, which are named after their kinds."""
    rng = np.random.default_rng(seed)
    T_root_sensor = np.array([sensor_pose(name, rng) for name in sensors])
    # The first sensor is the root.
    T_root_sensor = se3.inverse(T_root_sensor[0]) @ T_root_sensor
    T_root_board = se3.inverse(sensor_pose(sensors[0], np.random.default_rng(seed))) @ board_poses(boards, rng)
    views = [
        views_of(name, relative_poses(T, T_root_board)) for name, T in zip(sensors, T_root_sensor, strict=True)
    ]
    bundle = Bundle(
        tuple(sensors), tuple(views), np.arange(len(sensors)), bias_variances(len(sensors), 1e-3), lever=LEVER
    )
    return Scene(bundle, BundleState(T_root_sensor, T_root_board, np.zeros(0)))


def sensor_pose(name: str, rng: np.random.Generator) -> Array:
    """``T_robot_sensor`` (4, 4) of a sensor near the robot's origin that looks ahead."""
    turned = so3.exp(rng.uniform(-0.1, 0.1, 3))
    return se3.pose(turned @ _OPTICAL if name == "camera" else turned, rng.uniform(-0.2, 0.2, 3))


def board_poses(count: int, rng: np.random.Generator) -> Array:
    """``T_robot_board`` (count, 4, 4) ahead of the robot, facing it, tilted by up to 35 degrees."""
    bearing, distance = rng.uniform(-0.35, 0.35, count), rng.uniform(1.7, 3.0, count)
    t = np.stack([distance * np.cos(bearing), distance * np.sin(bearing), rng.uniform(-0.1, 0.1, count)], axis=-1)
    facing = np.array([[0.0, 0, -1], [-1, 0, 0], [0, 1, 0]])
    return se3.pose(so3.exp(rng.uniform(-0.4, 0.4, (count, 3))) @ facing, t)


def views_of(name: str, T_sensor_board: Array) -> BoardViews:
    """A sensor's noiseless views of boards (C, 4, 4) before it."""
    count = len(T_sensor_board)
    if name == "camera":
        points = se3.apply(T_sensor_board, CORNERS)
        pixels = CAMERA.project(points.reshape(-1, 3))
        start = np.arange(count) * len(CORNERS)
        printed = PrintedCorners.from_nominal(np.tile(CORNERS, (count, 1)))
        return CornerObservations(
            np.arange(count), start, printed, pixels, CAMERA, PIXEL, parameters=LocalParameters.exact(count, {})
        )
    points_of = _cut if name.startswith("laser") else _swept
    ends = [points_of(T) for T in T_sensor_board]
    ranges = np.linalg.norm(np.concatenate(ends), axis=1)
    start = np.cumsum([0, *[len(points) for points in ends[:-1]]])
    return RangeObservations(
        np.arange(count), start, np.concatenate(ends) / ranges[:, None], ranges, RANGE,
        np.full(len(ranges), RANGE.range), _MIN_INCIDENCE_COSINE,
        parameters=LocalParameters.exact(count, {}),
    )  # fmt: skip


def with_range_bias(views: RangeObservations) -> RangeObservations:
    """The views of a scanner with a range bias as its only systematic error."""
    bias, _ = RangeUncertainty().beam_errors()
    index = np.zeros((len(views.board), 1), dtype=np.intp)
    return replace(views, errors=(bias,), parameters=LocalParameters({"beams": slice(0, 1)}, index, 1))


def _swept(T_sensor_board: Array) -> Array:
    """(N, 3) points of a 3-D scanner on the board."""
    x, y = np.meshgrid(np.linspace(-0.55, 0.55, 12), np.linspace(-0.4, 0.4, 9))
    return se3.apply(T_sensor_board, np.stack([x.ravel(), y.ravel(), np.zeros(x.size)], axis=-1))


def _cut(T_sensor_board: Array) -> Array:
    """(N, 3) points of a 2-D scanner on the board, in its plane z = 0."""
    a, b, _ = T_sensor_board[2, :3]
    nearest = -T_sensor_board[2, 3] * np.array([a, b]) / (a * a + b * b)
    line = nearest + np.linspace(-1, 1, 161)[:, None] * np.array([b, -a]) / np.hypot(a, b)
    on_board = line[np.all(np.abs(line) < [WIDTH / 2 - 0.02, HEIGHT / 2 - 0.02], axis=1)]
    return se3.apply(T_sensor_board, np.column_stack([on_board, np.zeros(len(on_board))]))
