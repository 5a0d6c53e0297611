"""Grouping of tracks by body."""

import numpy as np
import pytest

from calgraph.geometry import Array, se2
from calgraph.network.joint.track_association import (
    _link_successive,
    _overlap_in_scanner,
    _SampledTrack,
    group_tracks_by_body,
)
from calgraph.network.tracking.track import Hits, ScannerTracks, Track

T_ROOT = np.stack([np.eye(3), se2.pose(2.5, np.array([8.0, 1.0])), se2.pose(-1.5, np.array([4.0, 6.0]))])
NOISE = 0.02


def simulate_path(begin: float, end: float, start: tuple[float, float], speed: tuple[float, float]) -> Array:
    """(T, 5) times, s, positions, m, and velocities, m/s, of a person on a straight line, root frame."""
    times = np.arange(begin, end, 0.05)
    velocity = np.tile(speed, (len(times), 1))
    return np.column_stack([times, np.array(start) + (times - begin)[:, None] * velocity, velocity])


def track_paths(scanner: int, paths: list[Array], rng: np.random.Generator, late: float = 0.0) -> ScannerTracks:
    """The tracks of a scanner whose clock is late."""
    T_scanner_root = se2.inverse(T_ROOT[scanner])
    tracks = []
    for path in paths:
        positions = se2.apply(T_scanner_root, path[:, 1:3]) + rng.normal(0, NOISE, (len(path), 2))
        hits = Hits(positions, path[:, 0] + late, np.arange(len(path)))
        velocities = path[:, 3:] @ T_scanner_root[:2, :2].T
        spread = np.tile(NOISE**2 * np.eye(2), (len(path), 1, 1))
        tracks.append(Track(path[:, 0] + late, positions, velocities, spread, 0, hits))
    return ScannerTracks(tuple(tracks), np.zeros((0, 2)), 0.01)


def group(tracked: list[ScannerTracks]) -> list[list[tuple[int, int]]]:
    """By body: scanner, and index of its tracks."""
    index = {id(track): (s, k) for s, scanner in enumerate(tracked) for k, track in enumerate(scanner.tracks)}
    found = group_tracks_by_body(tracked, T_ROOT[: len(tracked)])
    return sorted(sorted(index[id(track)] for _, track in walker.tracks) for walker in found)


def test_simultaneous_tracks_at_one_position_are_one_body(rng: np.random.Generator) -> None:
    walk = simulate_path(0, 6, (1, 1), (1, 0.2))
    assert group([track_paths(s, [walk], rng) for s in (0, 1)]) == [[(0, 0), (1, 0)]]


def test_people_whose_paths_cross_are_not_confused(rng: np.random.Generator) -> None:
    walks = [simulate_path(0, 8, (0, 2), (1, 0)), simulate_path(0, 8, (8, 2), (-1, 0))]
    tracked = [track_paths(s, walks, rng) for s in (0, 1, 2)]
    assert group(tracked) == [[(0, 0), (1, 0), (2, 0)], [(0, 1), (1, 1), (2, 1)]]


def test_people_side_by_side_are_two_bodies(rng: np.random.Generator) -> None:
    walks = [simulate_path(0, 8, (0, 2), (1, 0)), simulate_path(0, 8, (0, 2.45), (1, 0))]
    tracked = [track_paths(s, walks, rng) for s in (0, 1)]
    assert [len({track for s, track in group if s == 0}) for group in group(tracked)] == [1, 1]


def test_an_interrupted_track_is_one_body(rng: np.random.Generator) -> None:
    whole = simulate_path(0, 9, (0, 1), (1, 0.1))
    broken = [whole[:60], whole[62:120], whole[124:]]
    assert group([track_paths(0, [whole], rng), track_paths(1, broken, rng)]) == [[(0, 0), (1, 0), (1, 1), (1, 2)]]


def test_consecutive_tracks_of_overlapping_scanners_are_one_body(rng: np.random.Generator) -> None:
    whole = simulate_path(0, 9, (0, 1), (1, 0.1))
    parts = [whole[:80], whole[60:140], whole[120:]]
    assert group([track_paths(s, [part], rng) for s, part in enumerate(parts)]) == [[(0, 0), (1, 0), (2, 0)]]


def test_clock_offsets_of_50_ms_do_not_split_a_body(rng: np.random.Generator) -> None:
    walk = simulate_path(0, 6, (1, 1), (2, 0))
    tracked = [
        track_paths(0, [walk], rng),
        track_paths(1, [walk], rng, late=0.05),
        track_paths(2, [walk], rng, late=-0.05),
    ]
    assert group(tracked) == [[(0, 0), (1, 0), (2, 0)]]


def test_bodies_of_a_single_scanner_are_left_out(rng: np.random.Generator) -> None:
    tracked = [
        track_paths(0, [simulate_path(0, 6, (0, 1), (1, 0))], rng),
        track_paths(1, [simulate_path(0, 6, (0, 4), (1, 0))], rng),
    ]
    assert group(tracked) == []


def test_a_long_interruption_splits_a_body(rng: np.random.Generator) -> None:
    walks = [simulate_path(0, 3, (0, 1), (1, 0)), simulate_path(6, 9, (3, 1), (1, 0))]
    assert len(group([track_paths(s, walks, rng) for s in (0, 1)])) == 2


def test_a_short_overlap_does_not_link_tracks(rng: np.random.Generator) -> None:
    whole = simulate_path(0, 8, (0, 1), (1, 0.1))
    parts = [whole[:80], whole[77:]]
    assert group([track_paths(s, [part], rng) for s, part in enumerate(parts)]) == []


