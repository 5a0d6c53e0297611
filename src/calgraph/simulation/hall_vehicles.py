"""Vehicles of several kinds in a hall: boxes that follow a walk, and reverse where that turns them less."""

from collections.abc import Callable

import numpy as np
from scipy.ndimage import gaussian_filter1d

from calgraph.geometry import Array
from calgraph.simulation.hall_bodies import Mover, Part, place_box
from calgraph.simulation.hall_people import turn_body
from calgraph.simulation.network_walks import SAMPLE_INTERVAL, SimulatedWalk

Box = tuple[tuple[float, float, float], tuple[float, float, float]]
"""Middle over the floor, and half edges, m; x is ahead."""
_SMOOTHING = 0.6
"""Standard deviation of the filters of places and headings, s: vehicles turn slower than people."""
_DRIVING = 0.3
"""Speed from which a vehicle heads where it goes, m/s."""
_LARGE_HALL = 12.0
"""Width of a hall from which vans drive in it, m."""


def draw_vehicles(count: int, width: float, rng: np.random.Generator) -> list[list[Box]]:
    """Draws vehicles of different kinds for a hall of a width, m: carts, forklifts, tugs, and vans of 4.5 m."""
    kinds = [_build_cart, _build_forklift, _build_tug, _build_van][: 4 if width > _LARGE_HALL else 3]
    order = np.concatenate([rng.permutation(len(kinds)) for _ in range(count // len(kinds) + 1)])
    return [kinds[k](rng) for k in order[:count].tolist()]


def measure_reach(boxes: list[Box]) -> float:
    """The largest distance of a corner from the vertical axis, m."""
    return max(float(np.hypot(*(np.abs(middle[:2]) + half[:2]))) for middle, half in boxes)


def drive_vehicle(walk: SimulatedWalk, ground: Callable[[Array], Array], boxes: list[Box], grey: float) -> Mover:
    """A vehicle that drives along a walk."""
    last = len(walk.positions) - 1
    sigma = _SMOOTHING / SAMPLE_INTERVAL
    places = gaussian_filter1d(walk.positions, sigma, axis=0, mode="nearest")
    velocity = np.gradient(places, SAMPLE_INTERVAL, axis=0)
    driving = np.flatnonzero(np.hypot(*velocity.T) > _DRIVING)
    yaw = np.zeros(last + 1)
    if len(driving):
        held = driving[np.maximum(np.searchsorted(driving, np.arange(last + 1), "right") - 1, 0)]
        angles = np.unwrap(np.arctan2(velocity[held, 1], velocity[held, 0]), period=np.pi)
        yaw = gaussian_filter1d(angles, sigma, mode="nearest")
    height = ground(places)

    def pose(times: Array) -> tuple[Array, Array]:
        sample = np.clip((times - walk.start) / SAMPLE_INTERVAL, 0, last)
        x, y, z, angle = (np.interp(sample, np.arange(last + 1), row) for row in (*places.T, height, yaw))
        return np.stack([x, y, z]), angle

    return build_mover(pose, boxes, grey)


def build_mover(pose: Callable[[Array], tuple[Array, Array]], boxes: list[Box], grey: float) -> Mover:
    """Boxes, by middle and half edges, in a frame at places (3, G) on the floor with yaws (G,)."""
    corners = np.abs([middle for middle, _ in boxes]) + [size for _, size in boxes]
    radius, height = float(np.linalg.norm(corners[:, :2], axis=1).max()), float(corners[:, 2].max())

    def parts(times: Array) -> list[Part]:
        place, yaw = pose(times)
        R = turn_body(yaw)
        return [
            place_box(R, place + np.einsum("ijg,j->ig", R, np.array(middle)), size, grey) for middle, size in boxes
        ]

    return Mover(lambda times: pose(times)[0], radius, height, parts)


def _build_cart(rng: np.random.Generator) -> list[Box]:
    """A trolley with a load and a handle."""
    length, width, load = rng.uniform(0.4, 0.7), rng.uniform(0.3, 0.4), rng.uniform(0.2, 0.5)
    return [
        ((0.0, 0.0, 0.25), (length, width, 0.12)),
        ((-0.05, 0.02, 0.37 + load), (0.8 * length, 0.9 * width, load)),
        ((-length, 0.0, 0.75), (0.03, width, 0.4)),
    ]


def _build_forklift(rng: np.random.Generator) -> list[Box]:
    """With forks, a mast, a roof on posts and a driver; its axis is before the middle of its body."""
    length, width, mast = rng.uniform(0.9, 1.2), rng.uniform(0.5, 0.6), rng.uniform(0.95, 1.1)
    posts = [(x, y, 1.5) for x in (-1.6 * length, -0.4 * length) for y in (-width + 0.05, width - 0.05)]
    return [
        ((-0.8 * length, 0.0, 0.5), (length, width, 0.4)),
        ((-1.4 * length, 0.0, 1.0), (0.4 * length, width, 0.15)),
        ((0.2 * length + 0.06, 0.0, mast), (0.06, 0.4, mast)),
        *(((0.2 * length + 0.6, y, 0.1), (0.5, 0.06, 0.03)) for y in (-0.3, 0.3)),
        *((post, (0.03, 0.03, 0.6)) for post in posts),
        ((-length, 0.0, 2.1), (0.7 * length, width, 0.02)),
        ((-0.9 * length, 0.0, 1.2), (0.14, 0.23, 0.35)),
        ((-0.85 * length, 0.0, 1.68), (0.1, 0.08, 0.12)),
    ]


def _build_tug(rng: np.random.Generator) -> list[Box]:
    """A base with a cabinet on one side at the rear: L-shaped from above, and not symmetric."""
    length, width, cabinet = rng.uniform(0.7, 1.1), rng.uniform(0.4, 0.6), rng.uniform(0.35, 0.55)
    side = float(rng.choice([-0.5, 0.5]))
    return [
        ((0.0, 0.0, 0.4), (length, width, 0.25)),
        ((-0.6 * length, side * width, 0.65 + cabinet), (0.4 * length, 0.5 * width, cabinet)),
        ((0.8 * length, 0.0, 0.8), (0.15 * length, 0.9 * width, 0.16)),
    ]


def _build_van(rng: np.random.Generator) -> list[Box]:
    """A body with a cabin."""
    length, width, top = rng.uniform(1.75, 2.25), rng.uniform(0.85, 1.0), rng.uniform(0.3, 0.6)
    return [
        ((0.0, 0.0, 0.65), (length, width, 0.4)),
        ((-0.25 * length, 0.0, 1.05 + top), (0.75 * length, 0.95 * width, top)),
    ]
