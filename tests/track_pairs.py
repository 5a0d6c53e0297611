"""Simultaneous samples of objects on smooth paths, as two scanners track them."""

import numpy as np

from calgraph.errors import Rejected
from calgraph.geometry import Array, se2
from calgraph.network.pairs.scanner_pair import DEPTH_STDDEV, ScannerPairEstimate, estimate_scanner_pairs
from calgraph.network.pairs.synchronized_tracks import TICK_PERIOD, SimultaneousPairs, TrackSamples, pair_samples
from calgraph.network.tracking.track import ScannerTracks

T_A_B = se2.pose(2.1, np.array([5.0, 1.5]))


def estimate_scanner_pair(
    name_a: str,
    name_b: str,
    a: ScannerTracks,
    b: ScannerTracks,
    rng: np.random.Generator,
    *,
    icp: bool = True,
    depth_stddev: float = DEPTH_STDDEV,
) -> ScannerPairEstimate | Rejected:
    """The only pair of two scanners."""
    tracked = {name_a: a, name_b: b}
    found = estimate_scanner_pairs(tracked, rng, icp=icp, depth_stddev=depth_stddev)
    return found[name_a, name_b]


def walk_along_curve(seconds: float, number: int = 0) -> tuple[Array, Array]:
    """Positions and velocities (N, 2) in frame a at all ticks of a closed curve, 2 to 6 m from a."""
    t = np.arange(round(seconds / TICK_PERIOD)) * TICK_PERIOD
    u, v = 0.5 * t + number, 0.7 * t + 2.0 * number
    x = np.column_stack([4.0 + 1.8 * np.cos(u), 1.5 * np.sin(v)])
    return x, np.column_stack([-0.9 * np.sin(u), 1.05 * np.cos(v)])


def move_away(x: Array, distance: float) -> Array:
    """Positions (N, 2) farther from the origin by a distance, m."""
    return np.asarray(x * (1 + distance / np.linalg.norm(x, axis=1, keepdims=True)))


def observe_walks(
    walks: list[tuple[Array, Array]],
    rng: np.random.Generator,
    *,
    sigma: float = 0.0,
    stated_sigma: float = 0.02,
    clock_offset: float = 0.0,
    depths: tuple[float, float] = (0.0, 0.0),
) -> SimultaneousPairs:
    """Samples of both scanners with white noise, m; b's are early by the clock offset, all nearer by depths."""
    T_b_a = se2.inverse(T_A_B)
    of_a, of_b = [], []
    for x, v in walks:
        of_a.append((move_away(x, -depths[0]) + sigma * rng.normal(size=x.shape), v))
        x_b = move_away(se2.apply(T_b_a, x - clock_offset * v), -depths[1])
        of_b.append((x_b + sigma * rng.normal(size=x.shape), v @ T_b_a[:2, :2].T))
    return pair_samples(gather_samples(of_a, stated_sigma), gather_samples(of_b, stated_sigma))


def gather_samples(tracks: list[tuple[Array, Array]], sigma: float) -> TrackSamples:
    """One trajectory for each pair of positions and velocities, from tick 0 on."""
    tick = np.concatenate([np.arange(len(x)) for x, _ in tracks])
    trajectory = np.repeat(np.arange(len(tracks)), [len(x) for x, _ in tracks])
    order = np.argsort(tick, kind="stable")
    x, v = (np.concatenate(column)[order] for column in zip(*tracks, strict=True))
    covariances = np.broadcast_to(sigma**2 * np.eye(2), (len(x), 2, 2))
    return TrackSamples(tick[order], trajectory[order], x, v, covariances)
