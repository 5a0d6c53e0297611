"""ICP of walls: exact in observable directions, unchanged in unobservable ones."""

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from calgraph.errors import Rejected
from calgraph.geometry import Array, se2
from calgraph.network.pairs import icp
from calgraph.network.pairs.icp import (
    IcpResult,
    StaticBackground,
    _build_normal_equations,
    _differentiate_by_beam_errors,
    _match_points,
    _SurfacePoints,
    _wall_error_covariance,
    align_backgrounds,
)

SIGMA = 0.01
Wall = tuple[tuple[float, float], tuple[float, float]]
ROOM: list[Wall] = [
    ((-4, -3), (4, -3)), ((4, -3), (4, 3)), ((4, 3), (-4, 3)), ((-4, 3), (-4, -3)), ((1, 3), (1, 1.5)),
]  # fmt: skip
CORRIDOR: list[Wall] = [((-50, -1), (50, -1)), ((-50, 1), (50, 1))]
A = se2.pose(0.2, np.array([-2.0, -0.6]))
B = se2.pose(2.9, np.array([2.5, 0.4]))
T_A_B = se2.inverse(A) @ B
LOOSE = np.diag([0.1, 0.1, 0.05]) ** 2


def scan(walls: list[Wall], T: Array, rng: np.random.Generator, reach: float = 8.0) -> StaticBackground:
    """Points in the sensor's frame on the nearest wall of each beam; NaN where there is none."""
    bearing = np.radians(np.arange(-135, 135, 0.5))
    heading = bearing + se2.angle(T)
    d = np.column_stack([np.cos(heading), np.sin(heading)])
    nearest = np.full(len(d), np.inf)
    for p, q in walls:
        along, offset = np.subtract(q, p), np.subtract(p, T[:2, 2])
        with np.errstate(divide="ignore", invalid="ignore"):
            denominator = d[:, 0] * along[1] - d[:, 1] * along[0]
            r = (offset[0] * along[1] - offset[1] * along[0]) / denominator
            u = (offset[0] * d[:, 1] - offset[1] * d[:, 0]) / denominator
        nearest = np.where((r > 0) & (u >= 0) & (u <= 1) & (r < nearest), r, nearest)
    r = np.where(nearest < reach, nearest + rng.normal(size=len(d)) * SIGMA, np.nan)
    return StaticBackground(np.column_stack([np.cos(bearing), np.sin(bearing)]) * r[:, None])


def aligned(walls: list[Wall], off: Array, covariance: Array, rng: np.random.Generator) -> IcpResult:
    found = align_backgrounds(se2.retract(T_A_B, off), covariance, scan(walls, A, rng), scan(walls, B, rng), SIGMA)
    assert isinstance(found, IcpResult), found
    return found


def distort(
    background: StaticBackground, bias: float, scale: float = 0, angle: float = 0, c: float = 0, d: float = 0
) -> StaticBackground:
    """The background of a scanner without these errors of ranges and angles."""
    azimuth = np.arctan2(background.points[:, 1], background.points[:, 0])
    cos, sin = np.cos(2 * azimuth), np.sin(2 * azimuth)
    ranges = (np.linalg.norm(background.points, axis=1) - bias) / (1 + scale + c * cos + d * sin)
    azimuth = azimuth * (1 + angle) + c * sin - d * cos
    return StaticBackground(np.column_stack([np.cos(azimuth), np.sin(azimuth)]) * ranges[:, None])


