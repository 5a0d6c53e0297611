"""Corrected points and the estimator have one model of systematic errors: both agree to rounding."""

from dataclasses import replace

import numpy as np
import pytest

from bundle_scenes import scene
from calgraph.geometry import Array
from calgraph.result import Correction, EstimatedParameter
from calgraph.rig.bundle.bundle_parameters import LocalParameters
from calgraph.rig.bundle.observations import relative_poses
from calgraph.rig.bundle.range_observations import RangeObservations
from calgraph.sensors.kinds import KindName, list_beam_errors

# Of the values, in prior standard deviations: large enough for every product of two errors to matter.
SIZE = 3.0


def measured_with_errors(kind: KindName, rings: int) -> tuple[Correction, RangeObservations, Array, Array]:
    """A correction, views that the estimator has no residuals of, and the boards' normals and offsets by beam."""
    true = scene(("laser" if kind == "lidar2d" else "lidar",))
    views, T_root_sensor = true.bundle.views[-1], true.truth.T_root_sensor[-1]
    assert isinstance(views, RangeObservations)
    T = relative_poses(T_root_sensor, true.truth.T_root_board)
    if kind == "depth_camera":
        # The same boards before a sensor whose z axis points ahead.
        optical = np.array([[0.0, -1, 0, 0], [0, 0, -1, 0], [1, 0, 0, 0], [0, 0, 0, 1]])
        T, views = optical @ T, replace(views, directions=views.directions @ optical[:3, :3].T)
    errors = list_beam_errors(kind)
    ring = np.digitize(views.directions[:, 2], np.linspace(-0.1, 0.1, rings - 1)) if rings else None
    count = len(errors) + rings
    blocks = {"beams": slice(0, len(errors)), "varying": slice(len(errors), count)}
    index = np.tile(np.arange(count), (len(views.board), 1))
    views = replace(views, errors=errors, ring=None, parameters=LocalParameters(blocks, index, count))
    views = views if ring is None else views.with_rings(ring)
    prior = np.array([*(one.stddev for one in errors), *[0.01] * rings])
    extra = SIZE * prior * np.random.default_rng(1).choice([-1, 1], count)
    residual = views.linearize(T, extra).residual[:, 0]
    views = replace(views, ranges=views.ranges + residual * views.sigma)
    elevation = np.arcsin(views.directions[:, 2])
    borders = [(elevation[views.ring == k].min(), elevation[views.ring == k].max()) for k in range(rings)]
    names = [*(one.quantity for one in errors), *(f"bias of ring {k}" for k in range(rings))]
    stated = [*(one.stated for one in errors), *[0.0] * rings]
    parameters = tuple(
        EstimatedParameter("x", name, "", at, stddev, at + value, 0.0)
        for name, at, stddev, value in zip(names, stated, prior.tolist(), extra.tolist(), strict=True)
    )
    rings_of = np.array(borders).reshape(-1, 2)
    correction = Correction(kind, parameters, np.zeros((count, count)), 2.0, rings_of)
    beams = np.diff(views.start, append=len(views.ranges))
    normals = np.repeat(T[:, :3, 2], beams, axis=0)
    return correction, views, normals, np.repeat(np.sum(T[:, :3, 2] * T[:, :3, 3], axis=1), beams)


@pytest.mark.parametrize(("kind", "rings"), [("lidar2d", 0), ("lidar3d", 4), ("depth_camera", 0)])
def test_points_that_the_estimator_has_no_residuals_of_are_corrected_onto_the_boards(
    kind: KindName, rings: int
) -> None:
    correction, views, normals, offsets = measured_with_errors(kind, rings)
    points = views.directions * views.ranges[:, None]
    before = np.abs(np.sum(normals * points, axis=1) - offsets)
    after = np.abs(np.sum(normals * correction.correct(points), axis=1) - offsets)
    assert before.max() > 0.03
    assert after.max() < 1e-9
