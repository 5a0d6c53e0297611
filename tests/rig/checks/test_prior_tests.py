"""Tests of priors and rigid groups: which are contradicted by the captures, and by how much."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.special import chdtrc

from bundle_scenes import Scene, scene, views_of
from bundles_with_priors import EXACT, PAIR, STDDEV, group_of, grouped, with_prior
from calgraph.geometry import se3
from calgraph.rig.bundle.bundle_parameters import SensorPrior
from calgraph.rig.bundle.bundle_solver import minimize_bundle
from calgraph.rig.bundle.covariances import pose_covariance
from calgraph.rig.bundle.observations import relative_poses
from calgraph.rig.bundle.priors import assign_bodies
from calgraph.rig.checks.prior_tests import _format_discrepancy, find_contradicted_priors

SEEDS = 16


def test_correct_priors_and_groups_pass_their_test() -> None:
    # Chance would have it once in ten thousand for each.
    for seed in range(SEEDS):
        rng = np.random.default_rng(seed)
        bundle = with_prior(EXACT.measured(rng), 1, STDDEV * rng.normal(size=6))
        group = group_of(EXACT, PAIR)
        assert find_contradicted_priors(bundle, minimize_bundle(bundle, EXACT.truth), [], 1e-3) == {}
        bundle = replace(bundle, body=assign_bodies(bundle.sensors, [group]))
        assert find_contradicted_priors(bundle, grouped(bundle, group), [group], 1e-3) == {}


def test_a_wrong_prior_is_reported_with_its_size(rng: np.random.Generator) -> None:
    bundle = with_prior(EXACT.measured(rng), 1, np.array([0, 0, 0.2, 0, 0, 0]))
    contradicted = find_contradicted_priors(bundle, minimize_bundle(bundle, EXACT.truth), [], 1e-3)
    assert set(contradicted) == {"camera"}
    # Ten standard deviations of the prior, to which those of the captures add little.
    numbers = contradicted["camera"].removeprefix("the prior of camera disagrees with the captures by ").split()
    assert 9 < float(numbers[0]) < 11
    assert 185 < float(numbers[3].lstrip("(")) < 210


def test_a_wrong_group_is_reported_by_its_sensors(rng: np.random.Generator) -> None:
    group = group_of(EXACT, PAIR, wrong=np.array([0.03, 0, 0, 0, 0, 0]))
    bundle = replace(EXACT.measured(rng), body=assign_bodies(EXACT.bundle.sensors, [group]))
    contradicted = find_contradicted_priors(bundle, grouped(bundle, group), [group], 1e-3)
    assert set(contradicted) == set(PAIR)
    assert all("the rigid group of" in why and "in rig: released" in why for why in contradicted.values())


def stated_deviations(reason: str) -> float:
    """Standard deviations in the reason of a contradiction."""
    return float(reason.split(" standard deviations", maxsplit=1)[0].rsplit(maxsplit=1)[-1])


def test_priors_and_groups_are_contradicted_at_the_stated_probability(rng: np.random.Generator) -> None:
    """Statistics of six degrees of freedom, on either side of their chi-squared limit."""
    measured, group = EXACT.measured(rng), group_of(EXACT, PAIR, wrong=np.array([0.015, 0, 0, 0, 0, 0]))
    prior = with_prior(measured, 1, np.array([0, 0, 0.1, 0, 0, 0]))
    grouped_bundle = replace(measured, body=assign_bodies(EXACT.bundle.sensors, [group]))
    for bundle, solved, groups, name in (
        (prior, minimize_bundle(prior, EXACT.truth), [], "camera"),
        (grouped_bundle, grouped(grouped_bundle, group), [group], "laser"),
    ):
        deviations = stated_deviations(find_contradicted_priors(bundle, solved, groups, 0.01)[name])
        below, above = chdtrc(6, (deviations + 0.06) ** 2), chdtrc(6, (deviations - 0.06) ** 2)
        assert name not in find_contradicted_priors(bundle, solved, groups, below)
        assert name in find_contradicted_priors(bundle, solved, groups, above)


def test_of_sensors_fixed_to_the_root_the_one_that_is_not_is_named(rng: np.random.Generator) -> None:
    group = group_of(EXACT, ("lidar", "laser", "camera"), wrong=np.array([0, 0.03, 0, 0, 0, 0]))
    bundle = replace(EXACT.measured(rng), body=assign_bodies(EXACT.bundle.sensors, [group]))
    contradicted = find_contradicted_priors(bundle, grouped(bundle, group), [group], 1e-3)
    assert "the rigid group of camera and lidar, laser in rig: released, camera moves by" in contradicted["camera"]


def test_a_sensor_without_captures_is_reported() -> None:
    bundle = EXACT.bundle
    blind = replace(bundle, views=(*bundle.views[:3], bundle.views[3].select(np.zeros(8, dtype=bool))))
    blind = with_prior(blind, 3, np.zeros(6))
    solution = minimize_bundle(blind, EXACT.truth)
    assert find_contradicted_priors(blind, solution, [], 1e-3) == {
        "laser_2": "no capture connects laser_2 to another sensor: its pose is the prior; record captures in "
        "which it and another sensor detect the board"
    }
    np.testing.assert_allclose(
        pose_covariance(blind, solution.state, solution.equations)[18:, 18:],
        np.diag(STDDEV**2),
        rtol=1e-4,
        atol=1e-12,
    )


@pytest.mark.parametrize(
    ("error", "expected"),
    [
        ((0.002, 0.003, 0.006, 0, 0, 0), "3.0 standard deviations (7 mm, 0.00°)"),
        ((0, 0, 0, 0.02, 0.03, 0.06), "3.0 standard deviations (0 mm, 4.01°)"),
    ],
)
def test_a_discrepancy_is_the_length_of_the_translation_and_the_angle(
    error: tuple[float, ...], expected: str
) -> None:
    assert _format_discrepancy(9.0, np.array(error)) == expected


@pytest.mark.parametrize("seed", range(4))
def test_of_a_group_with_the_root_the_other_sensor_is_released(seed: int) -> None:
    """Releasing the root instead fits equally well, but it is where all poses are expressed."""
    group = group_of(EXACT, ("lidar", "laser"), wrong=np.array([0, 0.03, 0, 0, 0, 0]))
    bundle = EXACT.measured(np.random.default_rng(seed))
    bundle = replace(bundle, body=assign_bodies(bundle.sensors, [group]))
    contradicted = find_contradicted_priors(bundle, grouped(bundle, group), [group], 1e-3)
    assert list(contradicted) == ["laser"]
    assert "the rigid group of laser and lidar in rig: released, laser moves by" in contradicted["laser"]


def test_the_discrepancy_of_a_prior_is_along_directions_that_captures_determine(rng: np.random.Generator) -> None:
    """Two 3-D scanners with all boards facing them: 0.2 m along the normals, nothing along the boards."""
    exact = scene(("lidar", "lidar_2"), boards=8)
    T_root_board = se3.pose(exact.truth.T_root_board[:1, :3, :3], exact.truth.T_root_board[:, :3, 3])
    truth = replace(exact.truth, T_root_board=T_root_board)
    views = tuple(views_of("lidar", relative_poses(T, T_root_board)) for T in truth.T_root_sensor)
    bundle = Scene(replace(exact.bundle, views=views), truth).measured(rng, noise=0.01)
    off = np.concatenate([0.2 * T_root_board[0, :3, 2], np.zeros(3)])
    prior = SensorPrior(1, se3.retract(truth.T_root_sensor[1], off), np.diag(STDDEV**-2))
    bundle = replace(bundle, priors=(prior,))
    contradicted = find_contradicted_priors(bundle, minimize_bundle(bundle, truth), [], 1e-3)
    assert 195 < float(contradicted["lidar_2"].split("(")[1].split(" mm")[0]) < 205
