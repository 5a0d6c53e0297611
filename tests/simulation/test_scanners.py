import numpy as np
import pytest

from calgraph.geometry import Array, se3, so3
from calgraph.sensors.beam_pattern import BeamPattern, laser_pattern, multibeam_pattern, spinning_pattern
from calgraph.simulation import BeamOptions
from calgraph.simulation.scanners import SceneAt, point_cloud, simulate_ranges
from calgraph.simulation.solids import BoxShape, RectangleShape, Solid

EXACT = BeamOptions(range_noise=0.0, angle_noise=0.0, mixed_pixels=0.0, dropout=0.0, min_range=0.1, max_range=30.0)
QUARTER = np.radians(0.25)


def unchanging(*solids: Solid) -> SceneAt:
    return lambda _start, _end: [(np.inf, solids)]


def wall(x: float) -> Solid:
    return Solid(BoxShape(1.0, 40.0, 40.0), se3.pose(np.eye(3), np.array([x + 0.5, 0.0, 0.0])))


def spinning(tilt: float = 0.0, offset: float = 0.0) -> BeamPattern:
    laser = laser_pattern(np.radians(270), np.radians(0.5), 0.02)
    return spinning_pattern(laser, 0.02, tilt, offset, 1 / 3, np.pi)


def many(pattern: BeamPattern, scene: SceneAt, noise: BeamOptions, times: int, rng: np.random.Generator) -> Array:
    """(times, N) ranges."""
    return np.stack([simulate_ranges(pattern, np.eye(4), 0.0, scene, noise, rng) for _ in range(times)])


def test_exact_laser_measures_a_wall_where_it_is(rng: np.random.Generator) -> None:
    pattern = laser_pattern(np.radians(90), QUARTER, 0.025)
    ranges = simulate_ranges(pattern, np.eye(4), 0.0, unchanging(wall(2.0)), EXACT, rng)
    assert ranges == pytest.approx(2.0 / np.cos(pattern.angles))


def test_laser_has_the_stated_beams() -> None:
    pattern = laser_pattern(np.radians(270), QUARTER, 0.025)
    assert len(pattern.angles) == 1081
    assert np.degrees(pattern.angles[[0, 540, 1080]]) == pytest.approx([-135, 0, 135])
    # 270 of 360 degrees of a turn of the mirror.
    assert pattern.times[-1] == pytest.approx(0.025 * 270 / 360)


def test_range_noise_has_the_stated_deviation(rng: np.random.Generator) -> None:
    pattern = laser_pattern(np.radians(20), QUARTER, 0.025)
    noise = BeamOptions(
        range_noise=0.015, angle_noise=0.0, mixed_pixels=0.0, dropout=0.0, min_range=0.1, max_range=30.0
    )
    errors = many(pattern, unchanging(wall(2.0)), noise, 400, rng) - 2.0 / np.cos(pattern.angles)
    assert errors.std() == pytest.approx(0.015, rel=0.02)
    assert errors.mean() == pytest.approx(0, abs=0.0004)


def test_angle_noise_moves_ranges_on_a_slanted_wall(rng: np.random.Generator) -> None:
    pattern = laser_pattern(np.radians(130), np.radians(1), 0.025)
    noise = BeamOptions(
        range_noise=0.0, angle_noise=0.002, mixed_pixels=0.0, dropout=0.0, min_range=0.1, max_range=30.0
    )
    ranges = many(pattern, unchanging(wall(2.0)), noise, 1500, rng)
    slanted = np.abs(pattern.angles) > np.radians(20)
    # r = 2 / cos(a), so dr/da = r tan(a).
    expected = (0.002 * 2.0 / np.cos(pattern.angles) * np.abs(np.tan(pattern.angles)))[slanted]
    assert ranges.std(axis=0)[slanted] == pytest.approx(expected, rel=0.1)


def test_dropouts_have_the_stated_probability(rng: np.random.Generator) -> None:
    noise = BeamOptions(
        range_noise=0.0, angle_noise=0.0, mixed_pixels=0.0, dropout=0.1, min_range=0.1, max_range=30.0
    )
    pattern = laser_pattern(np.radians(90), QUARTER, 0.025)
    lost = np.isnan(many(pattern, unchanging(wall(2.0)), noise, 100, rng)).mean()
    assert lost == pytest.approx(0.1, abs=0.01)


def test_ranges_beyond_the_limits_are_not_measured(rng: np.random.Generator) -> None:
    noise = BeamOptions(
        range_noise=0.0, angle_noise=0.0, mixed_pixels=0.0, dropout=0.0, min_range=0.1, max_range=2.5
    )
    pattern = laser_pattern(np.radians(100), QUARTER, 0.025)
    ranges = simulate_ranges(pattern, np.eye(4), 0.0, unchanging(wall(2.0)), noise, rng)
    assert np.isfinite(ranges).tolist() == (2.0 / np.cos(pattern.angles) <= 2.5).tolist()


