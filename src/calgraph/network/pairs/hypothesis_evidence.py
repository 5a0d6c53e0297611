"""Pose hypotheses of two scanners, with their evidence: the matches of simultaneous tracks, and those expected.

Hypotheses are least-squares alignments of stretches of a trajectory of each: every combination of two tracks gives
some (Quenzel, Papenberg, Behnke, "Robust extrinsic calibration of multiple stationary laser range finders", 2016,
section III.D).
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from calgraph.geometry import Array, se2
from calgraph.network.pairs.synchronized_tracks import SimultaneousPairs, TrackSamples, pair_samples, to_ticks
from calgraph.network.pairs.track_registration import (
    GATE,
    MAX_MODEL_ERROR,
    NuisancePrior,
    TrackRegistration,
    compute_pose_costs,
    compute_registration_covariance,
)
from calgraph.network.pairs.track_similarity import MAX_RMS, MIN_DURATION, MIN_EXTENT, NOISE

# Standard deviation of the distance between two tracks of one person, m: better fits do not count more.
_TRACK_STDDEV = 0.01
# Standard deviation of the distance between different people on similar trajectories, m.
_COINCIDENCE_STDDEV = 0.15
# Weight of evidence of matching walls against chance: they match in 3 of 130 of these pairs, as in long
# corridors, which is the mean above times ln(130/3).
_WALL_EVIDENCE = 64.0
# Standard deviation of a pair's clock offset, s, up to which its matches are not by chance: people turned or
# changed their speed, which others seldom do at the same times. In 9 of 10 wrong pairs it was above 0.033, and
# below 0.027 in right ones that alone connect a scanner, but three with short walks.
MAX_CLOCK_STDDEV = 0.03


@dataclass(frozen=True, eq=False)
class PoseHypothesis:
    """A possible relative pose of two scanners, with its evidence."""

    T_a_b: Array
    """(3, 3)."""
    information: Array
    """(3, 3) inverse covariance of T_a_b's error (x, y, theta) in the fixed axes of a."""
    observations: int
    """Number of matching simultaneous positions, at ticks."""
    chance_observations: float
    """Expected number of matches if the scanners had tracked different people in the same places."""
    matched_share: float
    """Share of matches among the expected ones: positions where both scanners often detect people, 0..1."""
    cost: float
    """Mean truncated squared distance of a's samples to the nearest of b, over the gate, 0..1."""
    model_error: float
    """Standard deviation of the matches' distances beyond the tracks' covariances, m."""
    uses_background: bool
    """Whether the static background contributed by ICP."""
    clock_offset: float = 0.0
    """Clock of b minus clock of a, s."""
    clock_stddev: float = np.inf
    """Standard deviation of the clock offset, s."""
    lateral_spread: float = 0.0
    """Standard deviation of the matched positions across their main direction, m: near 0, mirrored tracks fit."""

    def weight_of_evidence(self) -> float:
        """Log likelihood ratio of the matches: same people against different people with similar trajectories.

        Source: Good, "Probability and the weighing of evidence", 1950. It is scaled by the share of matches among
        the expected ones. Positions are treated as independent, which they are not: it is not a probability.
        """
        stddev = np.hypot(self.model_error, _TRACK_STDDEV)
        return self.matched_share * self.observations * float(np.log(_COINCIDENCE_STDDEV / stddev))

    def weight_of_reflection(self, center_stddev: float) -> float:
        """Weight of evidence of the same matches if one of the scanners were mounted the other way up.

        A mirrored scanner is posed so that it reflects the positions at their main direction: they are then off by
        twice their distance from it. Centres of people differ between scanners by more than smooth tracks show,
        so that the difference to :meth:`weight_of_evidence` is computed with at least their standard deviation.

        Args:
            center_stddev: standard deviation of the distance from tracked to true centres, m.
        """
        stddev = np.hypot(self.model_error, center_stddev)
        ratio = np.hypot(stddev, 2 * self.lateral_spread) / stddev
        lost = self.matched_share * self.observations * float(np.log(ratio))
        return self.weight_of_evidence() - lost

    def may_be_by_chance(self, scanners: int) -> bool:
        """Whether different people may match like this in a network of this number of scanners.

        All of a straight walk at one speed matches all others at that speed, and does not determine the clocks.
        """
        evidence = self.weight_of_evidence() + _WALL_EVIDENCE * self.uses_background
        undetermined = self.clock_stddev > MAX_CLOCK_STDDEV
        return undetermined and evidence < compute_chance_evidence(scanners)


