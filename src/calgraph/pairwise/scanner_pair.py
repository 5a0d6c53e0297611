"""Relative poses of stationary scanners from simultaneous tracks.

Source: Quenzel, Papenberg, Behnke, "Robust extrinsic calibration of multiple stationary laser range finders",
2016, section III.D: every combination of two tracks gives hypotheses, which are scored on all tracks of all
periods. Its truncation at the scanner's range, which mixes metres with Mahalanobis distances, is a χ² gate here.
"""

import itertools
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from calgraph.errors import Rejected
from calgraph.geometry import Array, se2
from calgraph.pairwise.icp import StaticBackground, align_backgrounds
from calgraph.pairwise.pose_hypotheses import propose_poses
from calgraph.pairwise.synchronized_tracks import (
    TICK_PERIOD,
    SimultaneousPairs,
    TrackSamples,
    pair_samples,
)
from calgraph.pairwise.track_registration import (
    ASSOCIATION_GATE,
    DEPTH_STDDEV,
    TrackRegistration,
    compute_pose_costs,
    compute_registration_information,
    register_tracks,
)
from calgraph.pairwise.visibility_map import ScannerObservations, contradicts_visibility
from calgraph.processes import parallel_map
from calgraph.tracking import ScannerTracks

# Simultaneous pairs on which hypotheses are scored roughly, coarsely and finely, numbers of hypotheses that are
# registered coarsely and finely, and least number of samples of a on which hypotheses are scored.
_ROUGH_PAIRS = 300
_COARSE_PAIRS = 1200
_FINE_PAIRS = 6_000
_COARSE_HYPOTHESES = 6
_FINE_HYPOTHESES = 4
_MIN_SAMPLES = 20
# Standard deviation of positions under a proposed pose, whose angle comes from a short stretch, m.
_PROPOSAL_STDDEV = 0.3
# Distance within which the other scanner detects an object under a correct pose, m, and least number of expected
# detections to judge a pose.
_DETECTION_RADIUS = 0.5
_MIN_EXPECTED = 20
# A pose is rejected if a larger share of the expected detections is missed. Under correct poses the share is
# mostly below 0.2, but up to 0.5 where furniture occludes people from one of the two.
_MAX_MISSED_SHARE = 0.5
# Two hypotheses are duplicates if they differ by less than this, m and rad.
_SAME_POSE = (0.5, np.radians(8))
# Least number of matches, their least share of the expected ones, their least ratio to those by chance, and the
# least ratio of a score to that of the best hypothesis.
_MIN_TICKS = 20
_MIN_MATCHED_SHARE = 0.25
_MIN_CHANCE_RATIO = 2.0
_MIN_SCORE_RATIO = 0.4
# Standard deviation of the distance between different people with similar trajectories under a wrong pose, and
# between two tracks of one person, m. Least log likelihood ratio of the two: a perfect fit of 2 s has 52, a fit
# with 9 cm needs 9 s for the same.
_COINCIDENCE_STDDEV, _TRACK_STDDEV = 0.15, 0.01
_MIN_WEIGHT_OF_EVIDENCE = 45.0
# A scanner often detects people at a place if it has this number of samples within this distance of it, m.
_NEIGHBOUR_RADIUS = 0.4
_MIN_NEIGHBOURS = 3
# Fewer pairs than these are evaluated faster than other processes start.
_MIN_PARALLEL_PAIRS = 6
# Maximum number of positions whose neighbours are counted.
_MAX_QUERIES = 300


@dataclass(frozen=True, eq=False)
class PoseHypothesis:
    """A possible relative pose of two scanners, with its evidence."""

    T_a_b: Array
    """(3, 3)."""
    information: Array
    """(3, 3) inverse covariance of T_a_b's error (x, y, theta) in the fixed axes of a."""
    observations: int
    """Number of matching simultaneous positions, at ticks of 0.1 s."""
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

    @property
    def score(self) -> float:
        """Number of matches times their share of the expected ones."""
        return self.observations * self.matched_share

    @property
    def weight_of_evidence(self) -> float:
        """Log likelihood ratio of the matches: same people against different people with similar trajectories.

        Source: Good, "Probability and the weighing of evidence", 1950. It is scaled by the share of matches among
        the expected ones. Positions are treated as independent, which they are not: it is not a probability.
        """
        return (
            self.matched_share
            * self.observations
            * float(np.log(_COINCIDENCE_STDDEV / np.hypot(self.model_error, _TRACK_STDDEV)))
        )


