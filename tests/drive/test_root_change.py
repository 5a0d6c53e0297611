"""A joint solution with another root: states and covariances, against the errors of many samples."""

import numpy as np
import pytest
from numpy.testing import assert_allclose

from calgraph.drive.adjustment import Adjustment, change_root
from calgraph.geometry import Array, se_n
from calgraph.surfaces.sensor_states import BESIDE_POSE, SensorState
from calgraph.surfaces.surface_elimination import NoiseModel


@pytest.mark.parametrize("n", [2, 3])
def test_states_and_covariance_are_those_of_the_new_root(n: int) -> None:
    rng = np.random.default_rng(0)
    p = n + n * (n - 1) // 2

    def pose() -> Array:
        return se_n.pose(se_n.exp(rng.normal(size=p - n)), rng.normal(size=n))

    states = [SensorState(np.eye(n + 1)), SensorState(pose(), 0.1, 0.01), SensorState(pose(), -0.2)]
    free = np.ones((3, p + BESIDE_POSE), dtype=bool)
    free[0, : p + 1] = free[2, p + 1 :] = False
    A = rng.normal(size=(int(free.sum()),) * 2) * 1e-4
    adjusted = Adjustment(
        states,
        [],
        A @ A.T,
        A @ A.T,
        free,
        NoiseModel(np.array([0.0, 0.01, 0.02]), np.zeros(2)),
        np.eye(3),
        np.arange(3.0),
        0.0,
    )
    changed = change_root(adjusted, 2)
    assert_allclose(changed.states[0].T_root_sensor, np.eye(n + 1), atol=1e-12)
    assert_allclose(changed.states[1].T_root_sensor, se_n.inverse(states[2].T_root_sensor), atol=1e-12)
    assert changed.states[2].clock_offset == pytest.approx(0.3)
    assert changed.point_counts.tolist() == [2, 0, 1]
    assert changed.noise.white.tolist() == [0.02, 0.0, 0.01]
    assert not changed.free[0, : p + 1].any()
    errors = []
    for sample in rng.normal(size=(4000, len(A))):
        step = np.zeros(free.shape)
        step[free] = A @ sample
        moved = [one.moved(row) for one, row in zip(states, step, strict=True)]
        for k, (own, exact) in enumerate(((0, 1), (1, 2))):
            T = se_n.inverse(moved[2].T_root_sensor) @ moved[own].T_root_sensor
            e = se_n.difference(T, changed.states[exact].T_root_sensor)
            clock = moved[own].clock_offset - moved[2].clock_offset - changed.states[exact].clock_offset
            errors.append((k, *e, clock, moved[own].range_bias - states[own].range_bias))
    rows = np.array(errors)
    both = np.concatenate([rows[rows[:, 0] == 0, 1:], rows[rows[:, 0] == 1, 1:]], axis=1)
    number = np.full(free.shape, -1)
    number[changed.free] = np.arange(len(changed.covariance))
    chosen = number[1:, : p + 2].ravel()
    stated = changed.covariance[np.ix_(chosen, chosen)]
    scale = np.sqrt(np.diag(stated))
    assert_allclose(np.cov(both.T) / np.outer(scale, scale), stated / np.outer(scale, scale), atol=0.12)
