"""Ranges to ellipses agree with the simulation, and their derivatives with finite differences."""

import numpy as np
import pytest

from calgraph.geometry import Array
from calgraph.network.joint.ellipses import RaycastHits
from calgraph.network.joint.scanner_unknowns import rotate_by_small_angles
from calgraph.simulation.network_beams import cast_ellipses
from network_scenes import meet_ellipses

ORIGIN = np.zeros((1, 2))


def sample_beams(rng: np.random.Generator, count: int, nearest: float, farthest: float) -> tuple[Array, ...]:
    """Random beams and ellipses, some of which they miss: arguments of ``cast``."""
    origin = rng.uniform(-30, 30, (count, 2))
    bearing = rng.uniform(-np.pi, np.pi, count)
    radii = rng.uniform(0.05, 0.5, (count, 2))
    distance = radii.max(axis=1) + rng.uniform(nearest, farthest, count)
    centre = origin + distance[:, None] * np.column_stack([np.cos(bearing), np.sin(bearing)])
    aim = bearing + rng.uniform(-1, 1, count) * np.arcsin(radii.max(axis=1) / distance)
    direction = np.column_stack([np.cos(aim), np.sin(aim)])
    return origin, direction, centre, rng.uniform(-10, 10, count), radii


def differentiate(arguments: tuple[Array, ...], step: float = 1e-6) -> Array:
    """(N, 5) the Jacobian by central differences."""
    origin, direction, centre, heading, radii = arguments
    columns = []
    for k in range(5):
        step_k = step * np.eye(5)[k]
        ahead, behind = (
            meet_ellipses(
                origin, direction, centre + s * step_k[:2], heading + s * step_k[2], radii + s * step_k[3:]
            ).ranges
            for s in (1, -1)
        )
        columns.append((ahead - behind) / (2 * step))
    return np.column_stack(columns)


def cast_beam(angle: float, centre: tuple[float, float], heading: float) -> RaycastHits:
    """One beam from the origin to a person."""
    direction = np.array([[np.cos(angle), np.sin(angle)]])
    return meet_ellipses(ORIGIN, direction, np.array([centre]), np.array([heading]), np.array([[0.25, 0.15]]))


def test_ranges_equal_those_of_the_simulation(rng: np.random.Generator) -> None:
    origin, direction, centre, heading, radii = sample_beams(rng, 500, 0.01, 20)
    angles = np.arctan2(direction[:, 1], direction[:, 0])
    expected = [
        cast_ellipses(origin[k], angles[k : k + 1], centre[k : k + 1], heading[k : k + 1], radii[k])[0]
        for k in range(500)
    ]
    ranges = meet_ellipses(origin, direction, centre, heading, radii).ranges
    np.testing.assert_allclose(np.where(np.isnan(ranges), np.inf, ranges), expected, rtol=1e-7)


@pytest.mark.parametrize(("nearest", "farthest"), [(1.0, 20.0), (0.01, 0.2), (50.0, 100.0)])
def test_the_jacobian_equals_finite_differences(nearest: float, farthest: float, rng: np.random.Generator) -> None:
    arguments = sample_beams(rng, 2000, nearest, farthest)
    hits = meet_ellipses(*arguments)
    not_grazing = hits.cos_incidence > 0.1
    np.testing.assert_allclose(
        hits.jacobian[not_grazing], differentiate(arguments)[not_grazing], rtol=1e-3, atol=1e-3
    )


def test_the_jacobian_equals_finite_differences_at_grazing_incidence(rng: np.random.Generator) -> None:
    arguments = sample_beams(rng, 20000, 1.0, 5.0)
    hits = meet_ellipses(*arguments)
    grazing = (hits.cos_incidence > 0.02) & (hits.cos_incidence < 0.1)
    expected = differentiate(arguments, step=1e-8)[grazing]
    size = np.abs(expected).max(axis=1, keepdims=True)
    np.testing.assert_allclose(hits.jacobian[grazing] / size, expected / size, atol=1e-3)


def test_a_beam_at_the_front_depends_on_distance_and_second_radius() -> None:
    hits = cast_beam(0.0, (3.0, 0.0), 0.0)
    np.testing.assert_allclose(hits.jacobian[0], [1, 0, 0, 0, -1], atol=1e-12)


def test_a_beam_at_the_side_hits_the_first_radius() -> None:
    hits = cast_beam(0.0, (3.0, 0.0), np.pi / 2)
    assert hits.ranges[0] == pytest.approx(2.75)


def test_perpendicular_incidence_has_a_cosine_of_one() -> None:
    assert cast_beam(0.0, (3.0, 0.0), 0.0).cos_incidence[0] == pytest.approx(1.0)


def test_a_beam_that_misses_has_no_range() -> None:
    assert np.isnan(cast_beam(0.2, (3.0, 0.0), 0.0).ranges[0])


def test_a_beam_that_misses_has_no_incidence() -> None:
    assert np.isnan(cast_beam(0.2, (3.0, 0.0), 0.0).cos_incidence[0])


def test_ranges_are_equal_for_opposite_headings() -> None:
    forward, reversed_heading = (cast_beam(0.03, (3.0, 0.1), heading).ranges[0] for heading in (0.4, 0.4 + np.pi))
    assert forward == pytest.approx(reversed_heading)


def test_small_rotations_are_exact_to_the_stated_error() -> None:
    heading, angle = np.meshgrid(np.linspace(0, 6, 25), np.linspace(-0.1, 0.1, 21))
    rotated = rotate_by_small_angles(np.cos(heading), np.sin(heading), angle)
    np.testing.assert_allclose(rotated, [np.cos(heading + angle), np.sin(heading + angle)], atol=2e-9)
