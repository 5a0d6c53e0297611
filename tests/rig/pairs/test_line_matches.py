from collections.abc import Callable

import numpy as np
import pytest

from board_scenes import SIZE, make_boards, make_patch, make_segment, random_pose
from calgraph.geometry import Array, plane, se3, so3
from calgraph.rig.pairs.line_matches import (
    LineLineMatches,
    PlaneLineMatches,
    _regularized_coplanarity,
    axis_aligned_rotations,
    evaluate_coplanarity,
)


def numerical(f: Callable[[Array, Array], Array], x: Array, size: int) -> Array:
    h = 1e-6
    return np.stack([(f(x, h * e) - f(x, -h * e)) / (2 * h) for e in np.eye(size)], axis=-1)


@pytest.mark.parametrize("seed", range(5))
def test_coplanarity_derivatives(seed: int) -> None:
    rng = np.random.default_rng(seed)
    T = se3.pose(so3.exp(rng.normal(size=3)), rng.normal(size=3))
    a, b = rng.normal(size=(2, 2, 3))
    _, by_pose, by_a, by_b = evaluate_coplanarity(T, a, b)
    np.testing.assert_allclose(
        by_pose, numerical(lambda T, d: evaluate_coplanarity(se3.retract(T, d), a, b)[0], T, 6), atol=1e-7
    )
    np.testing.assert_allclose(
        by_a, numerical(lambda a, d: evaluate_coplanarity(T, a + d.reshape(2, 3), b)[0], a, 6), atol=1e-7
    )
    np.testing.assert_allclose(
        by_b, numerical(lambda b, d: evaluate_coplanarity(T, a, b + d.reshape(2, 3))[0], b, 6), atol=1e-7
    )


def test_coplanarity_is_the_gap_along_the_intersection_of_the_scan_planes() -> None:
    """Scan planes that cross at right angles along x; both lines at 90 degrees to x, 0.1 m apart there."""
    T_a_b = se3.pose(so3.exp(np.array([np.pi / 2, 0, 0])), np.zeros(3))
    a = np.array([[1.0, -0.3, 0], [1.0, 0.3, 0]])
    b = np.array([[1.1, -0.3, 0], [1.1, 0.3, 0]])
    assert abs(evaluate_coplanarity(T_a_b, a, b)[0]) == pytest.approx(0.1)


DIAGONAL = float(np.hypot(*SIZE))


def plane_line(
    T_a_b: Array, rng: np.random.Generator, count: int = 200, sigma: float = 1e-12, tilt: float = 0.6
) -> PlaneLineMatches:
    boards = make_boards(rng, count, tilt=tilt)
    pairs = [
        (make_patch(T, rng, sigma), segment)
        for T in boards
        if (segment := make_segment(se3.inverse(T_a_b) @ T, rng, sigma)) is not None
    ]
    rows = [(p.plane, p.covariance, p.center, s.endpoints, s.covariance) for p, s in pairs]
    planes, covariances_a, centers, endpoints, covariances_b = (
        np.array(column) for column in zip(*rows, strict=True)
    )
    return PlaneLineMatches(planes, covariances_a, centers, endpoints, covariances_b, DIAGONAL)


def line_line(T_a_b: Array, rng: np.random.Generator, count: int = 200, sigma: float = 1e-12) -> LineLineMatches:
    rows = [
        (of_a.endpoints, of_a.covariance, of_b.endpoints, of_b.covariance)
        for T in make_boards(rng, count)
        if (of_a := make_segment(T, rng, sigma)) is not None
        and (of_b := make_segment(se3.inverse(T_a_b) @ T, rng, sigma)) is not None
    ]
    a, covariances_a, b, covariances_b = (np.array(column) for column in zip(*rows, strict=True))
    return LineLineMatches(a, covariances_a, b, covariances_b, DIAGONAL)


def tilted_pose() -> Array:
    return se3.pose(so3.exp(np.array([0.4, 0.2, 0.9])), np.array([0.2, -0.1, 0.15]))


