"""From scans to tracks: accuracy, identity, periods, and the real recording."""

import itertools
from collections import Counter
from dataclasses import replace
from pathlib import Path
from time import process_time

import numpy as np
import pytest

from calgraph.config import Cylinder, People, RangeNoise
from calgraph.errors import Rejected
from calgraph.geometry import Array
from calgraph.recording import open_recording
from calgraph.sensors import LaserScan
from calgraph.tracking import Feature, Track, Tracked, track_scanner
from walking_scenes import Walk, World, along, circling

PEOPLE = People(kind="people")
EPOCH = 1e9


def tracked(
    world: World,
    seconds: float = 20.0,
    seed: int = 1,
    feature: Feature = "nls",
    target: People | Cylinder = PEOPLE,
) -> Tracked:
    scans = world.scans(seconds, seed)
    result = track_scanner(scans, target, RangeNoise(), feature=feature)
    assert isinstance(result, Tracked)
    return result


def off(track: Track, walk: Walk) -> Array:
    """(T, 2) how far a track is from a walk."""
    return track.positions - walk(track.times - EPOCH)


def whose(track: Track, world: World) -> int:
    """The walk that a track is nearest to, in the median over time."""
    distances = [np.linalg.norm(off(track, walk), axis=1) for walk in world.walks]
    return int(np.argmin([np.nanmedian(d) if np.isfinite(d).any() else np.inf for d in distances]))


def errors(result: Tracked, world: World) -> Array:
    return np.concatenate([off(track, world.walks[whose(track, world)]) for track in result.tracks])


def nees(result: Tracked, world: World) -> Array:
    information = np.concatenate([np.linalg.inv(track.covariances) for track in result.tracks])
    e = errors(result, world)
    return np.asarray(np.einsum("ti,tij,tj->t", e, information, e))


@pytest.fixture
def busy() -> World:
    """Three people, one of them on a circle for ever, the others crossing before and behind."""
    return World(
        (
            circling(2.0, (5.0, -1.0)),
            along([(1.0, 5.5), (3.0, 2.0), (9.0, 1.0), (3.0, -5.0), (1.0, 3.0)] * 3),
            along([(9.0, -5.0), (8.0, 5.0), (2.0, 4.0), (2.0, -4.0)] * 3, begin=5.0),
        )
    )


CIRCLE = World((circling(2.0, (5.0, -1.0)),))
DRUM = replace(CIRCLE, radii=(0.25, 0.25))
CYLINDER = Cylinder(kind="cylinder", diameter=0.5)


def test_one_walker_is_one_track_in_one_period() -> None:
    result = tracked(CIRCLE)
    assert [(track.period, len(track.times) > 290) for track in result.tracks] == [(0, True)]


def test_times_ascend() -> None:
    assert all((np.diff(track.times) > 0).all() for track in tracked(CIRCLE).tracks)


@pytest.mark.parametrize(("feature", "mean"), [("nls", 0.012), ("ellipse", 0.08), ("com", 0.2)])
def test_centres_are_as_good_as_their_feature(feature: Feature, mean: float) -> None:
    error = np.linalg.norm(errors(tracked(CIRCLE, feature=feature), CIRCLE), axis=1)
    assert error.mean() < mean


def test_the_fixed_ellipse_has_no_bias_along_the_line_of_sight() -> None:
    result = tracked(CIRCLE, 30.0)
    positions = np.concatenate([track.positions for track in result.tracks])
    sight = positions / np.linalg.norm(positions, axis=1, keepdims=True)
    assert abs((errors(result, CIRCLE) * sight).sum(axis=1).mean()) < 0.004


def test_a_cylinders_covariances_hold_over_many_recordings() -> None:
    values = [nees(tracked(DRUM, 6.0, seed, target=CYLINDER), DRUM).mean() for seed in range(10)]
    assert 0.8 < np.mean(values) < 2.6


def test_peoples_covariances_hold_whatever_their_size() -> None:
    values = []
    for seed, larger in enumerate(np.linspace(0.94, 1.06, 10)):
        world = replace(CIRCLE, radii=(0.25 * larger, 0.15 * larger))
        values.append(nees(tracked(world, 6.0, seed), world).mean())
    assert 0.4 < np.mean(values) < 2.6


@pytest.mark.parametrize("feature", ["com", "ellipse"])
def test_covariances_of_the_plain_features_cover_their_bias(feature: Feature) -> None:
    assert nees(tracked(CIRCLE, feature=feature), CIRCLE).mean() < 5.0


def test_velocities_are_those_of_the_walk() -> None:
    track = tracked(CIRCLE).tracks[0]
    assert np.linalg.norm(track.velocities, axis=1).mean() == pytest.approx(1.2, abs=0.03)


@pytest.mark.parametrize("sweep", [0.75, -0.75])
def test_beams_count_at_their_own_times(sweep: float) -> None:
    # At 5 Hz the last beam is 150 ms after the stamp: 0.3 m at this speed.
    world = World((circling(2.0, (5.0, -1.0), speed=2.0),), rate=5.0, sweep=sweep)
    assert np.linalg.norm(errors(tracked(world), world), axis=1).mean() < 0.04


def test_a_cylinder_is_measured_to_a_centimetre() -> None:
    error = np.linalg.norm(errors(tracked(DRUM, 15.0, target=CYLINDER), DRUM), axis=1)
    assert error.mean() < 0.01


CROSSING = World(
    (along([(3.0, -4.0), (5.0, 0.0), (7.0, 4.0)]), along([(3.0, 4.0), (5.0, 0.0), (7.0, -4.0)], begin=0.6))
)


