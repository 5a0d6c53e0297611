"""Captures left out: errors are as noise and covariances say where all is right, and show what is not."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import t as student

from bundle_scenes import LEVER, Scene, remeasured, scene
from calgraph.errors import InputError
from calgraph.geometry import se3
from calgraph.result import HeldOutError
from calgraph.rig.bundle.bundle_solver import Bundle, linearize_bundle, minimize_bundle
from calgraph.rig.bundle.corner_observations import CornerObservations
from calgraph.rig.bundle.observations import relative_poses
from calgraph.rig.bundle.solution import SolvedBundle
from calgraph.rig.checks.cross_validation import (
    _observes_tilt,
    _predict_boards,
    _solve_boards,
    cross_validate,
    view_jacobians,
)

SEEDS, SWAY = 12, 0.001


def left_out(exact: Scene, bundle: Bundle, folds: int = 4, jobs: int = 1) -> dict[str, HeldOutError]:
    """Cross-validation of a bundle whose every capture shows one board."""
    solved = minimize_bundle(bundle, exact.truth)
    boards = np.arange(len(exact.truth.T_root_board))
    return cross_validate(SolvedBundle(bundle, solved, boards), folds, jobs=jobs)


def test_errors_are_as_large_as_noise_and_covariances_say() -> None:
    exact = scene(boards=16)
    found = []
    for seed in range(SEEDS):
        predicted = left_out(exact, exact.measured(np.random.default_rng(seed), view_bias=SWAY))
        found.append([predicted[name].ratio ** 2 for name in exact.bundle.sensors])
    spread = np.std(found, axis=0, ddof=1) / np.sqrt(SEEDS)
    # Right in 99 of 100 such tests, of three sensors each.
    assert np.all(np.abs(np.mean(found, axis=0) - 1) < student.ppf(1 - 0.01 / 6, SEEDS - 1) * spread)
    assert np.all(spread < 0.15)


def test_errors_are_in_pixels_metres_and_radians() -> None:
    exact = scene()
    predicted = left_out(exact, exact.measured(np.random.default_rng(0), view_bias=SWAY))
    assert [predicted[name].unit for name in ("lidar", "camera", "laser")] == ["m", "px", "m"]
    # Corners err by 0.3 px in x and y; ranges by 12 mm, to the plane by less.
    assert 0.3 * np.sqrt(2) * 0.9 < predicted["camera"].rms < 0.3 * np.sqrt(2) * 2
    assert predicted["lidar"].along == pytest.approx(0.012, rel=0.1)
    assert predicted["camera"].along is None
    assert 0.007 < predicted["lidar"].rms < 0.012
    assert np.degrees(predicted["camera"].tilt or 90) < 1
    assert predicted["laser"].tilt is None


def test_predictions_have_the_covariance_of_the_others_boards_and_of_all_sensors() -> None:
    exact = scene(("camera", "camera", "lidar"), boards=6)
    equations = linearize_bundle(exact.bundle, exact.truth)
    P, sensor = equations.covariance, 1
    _, found = _predict_boards(exact.bundle, equations, P, sensor)
    of_sensor, of_board = view_jacobians(equations.views[sensor])
    G = len(P)
    for v, board in enumerate(exact.bundle.views[sensor].board.tolist()):
        others = np.zeros((6, G + 6))
        for k in (0, 2):
            at, columns = equations.views[k], exact.bundle.columns(k)
            weighted = at.J_board[board].T @ at.information[board]
            others[:, columns] += weighted @ at.J_sensor[board]
            others[:, G:] += weighted @ at.J_board[board]
        # Errors of the board are those of its own views, and follow those of the sensors.
        alone = np.linalg.inv(others[:, G:])
        follow = np.concatenate([np.eye(G), -alone @ others[:, :G]])
        joint = follow @ P @ follow.T
        joint[G:, G:] += alone
        J = np.zeros((6, G + 6))
        J[:, exact.bundle.columns(sensor)], J[:, G:] = of_sensor[v], of_board[v]
        np.testing.assert_allclose(found[v], J @ joint @ J.T, atol=1e-6 * np.abs(found[v]).max())


def test_processes_do_not_change_the_errors() -> None:
    exact = scene()
    bundle = exact.measured(np.random.default_rng(0), view_bias=SWAY)
    assert left_out(exact, bundle, jobs=3) == left_out(exact, bundle)


def test_errors_that_every_view_of_a_sensor_shares_do_not_hide() -> None:
    exact = scene()
    bundle = exact.measured(np.random.default_rng(0), view_bias=SWAY)
    lidar, camera, laser = bundle.views
    assert isinstance(camera, CornerObservations)
    # A focal length that is off by three in a hundred: poses follow, the rest shows in captures left out.
    centre = np.array([[camera.camera.K[0, 2], camera.camera.K[1, 2]]])
    wrong = replace(camera, pixels=centre + 1.03 * (camera.pixels - centre))
    predicted = left_out(exact, replace(bundle, views=(lidar, wrong, laser)))
    assert predicted["camera"].ratio > 1.5


def test_sensors_alone_with_a_board_are_not_predicted() -> None:
    exact = scene(("lidar", "laser"))
    lidar, laser = exact.measured(np.random.default_rng(0)).views
    first = np.arange(20) < 10
    bundle = replace(exact.bundle, views=(lidar.select(first), laser))
    predicted = left_out(exact, bundle)
    assert {name: p.captures for name, p in predicted.items()} == {"lidar": 10, "laser": 10}


def test_sensors_without_views_in_the_other_captures_are_not_predicted() -> None:
    exact = scene()
    lidar, camera, laser = exact.measured(np.random.default_rng(0)).views
    once = np.arange(20) == 3
    assert set(left_out(exact, replace(exact.bundle, views=(lidar, camera, laser.select(once))))) == {
        "lidar",
        "camera",
    }


@pytest.mark.parametrize("folds", [2, 5, 8, 20])
def test_every_view_is_held_out_once(folds: int) -> None:
    """Also with as many folds as captures, and with more."""
    exact = scene(boards=8)
    predicted = left_out(exact, exact.measured(np.random.default_rng(0)), folds)
    assert [predicted[name].captures for name in exact.bundle.sensors] == [8, 8, 8]


def test_a_capture_of_two_boards_is_one() -> None:
    exact = scene(boards=12)
    bundle = exact.measured(np.random.default_rng(0))
    captures = np.array([0, 0, 1, 1, 2, 2, 4, 4, 7, 7, 7, 9])
    predicted = cross_validate(SolvedBundle(bundle, minimize_bundle(bundle, exact.truth), captures), 3)
    assert [predicted[name].captures for name in exact.bundle.sensors] == [6, 6, 6]


@pytest.mark.parametrize(("stddev", "compared"), [(1e-4, False), (0.1, True)])
def test_tilts_are_compared_of_views_that_determine_them(
    stddev: float, compared: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Views of the camera determine the tilt of a board to some milliradians."""
    monkeypatch.setattr("calgraph.rig.checks.cross_validation._COMPARED_TILT_STDDEV", stddev)
    exact = scene(boards=8)
    bundle = exact.measured(np.random.default_rng(0))
    solved = SolvedBundle(bundle, minimize_bundle(bundle, exact.truth), np.arange(8))
    found = cross_validate(solved, 4)
    assert (found["camera"].tilt is not None) == compared