# Share of all pairs of scanners that tracked different people and match by chance, with the least evidence:
# 3.6e-4 and 2.6e-4.
_RATE = 4e-4
# Mean weight of evidence of these pairs above the least one, which is distributed exponentially.
_EVIDENCE_SCALE = 17.0
# Expected number of these pairs in a whole network from which a scanner needs more evidence: one in twenty
# networks has a scanner that chance connects. Up to 16 scanners, the least evidence suffices.
_MAX_EXPECTED = 0.05
# Minimum weight of evidence of a hypothesis, a log likelihood ratio: a perfect fit of 2 s has 52, a fit with 9 cm
# needs 9 s for the same. Chosen on simulated networks (short_networks.py at df299a6b).
MIN_WEIGHT_OF_EVIDENCE = 45.0


def compute_chance_evidence(scanners: int) -> float:
    """Weight of evidence that hardly any two scanners of a network reach by matching different people.

    The number of pairs that match different people decreases exponentially with their evidence, and increases with
    the number of pairs that are compared.

    Args:
        scanners: of the network, all pairs of which were compared.
    """
    expected = _RATE * scanners * (scanners - 1) / 2
    excess = _EVIDENCE_SCALE * float(np.log(max(expected / _MAX_EXPECTED, 1.0)))
    return MIN_WEIGHT_OF_EVIDENCE + excess


# Minimum ratio of matches to those by chance, where both always track people in one passage.
_MIN_CHANCE_RATIO = 2.0
# Minimum share of matches among expected ones: a quarter remains where furniture occludes half of the positions
# from either scanner.
MIN_MATCHED_SHARE = 0.25


def is_credible(h: PoseHypothesis, min_observations: int) -> bool:
    """Tests whether matches exceed those by chance and by similar trajectories, and enough expected ones exist."""
    return (
        h.observations >= max(min_observations, _MIN_CHANCE_RATIO * h.chance_observations)
        and h.weight_of_evidence() >= MIN_WEIGHT_OF_EVIDENCE
        and h.matched_share >= MIN_MATCHED_SHARE
    )


# Samples of a that subsampling leaves at least.
_MIN_SAMPLES = 20


def subsample_pairs(pairs: SimultaneousPairs, wanted: int) -> SimultaneousPairs:
    """Selects every n-th tick to leave about ``wanted`` pairs; all pairs if too few samples would be left."""
    step = max(1, round(len(pairs) / wanted))
    subsampled = pair_samples(pairs.a.subsample(step), pairs.b.subsample(step))
    return subsampled if len(np.unique(subsampled.row_a)) >= _MIN_SAMPLES else pairs


def select_distinct(T: Array, cost: Array, count: int, position: float, angle: float) -> list[int]:
    """Rows of up to ``count`` poses (K, 3, 3) of least cost (K,) that differ from each other, m or rad."""
    kept: list[int] = []
    for i in np.argsort(cost, kind="stable").tolist():
        d = se2.difference(T[kept], T[i])
        same = (np.hypot(d[:, 0], d[:, 1]) < position) & (np.abs(d[:, 2]) < angle)
        if not same.any():
            kept.append(i)
        if len(kept) == count:
            break
    return kept


# Positions whose neighbours are counted at most: the standard error of a share is below 3 %.
_MAX_QUERIES = 300