@dataclass(frozen=True, eq=False)
class _ScannerData:
    """Data of one scanner, shared by all its pairs."""

    observations: ScannerObservations
    background: StaticBackground
    sigma: float
    """Standard deviation of the background's ranges, m."""

    @classmethod
    def from_tracks(cls, tracked: ScannerTracks) -> "_ScannerData":
        return cls(ScannerObservations.from_tracks(tracked), StaticBackground(tracked.background), tracked.sigma)


@dataclass(frozen=True, eq=False)
class ScannerPairEstimate:
    """Pose hypotheses of a pair of stationary scanners; at most one is correct."""

    sensor_a: str
    sensor_b: str
    hypotheses: tuple[PoseHypothesis, ...]
    """Best first; never empty."""

    @property
    def T_a_b(self) -> Array:
        """(3, 3) of the best hypothesis."""
        return self.hypotheses[0].T_a_b

    @property
    def information(self) -> Array:
        """(3, 3) of the best hypothesis."""
        return self.hypotheses[0].information


def estimate_scanner_pairs(
    tracked: Mapping[str, ScannerTracks],
    rng: np.random.Generator,
    *,
    icp: bool = True,
    depth_stddev: float = DEPTH_STDDEV,
    jobs: int = 1,
    progress: Callable[[float], None] = lambda _done: None,
) -> dict[tuple[str, str], ScannerPairEstimate | Rejected]:
    """Estimates the relative pose of every pair of scanners, as :func:`estimate_network_pair` does.

    Args:
        tracked: tracks and background of each scanner, by its name.
        rng: random generator for the selection of hypotheses.
        icp: whether to match the static background, too.
        depth_stddev: prior standard deviation of the distance from tracked to true centres along the beam, m: some
            centimetres for fitted ellipses, 0.1 and more for centres of mass.
        jobs: maximum number of processes, see :func:`calgraph.processes.parallel_map`; does not affect the result.
        progress: called with the completed fraction, 0..1.
    """
    scanners = {name: _ScannerData.from_tracks(tracks) for name, tracks in tracked.items()}
    names = list(itertools.combinations(tracked, 2))
    pairs = [(scanners[a], scanners[b]) for a, b in names]
    # Random numbers are drawn here in a fixed order, so that results do not depend on the number of processes.
    proposals = [_propose_hypotheses(a.observations.samples, b.observations.samples, rng) for a, b in pairs]
    work = [(*names[k], *pairs[k], proposals[k], icp, depth_stddev) for k in range(len(names))]
    found = parallel_map(_evaluate_hypotheses, work, jobs if len(work) >= _MIN_PARALLEL_PAIRS else 1, progress)
    return dict(zip(names, found, strict=True))


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
    """Estimates ``T_a_b`` from the people that both scanners tracked.

    Args:
        name_a: name of scanner a.
        name_b: name of scanner b.
        a: its tracks and background.
        b: those of b.
        rng: random generator for the selection of hypotheses.
        icp: whether to match the static background, too.
        depth_stddev: prior standard deviation of the distance from tracked to true centres along the beam, m: some
            centimetres for fitted ellipses, 0.1 and more for centres of mass.

    Returns:
        The best hypotheses, or the reason why there is none.
    """
    of_a, of_b = _ScannerData.from_tracks(a), _ScannerData.from_tracks(b)
    proposals = _propose_hypotheses(of_a.observations.samples, of_b.observations.samples, rng)
    return _evaluate_hypotheses(name_a, name_b, of_a, of_b, proposals, icp, depth_stddev)


def _propose_hypotheses(a: TrackSamples, b: TrackSamples, rng: np.random.Generator) -> Array | Rejected:
    """Proposes poses (K, 3, 3)."""
    pairs = pair_samples(a, b)
    seconds = len(np.unique(pairs.a.tick[pairs.row_a])) * TICK_PERIOD
    if seconds < _MIN_TICKS * TICK_PERIOD:
        needed = _MIN_TICKS * TICK_PERIOD
        return Rejected(f"both tracked somebody at the same time for {seconds:.1f} s, {needed:.1f} s are needed")
    poses = propose_poses(pairs, rng)
    if not len(poses):
        return Rejected("no trajectory of one has the shape of one of the other, or all are too short")
    return poses


