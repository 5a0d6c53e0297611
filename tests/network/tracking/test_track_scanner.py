"""From scans to tracks: accuracy, identity, periods, and the real recording."""

import itertools
from collections import Counter
from dataclasses import replace
from pathlib import Path
from time import process_time

import numpy as np
import pytest

from calgraph.config import Cylinder, People, RangeNoise
from calgraph.config.settings import CenterFeature, TrackingSettings
from calgraph.errors import Rejected
from calgraph.geometry import Array
from calgraph.network.track_recording import select_center_estimator
from calgraph.network.tracking.clusters import Clusters
from calgraph.network.tracking.features import ObjectVelocities, measure_fixed_ellipses
from calgraph.network.tracking.track import ScannerTracks, Track
from calgraph.network.tracking.track_scanner import track_scanner
from calgraph.recording import open_recording
from calgraph.sensors import LaserScan
from walking_scenes import Walk, World, walk_along, walk_in_circle

PEOPLE = People(kind="people")
EPOCH = 1e9


def track_world(
    world: World,
    seconds: float = 20.0,
    seed: int = 1,
    feature: CenterFeature = "nls",
    target: People | Cylinder = PEOPLE,
) -> ScannerTracks:
    scans = world.simulate_scans(seconds, seed)
    result = track_scanner(
        scans, target, RangeNoise(), centers=select_center_estimator(feature), settings=TrackingSettings()
    )
    assert isinstance(result, ScannerTracks)
    return result


def errors_from(track: Track, walk: Walk) -> Array:
    """(T, 2) how far a track is from a walk."""
    return track.positions - walk(track.times - EPOCH)


def nearest_walk(track: Track, world: World) -> int:
    """The walk that a track is nearest to, in the median over time."""
    distances = [np.linalg.norm(errors_from(track, walk), axis=1) for walk in world.walks]
    return int(np.argmin([np.nanmedian(d) if np.isfinite(d).any() else np.inf for d in distances]))


def errors(result: ScannerTracks, world: World) -> Array:
    return np.concatenate([errors_from(track, world.walks[nearest_walk(track, world)]) for track in result.tracks])


def nees(result: ScannerTracks, world: World) -> Array:
    information = np.concatenate([np.linalg.inv(track.covariances) for track in result.tracks])
    e = errors(result, world)
    return np.asarray(np.einsum("ti,tij,tj->t", e, information, e))


@pytest.fixture
def busy_room() -> World:
    """Three people, one of them on a circle for ever, the others crossing before and behind."""
    return World(
        (
            walk_in_circle(2.0, (5.0, -1.0)),
            walk_along([(1.0, 5.5), (3.0, 2.0), (9.0, 1.0), (3.0, -5.0), (1.0, 3.0)] * 3),
            walk_along([(9.0, -5.0), (8.0, 5.0), (2.0, 4.0), (2.0, -4.0)] * 3, begin=5.0),
        )
    )


CIRCLE = World((walk_in_circle(2.0, (5.0, -1.0)),))
DRUM = replace(CIRCLE, radii=(0.25, 0.25))
CYLINDER = Cylinder(kind="cylinder", diameter=0.5)


def test_one_person_gives_one_track_in_one_period() -> None:
    result = track_world(CIRCLE)
    assert [(track.period, len(track.times) > 290) for track in result.tracks] == [(0, True)]


def test_times_ascend() -> None:
    assert all((np.diff(track.times) > 0).all() for track in track_world(CIRCLE).tracks)


@pytest.mark.parametrize(("feature", "mean"), [("nls", 0.012), ("ellipse", 0.08), ("com", 0.2)])
def test_mean_error_of_each_feature(feature: CenterFeature, mean: float) -> None:
    error = np.linalg.norm(errors(track_world(CIRCLE, feature=feature), CIRCLE), axis=1)
    assert error.mean() < mean


def test_the_fixed_ellipse_has_no_bias_along_the_line_of_sight() -> None:
    result = track_world(CIRCLE, 30.0)
    positions = np.concatenate([track.positions for track in result.tracks])
    sight = positions / np.linalg.norm(positions, axis=1, keepdims=True)
    assert abs((errors(result, CIRCLE) * sight).sum(axis=1).mean()) < 0.004


def test_nees_of_a_cylinder_over_many_recordings() -> None:
    values = [nees(track_world(DRUM, 6.0, seed, target=CYLINDER), DRUM).mean() for seed in range(10)]
    assert 0.8 < np.mean(values) < 2.6


def test_nees_of_people_of_several_sizes() -> None:
    values = []
    for seed, larger in enumerate(np.linspace(0.94, 1.06, 10)):
        world = replace(CIRCLE, radii=(0.25 * larger, 0.15 * larger))
        values.append(nees(track_world(world, 6.0, seed), world).mean())
    assert 0.4 < np.mean(values) < 2.6


