"""Whose tracks are whose: bodies are told apart as somebody watching from above would."""

import numpy as np

from calgraph.estimation.network.track_association import group_tracks_by_body
from calgraph.geometry import Array, se2
from calgraph.tracking import ScannerTracks, Track
from calgraph.tracking.track import Hits

T_ROOT = np.stack([np.eye(3), se2.pose(2.5, np.array([8.0, 1.0])), se2.pose(-1.5, np.array([4.0, 6.0]))])
NOISE = 0.02


def path(begin: float, end: float, start: tuple[float, float], speed: tuple[float, float]) -> Array:
    """(T, 5) times, s, places, m, and velocities, m/s, of somebody who walks straight, in the root's frame."""
    times = np.arange(begin, end, 0.05)
    velocity = np.tile(speed, (len(times), 1))
    return np.column_stack([times, np.array(start) + (times - begin)[:, None] * velocity, velocity])


def follow(scanner: int, paths: list[Array], rng: np.random.Generator, late: float = 0.0) -> ScannerTracks:
    """What a scanner knows of paths, its clock being late."""
    T_scanner_root = se2.inverse(T_ROOT[scanner])
    tracks = []
    for own in paths:
        places = se2.apply(T_scanner_root, own[:, 1:3]) + rng.normal(0, NOISE, (len(own), 2))
        hits = Hits(places, own[:, 0] + late, np.arange(len(own)))
        velocities = own[:, 3:] @ T_scanner_root[:2, :2].T
        spread = np.tile(NOISE**2 * np.eye(2), (len(own), 1, 1))
        tracks.append(Track(own[:, 0] + late, places, velocities, spread, 0, hits))
    return ScannerTracks(tuple(tracks), np.zeros((0, 2)), 0.01)


def grouped(tracked: list[ScannerTracks]) -> list[list[tuple[int, int]]]:
    """By body: scanner, and which of its tracks."""
    index = {id(track): (s, k) for s, own in enumerate(tracked) for k, track in enumerate(own.tracks)}
    found = group_tracks_by_body(tracked, T_ROOT[: len(tracked)])
    return sorted(sorted(index[id(track)] for _, track in walker.tracks) for walker in found)


def test_what_two_scanners_follow_at_one_place_is_one_body(rng: np.random.Generator) -> None:
    walk = path(0, 6, (1, 1), (1, 0.2))
    assert grouped([follow(s, [walk], rng) for s in (0, 1)]) == [[(0, 0), (1, 0)]]


def test_people_who_cross_stay_themselves(rng: np.random.Generator) -> None:
    walks = [path(0, 8, (0, 2), (1, 0)), path(0, 8, (8, 2), (-1, 0))]
    tracked = [follow(s, walks, rng) for s in (0, 1, 2)]
    assert grouped(tracked) == [[(0, 0), (1, 0), (2, 0)], [(0, 1), (1, 1), (2, 1)]]


def test_people_abreast_are_two(rng: np.random.Generator) -> None:
    walks = [path(0, 8, (0, 2), (1, 0)), path(0, 8, (0, 2.45), (1, 0))]
    tracked = [follow(s, walks, rng) for s in (0, 1)]
    assert [len({track for s, track in group if s == 0}) for group in grouped(tracked)] == [1, 1]


def test_a_track_broken_into_periods_is_one_body(rng: np.random.Generator) -> None:
    whole = path(0, 9, (0, 1), (1, 0.1))
    broken = [whole[:60], whole[62:120], whole[124:]]
    assert grouped([follow(0, [whole], rng), follow(1, broken, rng)]) == [[(0, 0), (1, 0), (1, 1), (1, 2)]]


def test_who_hands_over_from_scanner_to_scanner_is_one_body(rng: np.random.Generator) -> None:
    whole = path(0, 9, (0, 1), (1, 0.1))
    parts = [whole[:80], whole[60:140], whole[120:]]
    assert grouped([follow(s, [part], rng) for s, part in enumerate(parts)]) == [[(0, 0), (1, 0), (2, 0)]]


def test_clocks_that_differ_by_50_ms_do_not_part_anybody(rng: np.random.Generator) -> None:
    walk = path(0, 6, (1, 1), (2, 0))
    tracked = [follow(0, [walk], rng), follow(1, [walk], rng, late=0.05), follow(2, [walk], rng, late=-0.05)]
    assert grouped(tracked) == [[(0, 0), (1, 0), (2, 0)]]


def test_whom_one_scanner_alone_sees_is_nobody(rng: np.random.Generator) -> None:
    tracked = [follow(0, [path(0, 6, (0, 1), (1, 0))], rng), follow(1, [path(0, 6, (0, 4), (1, 0))], rng)]
    assert grouped(tracked) == []


def test_whom_nobody_saw_for_long_is_another_afterwards(rng: np.random.Generator) -> None:
    walks = [path(0, 3, (0, 1), (1, 0)), path(6, 9, (3, 1), (1, 0))]
    assert len(grouped([follow(s, walks, rng) for s in (0, 1)])) == 2


def test_a_glimpse_of_half_a_second_is_left_out(rng: np.random.Generator) -> None:
    walk = path(0, 0.5, (1, 1), (1, 0))
    assert grouped([follow(s, [walk], rng) for s in (0, 1)]) == []


def test_an_empty_building_has_nobody() -> None:
    assert group_tracks_by_body([ScannerTracks((), np.zeros((0, 2)), 0.01)] * 2, T_ROOT[:2]) == []


def test_a_bodys_tracks_are_known_by_scanner(rng: np.random.Generator) -> None:
    whole = path(0, 9, (0, 1), (1, 0.1))
    [one] = group_tracks_by_body([follow(0, [whole], rng), follow(1, [whole[:60], whole[62:]], rng)], T_ROOT[:2])
    assert {scanner: len(tracks) for scanner, tracks in one.by_scanner().items()} == {0: 1, 1: 2}
