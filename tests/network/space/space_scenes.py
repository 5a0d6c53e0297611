"""What stationary LiDARs measure of a box, and of people on smooth paths: for the joint solution."""

from dataclasses import dataclass, replace

import numpy as np
from scipy.interpolate import CubicSpline

from calgraph.geometry import Array, se3, so3
from calgraph.network.space.observations import BodyTrack, SpaceObservations, StaticPoints
from calgraph.surfaces.sensor_states import DRIFT, TIMING, SensorState
from network.space.people_hall import mount

SIZE = np.array([14.0, 10.0, 4.5])
PERIOD = 0.1


@dataclass(frozen=True)
class Scene:
    """The first sensor is the root, whose pose is exact."""

    observations: list[SpaceObservations]
    truth: list[SensorState]


def build_scene(
    seed: int,
    *,
    duration: float = 30.0,
    people: int = 3,
    sensors: int = 3,
    scanner: float = 0.0,
    bias: float = 0.0,
    jump: float = 0.0,
    drift: float = 0.0,
) -> Scene:
    """Sensors in corners of a hall.

    Args:
        seed: of everything.
        duration: s.
        people: their number.
        sensors: their number.
        scanner: height of a 2-D scanner, the last sensor, m; there is none if 0.
        bias: standard deviation of the range biases of sensors, m.
        jump: of the last sensor's clock in the middle, s.
        drift: of the last sensor's clock, as a share of time.
    """
    rng = np.random.default_rng(seed)
    corners = np.array([[0.4, 0.5], [13.5, 9.4], [13.6, 0.6], [0.5, 9.5]])[:sensors]
    truth = []
    for k, corner in enumerate(corners):
        target = np.append(SIZE[:2] / 2 + rng.normal(size=2), rng.uniform(0, 1.5))
        T = mount(np.append(corner, rng.uniform(2.5, 3.5)), target, rng.uniform(-0.3, 0.3))
        if scanner and k == sensors - 1:
            level = so3.exp(np.array([0.0, 0.0, np.arctan2(T[1, 0], T[0, 0])]))
            T = se3.pose(level @ so3.exp(np.append(0.02 * rng.normal(size=2), 0.0)), np.append(corner, scanner))
        offset = 0.0 if k == 0 else rng.uniform(-0.05, 0.05)
        timing = np.array([drift * (k == sensors - 1), 0.0, 0.0])
        truth.append(SensorState(T, offset, bias * rng.normal(), timing=timing, mid_time=duration / 2 + offset))
    times = np.arange(0.0, duration + 8.0, 6.0)
    paths = [CubicSpline(times, 2.0 + rng.uniform(size=(len(times), 2)) * (SIZE[:2] - 4.0)) for _ in range(people)]
    observations = []
    for k, state in enumerate(truth):
        last = k == sensors - 1
        tracks = [_track(path, state, duration, jump * last, rng) for path in paths]
        flat = last and scanner > 0
        static = _measure_box(state, rng, flat)
        if flat:
            tracks = [replace(track, centers=_flatten(track.centers)) for track in tracks]
        observations.append(
            SpaceObservations(
                np.eye(4), np.zeros((3, 3)), static, np.zeros(0, dtype=np.bool_), tuple(tracks),
                np.array([[0.0, duration]]), flat=flat,
            )
        )  # fmt: skip
    return Scene(observations, truth)


def _track(
    path: CubicSpline, state: SensorState, duration: float, jump: float, rng: np.random.Generator
) -> BodyTrack:
    times = np.arange(rng.uniform(0, PERIOD), duration, PERIOD)
    axis, velocity = path(times), path(times, 1)
    away = axis - state.T_root_sensor[:2, 3]
    outward = away / np.linalg.norm(away, axis=1, keepdims=True)
    across = np.column_stack([-outward[:, 1], outward[:, 0]])
    along = np.sum(outward * velocity, axis=1) / np.linalg.norm(velocity, axis=1)
    second = np.floor(times).astype(int)
    errors = 0.01 * rng.normal(size=(2, int(duration) + 1))[:, second] + 0.015 * rng.normal(size=(2, len(times)))
    front = 0.13 - 0.04 * (2 * along**2 - 1)
    place = axis + outward * (errors[0] - front)[:, None] + across * errors[1][:, None]
    heights = 1.3 + 0.1 * rng.normal(size=len(times))
    measured = se3.apply(se3.inverse(state.T_root_sensor), np.column_stack([place, heights]))
    ranges = np.linalg.norm(measured, axis=1, keepdims=True)
    measured *= 1 + state.range_bias / ranges
    stddev = np.full(len(times), 0.02)
    stamps = times + state.clock_offset + jump * (times > duration / 2)
    stamps += state.timing[0] * (times - duration / 2)
    return BodyTrack(stamps, measured, stddev, stddev, np.zeros(len(times), dtype=np.intp))


def _flatten(points: Array) -> Array:
    """Points (N, 3) in the plane of their scanner, as far as before."""
    return points * [1.0, 1.0, 0.0]


def _measure_box(state: SensorState, rng: np.random.Generator, flat: bool) -> StaticPoints:
    """Points of floor and walls, with errors that are the same in each quarter of a metre."""
    origin = state.T_root_sensor[:3, 3]
    azimuth, elevation = rng.uniform(-np.pi, np.pi, 30_000), rng.uniform(-0.9, 0.15, 30_000)
    level = np.cos(elevation)
    beams = np.column_stack([level * np.cos(azimuth), level * np.sin(azimuth), np.sin(elevation)])
    if flat:
        angles = np.radians(np.arange(0, 360, 0.5))
        beams = np.column_stack([np.cos(angles), np.sin(angles), np.zeros(720)]) @ state.T_root_sensor[:3, :3].T
    with np.errstate(divide="ignore"):
        ranges = np.maximum((0 - origin) / beams, (SIZE - origin) / beams).min(axis=1)
    ranges += state.range_bias + 0.006 * rng.normal(size=len(ranges))
    points = se3.apply(se3.inverse(state.T_root_sensor), origin + beams * ranges[:, None])
    return StaticPoints(points, np.full(len(points), 0.01), np.full(len(points), 100))


def perturb(truth: list[SensorState], rng: np.random.Generator, metres: float = 0.05) -> list[SensorState]:
    """Start values of the sensors besides the root."""
    moved = [SensorState(truth[0].T_root_sensor)]
    for state in truth[1:]:
        off = np.concatenate([metres * rng.normal(size=3), 0.003 * rng.normal(size=3)])
        step = np.array([*off, 0.005 * rng.normal(), *[0.0] * (2 + TIMING)])
        moved.append(SensorState(state.T_root_sensor, state.clock_offset).moved(step))
    return moved


def prior_of(sensors: int, bias: float = 0.02, scale: float = 0.003, drift: float = 3e-5) -> Array:
    """(S, 12) standard deviations of start values."""
    stddev = np.tile([1.0, 1.0, 1.0, 0.2, 0.2, 0.2, 0.1, bias, scale, drift, 0.0, 0.0], (sensors, 1))
    stddev[0, :7] = stddev[0, DRIFT] = 0.0
    return stddev