def build_hypothesis(
    fit: TrackRegistration,
    pairs: SimultaneousPairs,
    a: TrackSamples,
    b: TrackSamples,
    count: int,
    prior: NuisancePrior,
) -> PoseHypothesis:
    """A registration with its evidence.

    Args:
        fit: the registration.
        pairs: the simultaneous pairs that were registered.
        a: all samples of a.
        b: all samples of b.
        count: number of simultaneous pairs, of which ``pairs`` are a selection.
        prior: of the registration.
    """
    scale = count / len(pairs)
    expected = count_expected(fit.T_a_b, pairs, a, b)
    covariance = compute_registration_covariance(fit, pairs, prior)
    matched = pairs.x_a[fit.matches]
    return PoseHypothesis(
        fit.T_a_b,
        np.asarray(np.linalg.inv(covariance[:3, :3]), dtype=np.float64),
        round(len(fit.matches) * scale),
        _count_by_chance(fit, pairs, b) * scale,
        min(len(fit.matches) / expected, 1.0),
        float(compute_pose_costs(fit.T_a_b[None], pairs, MAX_MODEL_ERROR)[0]),
        fit.model_error,
        uses_background=False,
        clock_offset=float(fit.nuisance[0]) - prior.clock_mean,
        clock_stddev=float(np.sqrt(covariance[3, 3])),
        lateral_spread=float(np.sqrt(max(np.linalg.eigvalsh(np.cov(matched.T))[0], 0.0))),
    )


