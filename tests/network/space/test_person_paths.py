"""Equations of persons with their sensors only: those of the whole network, on any engine."""

from dataclasses import replace

import numpy as np

from calgraph.geometry import se3
from calgraph.network.space.person_paths import (
    SHAPE,
    SHARED_MEAN,
    BodyNoise,
    LocalPerson,
    add_persons,
    eliminate_direction,
    expect_shapes,
    reduce_person,
    reduce_persons,
)
from calgraph.network.space.persons import BodySamples, find_persons, gather_samples
from calgraph.parallel.engine import THIS_PROCESS, Processes
from calgraph.surfaces.sensor_states import SensorState
from network.space.space_scenes import build_scene, prior_of

NOISE = BodyNoise(np.ones(2), np.array([0.03, 0.02]))


def test_sums_over_persons_are_those_of_the_equations_of_all_sensors() -> None:
    scene = build_scene(0, duration=6.0, people=2, sensors=4)
    states, free = scene.truth, prior_of(4) > 0
    # The third sensor measures nobody.
    samples = gather_samples([*scene.observations[:2], scene.observations[3]])
    samples.sensor[samples.sensor == 2] = 3
    found = find_persons(samples, states, 0.5)
    persons = [LocalPerson.of(one) for one in found]
    people = add_persons(persons, reduce_persons(persons, states, NOISE, SHARED_MEAN, THIS_PROCESS), free, SHAPE)
    whole = [reduce_person(one, states, NOISE, SHARED_MEAN) for one in found]
    columns = np.append(np.flatnonzero(free), free.size + np.arange(SHAPE))
    information = np.sum([one.information for one in whole], axis=0)[np.ix_(columns, columns)]
    np.testing.assert_allclose(people.information, information, rtol=1e-9, atol=1e-6)
    scores = np.concatenate([one.scores[:, columns] for one in whole])
    np.testing.assert_allclose(people.scores.toarray(), scores, rtol=1e-9, atol=1e-6)
    assert set(people.source % 4) == {0, 1, 3}


def test_a_head_ahead_of_the_chest_is_so_of_who_stands_too() -> None:
    """A person walks along x for 4 s, and stands for 4 s: views of the head have no errors then."""
    times = np.repeat(np.arange(0, 8, 0.1), 4)
    sensor, band = np.tile([0, 0, 1, 1], 80), np.tile([1, 2, 1, 2], 80)
    axis = np.column_stack([1.2 * np.minimum(times, 4.0) + 0.08 * (band == 2), np.full(len(times), 3.0)])
    origin = np.array([[0.0, 0.0], [5.0, 9.0]])[sensor]
    away = axis - origin
    center = axis - np.where(band == 2, 0.07, 0.13)[:, None] * away / np.linalg.norm(away, axis=1, keepdims=True)
    heights = np.where(band == 2, 1.65, 1.35)
    states = [SensorState(se3.pose(np.eye(3), np.array([*one, 0.0]))) for one in ((0.0, 0.0), (5.0, 9.0))]
    places = np.column_stack([center - origin, heights])
    samples = BodySamples(sensor, sensor, times, places, np.full((len(times), 2), 0.02), band)
    noise = BodyNoise(np.ones(6), np.full(6, 0.02))
    of_views = reduce_person(samples, states, noise, expect_shapes(3)[0]).view
    stddev = np.sqrt(of_views[[2, 5], 0] / of_views[[2, 5], 1])
    assert np.all(stddev < 0.02)


def test_equations_have_the_same_bits_in_other_processes() -> None:
    scene = build_scene(0, duration=6.0, people=3)
    persons = [LocalPerson.of(one) for one in find_persons(gather_samples(scene.observations), scene.truth, 0.5)]
    here, there = (
        reduce_persons(persons, scene.truth, NOISE, SHARED_MEAN, engine) for engine in (THIS_PROCESS, Processes(2))
    )
    for one, other in zip(here, there, strict=True):
        np.testing.assert_array_equal(one.information, other.information)
        np.testing.assert_array_equal(one.scores, other.scores)


def test_equations_have_the_same_bits_with_poses_that_are_not_aligned() -> None:
    """As arrays of a few numbers are that come from the scheduler of a cluster."""
    scene = build_scene(0, duration=6.0, people=3)
    persons = [LocalPerson.of(one) for one in find_persons(gather_samples(scene.observations), scene.truth, 0.5)]
    moved = []
    for state in scene.truth:
        T = np.ndarray((4, 4), buffer=bytearray(129), offset=1)
        T[...] = state.T_root_sensor
        moved.append(replace(state, T_root_sensor=T))
    here, there = (
        reduce_persons(persons, states, NOISE, SHARED_MEAN, THIS_PROCESS) for states in (scene.truth, moved)
    )
    for one, other in zip(here, there, strict=True):
        np.testing.assert_array_equal(one.information, other.information)


def test_persons_do_not_determine_a_direction_that_is_eliminated() -> None:
    scene = build_scene(0, duration=6.0, people=2, sensors=2)
    persons = [LocalPerson.of(one) for one in find_persons(gather_samples(scene.observations), scene.truth, 0.5)]
    reduced = reduce_persons(persons, scene.truth, NOISE, SHARED_MEAN, THIS_PROCESS)
    people = add_persons(persons, reduced, prior_of(2) > 0, SHAPE)
    direction, other = np.random.default_rng(1).normal(size=(2, len(people.gradient)))
    information, gradient = (
        eliminate_direction(one, people.information, direction) for one in (people.information, people.gradient)
    )
    assert abs(information @ direction).max() < 1e-9 * (direction @ people.information @ direction)
    assert abs(gradient @ direction) < 1e-9 * abs(people.gradient).max()
    # What is left of another direction is the least information over all moves along the first.
    moves = other + np.linspace(-5, 5, 20001)[:, None] * direction
    least = np.einsum("mi,ij,mj->m", moves, people.information, moves).min()
    np.testing.assert_allclose(other @ information @ other, least, rtol=2e-3)