def test_mixed_pixels_lie_between_the_depths_beside_an_edge(rng: np.random.Generator) -> None:
    upright = np.array([[0.0, 0, -1], [-1, 0, 0], [0, 1, 0]])
    board = Solid(RectangleShape(1.0, 1.0), se3.pose(upright, np.array([2.0, 0, 0])))
    noise = BeamOptions(
        range_noise=0.0, angle_noise=0.0, mixed_pixels=0.4, dropout=0.0, min_range=0.1, max_range=30.0
    )
    pattern = laser_pattern(np.radians(60), QUARTER, 0.025)
    scene = unchanging(board, wall(4.0))
    exact = simulate_ranges(pattern, np.eye(4), 0.0, scene, EXACT, rng)
    ranges = many(pattern, scene, noise, 500, rng)
    edges = np.flatnonzero(np.abs(np.diff(exact)) > 0.5)
    assert len(edges) == 2
    changed = np.abs(ranges - exact) > 1e-9
    assert np.flatnonzero(changed.any(axis=0)).tolist() == sorted([*edges, *edges + 1])
    assert changed.any(axis=1).mean() == pytest.approx(1 - 0.6**2, abs=0.05)
    assert (ranges[changed] > 2.0).all()
    assert (ranges[changed] < 4.0 / np.cos(pattern.angles[edges]).min()).all()


def test_an_upright_spinning_scanner_covers_all_azimuths(rng: np.random.Generator) -> None:
    room = Solid(BoxShape(10.0, 8.0, 3.0), np.eye(4))
    pattern = spinning()
    cloud = point_cloud(
        pattern, simulate_ranges(pattern, np.eye(4), 0.0, unchanging(room), EXACT, rng), 0.0, "lidar"
    )
    off_walls = np.abs(np.abs(cloud.points) / [5.0, 4.0, 1.5] - 1).min(axis=1)
    assert off_walls == pytest.approx(0, abs=1e-9)
    walls_seen = {(axis, side) for axis in (0, 1) for side in (-1, 1)
                  if (np.abs(cloud.points[:, axis] * side - [5.0, 4.0][axis]) < 1e-6).sum() > 500}  # fmt: skip
    assert len(walls_seen) == 4


def test_a_spinning_scanner_has_the_stated_tilt_and_offset() -> None:
    pattern = spinning(tilt=np.radians(10), offset=0.05)
    forward = np.flatnonzero(np.abs(pattern.angles) < 1e-9)
    assert pattern.directions[forward, 2] == pytest.approx(np.cos(np.radians(10)))
    assert np.linalg.norm(pattern.origins[:, :2], axis=1) == pytest.approx(0.05)


def test_spinning_sweep_takes_as_long_as_its_scans() -> None:
    pattern = spinning()
    # 180 degrees, one scan in 3 degrees, 20 ms each; the last scan ends after 270 of 360 degrees of mirror turn.
    assert pattern.times[-1] == pytest.approx(59 * 0.02 + 0.75 * 0.02)


def test_multibeam_rings_have_the_stated_elevations() -> None:
    elevations = np.radians([-15.0, 0.0, 15.0])
    pattern = multibeam_pattern(elevations, np.radians(0.5), 0.1)
    assert pattern.rings is not None
    assert np.arcsin(pattern.directions[:, 2]) == pytest.approx(elevations[pattern.rings])
    assert len(pattern.times) == 3 * 720


def test_sideways_is_the_derivative_of_the_direction() -> None:
    pattern = spinning(tilt=0.2)
    beams = np.arange(541)
    spun = pattern.directions[beams[1:]] - pattern.directions[beams[:-1]]
    moved = spun / np.radians(0.5)
    # The spin adds at most 3 degrees in 360 of mirror angle.
    assert np.abs(moved - pattern.sideways[beams[:-1]]).max() < 0.02


def test_beams_hit_the_scene_at_their_time_of_measurement(rng: np.random.Generator) -> None:
    pattern = laser_pattern(np.radians(90), QUARTER, 0.025)
    middle = float(pattern.times[180])

    def approaching(_start: float, _end: float) -> list[tuple[float, list[Solid]]]:
        return [(10.0 + middle, [wall(2.0)]), (np.inf, [wall(1.0)])]

    ranges = simulate_ranges(pattern, np.eye(4), 10.0, approaching, EXACT, rng) * np.cos(pattern.angles)
    assert ranges[:180] == pytest.approx(2.0)
    assert ranges[182:] == pytest.approx(1.0)


def test_ranges_are_invariant_to_a_common_transform(rng: np.random.Generator) -> None:
    T_world_sensor = se3.pose(so3.exp(np.array([0.4, -0.7, 1.9])), np.array([3.0, -1.0, 0.5]))
    moved = Solid(wall(2.0).shape, T_world_sensor @ wall(2.0).T_world_shape)
    pattern = laser_pattern(np.radians(90), QUARTER, 0.025)
    ranges = simulate_ranges(pattern, T_world_sensor, 0.0, unchanging(moved), EXACT, rng)
    assert ranges == pytest.approx(2.0 / np.cos(pattern.angles))