def _count_by_chance(fit: TrackRegistration, pairs: SimultaneousPairs, b: TrackSamples) -> float:
    """Expected number of a's samples that match one of b by chance, from matches at all times.

    If both scanners detect people all the time in one narrow passage, the number is large under any pose that
    superimposes the passages.
    """
    radius = np.sqrt(GATE * (float(np.median(pairs.variance)) + fit.model_error**2))
    sampled = pairs.a.positions[:: max(1, len(pairs.a.tick) // _MAX_QUERIES)]
    near = _count_neighbours(sampled, se2.inverse(fit.T_a_b), b, radius)
    return float(np.mean(1 - np.exp(-near / len(np.unique(b.tick))))) * len(pairs.a.tick)


def count_expected(T_a_b: Array, pairs: SimultaneousPairs, a: TrackSamples, b: TrackSamples) -> float:
    """Expected number (>= 1) of matches under a correct pose: samples where the other often detects people."""
    of_a = _count_observable(se2.inverse(T_a_b), pairs.a, b)
    of_b = _count_observable(T_a_b, pairs.b, a)
    return max(of_a, of_b, 1)


# Distance within which a scanner's other detections show that it detects people at a place, m.
_NEIGHBOUR_RADIUS = 0.4
# Number of detections within that distance for a match to be expected there.
_MIN_NEIGHBOURS = 3


def _count_observable(T: Array, samples: TrackSamples, other: TrackSamples) -> float:
    overlapping = (samples.tick >= other.tick.min()) & (samples.tick <= other.tick.max())
    x = samples.positions[overlapping]
    sampled = x[:: max(1, len(x) // _MAX_QUERIES)]
    near = _count_neighbours(sampled, T, other, _NEIGHBOUR_RADIUS)
    return float(np.mean(near >= _MIN_NEIGHBOURS)) * len(x)


def _count_neighbours(x: Array, T: Array, samples: TrackSamples, radius: float) -> NDArray[np.intp]:
    """Number of samples of all times within the radius of each transformed point (N, 2)."""
    near = samples.tree.query_ball_point(se2.apply(T, x), radius, return_length=True)
    return np.asarray(near, dtype=np.intp)


# Lengths of the stretches, s; whole trajectories are used, too. Short ones survive identity switches of the
# tracker, long ones determine the angle.
_STRETCH_DURATIONS = (3.0, 8.0)
# Number of hypotheses that are scored: half of them the best, half random; bounds the time for crowds. 200 of
# 2,800 (40 people, ten minutes) contained the right pose in 31 of 40 cases, 800 in all 40.
_MAX_COUNT = 800


def propose_poses(pairs: SimultaneousPairs, rng: np.random.Generator, max_count: int = _MAX_COUNT) -> Array:
    """Proposes poses (K, 3, 3) from stretches of every combination of a trajectory of a with one of b.

    The stretches with the largest extent and the smallest RMS distance come first, then a random selection.
    """
    trajectories = pairs.trajectories
    order = np.argsort(trajectories, kind="stable")  # and ascending in tick within each trajectory
    trajectories, ticks = trajectories[order], pairs.a.tick[pairs.row_a][order]
    moments = _compute_moments(pairs.x_a[order], pairs.x_b[order])
    poses, scores = [], []
    for length in (*map(to_ticks, _STRETCH_DURATIONS), np.iinfo(np.intp).max):
        begins = np.diff(trajectories, prepend=-1).astype(bool) | np.diff(ticks // length, prepend=-1).astype(bool)
        T, fit, extent = _fit_stretches(moments, np.flatnonzero(begins), to_ticks(MIN_DURATION))
        usable = (extent > MIN_EXTENT) & (fit < MAX_RMS)
        poses.append(T[usable])
        scores.append(extent[usable] / (fit[usable] + NOISE))
    T, score = np.concatenate(poses), np.concatenate(scores)
    order = np.argsort(-score)
    if len(order) > max_count:
        first, rest = np.split(order, [max_count // 2])
        order = np.concatenate([first, rng.choice(rest, max_count - len(first), replace=False)])
    return np.asarray(T[order])


def _compute_moments(x_a: Array, x_b: Array) -> Array:
    """Moments (M, 9) whose sums over a stretch determine its least-squares pose."""
    dot, cross = np.sum(x_a * x_b, axis=1), x_b[:, 0] * x_a[:, 1] - x_b[:, 1] * x_a[:, 0]
    squares = np.sum(x_a**2, axis=1), np.sum(x_b**2, axis=1)
    return np.column_stack([np.ones(len(x_a)), x_a, x_b, dot, cross, *squares])


def _fit_stretches(moments: Array, starts: NDArray[np.intp], min_ticks: int) -> tuple[Array, Array, Array]:
    """Fits poses to all stretches of all combinations of trajectories (Kabsch).

    Args:
        moments: (M, 9) from :func:`_compute_moments`, ordered by stretch.
        starts: (K,) first row of each stretch.
        min_ticks: least number of rows of a stretch.

    Returns:
        Poses (K, 3, 3), RMS distances (K,), m, and extents of the trajectories (K,), m; infinite distances for
        stretches of too few ticks.
    """
    sums = np.add.reduceat(moments, starts)
    count = sums[:, 0]
    center_a, center_b, dot, cross, square_a, square_b = np.split(sums[:, 1:] / count[:, None], [2, 4, 5, 6, 7], 1)
    dot = (dot - np.sum(center_a * center_b, axis=1, keepdims=True))[:, 0]
    cross = cross[:, 0] - (center_b[:, 0] * center_a[:, 1] - center_b[:, 1] * center_a[:, 0])
    spread_a = square_a[:, 0] - np.sum(center_a**2, axis=1)
    spread_b = square_b[:, 0] - np.sum(center_b**2, axis=1)
    T = se2.pose(np.arctan2(cross, dot), np.zeros(2))
    T[:, :2, 2] = center_a - np.einsum("kij,kj->ki", T[:, :2, :2], center_b)
    fit = np.sqrt(np.maximum(spread_a + spread_b - 2 * np.hypot(dot, cross), 0))
    extent = np.sqrt(np.maximum(np.minimum(spread_a, spread_b), 0))
    return T, np.where(count < min_ticks, np.inf, fit), extent