def test_one_fold_is_refused() -> None:
    exact = scene()
    with pytest.raises(InputError, match="`folds`: must be 0 for none, or 2 and more, got 1"):
        left_out(exact, exact.bundle, folds=1)


def test_held_out_boards_are_located_with_sensors_fixed() -> None:
    """Noiseless views locate boards that start 20 mm and 1 degree off, to which one step is accurate to 0.1 mm."""
    exact = scene(boards=8).without_bias()
    off = np.repeat([0.02, np.radians(1)], 3) * np.random.default_rng(0).choice([-1, 1], (8, 6))
    start = replace(exact.truth, T_root_board=se3.retract(exact.truth.T_root_board, off))
    state, _ = _solve_boards(exact.bundle, start, linearize_bundle(exact.bundle, exact.truth).cache)
    np.testing.assert_array_equal(state.T_root_sensor, exact.truth.T_root_sensor)
    np.testing.assert_allclose(se3.difference(state.T_root_board, exact.truth.T_root_board), 0, atol=2e-5)


@pytest.mark.parametrize(("deviations", "determined"), [(2.1, True), (1.9, False)])
def test_tilt_is_determined_by_views_of_smaller_standard_deviation(deviations: float, determined: bool) -> None:
    """Of 10 mm on the board, at a lever of 0.5 m."""
    A = np.eye(6)[None] / 0.01**2
    assert _observes_tilt(A, np.eye(4)[None], 0.5, deviations * 0.01).tolist() == [determined]


@pytest.mark.parametrize(("limit", "determined"), [(1.1, True), (0.9, False)])
def test_a_tilt_that_is_not_observed_is_uncertain_by_one_radian(limit: float, determined: bool) -> None:
    """Also with a seventh unknown."""
    assert _observes_tilt(np.zeros((1, 7, 7)), np.eye(4)[None], 0.5, limit).tolist() == [determined]


@pytest.mark.parametrize("first", [0, 3])
def test_the_expected_error_of_a_view_contains_its_bias(first: int) -> None:
    """Views of the camera without noise, all of them off by one standard deviation along, or about, three axes.

    With biases of 20 mm and 2°, everything else is negligible: half of the six degrees of freedom have an error.
    """
    exact = scene(boards=40)
    stddevs = np.array([1e-4, 0.02, 1e-4])[:, None] * [1, 1 / LEVER, 0, 0]
    bundle = replace(exact.bundle, bias_variance=stddevs**2)
    signs = np.zeros((40, 6))
    signs[:, first : first + 3] = np.random.default_rng(0).choice([-1, 1], (40, 3))
    T = relative_poses(exact.truth.T_root_sensor[1], exact.truth.T_root_board)
    off = se3.retract(T, signs * np.sqrt(bundle.bias_variances(1).pose))
    lidar, camera, laser = bundle.views
    camera = remeasured(camera, off, np.random.default_rng(0), noise=0.0)
    predicted = left_out(exact, replace(bundle, views=(lidar, camera, laser)))
    assert predicted["camera"].ratio == pytest.approx(np.sqrt(0.5), rel=0.1)
