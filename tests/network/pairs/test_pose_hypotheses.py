"""Pose hypotheses from stretches of trajectories."""

import numpy as np
import pytest

from calgraph.geometry import Array, se2
from calgraph.network.pairs.hypothesis_evidence import propose_poses
from calgraph.network.pairs.synchronized_tracks import pair_samples
from track_pairs import T_A_B, gather_samples, observe_walks, walk_along_curve


def propose_for(x_a: Array, x_b: Array) -> Array:
    """Proposals from one trajectory of either scanner."""
    v = np.zeros_like(x_a)
    pairs = pair_samples(gather_samples([(x_a, v)], 0.02), gather_samples([(x_b, v)], 0.02))
    return propose_poses(pairs, np.random.default_rng(0))


def walk_straight(length: float, ticks: int = 20) -> Array:
    """Positions (N, 2) on a line along x, evenly spaced."""
    return np.column_stack([2.0 + np.linspace(0, length, ticks), np.ones(ticks)])


def test_every_stretch_of_an_exact_trajectory_gives_the_pose(rng: np.random.Generator) -> None:
    """20 s are seven stretches of at most 3 s, three of at most 8 s, and the whole."""
    poses = propose_poses(observe_walks([walk_along_curve(20.0)], rng), rng)
    assert len(poses) == 7 + 3 + 1
    np.testing.assert_allclose(poses, np.broadcast_to(T_A_B, (11, 3, 3)), atol=1e-6)


def test_stretches_of_the_same_person_come_first(rng: np.random.Generator) -> None:
    """Of two people's four combinations of trajectories two are right: 22 stretches."""
    walks = [walk_along_curve(20.0, number) for number in (0, 1)]
    poses = propose_poses(observe_walks(walks, rng), rng)
    np.testing.assert_allclose(poses[:22], np.broadcast_to(T_A_B, (22, 3, 3)), atol=1e-6)


def test_a_stretch_needs_the_least_extent() -> None:
    """Evenly spaced positions on a line of length L have a standard deviation of L / sqrt(12)."""
    long, short = (walk_straight(factor * 0.15 * np.sqrt(12), 200) for factor in (1.05, 0.95))
    assert len(propose_for(long, long)) == 1
    assert len(propose_for(short, short)) == 0
    assert len(propose_for(short, long)) == 0
    assert len(propose_for(long, short)) == 0


def test_a_stretch_needs_the_least_duration() -> None:
    assert len(propose_for(walk_straight(1.0, 6), walk_straight(1.0, 6))) == 3
    assert len(propose_for(walk_straight(1.0, 5), walk_straight(1.0, 5))) == 0


def test_trajectories_of_another_shape_are_not_aligned(monkeypatch: pytest.MonkeyPatch) -> None:
    """Of one line half as long as the other, scaled about their centres, the RMS distance is half the extent."""
    extent = 2.0 / np.sqrt(12) * np.sqrt(21 / 19)  # of 20 evenly spaced positions
    line, half = walk_straight(2.0), walk_straight(1.0)
    for factor, count in ((1.02, 3), (0.98, 0)):
        monkeypatch.setattr("calgraph.network.pairs.hypothesis_evidence.MAX_RMS", factor * extent / 2)
        assert len(propose_for(line, half)) == count


def test_proposals_are_limited_to_the_best_and_a_random_rest(
    rng: np.random.Generator, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("calgraph.network.pairs.hypothesis_evidence.MAX_RMS", 2.0)
    walks = [walk_along_curve(20.0, number) for number in (0, 1)]
    pairs = observe_walks(walks, rng)
    poses = propose_poses(pairs, rng, max_count=20)
    assert len(poses) == 20
    errors = np.abs(se2.difference(poses, np.broadcast_to(T_A_B, poses.shape))).max(axis=1)
    assert (errors[:10] < 1e-6).all()
    every = propose_poses(pairs, rng, max_count=1000)
    assert len(every) > 30