def _evaluate_hypotheses(
    name_a: str,
    name_b: str,
    scanner_a: _ScannerData,
    scanner_b: _ScannerData,
    proposals: Array | Rejected,
    icp: bool,
    depth_stddev: float,
) -> ScannerPairEstimate | Rejected:
    """Registers and scores proposed poses, coarsely, then finely."""
    if isinstance(proposals, Rejected):
        return proposals
    a, b = scanner_a.observations.samples, scanner_b.observations.samples
    maps = scanner_a.observations.visibility, scanner_b.observations.visibility
    pairs = pair_samples(a, b)
    rough, coarse, fine = (
        _subsample_pairs(pairs, wanted) for wanted in (_ROUGH_PAIRS, _COARSE_PAIRS, _FINE_PAIRS)
    )
    refuted = contradicts_visibility(
        proposals,
        rough,
        *maps,
        radius=_DETECTION_RADIUS + _PROPOSAL_STDDEV,
        min_expected=_MIN_EXPECTED * len(rough) / len(pairs),
        max_missed_share=_MAX_MISSED_SHARE,
    )
    proposals = proposals[~refuted]
    proposals = _select_distinct(
        proposals, compute_pose_costs(proposals, coarse, _PROPOSAL_STDDEV), _COARSE_HYPOTHESES
    )
    registrations = [
        fit
        for T in proposals
        if (fit := register_tracks(T, coarse, depth_stddev=depth_stddev, steps=3)) is not None
    ]
    refuted = contradicts_visibility(
        _stack_poses(registrations),
        coarse,
        *maps,
        radius=_DETECTION_RADIUS,
        min_expected=_MIN_EXPECTED * len(coarse) / len(pairs),
        max_missed_share=_MAX_MISSED_SHARE,
    )
    registrations = [fit for fit, wrong in zip(registrations, refuted, strict=True) if not wrong]
    if not registrations:
        return Rejected("under every proposed pose, one does not detect what the other tracks in its view")
    shares = np.array(
        [len(fit.matches) / max(_expected_matches(fit.T_a_b, coarse, a, b), 1) for fit in registrations]
    )
    scores = np.array([len(fit.matches) for fit in registrations]) * shares
    promising = (shares >= _MIN_MATCHED_SHARE) & (scores >= _MIN_SCORE_RATIO * np.max(scores, initial=0.0))
    poses = _select_distinct(_stack_poses(registrations)[promising], -scores[promising], _FINE_HYPOTHESES)
    refined = [register_tracks(T, fine, depth_stddev=depth_stddev, steps=3, model_error=0.1) for T in poses]
    hypotheses = [
        _build_hypothesis(fit, fine, a, b, len(pairs), depth_stddev) for fit in refined if fit is not None
    ]
    hypotheses.sort(key=lambda h: -h.score)
    kept = [h for h in hypotheses if _is_credible(h)]
    if not kept:
        most = round(max(map(len, (fit.matches for fit in registrations)), default=0) * len(pairs) / len(coarse))
        return Rejected(
            f"no pose hypothesis is credible: the best one matches {most * TICK_PERIOD:.1f} s of tracks, which "
            "chance or similar trajectories explain as well"
        )
    kept = [h for h in kept if h.score >= _MIN_SCORE_RATIO * kept[0].score]
    if icp:
        kept = [_align_with_background(h, scanner_a, scanner_b) for h in kept]
    return ScannerPairEstimate(name_a, name_b, tuple(kept))


def _stack_poses(fits: Sequence[TrackRegistration]) -> Array:
    """(K, 3, 3)."""
    return np.array([fit.T_a_b for fit in fits]).reshape(-1, 3, 3)


def _is_credible(h: PoseHypothesis) -> bool:
    """Tests whether matches exceed those by chance and by similar trajectories, and enough expected ones exist."""
    return (
        h.observations >= max(_MIN_TICKS, _MIN_CHANCE_RATIO * h.chance_observations)
        and h.weight_of_evidence >= _MIN_WEIGHT_OF_EVIDENCE
        and h.matched_share >= _MIN_MATCHED_SHARE
    )


