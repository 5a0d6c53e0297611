"""Capture rows of walks, residuals between scanners, and floor plans."""

from dataclasses import replace

import numpy as np
import pytest

from calgraph.geometry import Array, se2
from calgraph.network.checks.assemble import (
    CrossScannerMatches,
    build_floor_views,
    build_walk_rows,
    match_across_scanners,
)
from calgraph.network.pairs.synchronized_tracks import TrackSamples, resample_tracks
from calgraph.network.tracking.track import ScannerTracks, Track
from calgraph.result import CaptureRow

T_ROOT = {
    "west": np.eye(3),
    "east": se2.pose(2.5, np.array([8.0, 1.0])),
    "north": se2.pose(-1.5, np.array([4.0, 6.0])),
}
START = 1000.0
SIGMA = 0.02


def simulate_walk(begin: float, end: float, y: float) -> Array:
    """(T, 3) times, s, and positions in the root frame, m: along x at 1 m/s."""
    times = START + np.arange(begin, end, 0.05)
    return np.column_stack([times, times - START, np.full(len(times), y)])


def build_tracks(
    name: str, walks: list[Array], rng: np.random.Generator, sigma: tuple[float, float] = (SIGMA, SIGMA)
) -> ScannerTracks:
    """Tracks of walks given in the root frame, with noise of the stated covariance in the scanner frame."""
    T_scanner_root = se2.inverse(T_ROOT[name])
    tracks = tuple(
        Track(
            w[:, 0],
            se2.apply(T_scanner_root, w[:, 1:]) + rng.normal(0, sigma, (len(w), 2)),
            np.tile(T_scanner_root[:2, 0], (len(w), 1)),
            np.tile(np.diag(np.square(sigma)), (len(w), 1, 1)),
            period=0,
        )
        for w in walks
    )
    wall = np.column_stack([np.linspace(0, 10, 5001), np.full(5001, -2.0)])
    wall[2500] = np.nan
    return ScannerTracks(tracks, se2.apply(T_scanner_root, wall), SIGMA)


@pytest.fixture
def samples(rng: np.random.Generator) -> dict[str, TrackSamples]:
    """Three walks of west: shared with east, at a distance from a person in east, and alone."""
    return {
        "west": resample_tracks(
            build_tracks("west", [simulate_walk(0, 4, 0), simulate_walk(5, 9, 0), simulate_walk(10, 14, 0)], rng)
        ),
        "east": resample_tracks(build_tracks("east", [simulate_walk(1, 4.5, 0), simulate_walk(5, 9, 3)], rng)),
        "north": resample_tracks(build_tracks("north", [simulate_walk(0, 4, 0)], rng)),
    }


def match(samples: dict[str, TrackSamples], names: tuple[str, ...] = tuple(T_ROOT)) -> CrossScannerMatches:
    return match_across_scanners(samples, {name: T_ROOT[name] for name in names})


def rows_of(name: str, samples: dict[str, TrackSamples], connected: tuple[str, ...]) -> list[CaptureRow]:
    rows = build_walk_rows(samples, match(samples, connected), START)
    return [row for row in rows if row.sensor == name]


def test_a_shared_walk_is_used(samples: dict[str, TrackSamples]) -> None:
    shared = rows_of("west", samples, ("west", "east"))[0]
    assert (shared.used, shared.reason) == (True, "")
    assert shared.residual is not None
    # Noise of two scanners along two axes; the RMS of 29 distances is accurate to a quarter.
    assert 1.5 * SIGMA < shared.residual < 2.5 * SIGMA


def test_a_walk_of_one_scanner_is_rejected_with_a_reason(samples: dict[str, TrackSamples]) -> None:
    rows = rows_of("west", samples, ("west", "east"))
    assert [(row.used, row.reason, row.residual) for row in rows[1:]] == [
        (False, "other sensors detected people at that time, but not within 0.5 m of it", None),
        (False, "no other sensor detected a person at that time", None),
    ]


def test_reasons_are_given_from_the_side_of_either_scanner(samples: dict[str, TrackSamples]) -> None:
    rows = rows_of("east", samples, ("west", "east"))
    assert [(row.used, row.reason) for row in rows] == [
        (True, ""),
        (False, "other sensors detected people at that time, but not within 0.5 m of it"),
    ]