@pytest.mark.parametrize("feature", ["com", "ellipse"])
def test_covariances_of_the_baseline_features_cover_their_bias(feature: CenterFeature) -> None:
    assert nees(track_world(CIRCLE, feature=feature), CIRCLE).mean() < 5.0


def test_velocities_are_those_of_the_walk() -> None:
    track = track_world(CIRCLE).tracks[0]
    assert np.linalg.norm(track.velocities, axis=1).mean() == pytest.approx(1.2, abs=0.03)


@pytest.mark.parametrize("sweep", [0.75, -0.75])
def test_beams_count_at_their_own_times(sweep: float) -> None:
    # At 5 Hz the last beam is 150 ms after the stamp: 0.3 m at this speed.
    world = World((walk_in_circle(2.0, (5.0, -1.0), speed=2.0),), rate=5.0, sweep=sweep)
    assert np.linalg.norm(errors(track_world(world), world), axis=1).mean() < 0.04


def test_a_cylinder_is_measured_to_a_centimetre() -> None:
    error = np.linalg.norm(errors(track_world(DRUM, 15.0, target=CYLINDER), DRUM), axis=1)
    assert error.mean() < 0.01


CROSSING = World(
    (
        walk_along([(3.0, -4.0), (5.0, 0.0), (7.0, 4.0)]),
        walk_along([(3.0, 4.0), (5.0, 0.0), (7.0, -4.0)], begin=0.6),
    )
)


@pytest.mark.parametrize("seed", range(3))
def test_identities_survive_a_crossing(seed: int) -> None:
    result = track_world(CROSSING, 8.0, seed)
    # Each track is nearest to the same walk at all times.
    for track in result.tracks:
        walk = CROSSING.walks[nearest_walk(track, CROSSING)]
        assert np.linalg.norm(errors_from(track, walk), axis=1).max() < 0.25


def test_both_people_of_a_crossing_are_tracked_nearly_all_the_time() -> None:
    counts = Counter[int]()
    for track in track_world(CROSSING, 7.0).tracks:
        counts[nearest_walk(track, CROSSING)] += len(track.times)
    assert min(counts.values()) > 75


def test_a_walk_behind_a_pillar_starts_periods() -> None:
    # The pillar hides the walker for about half a second.
    world = World((walk_along([(7.0, 5.5), (7.5, 0.0), (7.0, -5.0)], speed=1.0),), pillar=(4.0, 4.5, 0.8, 1.3))
    assert [track.period for track in track_world(world, 10.0).tracks] == [0, 1]


def test_a_second_walker_starts_a_period_when_coming_and_when_going() -> None:
    second = walk_along([(2.0, 5.0), (2.0, 1.5), (1.0, 5.0)], begin=4.0)
    result = track_world(World((CIRCLE.walks[0], second)), 15.0)
    periods = [
        track.period for track in result.tracks if nearest_walk(track, World((CIRCLE.walks[0], second))) == 0
    ]
    assert periods == [0, 1, 2]


def test_within_a_period_all_objects_are_always_detected(busy_room: World) -> None:
    for _, group in itertools.groupby(track_world(busy_room, 30.0).tracks, key=lambda track: track.period):
        spans = np.array([[track.times[0], track.times[-1]] for track in group])
        # Gaps of up to 0.4 s count as detected.
        assert np.ptp(spans, axis=0).max() < 0.5


def test_tracks_in_a_busy_room_are_accurate(busy_room: World) -> None:
    error = np.linalg.norm(errors(track_world(busy_room, 30.0), busy_room), axis=1)
    assert np.median(error) < 0.012
    assert np.mean(error < 0.05) > 0.97


def test_the_background_is_the_room_and_the_pillar() -> None:
    static = track_world(CIRCLE).background
    static = static[np.isfinite(static).all(axis=1)]
    x0, x1, y0, y1 = CIRCLE.room
    wall = np.min(np.abs([static[:, 0] - x0, static[:, 0] - x1, static[:, 1] - y0, static[:, 1] - y1]), axis=0)
    on_pillar = (np.abs(static - [5.2, 2.2]) < 0.25).all(axis=1)
    assert len(static) > 500
    assert (wall[~on_pillar] < 0.02).all()


def test_a_standing_person_gives_no_track() -> None:
    def standing(times: Array) -> Array:
        there = (np.asarray(times) > 5.0) & (np.asarray(times) < 10.0)
        return np.where(there[..., None], [3.0, 1.0 + 1e-9], np.nan)

    scans = World((standing,)).simulate_scans(20.0, 0)
    result = track_scanner(scans, PEOPLE, RangeNoise(), settings=TrackingSettings())
    assert isinstance(result, Rejected)
    assert "could be tracked" in result.reason