def _subsample_pairs(pairs: SimultaneousPairs, wanted: int) -> SimultaneousPairs:
    """Selects every n-th tick to leave about ``wanted`` pairs; all pairs if too few samples would be left."""
    step = max(1, round(len(pairs) / wanted))
    subsampled = pair_samples(pairs.a.subsample(step), pairs.b.subsample(step))
    return subsampled if len(np.unique(subsampled.row_a)) >= _MIN_SAMPLES else pairs


def _select_distinct(T: Array, cost: Array, count: int) -> Array:
    """Selects up to ``count`` poses (n, 3, 3) of least cost (K,) that differ from each other."""
    kept: list[Array] = []
    for i in np.argsort(cost):
        if not any(_are_close(T[i], other) for other in kept):
            kept.append(T[i])
        if len(kept) == count:
            break
    return np.array(kept)


def _are_close(T: Array, other: Array) -> bool:
    d = se2.difference(T, other)
    return bool(np.hypot(d[0], d[1]) < _SAME_POSE[0] and abs(d[2]) < _SAME_POSE[1])


def _build_hypothesis(
    fit: TrackRegistration,
    pairs: SimultaneousPairs,
    a: TrackSamples,
    b: TrackSamples,
    count: int,
    depth_stddev: float,
) -> PoseHypothesis:
    scale = count / len(pairs)
    return PoseHypothesis(
        fit.T_a_b,
        compute_registration_information(fit, pairs, depth_stddev),
        round(len(fit.matches) * scale),
        _expected_by_chance(fit, pairs, b) * scale,
        min(len(fit.matches) / max(_expected_matches(fit.T_a_b, pairs, a, b), 1), 1.0),
        float(compute_pose_costs(fit.T_a_b[None], pairs)[0]),
        fit.model_error,
        uses_background=False,
    )


def _expected_by_chance(fit: TrackRegistration, pairs: SimultaneousPairs, b: TrackSamples) -> float:
    """Expected number of a's samples that match one of b by chance, from matches at all times.

    If both scanners detect people all the time in one narrow passage, the number is large under any pose that
    superimposes the passages.
    """
    radius = np.sqrt(ASSOCIATION_GATE * (float(np.median(pairs.variance)) + fit.model_error**2))
    sampled = pairs.a.positions[:: max(1, len(pairs.a.tick) // _MAX_QUERIES)]
    near = _count_neighbours(sampled, se2.inverse(fit.T_a_b), b, radius)
    return float(np.mean(1 - np.exp(-near / len(np.unique(b.tick))))) * len(pairs.a.tick)


def _expected_matches(T_a_b: Array, pairs: SimultaneousPairs, a: TrackSamples, b: TrackSamples) -> float:
    """Expected number of matches under a correct pose: samples where the other scanner often detects people."""
    return max(_count_observable(se2.inverse(T_a_b), pairs.a, b), _count_observable(T_a_b, pairs.b, a))


def _count_observable(T: Array, samples: TrackSamples, other: TrackSamples) -> float:
    overlapping = (samples.tick >= other.tick.min()) & (samples.tick <= other.tick.max())
    x = samples.positions[overlapping]
    sampled = x[:: max(1, len(x) // _MAX_QUERIES)]
    return float(np.mean(_count_neighbours(sampled, T, other, _NEIGHBOUR_RADIUS) >= _MIN_NEIGHBOURS)) * len(x)


def _count_neighbours(x: Array, T: Array, samples: TrackSamples, radius: float) -> NDArray[np.intp]:
    """Number of samples of all times within the radius of each transformed point (N, 2)."""
    near = samples.tree.query_ball_point(se2.apply(T, x), radius, return_length=True)
    return np.asarray(near, dtype=np.intp)


def _align_with_background(h: PoseHypothesis, a: _ScannerData, b: _ScannerData) -> PoseHypothesis:
    """Fuses the hypothesis with the alignment of the static backgrounds, unless that is rejected."""
    covariance = np.asarray(np.linalg.inv(h.information), dtype=np.float64)
    sigma = float(np.hypot(a.sigma, b.sigma))
    alignment = align_backgrounds(h.T_a_b, covariance, a.background, b.background, sigma)
    if isinstance(alignment, Rejected):
        return h
    T_a_b, information = alignment.fuse(h.T_a_b, h.information)
    return replace(h, T_a_b=T_a_b, information=information, uses_background=True)
