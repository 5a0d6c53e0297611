"""Plane–plane matches: minimal solver, residuals, their derivatives, covariances, and feasible poses."""

import numpy as np
import pytest

from board_scenes import SIZE, make_boards, make_patch, random_pose
from calgraph.geometry import Array, plane, se3, so3
from calgraph.rig.pairs.board_matches import PlanePlaneMatches

RADIUS, DIAGONAL = min(SIZE) / 2, float(np.hypot(*SIZE))


def build_matches(
    T_a_b: Array, boards: Array, rng: np.random.Generator, sigma: float = 0.003
) -> PlanePlaneMatches:
    a = [make_patch(T, rng, sigma) for T in boards]
    b = [make_patch(se3.inverse(T_a_b) @ T, rng, sigma) for T in boards]
    columns = [
        (np.array([p.plane for p in of]), np.array([p.covariance for p in of]), np.array([p.center for p in of]))
        for of in (a, b)
    ]
    return PlanePlaneMatches(*columns[0], *columns[1], RADIUS, DIAGONAL)


def test_three_exact_planes_determine_the_pose(rng: np.random.Generator) -> None:
    T_a_b = random_pose(rng)
    matches = build_matches(T_a_b, make_boards(rng, 30), rng, 1e-12)
    found = matches.solve(np.arange(30).reshape(10, 3))
    solved = np.isfinite(found).all(axis=(1, 2))
    assert solved.sum() >= 8
    np.testing.assert_allclose(found[solved], np.broadcast_to(T_a_b, (solved.sum(), 4, 4)), atol=1e-8)


@pytest.mark.parametrize(("spread", "solvable"), [(0.006, False), (0.02, True)])
def test_nearly_coplanar_normals_have_no_solution(spread: float, solvable: bool) -> None:
    # Normals at -60, 0 and 60 degrees in one plane, tilted out of it by the spread (rad).
    headings = np.radians([-60, 0, 60])
    normals = np.stack([np.cos(headings), np.sin(headings), spread * np.array([1, -1, 1])], axis=-1)
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    planes = np.column_stack([-normals, np.full(3, 2.0)])
    C = np.tile(1e-6 * np.eye(3), (3, 1, 1))
    matches = PlanePlaneMatches(planes, C, 2 * normals, planes, C, 2 * normals, 0.4, 1.5)
    assert np.isfinite(matches.solve(np.array([[0, 1, 2]]))).all() == solvable


def test_residuals_are_distances_of_three_points_around_the_centre() -> None:
    # Plane b is plane a shifted by 0.1 m along the normal, or turned about x by 0.1 rad.
    C = np.zeros((1, 3, 3))
    a, center = np.array([[0.0, 0, -1, 2]]), np.array([[0.0, 0, 2]])
    matches = PlanePlaneMatches(a, C, center, a, C, center, 0.4, 1.5)
    shifted = matches.linearize(se3.pose(np.eye(3), np.array([0, 0, 0.1]))[None])
    np.testing.assert_allclose(shifted.residuals, [[[-0.1, -0.1, -0.1]]], atol=1e-12)
    turn = so3.exp(np.array([0.1, 0, 0]))
    about_center = se3.pose(turn, center[0] - turn @ center[0])
    residuals = matches.linearize(about_center[None]).residuals[0, 0]
    assert residuals.sum() == pytest.approx(0, abs=1e-12)
    assert np.sum(residuals**2) == pytest.approx(1.5 * (0.4 * np.sin(0.1)) ** 2)


def test_jacobian_is_the_derivative(rng: np.random.Generator) -> None:
    T_a_b = random_pose(rng)
    matches = build_matches(T_a_b, make_boards(rng, 4), rng)
    at = matches.linearize(T_a_b[None])
    h = 1e-6
    numeric = [
        (matches.linearize(se3.retract(T_a_b, h * e)[None]).residuals[0]
         - matches.linearize(se3.retract(T_a_b, -h * e)[None]).residuals[0]) / (2 * h)
        for e in np.eye(6)
    ]  # fmt: skip
    np.testing.assert_allclose(at.jacobian[0], np.stack(numeric, axis=-1), atol=1e-7)


def test_covariance_is_the_scatter_of_the_residuals(rng: np.random.Generator) -> None:
    T_a_b, boards = random_pose(rng), make_boards(rng, 1)
    exact = build_matches(T_a_b, boards, rng, 1e-12)
    stated = build_matches(T_a_b, boards, np.random.default_rng(0))
    count = 4000
    planes_a = plane.retract(exact.planes_a, rng.multivariate_normal(np.zeros(3), stated.covariances_a[0], count))
    planes_b = plane.retract(exact.planes_b, rng.multivariate_normal(np.zeros(3), stated.covariances_b[0], count))
    zero = np.zeros((count, 3, 3))
    # Points stay at the centre of the board, as distances along the normal are small.
    centers_a, centers_b = (np.broadcast_to(c, (count, 3)) for c in (exact.centers_a, exact.centers_b))
    on_b = centers_b - plane.distance(planes_b, centers_b[:, None]) * planes_b[:, :3]
    drawn = PlanePlaneMatches(planes_a, zero, centers_a, planes_b, zero, on_b, RADIUS, DIAGONAL)
    residuals = drawn.linearize(T_a_b[None]).residuals[0]
    covariance = stated.linearize(T_a_b[None]).covariance[0, 0]
    np.testing.assert_allclose(np.cov(residuals.T), covariance, rtol=0.15, atol=0.1 * covariance.max())


@pytest.mark.parametrize(("degrees", "expected"), [(0.0, True), (29.0, True), (31.0, False), (79.0, False)])
def test_planes_at_a_large_angle_are_infeasible(degrees: float, expected: bool) -> None:
    C, center = np.zeros((1, 3, 3)), np.array([[0.0, 0, 2]])
    planes = np.array([[0.0, 0, -1, 2]])
    matches = PlanePlaneMatches(planes, C, center, planes, C, center, 0.4, 1.5)
    turn = so3.exp(np.array([0, np.radians(degrees), 0]))
    about_center = se3.pose(turn, center[0] - turn @ center[0])
    assert matches.feasible(about_center[None]).tolist() == [[expected]]


@pytest.mark.parametrize(("shift", "expected"), [(1.49, True), (1.51, False)])
def test_centres_farther_apart_than_a_board_are_infeasible(shift: float, expected: bool) -> None:
    C, center = np.zeros((1, 3, 3)), np.array([[0.0, 0, 2]])
    planes = np.array([[0.0, 0, -1, 2]])
    matches = PlanePlaneMatches(planes, C, center, planes, C, center, 0.4, 1.5)
    T_a_b = se3.pose(np.eye(3), np.array([shift, 0, 0]))
    assert matches.feasible(T_a_b[None]).tolist() == [[expected]]
