"""Simulated halls: bodies by rays known by hand, people who walk as stated, poses that put points on surfaces."""

from dataclasses import replace
from time import process_time

import numpy as np
import pytest

from calgraph.config import Lidar3dSpec
from calgraph.errors import InputError
from calgraph.geometry import Array, se3
from calgraph.sensors import LaserScan, PointCloud
from calgraph.simulation import HallFaults, HallScenario, SimulatedHall, simulate_hall
from calgraph.simulation.drive_beams import Hits
from calgraph.simulation.drive_scenario import EXACT
from calgraph.simulation.hall_bodies import Mover, Part, cast_mover, place_box, place_ellipsoid, place_limb
from calgraph.simulation.hall_mounts import mount_sensors
from calgraph.simulation.hall_scenario import LIDAR_MODELS
from calgraph.simulation.hall_world import build_hall
from calgraph.simulation.network_walks import SAMPLE_INTERVAL
from simulation.test_drive_simulation import distance_to_surfaces

UPRIGHT = np.eye(3)[..., None]
SHORT = HallScenario(seed=1, duration=2.0, lidars=("vlp16", "vlp16"), people=0, errors=EXACT)


def cast(part: Part, origin: list[float], directions: list[list[float]]) -> Hits:
    """Rays at one part that does not move."""
    mover = Mover(lambda times: np.zeros((3, len(times))), 1.0, 2.0, lambda _: [part])
    d = np.array(directions, dtype=np.float64).T
    return cast_mover(
        mover, np.zeros(1), np.zeros(d.shape[1], dtype=np.intp), np.array(origin), d / np.linalg.norm(d, axis=0)
    )


def column(*values: float) -> Array:
    return np.array(values)[:, None]


def test_rays_meet_ellipsoids_boxes_and_limbs_where_geometry_has_them() -> None:
    ball = cast(place_ellipsoid(UPRIGHT, column(5, 0, 1), (1.0, 2.0, 0.5), 0.3), [0, 0, 1], [[1, 0, 0], [1, 1, 0]])
    assert ball.ranges[0] == pytest.approx(4)
    assert ball.cosines[0] == pytest.approx(1)
    assert np.isinf(ball.ranges[1])
    box = cast(place_box(UPRIGHT, column(3, 0, 0), (0.5, 1.0, 1.0), 0.3), [0, 0, 0], [[1, 0.2, 0]])
    assert box.ranges[0] == pytest.approx(2.5 * np.hypot(1, 0.2))
    assert box.cosines[0] == pytest.approx(1 / np.hypot(1, 0.2))
    # A cone of 0.2 m at z = 0 and 0.1 m at z = 1: 0.15 m half way up, with a normal that rises by 0.1 in 1.
    cone = place_limb(column(2, 0, 0), column(2, 0, 1), 0.2, 0.1, 0.3)
    side = cast(cone, [0, 0, 0.5], [[1, 0, 0], [1, 0.1, 0], [0, 0, 1]])
    assert side.ranges[0] == pytest.approx(1.85)
    assert side.cosines[0] == pytest.approx(1 / np.hypot(1, 0.1))
    assert np.isinf(side.ranges[1:]).all()
    cap = cast(cone, [2, 0, 3], [[0, 0, -1]])
    assert cap.ranges[0] == pytest.approx(1.9)
    # Of sections that are ellipses the first radius is ahead.
    ahead = place_limb(column(2, 0, 0), column(2, 0, 1), (0.1, 0.3), 0.3, 0.3, column(0, 1, 0))
    assert cast(ahead, [0, 0, 0.5], [[1, 0, 0]]).ranges[0] == pytest.approx(1.7)


def test_people_walk_at_their_speed_on_legs_of_constant_length_and_feet_that_rest() -> None:
    """Speeds are 1.1 m/s within 30 %; a foot rests for a good part of a step; thighs keep their length."""
    hall = build_hall(replace(SHORT, seed=4, duration=30.0, people=4))
    times = np.arange(2.0, 28.0, SAMPLE_INTERVAL)
    for mover, walk in zip(hall.movers, hall.walks, strict=True):
        places = mover.place(times)
        expected, _ = walk.pose_at(times)
        np.testing.assert_allclose(places[:2].T, expected, atol=0.08)
        speeds = np.linalg.norm(np.diff(walk.positions, axis=0), axis=1) / SAMPLE_INTERVAL
        assert 0.7 < np.median(speeds[speeds > 0.3]) < 1.5
        parts = mover.parts(times)
        # The legs' last limbs are feet, whose origin is the heel.
        heel = parts[9].origin
        at_rest = np.linalg.norm(np.diff(heel[:2], axis=1), axis=0) / SAMPLE_INTERVAL < 0.15
        assert at_rest.mean() > 0.3
        assert np.ptp(heel[2]) < 0.25
        thigh = np.linalg.norm(parts[7].origin - parts[8].origin, axis=0)
        assert np.quantile(thigh, 0.99) < 1.02 * np.quantile(thigh, 0.01)
        tops = parts[0].origin[2] - places[2]
        assert np.all((tops > 1.3) & (tops < 1.95))


