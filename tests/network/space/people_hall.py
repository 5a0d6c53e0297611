"""A small hall for tests: a box with tables, people of two ellipses each, and LiDARs."""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from scipy.interpolate import CubicSpline

from calgraph.geometry import Array, se3, so3
from calgraph.sensors import PointCloud

PERIOD = 0.1


@dataclass(frozen=True)
class Person:
    """Walks along a spline; half axes across and along its heading, m."""

    path: CubicSpline
    height: float
    across: float
    along: float


@dataclass(frozen=True)
class Lidar:
    """A LiDAR with equal angles between its rings; its clock is ahead by ``clock``, s."""

    T_world_sensor: Array
    rings: int
    clock: float = 0.0
    range_stddev: float = 0.02
    columns: int = 720

    @property
    def directions(self) -> Array:
        """(columns * rings, 3) in order of time."""
        azimuth = -np.repeat(np.arange(self.columns), self.rings) * 2 * np.pi / self.columns
        elevation = np.tile(np.radians(np.linspace(-15, 15, self.rings)), self.columns)
        level = np.cos(elevation)
        return np.column_stack([level * np.cos(azimuth), level * np.sin(azimuth), np.sin(elevation)])


@dataclass(frozen=True)
class Hall:
    """Boxes (B, 2, 3) of corners, m, of which the first is the room."""

    boxes: Array
    people: tuple[Person, ...]

    @property
    def size(self) -> Array:
        """(3,) of the room, m."""
        return np.asarray(self.boxes[0, 1])


def build_hall(count: int, duration: float, rng: np.random.Generator) -> Hall:
    """A hall of 16 m by 11 m with two tables, a pillar, and people who walk about."""
    boxes = [[[0, 0, 0], [16, 11, 5.5]], [[4, 3, 0], [5.6, 3.8, 0.75]], [[9, 7, 0], [11, 8, 0.75]]]
    boxes.append([[8, 4, 0], [8.4, 4.4, 5.5]])
    people = []
    for _ in range(count):
        times = np.arange(-2, duration + 6, 3.0)
        places = [rng.uniform([1.5, 1.5], [14.5, 9.5])]
        while len(places) < len(times):
            place = places[-1] + 3.3 * rng.normal(size=2)
            if np.all(place > 1.2) and place[0] < 14.8 and place[1] < 9.8:
                places.append(place)
        people.append(
            Person(
                CubicSpline(times, places), rng.uniform(1.6, 1.9), rng.uniform(0.2, 0.26), rng.uniform(0.11, 0.16)
            )
        )
    return Hall(np.array(boxes, dtype=float), tuple(people))


def mount(position: Array, target: Array, roll: float) -> Array:
    """T_world_sensor of a LiDAR whose x axis points at a target, turned about it."""
    x = (target - position) / np.linalg.norm(target - position)
    y = np.cross([0, 0, 1.0], x)
    y /= np.linalg.norm(y)
    R = np.column_stack([x, y, np.cross(x, y)]) @ so3.exp(np.array([roll, 0.0, 0.0]))
    return se3.pose(R, position)


def build_lidars(count: int, rings: int, rng: np.random.Generator) -> dict[str, Lidar]:
    """LiDARs at the walls, 2.5 to 4 m high, tilted by up to 35°, with clocks up to 50 ms apart."""
    corners = np.array([[0.4, 0.4], [15.6, 10.6], [15.6, 0.4], [0.4, 10.6]])[:count]
    lidars = {}
    for k, corner in enumerate(corners):
        position = np.append(corner, rng.uniform(2.5, 4))
        target = np.append(np.array([8, 5.5]) + rng.normal(size=2), rng.uniform(-0.5, 1.5))
        roll = rng.uniform(-0.2, 0.2) + (np.pi if rng.uniform() < 0.25 else 0)
        clock = 0.0 if k == 0 else rng.uniform(-0.05, 0.05)
        lidars[f"lidar_{k}"] = Lidar(mount(position, target, roll), rings, clock)
    return lidars


def simulate_clouds(hall: Hall, lidar: Lidar, duration: float, rng: np.random.Generator) -> Iterator[PointCloud]:
    """The sweeps of a LiDAR."""
    directions, origin = lidar.directions @ lidar.T_world_sensor[:3, :3].T, lidar.T_world_sensor[:3, 3]
    static = _cast_boxes(hall.boxes, origin, directions)
    times = np.repeat(np.arange(lidar.columns), lidar.rings) / lidar.columns * PERIOD
    phase = rng.uniform(0, PERIOD)
    for k in range(round(duration / PERIOD)):
        start = phase + k * PERIOD
        ranges = static.copy()
        for person in hall.people:
            _cast_person(person, origin, directions, start + times, ranges)
        ranges += lidar.range_stddev * rng.normal(size=len(ranges))
        kept = rng.uniform(size=len(ranges)) > 0.02
        points = (lidar.directions * ranges[:, None])[kept].astype(np.float64)
        yield PointCloud(1000 + start + lidar.clock, "lidar", points, times=times[kept])


def _cast_boxes(boxes: Array, origin: Array, directions: Array) -> Array:
    ranges = np.full(len(directions), np.inf)
    for k, (low, high) in enumerate(boxes):
        t = np.stack([(low - origin) / directions, (high - origin) / directions])
        near, far = t.min(axis=0).max(axis=1), t.max(axis=0).min(axis=1)
        hit = far if k == 0 else np.where((near < far) & (near > 0), near, np.inf)
        ranges = np.minimum(ranges, hit)
    return ranges


def _cast_person(person: Person, origin: Array, directions: Array, times: Array, ranges: Array) -> None:
    middle = person.path(times[len(times) // 2]) - origin[:2]
    distance = np.hypot(*middle)
    bearing = np.arctan2(directions[:, 1], directions[:, 0]) - np.arctan2(middle[1], middle[0])
    rows = np.flatnonzero(np.cos(bearing) > np.cos(min(0.8 / max(distance, 0.8), 1.5)))
    if not len(rows):
        return
    d, x, v = directions[rows], person.path(times[rows]), person.path(times[rows], 1)
    ahead = v / np.maximum(np.linalg.norm(v, axis=1, keepdims=True), 1e-9)
    across = np.column_stack([-ahead[:, 1], ahead[:, 0]])
    shoulders = person.height - 0.28
    for low, high, a, b in ((0.0, shoulders, person.along, person.across), (shoulders, person.height, 0.1, 0.08)):
        o = origin[:2] - x
        ox, oy = np.sum(o * ahead, axis=1) / a, np.sum(o * across, axis=1) / b
        dx, dy = np.sum(d[:, :2] * ahead, axis=1) / a, np.sum(d[:, :2] * across, axis=1) / b
        A, B, C = dx**2 + dy**2, ox * dx + oy * dy, ox**2 + oy**2 - 1
        root = B**2 - A * C
        t = np.where(root > 0, (-B - np.sqrt(np.maximum(root, 0))) / A, np.inf)
        z = origin[2] + t * d[:, 2]
        top = (high - origin[2]) / d[:, 2]
        px, py = ox + top * dx, oy + top * dy
        t = np.where((t > 0) & (z > low) & (z < high), t, np.inf)
        t = np.minimum(t, np.where((px**2 + py**2 < 1) & (top > 0), top, np.inf))
        ranges[rows] = np.minimum(ranges[rows], t)