def test_walks_of_an_unconnected_scanner_are_rejected(samples: dict[str, TrackSamples]) -> None:
    (row,) = rows_of("north", samples, ("west", "east"))
    assert (row.used, row.reason) == (False, "its sensor is not calibrated")


@pytest.mark.parametrize(("y", "used"), [(0.4, True), (0.6, False)])
def test_a_walk_is_shared_within_half_a_metre(y: float, used: bool, rng: np.random.Generator) -> None:
    walks = {"west": simulate_walk(0, 4, 0), "east": simulate_walk(0, 4, y)}
    samples = {name: resample_tracks(build_tracks(name, [walk], rng)) for name, walk in walks.items()}
    assert [row.used for row in rows_of("west", samples, ("west", "east"))] == [used]


def test_a_short_overlap_is_rejected(rng: np.random.Generator) -> None:
    samples = {
        "west": resample_tracks(build_tracks("west", [simulate_walk(0, 4, 0)], rng)),
        "east": resample_tracks(build_tracks("east", [simulate_walk(2, 2.35, 0)], rng)),
    }
    (row,) = rows_of("west", samples, ("west", "east"))
    assert (row.used, row.reason) == (False, "another sensor detected it for less than 0.5 s")


def test_times_count_from_the_start_of_the_recording(samples: dict[str, TrackSamples]) -> None:
    first, second, third = rows_of("west", samples, ("west", "east"))
    np.testing.assert_allclose([first.start, second.start, third.start], [0, 5, 10], atol=0.1)
    np.testing.assert_allclose([first.end, second.end, third.end], [4, 9, 14], atol=0.2)


def test_walks_are_numbered_in_order_of_time(samples: dict[str, TrackSamples]) -> None:
    rows = build_walk_rows(samples, match(samples), START)
    assert [row.capture for row in rows] == list(range(6))
    assert [row.start for row in rows] == sorted(row.start for row in rows)


def test_whitened_residuals_have_unit_variance() -> None:
    """Squared residuals of 40 seeds, 60 each: the mean deviates from 1 by 0.12 with a probability of 1e-4."""
    walk, sigma = simulate_walk(0, 3, 0), (SIGMA, 3 * SIGMA)
    chi2 = []
    for seed in range(40):
        rng = np.random.default_rng(seed)
        samples = {name: resample_tracks(build_tracks(name, [walk], rng, sigma)) for name in ("east", "north")}
        chi2.append(float(np.mean(match(samples).residuals ** 2)))
    assert abs(np.mean(chi2) - 1) < 0.12


def test_matches_of_people_side_by_side_are_mutual_nearest_neighbours(rng: np.random.Generator) -> None:
    """Two walks 0.4 m apart, detected by both: 30 ticks of each, and no match of one with the other."""
    walks = [simulate_walk(0, 3, y) for y in (0.0, 0.4)]
    samples = {name: resample_tracks(build_tracks(name, walks, rng)) for name in ("west", "east")}
    matches = match(samples)
    assert len(matches.residuals) == sum(len(samples[name].tick) for name in samples) / 2
    assert max(distance.max() for distance in matches.distance.values()) < 6 * SIGMA


def test_without_tracks_there_are_no_matches(rng: np.random.Generator) -> None:
    samples = {n: resample_tracks(build_tracks(n, [], rng)) for n in T_ROOT}
    matches = match(samples)
    assert matches.residuals.shape == (0, 2)
    assert build_walk_rows(samples, matches, START) == ()


def test_the_floor_plan_is_in_the_root_frame(rng: np.random.Generator) -> None:
    tracked = {
        "east": build_tracks("east", [simulate_walk(0, 4, 1.5)], rng),
        "north": build_tracks("north", [], rng),
    }
    views = build_floor_views(
        tracked, {n: resample_tracks(t) for n, t in tracked.items()}, {"east": T_ROOT["east"]}, start=0.0
    )
    (view,) = views
    (line,) = view.tracks
    assert view.sensor == "east"
    np.testing.assert_allclose(view.background[:, 1], -2.0, atol=1e-9)
    np.testing.assert_allclose(line[:, 1], 1.5, atol=5 * SIGMA)