def clouds(simulated: SimulatedHall, name: str) -> list[PointCloud]:
    topic = simulated.rig.sensors[name].topic
    messages = [record.decode() for record in simulated.recording.records([topic])]
    return [one for one in messages if isinstance(one, PointCloud)]


@pytest.mark.parametrize("seed", range(3))
def test_true_poses_put_points_on_surfaces(seed: int) -> None:
    """Exact ranges lie on walls, floor and furniture to 2 mm, of sensors of any tilt."""
    simulated = simulate_hall(replace(SHORT, seed=seed, lidars=("vlp16", "xt32", "solid_state")))
    truth = simulated.truth
    for name, T in truth.T_root_sensor.items():
        cloud = clouds(simulated, name)[3]
        points = se3.apply(truth.T_world_root @ T, cloud.points[::7])
        assert len(points) > 1000
        assert np.quantile(distance_to_surfaces(truth.hall.surfaces, points), 0.999) < 2e-3


def test_sensors_are_mounted_as_stated_and_share_the_middle_of_the_hall() -> None:
    """Heights are 2 to 4 m, tilts up to 40 degrees but for the roll; some hang upside down."""
    down = 0
    for seed in range(12):
        scenario = replace(SHORT, seed=seed, lidars=("vlp16",) * 4)
        hall = build_hall(scenario)
        for mount in mount_sensors(scenario, hall, np.random.default_rng(seed)):
            T = mount.poses[0]
            assert 1.9 < T[2, 3] - hall.ground(T[None, :2, 3])[0] < 4.1
            assert abs(T[2, 2]) > np.cos(np.radians(60))
            down += T[2, 2] < 0
    assert 2 <= down <= 20


def test_noise_biases_and_clocks_are_of_the_stated_sizes() -> None:
    simulated = simulate_hall(replace(SHORT, errors=HallScenario().errors, duration=4.0))
    ranges = simulated.ranges["lidar_2"]
    noise = 1.4826 * np.median(np.abs(ranges - np.nanmedian(ranges, axis=0)), axis=0)
    assert 0.006 < np.nanmedian(noise) < 0.03
    assert 0.9 < np.isfinite(ranges).mean() < 1
    stamps = simulated.stamps["lidar_2"]
    assert np.median(np.diff(stamps)) == pytest.approx(0.1, abs=3e-4)
    assert 0 < abs(simulated.truth.clock_offsets["lidar_2"]) <= 0.05
    assert simulated.truth.clock_offsets["lidar_1"] == 0


