"""Derivatives by the states of sensors, against numerical ones."""

from collections.abc import Callable

import numpy as np
import pytest
from numpy.testing import assert_allclose

from calgraph.geometry import Array
from calgraph.network.space.persons import derive_places, gather_samples, place_samples
from calgraph.network.space.static_surfaces import find_shared_surfaces, linearize_surfaces, thin_points
from calgraph.surfaces.sensor_states import TIMING, SensorState
from network.space.space_scenes import Scene, build_scene

STEP, NUMBERS = 1e-5, 9 + TIMING


@pytest.fixture(scope="module")
def scene() -> Scene:
    return build_scene(5, duration=8.0)


def differentiate(of: Callable[[list[SensorState]], Array], states: list[SensorState], sensor: int) -> Array:
    """Central differences by the state of one sensor, in the last axis."""
    found = []
    for k in range(NUMBERS):
        step = np.zeros(NUMBERS)
        step[k] = STEP
        moved = [
            of([state.moved(sign * step) if i == sensor else state for i, state in enumerate(states)])
            for sign in (1.0, -1.0)
        ]
        found.append((moved[0] - moved[1]) / (2 * STEP))
    return np.stack(found, axis=-1)


@pytest.mark.parametrize("sensor", [0, 2])
def test_places_of_people(scene: Scene, sensor: int) -> None:
    samples = gather_samples(scene.observations)
    by_state = derive_places(samples, scene.truth, place_samples(samples, scene.truth))
    numerical = differentiate(lambda states: place_samples(samples, states)[:, :2], scene.truth, sensor)
    of = samples.sensor == sensor
    # Derivatives by clocks are those of paths.
    compared = np.delete(np.arange(NUMBERS), 6)
    assert_allclose(by_state[of][..., compared], numerical[of][..., compared], atol=1e-6)


@pytest.mark.parametrize("sensor", [0, 1])
def test_distances_from_surfaces(scene: Scene, sensor: int) -> None:
    """At places where beams meet their surface, the derivatives of the distances from it."""
    points = [thin_points(one.static.points) for one in scene.observations]
    flat = np.zeros(len(points), dtype=np.bool_)
    shared = find_shared_surfaces(points, scene.truth, 0.1, flat)
    at = linearize_surfaces(shared, scene.truth)
    numerical = differentiate(lambda states: linearize_surfaces(shared, states).residual, scene.truth, sensor)
    of = at.sensor == sensor
    assert of.any()
    # A residual of 1 cm times the slope of a plane that is met at an angle.
    assert_allclose(at.by_sensor[of][:, :3], numerical[of][:, :3], atol=1e-6)
    assert np.quantile(np.abs(at.by_sensor[of] - numerical[of]), 0.99) < 0.06
    assert np.median(np.abs(at.by_sensor[of] - numerical[of])[:, 3:6]) < 5e-3
