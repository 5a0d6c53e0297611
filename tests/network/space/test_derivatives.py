"""Derivatives by the states of sensors, against numerical ones."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose

from calgraph.geometry import Array, se3
from calgraph.network.space.person_paths import SHAPE, SHARED_MEAN, BodyNoise, reduce_person
from calgraph.network.space.persons import (
    date_samples,
    derive_places,
    find_persons,
    gather_samples,
    place_samples,
    point_outward,
)
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


@pytest.mark.parametrize("number", [6, 9])
def test_gradients_of_a_person_by_a_clock_and_its_drift(scene: Scene, number: int) -> None:
    """Of one who walks on a circle, and is measured without errors: second derivatives do not count."""
    states = [*scene.truth[:2], replace(scene.truth[2], timing=np.array([1e-3, 0.0, 0.0]))]
    samples = find_persons(gather_samples(scene.observations), states, 0.5)[0]
    angle = 0.5 * date_samples(samples, states)
    walk = np.array([7.0, 5.0]) + 2.0 * np.column_stack([np.cos(angle), np.sin(angle)])
    front = SHARED_MEAN[0] * point_outward(samples, states, walk)
    world = np.column_stack([walk - front, np.full(len(walk), 1.35)])
    inverse = np.array([se3.inverse(one.T_root_sensor) for one in states])[samples.sensor]
    center = np.einsum("nij,nj->ni", inverse[:, :3, :3], world) + inverse[:, :3, 3]
    samples, shape = replace(samples, center=center), np.where(np.arange(SHAPE), 0.0, SHARED_MEAN)
    noise = BodyNoise(np.ones(2), np.full(2, 0.03))
    step = np.zeros(NUMBERS)
    step[number] = 1e-4
    forth, back = (
        reduce_person(samples, [*states[:2], states[2].moved(sign * step)], noise, shape).gradient
        for sign in (1.0, -1.0)
    )
    column = reduce_person(samples, states, noise, shape).information[:, 2 * NUMBERS + number]
    assert_allclose((forth - back) / 2e-4, column, atol=0.02 * np.abs(column).max())


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
