"""The floor of a LiDAR, where other planes have more points."""

import numpy as np

from calgraph.network.space.floor_plane import Floor, find_floor
from calgraph.network.space.observations import StaticPoints
from calgraph.network.space.static_directions import MovingPoints


def test_people_in_a_corridor_stand_on_its_floor_and_not_on_its_wall() -> None:
    """One walks along a line; the wall beside has ten times as many points as the floor."""
    rng = np.random.default_rng(0)
    floor = np.column_stack([rng.uniform(-4, 4, 300), rng.uniform(-3, 0, 300), rng.normal(-2.6, 0.005, 300)])
    wall = np.column_stack(
        [rng.uniform(-12, 12, 3000), rng.normal(-4.8, 0.005, 3000), rng.uniform(-2.6, 1.0, 3000)]
    )
    points = np.concatenate([floor, wall])
    static = StaticPoints(points, np.full(len(points), 0.01), np.full(len(points), 100))
    sweep = np.repeat(np.arange(200), 40)
    walk = np.column_stack([10 * np.sin(0.05 * sweep), np.full(len(sweep), -4.2), np.full(len(sweep), -1.8)])
    body = rng.uniform(-1, 1, (len(sweep), 3)) * [0.2, 0.15, 0.8]
    times = np.asarray(0.1 * sweep, dtype=np.float64)
    moving = MovingPoints(walk + body, times, sweep, 0.1)

    found = find_floor(static, moving, 0.02, 0.003, rng)

    assert isinstance(found, Floor)
    assert abs(found.T_floor_sensor[2, 3] - 2.6) < 0.05
    assert found.T_floor_sensor[2, 2] > np.cos(np.radians(3.0))