def test_people_are_measured_where_they_are() -> None:
    """Points that are nearer than without people are within 0.9 m of one of them, at the time of each point."""
    scenario = replace(SHORT, seed=5, people=4)
    simulated, empty = simulate_hall(scenario), simulate_hall(replace(scenario, people=0))
    hall, mount = simulated.truth.hall, simulated.truth.mounts[0]
    measured = simulated.ranges["lidar_1"]
    sweep, ray = np.nonzero(measured < empty.ranges["lidar_1"] - 0.05)
    assert len(ray) > 1000
    beams = mount.columns.directions.reshape(-1, 3)
    starts = simulated.stamps["lidar_1"] - scenario.start_time - mount.clock.offset
    times = starts[sweep] + mount.columns.times[ray // mount.columns.elevations.shape[1]]
    points = se3.apply(mount.poses[0], measured[sweep, ray, None] * beams[ray])
    off = [np.linalg.norm(mover.place(times)[:2].T - points[:, :2], axis=1) for mover in hall.movers]
    assert np.min(off, axis=0).max() < 0.95
    assert np.quantile(np.min(off, axis=0), 0.5) < 0.35
    assert points[:, 2].max() < 2.1


def test_no_ray_that_meets_a_person_is_left_out() -> None:
    """Rays are cast at people and vehicles near them only; all of a sweep give the same ranges."""
    scenario = replace(SHORT, seed=3, people=3, carts=1, moved=2)
    simulated, empty = simulate_hall(scenario), simulate_hall(replace(scenario, people=0, carts=0, moved=0))
    mount, sweep = simulated.truth.mounts[1], 7
    clock = mount.clock.offset + scenario.start_time
    times = simulated.stamps["lidar_2"][sweep] - clock + mount.columns.times
    directions = mount.poses[0][:3, :3] @ mount.columns.directions.reshape(-1, 3).T
    column = np.arange(directions.shape[1]) // mount.columns.elevations.shape[1]
    nearest = empty.ranges["lidar_2"][sweep].astype(np.float64)
    for mover in simulated.truth.hall.movers:
        hits = cast_mover(mover, times, column, mount.poses[0][:3, 3], directions)
        nearest = np.fmin(nearest, hits.ranges)
    # Stamps have a jitter of 0.2 ms, in which limbs move by a millimetre.
    differ = np.abs(nearest - simulated.ranges["lidar_2"][sweep]) > 0.02
    assert np.sum(nearest < empty.ranges["lidar_2"][sweep] - 0.05) > 100
    assert np.sum(differ) <= 5


def test_the_same_seed_gives_the_same_recording_and_others_do_not() -> None:
    scenario = replace(SHORT, people=2, errors=HallScenario().errors)
    one, two, other = (simulate_hall(one) for one in (scenario, scenario, replace(scenario, seed=2)))
    np.testing.assert_array_equal(one.ranges["lidar_2"], two.ranges["lidar_2"])
    np.testing.assert_array_equal(one.stamps["lidar_2"], two.stamps["lidar_2"])
    assert not np.array_equal(one.truth.T_root_sensor["lidar_2"], other.truth.T_root_sensor["lidar_2"])


def test_faults_are_of_one_sensor_at_the_stated_time() -> None:
    base = simulate_hall(SHORT)

    def simulate(**faults: float | tuple[float, float]) -> SimulatedHall:
        return simulate_hall(replace(SHORT, faults=HallFaults(**faults)))  # type: ignore[arg-type]

    bumped = simulate(bump=(0.05, 2.0))
    change = se3.difference(bumped.truth.T_root_sensor["lidar_2"], base.truth.T_root_sensor["lidar_2"])
    assert np.linalg.norm(change[:3]) == pytest.approx(0.05)
    assert np.degrees(np.linalg.norm(change[3:])) == pytest.approx(2.0)
    same = np.all(np.isclose(bumped.ranges["lidar_2"], base.ranges["lidar_2"], equal_nan=True), axis=1)
    assert np.all(same[:9])
    assert not np.any(same[10:])
    stretched = simulate(range_scale=0.01)
    assert np.nanmedian(stretched.ranges["lidar_2"] / base.ranges["lidar_2"]) == pytest.approx(1.01)
    jumped = simulate(clock_jump=0.1)
    assert jumped.stamps["lidar_2"][-1] - base.stamps["lidar_2"][-1] == pytest.approx(0.1)
    assert jumped.stamps["lidar_2"][0] == base.stamps["lidar_2"][0]
    swinging = simulate(swing=0.5)
    T = np.array(swinging.truth.mounts[1].poses)
    assert np.degrees(np.linalg.norm(se3.difference(T[0], T[-1])[3:])) == pytest.approx(1.0)
    np.testing.assert_allclose(
        swinging.truth.T_root_sensor["lidar_2"], base.truth.T_root_sensor["lidar_2"], atol=1e-9
    )
    rain = simulate(false_returns=0.02)
    wrong = ~np.isclose(rain.ranges["lidar_1"], base.ranges["lidar_1"], equal_nan=True)
    assert 0.01 < wrong.mean() < 0.025
    with pytest.raises(InputError, match="none of"):
        simulate_hall(replace(SHORT, faults=HallFaults(sensor="lidar_3")))


def test_glass_mirrors_stairs_slopes_and_moved_things_change_what_is_measured() -> None:
    base = simulate_hall(SHORT).ranges["lidar_1"]
    for change in ({"glass": 4}, {"mirrors": 3}, {"stairs": True}, {"floor_slope": 0.03}, {"moved": 6}):
        measured = simulate_hall(replace(SHORT, **change)).ranges["lidar_1"]
        assert measured.shape == base.shape
        assert np.mean(~np.isclose(measured, base, atol=0.01, equal_nan=True)) > 0.002


def test_a_rig_may_have_scanners_beside_lidars() -> None:
    simulated = simulate_hall(replace(SHORT, scanners=(0.3, 1.4)))
    kinds = {name: spec.kind for name, spec in simulated.rig.sensors.items()}
    assert kinds == {"lidar_1": "lidar3d", "lidar_2": "lidar3d", "scanner_1": "lidar2d", "scanner_2": "lidar2d"}
    scan = next(record.decode() for record in simulated.recording.records(["/scanner_2/scan"]))
    assert isinstance(scan, LaserScan)
    T = simulated.truth.mounts[3].poses[0]
    assert T[2, 3] - simulated.truth.hall.ground(T[None, :2, 3])[0] == pytest.approx(1.4)
    spec = simulated.rig.sensors["lidar_1"]
    assert isinstance(spec, Lidar3dSpec)
    assert spec.uncertainty.ring_bias == pytest.approx(0.01)


def test_a_second_of_a_lidar_takes_less_than_a_quarter_of_a_second() -> None:
    """Of 32 rings and three people, after the hall is built: 0.1 s on one core, with a margin for busy ones."""
    scenario = HallScenario(duration=1.0, lidars=("xt32", "xt32"))
    assert LIDAR_MODELS["xt32"].rings == 32
    simulate_hall(scenario)
    began = process_time()
    simulate_hall(replace(scenario, duration=6.0))
    longer = process_time() - began
    began = process_time()
    simulate_hall(scenario)
    assert (longer - (process_time() - began)) / 10 < 0.25