def test_times_of_the_floor_plan_count_from_the_start_of_the_recording(rng: np.random.Generator) -> None:
    tracks = {"east": build_tracks("east", [simulate_walk(1, 3, 1.5)], rng)}
    samples = {name: resample_tracks(one) for name, one in tracks.items()}
    (view,) = build_floor_views(tracks, samples, T_ROOT, START)
    (times,), (line,) = view.times, view.tracks
    assert times[0] == pytest.approx(1.0, abs=0.1)
    # The person walks at 1 m/s.
    np.testing.assert_allclose(line[:, 0], times, atol=5 * SIGMA)


@pytest.mark.parametrize(("ticks", "starts"), [(10, [0]), (11, [0, 3]), (21, [0, 4])])
def test_lines_of_the_floor_plan_break_at_gaps_of_more_than_a_second(
    ticks: int, starts: list[int], rng: np.random.Generator
) -> None:
    walk = simulate_walk(0, 6, 1.5)
    tracks = {"east": build_tracks("east", [walk], rng)}
    samples = resample_tracks(tracks["east"])
    kept = np.delete(np.arange(len(samples.tick)), slice(20, 19 + ticks))
    gap = replace(samples, **{name: getattr(samples, name)[kept] for name in ("tick", "positions", "covariances")},
                  trajectory=samples.trajectory[kept])  # fmt: skip
    (view,) = build_floor_views(tracks, {"east": gap}, T_ROOT, START)
    assert [round(float(times[0])) for times in view.times] == starts


def test_the_floor_plan_of_a_long_recording_is_thinned(rng: np.random.Generator) -> None:
    hour = np.concatenate([simulate_walk(0, 3600, 0)])
    hour[:, 1] = 5 + 5 * np.sin(hour[:, 1])
    tracked = build_tracks("west", [hour], rng)
    (view,) = build_floor_views({"west": tracked}, {"west": resample_tracks(tracked)}, T_ROOT, start=0.0)
    assert sum(map(len, view.tracks)) <= 30_000
    # Points on 10 m of wall, one in each cell of 3 cm.
    assert len(view.background) == pytest.approx(333, abs=10)


def test_lines_of_the_floor_plan_have_every_third_tick(rng: np.random.Generator) -> None:
    tracks = {"east": build_tracks("east", [simulate_walk(1, 3, 1.5)], rng)}
    samples = {name: resample_tracks(one) for name, one in tracks.items()}
    (view,) = build_floor_views(tracks, samples, T_ROOT, START)
    np.testing.assert_allclose(np.diff(view.times[0]), 0.3)


@pytest.mark.parametrize(("points", "kept"), [(11_999, 11_999), (12_001, 6_001)])
def test_the_floor_plan_has_at_most_12_000_static_points(points: int, kept: int) -> None:
    wall = np.column_stack([0.1 * np.arange(points), np.zeros(points)])
    tracked = {"west": ScannerTracks((), wall, SIGMA)}
    (view,) = build_floor_views(tracked, {"west": resample_tracks(tracked["west"])}, T_ROOT, START)
    assert len(view.background) == kept


def stand(ticks: int) -> TrackSamples:
    """Samples of a person who stays at one place."""
    x = np.zeros((ticks, 2))
    return TrackSamples(np.arange(ticks), np.zeros(ticks, np.intp), x, x, np.tile(np.eye(2), (ticks, 1, 1)))


@pytest.mark.parametrize(("ticks", "kept"), [(19_990, 19_990), (20_010, 10_005)])
def test_the_histogram_has_at_most_20_000_residuals(ticks: int, kept: int) -> None:
    matches = match_across_scanners(dict.fromkeys("ab", stand(ticks)), {"a": np.eye(3), "b": np.eye(3)})
    assert len(matches.residuals) == kept


@pytest.mark.parametrize(("scanners", "step"), [(1, 4), (2, 7), (3, 11)])
def test_scanners_share_the_30_000_positions_of_the_floor_plan(scanners: int, step: int) -> None:
    """Of 100,000 positions of each scanner, every fourth, seventh or eleventh is the first below the limit."""
    names = list(T_ROOT)[:scanners]
    nothing = ScannerTracks((), np.zeros((0, 2)), SIGMA)
    views = build_floor_views(
        dict.fromkeys(names, nothing),
        dict.fromkeys(names, stand(100_000)),
        {n: T_ROOT[n] for n in names},
        start=0.0,
    )
    np.testing.assert_allclose(np.diff(views[0].times[0]), step * 0.1)