@pytest.mark.parametrize("scans", [[], World(()).simulate_scans(3.0, 0)], ids=["no scans", "empty room"])
def test_the_reason_for_no_tracks_is_stated(scans: list[LaserScan]) -> None:
    result = track_scanner(scans, PEOPLE, RangeNoise(), settings=TrackingSettings())
    assert isinstance(result, Rejected)
    assert "scan" in result.reason


def test_malformed_scans_are_tolerated() -> None:
    scans = CIRCLE.simulate_scans(20.0, 0)
    rng = np.random.default_rng(1)
    ugly = [
        replace(scan, ranges=np.where(rng.uniform(size=scan.ranges.shape) < 0.1, np.nan, scan.ranges))
        for scan in scans
        if rng.uniform() > 0.1
    ]
    ugly[50] = replace(ugly[50], ranges=np.full_like(ugly[50].ranges, np.inf))
    ugly[60] = replace(ugly[60], angles=ugly[60].angles[:0], ranges=ugly[60].ranges[:0])
    ugly.insert(80, ugly[79])
    result = track_scanner(ugly, PEOPLE, RangeNoise(), settings=TrackingSettings())
    assert isinstance(result, ScannerTracks)
    assert np.linalg.norm(errors(result, CIRCLE), axis=1).mean() < 0.02


def test_a_minute_of_three_people_is_tracked_in_time(busy_room: World) -> None:
    scans = busy_room.simulate_scans(60.0, 0)
    begin = process_time()
    track_scanner(scans, PEOPLE, RangeNoise(), settings=TrackingSettings())
    # 0.6 s on an idle machine.
    assert process_time() - begin < 3.0


@pytest.mark.parametrize(("topic", "share"), [("/rear_scan", 0.8), ("/front_scan", 0.6)])
@pytest.mark.parametrize("feature", ["com", "nls"])
def test_the_person_of_the_real_recording_is_tracked(
    data_dir: Path, topic: str, share: float, feature: CenterFeature
) -> None:
    with open_recording(data_dir / "two-static-2d-lidars-moving-object" / "scans_demo.bag") as recording:
        messages = [record.decode() for record in recording.records([topic])]
    scans = [message for message in messages if isinstance(message, LaserScan)]
    result = track_scanner(
        scans, PEOPLE, RangeNoise(), centers=select_center_estimator(feature), settings=TrackingSettings()
    )
    assert isinstance(result, ScannerTracks)
    # The README counts foreground in 301 rear and 104 front scans, some of it a few stray beams.
    in_view = {"/rear_scan": 301, "/front_scan": 81}[topic]
    assert sum(len(track.times) for track in result.tracks) > share * in_view


@pytest.mark.parametrize(("length", "tracked"), [(0.7, False), (2.0, True)])
def test_a_track_takes_at_least_half_a_second(length: float, tracked: bool) -> None:
    """At 2 m/s the shorter walk lasts 0.35 s, and leads through more than the least travel."""

    def dash(times: Array) -> Array:
        way = 2.0 * (np.asarray(times) - 5.0)
        path = np.stack([np.full(way.shape, 3.0), way - 1.0], axis=-1)
        return np.where(((way >= 0) & (way <= length))[..., None], path, np.nan)

    world = World((walk_in_circle(1.0, (8.0, 3.0)), dash), rate=25.0)
    near = [track for track in track_world(world, 10.0).tracks if np.median(track.positions[:, 0]) < 4.0]
    assert bool(near) == tracked


def test_the_heading_of_a_walk_orients_ellipses_of_few_beams() -> None:
    """At 8 m a person is hit by two to five beams; without the prior of the shoulders the mean error is 16 mm."""
    far = World((walk_in_circle(2.0, (8.0, -1.0)),), beams=181)
    found = [np.linalg.norm(errors(track_world(far, 12.0, seed), far), axis=1) for seed in range(3)]
    assert np.concatenate(found).mean() < 0.0135


def test_what_hides_behind_an_occluder_is_part_of_the_noise() -> None:
    """Points of a whole cylinder without noise: what is visible fits exactly, and what is not, is unknown."""
    angles = np.linspace(-0.05, 0.05, 21)
    points = (5.0 - np.sqrt(0.25**2 - (5.0 * angles) ** 2 + 1e-9))[:, None] * np.column_stack(
        [np.cos(angles), np.sin(angles)]
    )
    one = np.zeros(1, dtype=np.intp)
    noise = []
    for clipped in (False, True):
        objects = Clusters(
            points, one, np.full(1, 21), one, np.zeros(1), np.zeros(21), np.full(1, 0.005), np.array([clipped])
        )
        still = ObjectVelocities(np.zeros((1, 2)), np.full(1, np.inf))
        noise.append(measure_fixed_ellipses(objects, CYLINDER, still, 0.01).noise[0])
    assert np.sqrt(noise[1][0, 0] - noise[0][0, 0]) == pytest.approx(0.15 * 0.25, rel=0.1)