@pytest.mark.parametrize("seed", range(3))
def test_identities_survive_a_crossing(seed: int) -> None:
    result = tracked(CROSSING, 8.0, seed)
    # Whoever is followed at any time is nearer to one walker all the time.
    for track in result.tracks:
        walk = CROSSING.walks[whose(track, CROSSING)]
        assert np.linalg.norm(off(track, walk), axis=1).max() < 0.25


def test_both_walkers_of_a_crossing_are_followed_nearly_all_the_time() -> None:
    seen = Counter[int]()
    for track in tracked(CROSSING, 7.0).tracks:
        seen[whose(track, CROSSING)] += len(track.times)
    assert min(seen.values()) > 75


def test_a_walk_behind_a_pillar_starts_periods() -> None:
    # The pillar hides the walker for about half a second.
    world = World((along([(7.0, 5.5), (7.5, 0.0), (7.0, -5.0)], speed=1.0),), pillar=(4.0, 4.5, 0.8, 1.3))
    assert [track.period for track in tracked(world, 10.0).tracks] == [0, 1]


def test_a_second_walker_starts_a_period_when_coming_and_when_going() -> None:
    second = along([(2.0, 5.0), (2.0, 1.5), (1.0, 5.0)], begin=4.0)
    result = tracked(World((CIRCLE.walks[0], second)), 15.0)
    periods = [track.period for track in result.tracks if whose(track, World((CIRCLE.walks[0], second))) == 0]
    assert periods == [0, 1, 2]


def test_within_a_period_all_objects_are_seen_all_the_time(busy: World) -> None:
    for _, group in itertools.groupby(tracked(busy, 30.0).tracks, key=lambda track: track.period):
        spans = np.array([[track.times[0], track.times[-1]] for track in group])
        # Gaps of up to 0.4 s count as seen.
        assert np.ptp(spans, axis=0).max() < 0.5


def test_a_busy_room_is_followed_accurately(busy: World) -> None:
    error = np.linalg.norm(errors(tracked(busy, 30.0), busy), axis=1)
    assert np.median(error) < 0.012
    assert np.mean(error < 0.05) > 0.97


def test_the_background_is_the_room_and_the_pillar() -> None:
    static = tracked(CIRCLE).background
    static = static[np.isfinite(static).all(axis=1)]
    x0, x1, y0, y1 = CIRCLE.room
    wall = np.min(np.abs([static[:, 0] - x0, static[:, 0] - x1, static[:, 1] - y0, static[:, 1] - y1]), axis=0)
    on_pillar = (np.abs(static - [5.2, 2.2]) < 0.25).all(axis=1)
    assert len(static) > 500
    assert (wall[~on_pillar] < 0.02).all()


def test_somebody_who_stands_still_is_no_track() -> None:
    def standing(times: Array) -> Array:
        there = (np.asarray(times) > 5.0) & (np.asarray(times) < 10.0)
        return np.where(there[..., None], [3.0, 1.0 + 1e-9], np.nan)

    scans = World((standing,)).scans(20.0, 0)
    result = track_scanner(scans, PEOPLE, RangeNoise())
    assert isinstance(result, Rejected)
    assert "could be followed" in result.reason


@pytest.mark.parametrize("scans", [[], World(()).scans(3.0, 0)], ids=["no scans", "nobody"])
def test_nothing_to_follow_is_said(scans: list[LaserScan]) -> None:
    result = track_scanner(scans, PEOPLE, RangeNoise())
    assert isinstance(result, Rejected)
    assert "scan" in result.reason


def test_ugly_scans_do_no_harm() -> None:
    scans = CIRCLE.scans(20.0, 0)
    rng = np.random.default_rng(1)
    ugly = [
        replace(scan, ranges=np.where(rng.uniform(size=scan.ranges.shape) < 0.1, np.nan, scan.ranges))
        for scan in scans
        if rng.uniform() > 0.1
    ]
    ugly[50] = replace(ugly[50], ranges=np.full_like(ugly[50].ranges, np.inf))
    ugly[60] = replace(ugly[60], angles=ugly[60].angles[:0], ranges=ugly[60].ranges[:0])
    ugly.insert(80, ugly[79])
    result = track_scanner(ugly, PEOPLE, RangeNoise())
    assert isinstance(result, Tracked)
    assert np.linalg.norm(errors(result, CIRCLE), axis=1).mean() < 0.02


def test_a_minute_of_three_people_is_quick(busy: World) -> None:
    scans = busy.scans(60.0, 0)
    begin = process_time()
    track_scanner(scans, PEOPLE, RangeNoise())
    # 0.6 s on an idle machine.
    assert process_time() - begin < 3.0


@pytest.mark.parametrize(("topic", "share"), [("/rear_scan", 0.8), ("/front_scan", 0.6)])
@pytest.mark.parametrize("feature", ["com", "nls"])
def test_the_person_of_the_real_recording_is_followed(
    data_dir: Path, topic: str, share: float, feature: Feature
) -> None:
    with open_recording(data_dir / "two-static-2d-lidars-moving-object" / "scans_demo.bag") as recording:
        messages = [record.decode() for record in recording.records([topic])]
    scans = [message for message in messages if isinstance(message, LaserScan)]
    result = track_scanner(scans, PEOPLE, RangeNoise(), feature=feature)
    assert isinstance(result, Tracked)
    # The README counts foreground in 301 rear and 104 front scans, some of it a few stray beams.
    in_view = {"/rear_scan": 301, "/front_scan": 81}[topic]
    assert sum(len(track.times) for track in result.tracks) > share * in_view
