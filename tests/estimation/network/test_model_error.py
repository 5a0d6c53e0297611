"""Sway that simulated bodies have is measured, place and heading, and none where they have none."""

from dataclasses import replace

import numpy as np
import pytest

from calgraph.estimation.network.ellipse_raycast import raycast_ellipses
from calgraph.estimation.network.model_error import estimate_model_error
from calgraph.estimation.network.problem import BodyObservations, BodyPath, BodyScans, NetworkProblem, NetworkState
from calgraph.estimation.network.scan_equations import compute_tukey_weights
from calgraph.estimation.network.splines import Knots, evaluate_spline
from calgraph.geometry import Array
from network_scenes import OFFSET, SIGMA, T_ROOT, glimpses

SECONDS = 60.0
BELIEVED = np.array([0.005, 0.05]) ** 2


def swaying(
    place: float, heading: float, rng: np.random.Generator, radii: tuple[float, float] = (0.25, 0.15)
) -> tuple[NetworkProblem, NetworkState]:
    """A body on a curve between three scanners; each scan of it sees it displaced, m, and turned, rad."""
    knots = Knots.spanning(-0.5, SECONDS + 0.5, 0.2)
    t = 0.9 * knots.control_times()
    path = np.column_stack([3 + 1.4 * np.sin(t), 2.2 + 0.9 * np.sin(1.5 * t + 0.4), t])
    motion = BodyPath(path, np.array(radii))
    times = np.arange(0.05, SECONDS, 0.08)
    seen = tuple(
        displaced(glimpses(s, knots, motion, times, rng), knots, motion, place, heading, rng) for s in range(3)
    )
    body = BodyObservations(knots, seen, motion.radii, 0.1 * motion.radii, faces_forward=False)
    return NetworkProblem(3, (body,), (), np.full(3, SIGMA), BELIEVED, 0.1), NetworkState(
        T_ROOT, OFFSET, (motion,)
    )


def displaced(
    seen: BodyScans, knots: Knots, motion: BodyPath, place: float, heading: float, rng: np.random.Generator
) -> BodyScans:
    """The same beams on a body that is elsewhere in each scan, with their weights about its path."""
    view = np.repeat(np.arange(len(seen.times)), np.diff(seen.first_beam, append=len(seen.ranges)))
    pose = evaluate_spline(motion.control, *knots.basis_at(seen.times - OFFSET[seen.scanner])[:2])[view]
    off = rng.normal(0, [place, place, heading], (len(seen.times), 3))[view]
    T = T_ROOT[seen.scanner]
    direction = seen.direction @ T[:2, :2].T
    origin, radii = np.broadcast_to(T[:2, 2], direction.shape), np.broadcast_to(motion.radii, direction.shape)

    def ranges(at: Array) -> Array:
        return raycast_ellipses(origin, direction, at[:, :2], at[:, 2], radii).ranges

    hit = seen.ranges + ranges(pose + off) - ranges(pose)
    met = np.isfinite(hit)
    hit = np.where(met, hit, seen.ranges)
    return replace(seen, ranges=hit, weight=compute_tukey_weights((ranges(pose) - hit) / SIGMA, met))


def measured(place: float, heading: float, rng: np.random.Generator) -> Array:
    """(2,) root mean square sway of places (m) and headings (rad) measured in several recordings."""
    return np.asarray(
        np.sqrt(np.mean([estimate_model_error(*swaying(place, heading, rng)) for _ in range(6)], axis=0))
    )


# A recording tells a sway of this size to a fifth, in the noise of its scans: six of them to a tenth. Beams that
# are off for the sway count less, so that less of it is seen.
@pytest.mark.parametrize(("place", "heading"), [(0.005, 0.0), (0.005, 0.06)])
def test_the_sway_of_places_is_measured(place: float, heading: float, rng: np.random.Generator) -> None:
    assert 0.7 * place < measured(place, heading, rng)[0] < 1.4 * place


@pytest.mark.parametrize(("place", "heading"), [(0.0, 0.06), (0.003, 0.06)])
def test_the_sway_of_headings_is_measured(place: float, heading: float, rng: np.random.Generator) -> None:
    assert 0.5 * heading < measured(place, heading, rng)[1] < 1.4 * heading


def test_what_does_not_sway_is_not_believed_to(rng: np.random.Generator) -> None:
    assert np.all(measured(0.0, 0.0, rng) < 0.6 * np.sqrt(BELIEVED))


def test_the_sway_of_bodies_that_one_scanner_sees_stays_as_it_is(rng: np.random.Generator) -> None:
    network, state = swaying(0.0, 0.0, rng)
    alone = replace(network.bodies[0], scans=network.bodies[0].scans[:1])
    np.testing.assert_array_equal(estimate_model_error(replace(network, bodies=(alone,)), state), BELIEVED)


def test_nothing_tells_how_a_cylinder_turns(rng: np.random.Generator) -> None:
    assert estimate_model_error(*swaying(0.0, 0.0, rng, radii=(0.2, 0.2)))[1] == BELIEVED[1]