def test_a_track_continues_where_the_velocity_leads(rng: np.random.Generator) -> None:
    # Scanner 1 tracks the first part only: the second one belongs to the body by its continuation in scanner 0.
    whole = simulate_path(0, 8, (0, 1), (1.5, 0))
    parts = [whole[:80], whole[96:]]
    tracked = [track_paths(0, parts, rng), track_paths(1, parts[:1], rng)]
    assert group(tracked) == [[(0, 0), (0, 1), (1, 0)]]


def test_of_two_continuations_the_nearer_one_is_taken(rng: np.random.Generator) -> None:
    # Another person comes into view 0.35 m beside where the first one is expected, at the same time.
    whole, beside = simulate_path(0, 8, (0, 1), (1.5, 0)), simulate_path(4.6, 8, (6.9, 1.35), (1.5, 0))
    tracked = [track_paths(0, [whole[:80], beside, whole[92:]], rng), track_paths(1, [whole[:80]], rng)]
    assert group(tracked) == [[(0, 0), (0, 2), (1, 0)]]


def test_people_behind_each_other_are_not_linked(rng: np.random.Generator) -> None:
    paths = [simulate_path(0, 6, (x, 1), (1, 0)) for x in (0, -0.8)]
    assert group([track_paths(s, [path], rng) for s, path in enumerate(paths)]) == []


def test_the_strongest_links_win(rng: np.random.Generator) -> None:
    # Two people walk side by side for five of eight seconds: their tracks are linked, too, but by fewer ticks.
    straight = simulate_path(0, 8, (0, 2), (1, 0))
    other = straight.copy()
    other[:, 2] += 0.3
    other[100:, 2] += np.linspace(0, 2, 60)
    tracked = [track_paths(s, [straight, other], rng) for s in (0, 1)]
    assert group(tracked) == [[(0, 0), (1, 0)], [(0, 1), (1, 1)]]


def test_people_side_by_side_are_not_linked_crosswise(rng: np.random.Generator) -> None:
    """All their tracks are close at all ticks: the closer ones are of one person."""
    walks = [simulate_path(0, 8, (0, y), (1, 0)) for y in (2.0, 2.4)]
    assert group([track_paths(s, walks, rng) for s in (0, 1, 2)]) == [
        [(0, 0), (1, 0), (2, 0)],
        [(0, 1), (1, 1), (2, 1)],
    ]


def test_a_body_of_half_a_second_is_left_out(rng: np.random.Generator) -> None:
    walk = simulate_path(0, 0.5, (1, 1), (1, 0))
    assert group([track_paths(s, [walk], rng) for s in (0, 1)]) == []


def test_without_tracks_there_are_no_bodies() -> None:
    assert group_tracks_by_body([ScannerTracks((), np.zeros((0, 2)), 0.01)] * 2, T_ROOT[:2]) == []


def test_the_tracks_of_a_body_are_grouped_by_scanner(rng: np.random.Generator) -> None:
    whole = simulate_path(0, 9, (0, 1), (1, 0.1))
    tracked = [track_paths(0, [whole], rng), track_paths(1, [whole[:60], whole[62:]], rng)]
    [one] = group_tracks_by_body(tracked, T_ROOT[:2])
    assert {scanner: len(tracks) for scanner, tracks in one.by_scanner().items()} == {0: 1, 1: 2}


def test_a_body_starts_at_its_first_scan(rng: np.random.Generator) -> None:
    """The first scanner misses five scans after its first one, while the second scanner begins."""
    whole = simulate_path(0, 6, (0, 1), (1, 0.1))
    tracked = [track_paths(0, [np.delete(whole, np.arange(1, 6), axis=0)], rng), track_paths(1, [whole[2:]], rng)]
    [one] = group_tracks_by_body(tracked, T_ROOT[:2])
    assert one.start == 0.0


@pytest.mark.parametrize(("overlap", "overlapping"), [(0.17, True), (0.13, False)])
@pytest.mark.parametrize("earlier", [0, 1])
def test_groups_overlap_from_the_first_to_the_last_time_of_their_tracks(
    overlap: float, overlapping: bool, earlier: int
) -> None:
    """Tracks of 3 s, sampled at their ends and in the middle, in either order; the limit is 0.15 s."""
    times = np.array([0.0, 1.5, 3.0])
    tracks = [
        Track(t, np.zeros((3, 2)), np.zeros((3, 2)), np.zeros((3, 2, 2)), 0) for t in (times, times + 3 - overlap)
    ]
    groups = [[_SampledTrack(0, track, np.zeros(0), np.zeros((0, 2)))] for track in tracks]
    assert _overlap_in_scanner(groups[earlier], groups[1 - earlier]) == overlapping


def test_the_strength_of_a_continuation_decreases_with_gap_and_jump(monkeypatch: pytest.MonkeyPatch) -> None:
    """A quarter of the largest gap and of the largest jump: 0.75² of the ticks of the largest gap, ten."""
    monkeypatch.setattr("calgraph.network.joint.track_association._MAX_GAP", 1.0)
    monkeypatch.setattr("calgraph.network.joint.track_association._MAX_JUMP", 0.4)
    still = np.zeros((2, 2))
    earlier = Track(np.array([0.0, 1.0]), still, still, np.zeros((2, 2, 2)), 0)
    later = Track(np.array([1.25, 2.0]), still + np.array([0.1, 0.0]), still, np.zeros((2, 2, 2)), 0)
    sampled = [_SampledTrack(0, track, np.zeros(0), np.zeros((0, 2))) for track in (later, earlier)]
    ((strength, first, second),) = _link_successive(sampled)
    assert (first, second) == (1, 0)
    assert strength == pytest.approx(0.75**2 * 10)