def test_five_exact_lines_on_planes_determine_the_pose(rng: np.random.Generator) -> None:
    matches = plane_line(tilted_pose(), rng)
    assert matches.sample_size == 5
    samples = np.arange(len(matches.planes) // 5 * 5).reshape(-1, 5)
    found = matches.solve(samples)
    error = np.linalg.norm(se3.difference(found, np.broadcast_to(tilted_pose(), found.shape)), axis=-1)
    assert len(samples) >= 15
    assert (error < 1e-5).mean() > 0.9


def test_upright_boards_leave_an_upright_scanner_upright(rng: np.random.Generator) -> None:
    # Height, roll and pitch are unobservable: they keep the values of the axis-aligned start.
    T_a_b = se3.pose(so3.exp(np.array([0, 0, 0.3])), np.array([0.2, -0.1, 0.0]))
    matches = plane_line(T_a_b, rng, 24, tilt=0.0)
    assert matches.sample_size == 3
    found = matches.solve(np.arange(24).reshape(-1, 3))
    assert np.median(np.abs(se3.difference(found, np.broadcast_to(T_a_b, found.shape))), axis=0).max() < 1e-3


def test_local_minima_include_the_pose_and_the_scanner_upside_down(rng: np.random.Generator) -> None:
    T_a_b = se3.pose(so3.exp(np.array([0, 0, 0.3])), np.array([0.2, -0.1, 0.0]))
    matches = plane_line(T_a_b, rng, 12, tilt=0.0)
    minima = matches.find_local_minima(np.ones(len(matches.planes), dtype=bool))
    assert minima.shape == (24, 4, 4)
    error = np.linalg.norm(se3.difference(minima, np.broadcast_to(T_a_b, minima.shape)), axis=-1)
    assert error.min() < 1e-5
    assert error.max() > 1.0


@pytest.mark.parametrize("build", [plane_line, line_line])
def test_jacobians_are_derivatives(
    build: Callable[..., PlaneLineMatches | LineLineMatches], rng: np.random.Generator
) -> None:
    matches, T, h = build(tilted_pose(), rng, 40, 0.003), tilted_pose(), 1e-6
    numeric = [
        (matches.linearize(se3.retract(T, h * e)[None]).residuals[0]
         - matches.linearize(se3.retract(T, -h * e)[None]).residuals[0]) / (2 * h)
        for e in np.eye(6)
    ]  # fmt: skip
    np.testing.assert_allclose(matches.linearize(T[None]).jacobian[0], np.stack(numeric, axis=-1), atol=1e-6)


def test_covariance_of_distances_from_a_plane_is_their_scatter(rng: np.random.Generator) -> None:
    T_a_b, count = tilted_pose(), 4000
    one = plane_line(T_a_b, rng, 20, 0.003)
    ends = rng.multivariate_normal(np.zeros(6), one.covariances_b[0], count).reshape(-1, 2, 3)
    planes = plane.retract(one.planes[:1], rng.multivariate_normal(np.zeros(3), one.covariances_a[0], count))
    drawn = PlaneLineMatches(
        planes, np.zeros((count, 3, 3)), np.zeros((count, 3)), one.endpoints[:1] + ends, np.zeros((count, 6, 6)),
        DIAGONAL,
    )  # fmt: skip
    stated = one.linearize(T_a_b[None]).covariance[0, 0]
    found = np.cov(drawn.linearize(T_a_b[None]).residuals[0].T)
    np.testing.assert_allclose(found, stated, atol=0.08 * stated.max())


def test_covariance_of_coplanarity_is_its_scatter(rng: np.random.Generator) -> None:
    T_a_b, count = tilted_pose(), 4000
    one = line_line(T_a_b, rng, 40, 0.003)
    a, b = (
        endpoints[:1] + rng.multivariate_normal(np.zeros(6), C[0], count).reshape(-1, 2, 3)
        for endpoints, C in ((one.endpoints_a, one.covariances_a), (one.endpoints_b, one.covariances_b))
    )
    stated = one.linearize(T_a_b[None]).covariance[0, 0, 0, 0]
    assert np.var(evaluate_coplanarity(T_a_b, a, b)[0]) == pytest.approx(stated, rel=0.1)


@pytest.mark.parametrize("build", [plane_line, line_line])
@pytest.mark.parametrize(("away", "expected"), [(0.9, True), (2.1, False)])
def test_detections_farther_apart_than_a_board_are_infeasible(
    build: Callable[..., PlaneLineMatches | LineLineMatches], away: float, expected: bool, rng: np.random.Generator
) -> None:
    # On one board the middles are less than half a diagonal apart.
    T_a_b = tilted_pose()
    matches = build(T_a_b, rng, 60)
    assert matches.feasible(T_a_b[None]).all()
    moved = se3.retract(T_a_b, np.array([0, 0, away * DIAGONAL, 0, 0, 0]))
    assert (matches.feasible(moved[None]).mean() > 0.5) == expected


def test_eight_exact_pairs_of_lines_are_coplanar_under_their_solution(rng: np.random.Generator) -> None:
    matches = line_line(tilted_pose(), rng)
    samples = np.arange(len(matches.endpoints_a) // 8 * 8).reshape(-1, 8)
    found = matches.solve(samples)
    gaps = evaluate_coplanarity(found[:, None], matches.endpoints_a[samples], matches.endpoints_b[samples])[0]
    assert len(samples) >= 5
    assert np.median(np.abs(gaps).max(axis=1)) < 1e-3


def test_parallel_scan_planes_have_no_residual() -> None:
    a, b = np.array([[1.0, -0.3, 0], [1.0, 0.3, 0]]), np.array([[1.1, -0.3, 0], [1.1, 0.4, 0]])
    for angle, finite in ((0.049, False), (0.051, True)):
        T = se3.pose(so3.exp(np.array([angle, 0, 0])), np.zeros(3))
        assert np.isfinite(evaluate_coplanarity(T, a, b)[0]) == finite


def test_axis_aligned_rotations_are_the_24_of_a_cube() -> None:
    R = axis_aligned_rotations()
    assert len({tuple(r.ravel()) for r in R}) == 24
    np.testing.assert_allclose(np.linalg.det(R), 1)
    np.testing.assert_array_equal(np.sort(np.abs(R), axis=-1), np.broadcast_to([0, 0, 1], (24, 3, 3)))


def test_random_mountings_are_solved_from_lines_on_planes(rng: np.random.Generator) -> None:
    T_a_b = random_pose(rng, rotation=1.2)
    matches = plane_line(T_a_b, rng, 400)
    found = matches.solve(np.arange(len(matches.planes) // 5 * 5).reshape(-1, 5))
    error = np.linalg.norm(se3.difference(found, np.broadcast_to(T_a_b, found.shape)), axis=-1)
    assert np.median(error) < 1e-6


def test_derivatives_of_the_regularized_coplanarity(rng: np.random.Generator) -> None:
    T, (a, b) = random_pose(rng), rng.normal(size=(2, 1, 4, 2, 3))

    def residuals(T: Array, d: Array) -> Array:
        return np.asarray(_regularized_coplanarity(se3.retract(T, d)[None], a, b, 0.7)[0][0])

    r, J = _regularized_coplanarity(T[None], a, b, 0.7)
    assert r.shape == (1, 4 + 12)
    np.testing.assert_allclose(J[0], numerical(residuals, T, 6), atol=1e-6)


def test_a_sample_of_one_repeated_match_has_no_solution(rng: np.random.Generator) -> None:
    matches = plane_line(tilted_pose(), rng)
    assert np.isnan(matches.solve(np.zeros((1, 5), dtype=np.intp))).any()


@pytest.mark.parametrize("quarter_turns", range(4))
def test_the_axis_aligned_rotation_of_least_residuals_comes_first(
    quarter_turns: int, rng: np.random.Generator
) -> None:
    """In samples of eight segments with little noise, whose translation is free."""
    R = so3.exp(np.array([0.0, 0.0, quarter_turns * np.pi / 2]))
    matches = plane_line(se3.pose(R, np.array([0.1, 0.2, 0.05])), rng, 300, 0.001)
    chosen = np.arange(len(matches.planes) // 8 * 8).reshape(-1, 8)
    n, d = np.repeat(matches.planes[chosen, :3], 2, axis=1), np.repeat(matches.planes[chosen, 3], 2, axis=1)
    x = matches.endpoints[chosen].reshape(len(chosen), -1, 3)
    found = matches._select_rotations(axis_aligned_rotations(), n, d, x)[:, 0]
    assert np.isclose(found, R).all(axis=(1, 2)).mean() > 0.9


def test_of_similar_solutions_from_upright_boards_the_least_rotated_is_taken(rng: np.random.Generator) -> None:
    """Three noisy segments: without the penalty on rotations, a sixth of the samples has another solution."""
    T_a_b = se3.pose(so3.exp(np.array([0, 0, 0.3])), np.array([0.2, -0.1, 0.0]))
    matches = plane_line(T_a_b, rng, 300, 0.003, tilt=0.0)
    found = matches.solve(np.arange(len(matches.planes) // 3 * 3).reshape(-1, 3))
    error = np.abs(se3.difference(found, np.broadcast_to(T_a_b, found.shape)))[:, [0, 1, 5]].max(axis=1)
    assert (error < 0.05).mean() > 0.95


@pytest.mark.parametrize(("rms", "chosen"), [(0.004, 0), (0.008, 1)])
def test_a_rotation_by_03_rad_outweighs_a_residual_of_6_mm(
    rms: float, chosen: int, rng: np.random.Generator, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The penalty is 20 mm/rad; the second solution is exact, the first one has not left its start."""
    monkeypatch.setattr("calgraph.rig.pairs.line_matches._REFINED_STARTS", 2)
    monkeypatch.setattr("calgraph.rig.pairs.line_matches._ROTATION_PENALTY", 0.02)

    def minimize(_self: object, R: Array, *_: Array) -> tuple[Array, Array]:
        turns = so3.exp(np.array([[0.0, 0.0, 0.0], [0.0, 0.0, 0.3]]))
        return se3.pose(turns @ R, np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0]])), np.array([rms**2, 0.0])

    monkeypatch.setattr(PlaneLineMatches, "_minimize", minimize)
    matches = plane_line(np.eye(4), rng, 12, tilt=0.0)
    assert matches.solve(np.array([[0, 1, 2]]))[0, 0, 3] == chosen