@pytest.mark.parametrize("error", range(10))
def test_the_gradient_depends_on_errors_of_ranges_and_angles_as_stated(
    error: int, rng: np.random.Generator
) -> None:
    """For fixed correspondences and constant weights."""
    scans = [scan(ROOM, T, rng) for T in (A, B)]
    a, b = (one.oriented_points for one in scans)
    matches = _match_points(T_A_B, a, b, 0.1)
    errors = np.zeros((2, 5))
    errors.flat[error] = 1e-6

    def gradient(sign: int) -> Array:
        points = (distort(StaticBackground(x.points), *(sign * e)) for x, e in zip((a, b), errors, strict=True))
        of_a, of_b = (replace(x, points=p.points) for x, p in zip((a, b), points, strict=True))
        return _build_normal_equations(T_A_B, of_a, of_b, matches, 1e-4, 1e3)[1]

    found = _differentiate_by_beam_errors(T_A_B, a, b, matches, 1e-4, 1e3)[:, error]
    # The Jacobian depends on the points as well; residuals are 1 cm, lever arms metres.
    numeric = (gradient(1) - gradient(-1)) / 2e-6
    np.testing.assert_allclose(found, numeric, atol=0.03 * float(np.linalg.norm(numeric)))


@pytest.mark.parametrize("walls", [ROOM, CORRIDOR])
def test_a_range_bias_shifts_the_pose_as_stated(walls: list[Wall]) -> None:
    scans = [scan(walls, T, np.random.default_rng(k)) for k, T in enumerate((A, B))]
    found = [
        align_backgrounds(T_A_B, LOOSE, distort(scans[0], bias), scans[1], SIGMA) for bias in (0.0, 0.01, -0.01)
    ]
    nominal, plus, minus = (one for one in found if isinstance(one, IcpResult))
    expected = 0.01 * nominal.by_beam_errors[:, 0]
    # Which points correspond changes with the bias.
    tolerance = 0.3 * float(np.linalg.norm(expected[:2]))
    np.testing.assert_allclose(se2.difference(plus.T_a_b, minus.T_a_b) / 2, expected, atol=tolerance)


@pytest.mark.parametrize("seed", range(5))
def test_a_room_determines_the_pose(seed: int) -> None:
    rng = np.random.default_rng(seed)
    found = aligned(ROOM, rng.normal(size=3) * [0.1, 0.1, 0.05], LOOSE, rng)
    d = se2.difference(found.T_a_b, T_A_B)
    assert np.hypot(d[0], d[1]) < 0.006
    assert np.degrees(abs(d[2])) < 0.1


def test_information_in_a_room_is_consistent_with_the_errors() -> None:
    squared = []
    for seed in range(30):
        rng = np.random.default_rng(seed)
        found = aligned(ROOM, rng.normal(size=3) * [0.05, 0.05, 0.02], LOOSE, rng)
        d = se2.difference(found.T_a_b, T_A_B)
        squared.append(float(d @ found.information @ d))
    # Walls are not as flat, nor scanners as level, as simulated ones: the information allows for that.
    assert np.mean(squared) < 4


