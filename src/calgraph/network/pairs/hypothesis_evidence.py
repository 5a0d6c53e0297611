"""Pose hypotheses of two scanners, with their evidence: the matches of simultaneous tracks, and those expected."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from calgraph.geometry import Array, se2
from calgraph.network.pairs.synchronized_tracks import SimultaneousPairs, TrackSamples, pair_samples
from calgraph.network.pairs.track_registration import (
    GATE,
    MAX_MODEL_ERROR,
    NuisancePrior,
    TrackRegistration,
    compute_pose_costs,
    compute_registration_covariance,
)

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
# needs 9 s for the same. Chosen on benchmarks/short_networks.py.
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


def subsample_pairs(pairs: SimultaneousPairs, wanted: int, min_samples: int) -> SimultaneousPairs:
    """Selects every n-th tick to leave about ``wanted`` pairs; all pairs if too few samples would be left."""
    step = max(1, round(len(pairs) / wanted))
    subsampled = pair_samples(pairs.a.subsample(step), pairs.b.subsample(step))
    return subsampled if len(np.unique(subsampled.row_a)) >= min_samples else pairs


def select_distinct(T: Array, cost: Array, count: int, position: float, angle: float) -> Array:
    """Selects up to ``count`` poses (n, 3, 3) of least cost (K,); see :func:`select_distinct_rows`."""
    return np.asarray(T[select_distinct_rows(T, cost, count, position, angle)])


def select_distinct_rows(T: Array, cost: Array, count: int, position: float, angle: float) -> list[int]:
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
