"""Ranges to the outlines of legs, against points of the outline and numerical derivatives."""

import numpy as np
import pytest

from calgraph.geometry import Array
from calgraph.network.joint.legs import LegHits, raycast_legs


def cast(center: Array, heading: Array, shape: Array, angles: Array) -> LegHits:
    direction = np.stack([np.cos(angles), np.sin(angles)], axis=1)
    return raycast_legs(np.zeros(2), direction, center, heading, shape)


def beams_across(rng: np.random.Generator, reach: float) -> tuple[Array, Array, Array]:
    center = np.array([2.0, 1.0]) + rng.normal(0, 0.02, (200, 2))
    angles = np.arctan2(center[:, 1], center[:, 0]) + rng.uniform(-reach, reach, 200) / np.hypot(2, 1)
    return center, rng.uniform(-3, 3, 200), angles


def test_ranges_end_on_an_ellipse_of_the_stated_depth_and_width() -> None:
    shape = np.array([0.06, 0.01, 0.0, 0.0, 0.0])
    center, heading, angles = beams_across(np.random.default_rng(0), 0.04)
    hits = cast(center, heading, shape, angles)
    off = hits.ranges[:, None] * np.stack([np.cos(angles), np.sin(angles)], axis=1) - center
    along = np.cos(heading) * off[:, 0] + np.sin(heading) * off[:, 1]
    across = -np.sin(heading) * off[:, 0] + np.cos(heading) * off[:, 1]
    # The half axes are r / (1 ∓ a / r₀), with r₀ = 65 mm.
    on_ellipse = (along * (1 - 0.01 / 0.065)) ** 2 + (across * (1 + 0.01 / 0.065)) ** 2
    assert np.sqrt(on_ellipse) == pytest.approx(np.full(200, 0.06), abs=1e-9)


def test_harmonics_displace_the_outline_along_its_normal() -> None:
    center, heading, angles = np.array([[3.0, 0.0]]), np.array([np.pi]), np.zeros(1)
    plain = cast(center, heading, np.array([0.06, 0, 0, 0, 0]), angles).ranges[0]
    bulged = cast(center, heading, np.array([0.06, 0, 0, 0.002, 0.001]), angles).ranges[0]
    assert plain == pytest.approx(2.94)
    assert bulged == pytest.approx(2.937), "both harmonics have their maximum in the direction of the heading"


def test_range_continues_linearly_beyond_the_edge() -> None:
    offset = np.array([0.92, 0.96, 1.0, 1.04]) * 0.06
    center = np.column_stack([np.full(4, 3.0), offset])
    hits = cast(center, np.zeros(4), np.array([0.06, 0, 0, 0, 0]), np.zeros(4))
    assert np.diff(hits.ranges) == pytest.approx(np.full(3, np.diff(hits.ranges)[0]))
    assert np.all(hits.slope == hits.slope[0])


@pytest.mark.parametrize("reach", [0.04, 0.09])
def test_derivatives_are_those_of_the_ranges(reach: float) -> None:
    shape = np.array([0.065, 0.008, 0.002, 0.004, -0.001])
    center, heading, angles = beams_across(np.random.default_rng(1), reach)
    jacobian, h = cast(center, heading, shape, angles).jacobian, 1e-7

    def difference(step: Array) -> Array:
        ends = [
            cast(center + sign * h * step[:2], heading + sign * h * step[2], shape + sign * h * step[3:], angles)
            for sign in (1, -1)
        ]
        return np.asarray((ends[0].ranges - ends[1].ranges) / (2 * h))

    numeric = np.stack([difference(step) for step in np.eye(8)], axis=1)
    assert jacobian == pytest.approx(numeric, abs=1e-6)