def test_information_of_independent_errors_is_consistent(
    rng: np.random.Generator, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("calgraph.network.pairs.icp._CORRELATED_POINTS", 1.0)
    monkeypatch.setattr("calgraph.network.pairs.icp._WALL_ERROR", 1e-6)
    # Points without common errors, with the noise of both scanners.
    squared = []
    for _ in range(40):
        a, b = (StaticBackground(scan(ROOM, T, rng).points) for T in (A, B))
        found = align_backgrounds(T_A_B, LOOSE, a, b, np.sqrt(2) * SIGMA)
        assert isinstance(found, IcpResult), found
        d = se2.difference(found.T_a_b, T_A_B)
        squared.append(d**2 * np.diag(found.information))
    assert (np.mean(squared, axis=0) < 3).all()
    assert (np.mean(squared, axis=0) > 0.2).all()


def test_translation_along_a_corridor_is_unobservable(rng: np.random.Generator) -> None:
    found = aligned(CORRIDOR, np.array([0.0, 0.1, 0.03]), LOOSE, rng)
    along = A[:2, :2].T @ np.array([1.0, 0.0])
    assert along @ found.information[:2, :2] @ along < 1.0  # 1 m or worse


def test_a_corridor_determines_translation_across_it_and_the_angle(rng: np.random.Generator) -> None:
    found = aligned(CORRIDOR, np.array([0.0, 0.1, 0.03]), LOOSE, rng)
    d = se2.difference(found.T_a_b, T_A_B)
    across = A[:2, :2].T @ np.array([0.0, 1.0])
    assert abs(across @ d[:2]) < 0.01
    assert abs(d[2]) < 0.003


def test_a_corridor_keeps_the_initial_translation_along_it(rng: np.random.Generator) -> None:
    off = A[:2, :2].T @ np.array([0.2, 0.0])
    found = aligned(CORRIDOR, np.append(off, 0.0), LOOSE, rng)
    d = se2.difference(found.T_a_b, T_A_B)
    assert A[0, :2] @ d[:2] == pytest.approx(0.2, abs=0.01)


def test_fusion_combines_observable_directions_of_walls_and_tracks(rng: np.random.Generator) -> None:
    R = np.eye(3)
    R[:2, :2] = A[:2, :2].T
    loose_across = R @ np.diag([1e-2, 0.3, 0.05]) ** 2 @ R.T
    off = R @ np.array([0.01, 0.2, 0.03])
    guess = se2.retract(T_A_B, off)
    T, _ = aligned(CORRIDOR, off, loose_across, rng).fuse(guess, np.linalg.inv(loose_across))
    d = se2.difference(T, T_A_B)
    assert np.hypot(d[0], d[1]) < 0.015


def test_walls_that_contradict_the_tracks_are_rejected(rng: np.random.Generator) -> None:
    moved = [((x + 0.4, y), (u + 0.4, v)) for (x, y), (u, v) in ROOM]
    beside = se2.pose(-0.3, np.array([-1.0, 1.0]))
    certain = np.diag([0.03, 0.03, 0.01]) ** 2
    found = align_backgrounds(
        se2.inverse(A) @ beside, certain, scan(ROOM, A, rng), scan(moved, beside, rng), SIGMA
    )
    assert found == Rejected("static background and tracks contradict each other")


def test_a_room_in_the_free_space_of_the_other_scanner_is_rejected(rng: np.random.Generator) -> None:
    small: list[Wall] = [((-1, -3), (-1, 3)), ((4, -3), (4, 3)), ((4, 3), (-1, 3)), ((-1, -3), (4, -3))]
    wide: list[Wall] = [((-4, -3), (5, -3)), ((-4, -3), (-4, 5)), ((5, -3), (5, 5)), ((-4, 5), (5, 5))]
    found = align_backgrounds(T_A_B, LOOSE, scan(wide, A, rng), scan(small, B, rng), SIGMA)
    assert isinstance(found, Rejected)
    assert found.reason == "268 static points of one lie in the free space of the other"


def test_the_two_sides_of_a_thin_wall_are_not_matched(rng: np.random.Generator) -> None:
    wall: list[Wall] = [((0, -6), (0, 6)), ((-5, -6), (-5, 6)), ((5, -6), (5, 6))]
    found = align_backgrounds(T_A_B, LOOSE, scan(wall, A, rng), scan(wall, B, rng), SIGMA)
    assert found == Rejected("only 0 points of the static background overlap")


@pytest.mark.parametrize("along_x", [True, False])
def test_errors_of_a_wall_turn_it_by_its_length(along_x: bool) -> None:
    # Uniform points on 4 m have a standard deviation of 4 / sqrt(12) m along the wall.
    position = np.linspace(-2, 2, 4001)
    x, normal = np.column_stack([position, np.full(4001, 3.0)]), np.tile([0.0, -1.0], (4001, 1))
    if not along_x:
        x, normal = x[:, ::-1], normal[:, ::-1]
    C = _wall_error_covariance(np.eye(3), _SurfacePoints(x, normal), np.arange(4001), 0.01)
    turn = 0.01 * np.sqrt(12) / 4
    assert np.sqrt(C[2, 2]) == pytest.approx(turn, rel=1e-3)
    # A turn about the wall's centre, 3 m away, moves the scanner along the wall.
    along, across = (0, 1) if along_x else (1, 0)
    assert np.sqrt(C[along, along]) == pytest.approx(np.hypot(0.01, 3 * turn), rel=1e-3)
    assert np.sqrt(C[across, across]) == pytest.approx(0.01, rel=1e-3)


def test_hardly_any_background_is_rejected() -> None:
    few = StaticBackground(np.array([[1.0, 0.0], [1.0, 0.1], [1.0, 0.2]]))
    assert align_backgrounds(np.eye(3), LOOSE, few, few, SIGMA) == Rejected("too little static background")


def straight_wall(distance: float, spacing: float, waves: float = 0.0) -> StaticBackground:
    """41 points on a wall ahead of the scanner, displaced to and fro by ``waves``, m."""
    y = spacing * np.arange(-20, 21)
    return StaticBackground(np.column_stack([distance + waves * (-1.0) ** np.arange(41), y]))


@pytest.mark.parametrize(
    ("distance", "spacing", "connected"),
    [(2.0, 0.14, True), (2.0, 0.17, False), (20.0, 0.95, True), (20.0, 1.15, False)],
)
def test_neighbours_are_connected_up_to_a_distance_that_grows_with_the_range(
    distance: float, spacing: float, connected: bool
) -> None:
    """0.15 m, or a twentieth of the range; of 41 points, three at either end have too few neighbours."""
    found = straight_wall(distance, spacing).oriented_points.points
    near = np.abs(found[:, 1]) < distance / 4  # farther away, ranges are larger
    expected = np.abs(spacing * np.arange(-17, 18)) < distance / 4
    assert near.sum() == (expected.sum() if connected else 0)


def test_normals_of_walls_point_to_the_scanner() -> None:
    wall = straight_wall(2.0, 0.1).oriented_points
    assert len(wall.points) == 35
    np.testing.assert_allclose(wall.normals, np.tile([-1.0, 0.0], (35, 1)), atol=1e-12)


@pytest.mark.parametrize(
    ("spacing", "waves", "straight"),
    [(0.13, 0.028, True), (0.13, 0.033, False), (0.03, 0.02, True), (0.03, 0.022, False)],
)
def test_rough_or_short_stretches_have_no_line(spacing: float, waves: float, straight: bool) -> None:
    """Rougher than 3 cm; or less than three times as long as wide: seven points have a length of 2 spacings."""
    assert len(straight_wall(2.0, spacing, waves).oriented_points.points) == (35 if straight else 0)


def test_breaks_separate_walls() -> None:
    points = straight_wall(2.0, 0.1).points.copy()
    points[20] = np.nan
    assert len(StaticBackground(points).oriented_points.points) == 2 * (20 - 6)


@pytest.mark.parametrize("r", [0.0, 0.05, 0.1, 0.19])
def test_weights_are_halved_at_half_of_the_match_distance(r: float) -> None:
    """One point in front of a wall ahead, beside the axis: weight, gradient, and the lever of the angle."""
    wall = _SurfacePoints(np.array([[3.0, 0.0]]), np.array([[-1.0, 0.0]]))
    point = _SurfacePoints(np.array([[3.0 - r, 0.5]]), np.array([[-1.0, 0.0]]))
    match = np.zeros(1, dtype=np.intp), np.zeros(1, dtype=np.intp)
    H, g = _build_normal_equations(np.eye(3), wall, point, match, noise2=0.01, match_distance=0.2)
    weight = 100 / (1 + (r / 0.1) ** 2)
    J = np.array([-1.0, 0.0, 0.5])
    np.testing.assert_allclose(H, weight * np.outer(J, J), atol=1e-12)
    np.testing.assert_allclose(g, weight * r * J, atol=1e-12)


@pytest.mark.parametrize(("stddevs", "contradicts"), [(7.5, False), (9.0, True)])
def test_walls_contradict_tracks_beyond_eight_standard_deviations(
    stddevs: float, contradicts: bool, rng: np.random.Generator, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The square root of 16.3, of twice the standard deviations of the initial pose; those of walls are small."""
    monkeypatch.setattr("calgraph.network.pairs.icp._CORRELATED_POINTS", 1.0)
    monkeypatch.setattr("calgraph.network.pairs.icp._WALL_ERROR", 1e-4)
    a, b = (StaticBackground(scan(ROOM, T, rng).points) for T in (A, B))
    covariance = np.diag([0.02, 1.0, 1.0]) ** 2
    start = se2.retract(T_A_B, np.array([stddevs * 0.02, 0.0, 0.0]))
    found = align_backgrounds(start, covariance, a, b, SIGMA)
    assert (found == Rejected("static background and tracks contradict each other")) == contradicts


@pytest.mark.parametrize(
    ("position", "angle", "expected"),
    [
        (0.2, 0.0, 0.6),
        (0.15, 0.05, 3 * np.sqrt(0.15**2 + 0.05**2 * (2**2 + 0.9**2))),
        (0.1, 0.0, 0.5),
        (0.3, 0.0, 0.8),
    ],
)
def test_the_first_match_distance_is_three_standard_deviations_within_limits(
    position: float, angle: float, expected: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Those of a point at the median distance, sqrt(2² + 0.9²) m, in the direction of larger variance."""
    distances: list[float] = []

    def match_none(_T: Array, _a: object, _b: object, distance: float) -> tuple[Array, Array]:
        distances.append(distance)
        return np.zeros(0), np.zeros(0)

    monkeypatch.setattr(icp, "_match_points", match_none)
    wall = straight_wall(2.0, 0.1)
    align_backgrounds(np.eye(3), np.diag([position, 0.05, angle]) ** 2, wall, wall, SIGMA)
    assert distances == pytest.approx([expected])


def test_the_match_distance_is_reduced_by_a_factor_at_each_step(
    rng: np.random.Generator, monkeypatch: pytest.MonkeyPatch
) -> None:
    """From the 0.6 m of the initial pose to 0.06 m, by 0.7."""
    distances: list[float] = []
    match = icp._match_points

    def record_distance(
        T: Array, a: _SurfacePoints, b: _SurfacePoints, distance: float
    ) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
        distances.append(distance)
        return match(T, a, b, distance)

    monkeypatch.setattr(icp, "_match_points", record_distance)
    align_backgrounds(T_A_B, np.diag([0.2, 0.2, 0.0]) ** 2, scan(ROOM, A, rng), scan(ROOM, B, rng), SIGMA)
    np.testing.assert_allclose(distances[:8], np.maximum(0.6 * 0.7 ** np.arange(8), 0.06))


@pytest.mark.parametrize(("before", "after", "ratio"), [
    ((1e-3, 1e-6, 4.0), (2e-3, 1e-6, 4.0), 4.0),
    ((1e-6, 1e-3, 1000.0), (1e-6, 2e-3, 1000.0), 4.0),
    ((1e-3, 1e-6, 4.0), (1e-3, 1e-6, 8.0), 2.0),
])  # fmt: skip
def test_the_variance_of_points_is_that_of_noise_and_walls_for_all_correlated_points(
    before: tuple[float, float, float],
    after: tuple[float, float, float],
    ratio: float,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Of noise and of walls, m, and the number of correlated points: one is doubled."""
    traces = []
    for sigma, wall_error, points in (before, after):
        rng = np.random.default_rng(0)
        monkeypatch.setattr("calgraph.network.pairs.icp._WALL_ERROR", wall_error)
        monkeypatch.setattr("calgraph.network.pairs.icp._CORRELATED_POINTS", points)
        a, b = (StaticBackground(scan(ROOM, T, rng).points) for T in (A, B))
        found = align_backgrounds(T_A_B, LOOSE, a, b, sigma)
        assert isinstance(found, IcpResult)
        traces.append(np.trace(found.information))
    assert traces[0] / traces[1] == pytest.approx(ratio, rel=1e-3)
