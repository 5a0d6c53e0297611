"""Relative poses of stationary scanners from what both saw moving at the same time.

Source: Quenzel, Papenberg, Behnke, "Robust extrinsic calibration of multiple stationary laser range finders",
2016, section III.D: every combination of two tracks gives hypotheses, and all tracks of all periods judge
them. Its truncation at the scanner's range, which mixes metres with Mahalanobis distances, is a χ² gate here.
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
    pair_simultaneous_samples,
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

# Combinations of samples on which hypotheses are judged roughly, coarsely and finely, how many hypotheses are
# refined coarsely and finely, and how many samples of a there must be to judge by.
_ROUGH_PAIRS = 300
_COARSE_PAIRS = 1200
_FINE_PAIRS = 6_000
_COARSE_HYPOTHESES = 6
_FINE_HYPOTHESES = 4
_MIN_SAMPLES = 20
# A stretch's pose strays at its far end: what it explains coarsely may be off by this standard deviation, m.
_PROPOSAL_STDDEV = 0.3
# Another scanner sees somebody within this distance of where he is under a right pose, m; and positions that both
# should see, so that a pose is judged by them.
_DETECTION_RADIUS = 0.5
_MIN_EXPECTED = 20
# A pose is refuted if more than this share of what should have been seen was not. Under right ones that is mostly
# less than a fifth, but up to a half where furniture hides people from one of the two.
_MAX_MISSED_SHARE = 0.5
# Two hypotheses are one if they differ by less than this in metres and in radians.
_SAME_POSE = (0.5, np.radians(8))
# Ticks that must agree: at least, as a share of those that should, as a multiple of what chance explains, and as a
# share of the best hypothesis's.
_MIN_MATCHED_TICKS = 20
_MIN_MATCHED_SHARE = 0.25
_MIN_CHANCE_RATIO = 2.0
_MIN_SCORE_RATIO = 0.4
# Two people who walk alike for some seconds are so far from each other under a wrong pose, m; one person, seen by
# both, is at one place, as well as tracks are known to be anywhere, m. By how much the latter must explain the
# positions better, a logarithm: a perfect fit of 2 s comes to 52, one to 9 cm takes 9 s for as much.
_COINCIDENCE_STDDEV, _TRACK_STDDEV = 0.15, 0.01
_MIN_WEIGHT_OF_EVIDENCE = 45.0
# A scanner sees people at a place if it saw them so often within this distance of it, m.
_NEIGHBOUR_RADIUS = 0.4
_MIN_NEIGHBOURS = 3
# Fewer pairs than these are judged before other processes have begun.
_MIN_PARALLEL_PAIRS = 6
# Positions at most that are asked for their neighbours.
_MAX_QUERIES = 300


@dataclass(frozen=True, eq=False)
class PoseHypothesis:
    """One way in which two scanners may stand to each other, with its evidence."""

    T_a_b: Array
    """(3, 3)."""
    information: Array
    """(3, 3) inverse covariance of T_a_b's error (x, y, theta) in the fixed axes of a."""
    observations: int
    """How many simultaneous positions agree, at ticks of 0.1 s."""
    chance_observations: float
    """How many would if the two scanners had seen different people in the same places."""
    matched_share: float
    """Which share that is of those that should agree, as both scanners often see people there, 0..1."""
    cost: float
    """Mean truncated squared distance of all that a saw while b saw somebody, in units of the gate, 0..1."""
    model_error: float
    """How far what agrees is apart beyond what tracks' covariances explain, standard deviation, m."""
    uses_background: bool
    """Whether the static background contributes."""

    @property
    def weight_of_evidence(self) -> float:
        """How much likelier the positions are if both saw the same people than if these only walked alike.

        A logarithm (Good, "Probability and the weighing of evidence", 1950), less what should agree and does not.
        Positions count as if they were independent, which they are not: it is no probability.
        """
        return (
            self.matched_share
            * self.observations
            * float(np.log(_COINCIDENCE_STDDEV / np.hypot(self.model_error, _TRACK_STDDEV)))
        )


@dataclass(frozen=True, eq=False)
class _ScannerData:
    """What one scanner knows, as all its pairs need it."""

    observations: ScannerObservations
    background: StaticBackground
    sigma: float
    """Of the background's ranges, m."""

    @classmethod
    def of(cls, tracked: ScannerTracks) -> "_ScannerData":
        return cls(ScannerObservations.from_tracks(tracked), StaticBackground(tracked.background), tracked.sigma)


@dataclass(frozen=True, eq=False)
class ScannerPairEstimate:
    """What the two stationary scanners of a pair know of each other; at most one hypothesis is right."""

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
        tracked: what each scanner knows, by its name.
        rng: source of the samples.
        icp: whether to match the static background, too.
        depth_stddev: distance (m) of objects' true centres from those that tracks show, along the beam, standard
            deviation: some centimetres for fitted ellipses, 0.1 and more for centres of mass.
        jobs: processes at most, see :func:`calgraph.processes.parallel_map`; the result does not depend on it.
        progress: told how much is done, 0..1.
    """
    scanners = {name: _ScannerData.of(known) for name, known in tracked.items()}
    names = list(itertools.combinations(tracked, 2))
    # Random numbers are drawn here, pair by pair, whoever judges then what they propose.
    work = [
        (
            a,
            b,
            scanners[a],
            scanners[b],
            _propose_hypotheses(scanners[a].observations, scanners[b].observations, rng),
            icp,
            depth_stddev,
        )
        for a, b in names
    ]
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
    """Estimates ``T_a_b`` from the people that both scanners saw.

    Args:
        name_a: name of scanner a.
        name_b: name of scanner b.
        a: its tracks and background.
        b: those of b.
        rng: source of the samples.
        icp: whether to match the static background, too.
        depth_stddev: distance (m) of objects' true centres from those that tracks show, along the beam, standard
            deviation: some centimetres for fitted ellipses, 0.1 and more for centres of mass.

    Returns:
        The best few hypotheses, or the reason why there is none.
    """
    of_a, of_b = _ScannerData.of(a), _ScannerData.of(b)
    return _evaluate_hypotheses(
        name_a,
        name_b,
        of_a,
        of_b,
        _propose_hypotheses(of_a.observations, of_b.observations, rng),
        icp,
        depth_stddev,
    )


def _propose_hypotheses(
    a: ScannerObservations, b: ScannerObservations, rng: np.random.Generator
) -> Array | Rejected:
    """Poses (K, 3, 3) to be judged."""
    pairs = pair_simultaneous_samples(a.samples, b.samples)
    seconds = len(np.unique(pairs.a.tick[pairs.row_a])) * TICK_PERIOD
    if seconds < _MIN_MATCHED_TICKS * TICK_PERIOD:
        return Rejected(
            f"only {seconds:.1f} s in which both saw somebody, {_MIN_MATCHED_TICKS * TICK_PERIOD:.1f} s are needed"
        )
    poses = propose_poses(pairs, rng)
    if not len(poses):
        return Rejected("nobody moved alike before both, or nobody moved far enough to tell a direction")
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
    """The hypotheses that some guesses lead to."""
    if isinstance(proposals, Rejected):
        return proposals
    a, b = scanner_a.observations.samples, scanner_b.observations.samples
    maps = scanner_a.observations.visibility, scanner_b.observations.visibility
    pairs = pair_simultaneous_samples(a, b)
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
        return Rejected("under every pose that explains some of what both saw, people pass one of them unnoticed")
    shares = np.array(
        [len(fit.pairs) / max(_expected_matches(fit.T_a_b, coarse, a, b), 1) for fit in registrations]
    )
    scores = np.array([len(fit.pairs) for fit in registrations]) * shares
    promising = (shares >= _MIN_MATCHED_SHARE) & (scores >= _MIN_SCORE_RATIO * np.max(scores, initial=0.0))
    poses = _select_distinct(_stack_poses(registrations)[promising], -scores[promising], _FINE_HYPOTHESES)
    refined = [register_tracks(T, fine, depth_stddev=depth_stddev, steps=3, model_error=0.1) for T in poses]
    hypotheses = [
        _build_hypothesis(fit, fine, a, b, len(pairs), depth_stddev) for fit in refined if fit is not None
    ]
    hypotheses.sort(key=lambda h: -h.observations * h.matched_share)
    kept = [h for h in hypotheses if _is_credible(h)]
    if not kept:
        most = round(max(map(len, (fit.pairs for fit in registrations)), default=0) * len(pairs) / len(coarse))
        return Rejected(
            f"no pose explains what both saw; the best agrees for {most * TICK_PERIOD:.1f} s, as by chance, or as "
            "people do who walk alike"
        )
    kept = [
        h
        for h in kept
        if h.observations * h.matched_share >= _MIN_SCORE_RATIO * kept[0].observations * kept[0].matched_share
    ]
    if icp:
        kept = [_align_with_background(h, scanner_a, scanner_b) for h in kept]
    return ScannerPairEstimate(name_a, name_b, tuple(kept))


def _stack_poses(fits: Sequence[TrackRegistration]) -> Array:
    """(K, 3, 3)."""
    return np.array([fit.T_a_b for fit in fits]).reshape(-1, 3, 3)


def _is_credible(h: PoseHypothesis) -> bool:
    """Whether neither chance nor people who walk alike explain the hypothesis, and it explains what it should."""
    by_chance = h.observations < max(_MIN_MATCHED_TICKS, _MIN_CHANCE_RATIO * h.chance_observations)
    return (
        not by_chance and h.weight_of_evidence >= _MIN_WEIGHT_OF_EVIDENCE and h.matched_share >= _MIN_MATCHED_SHARE
    )


def _subsample_pairs(met: SimultaneousPairs, wanted: int) -> SimultaneousPairs:
    """The meetings of so many ticks that there are about ``wanted`` of them, or all if few ticks would be left."""
    step = max(1, round(len(met) / wanted))
    thinned = pair_simultaneous_samples(met.a.subsample(step), met.b.subsample(step))
    return thinned if len(np.unique(thinned.row_a)) >= _MIN_SAMPLES else met


def _select_distinct(T: Array, cost: Array, count: int) -> Array:
    """The ``count`` poses (n, 3, 3) of least cost (K,) that differ from each other."""
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
        round(len(fit.pairs) * scale),
        _expected_by_chance(fit, pairs, b) * scale,
        min(len(fit.pairs) / max(_expected_matches(fit.T_a_b, pairs, a, b), 1), 1.0),
        float(compute_pose_costs(fit.T_a_b[None], pairs)[0]),
        fit.model_error,
        uses_background=False,
    )


def _expected_by_chance(fit: TrackRegistration, pairs: SimultaneousPairs, b: TrackSamples) -> float:
    """How many of a's positions would agree with some of b's by chance: with those at any other time.

    Where both saw people all the time in one narrow passage, many do, under any pose that lays the passages over
    each other.
    """
    radius = np.sqrt(ASSOCIATION_GATE * (float(np.median(pairs.variance)) + fit.model_error**2))
    sampled = pairs.a.positions[:: max(1, len(pairs.a.tick) // _MAX_QUERIES)]
    near = _count_neighbours(sampled, se2.inverse(fit.T_a_b), b, radius)
    return float(np.mean(1 - np.exp(-near / len(np.unique(b.tick))))) * len(pairs.a.tick)


def _expected_matches(T_a_b: Array, pairs: SimultaneousPairs, a: TrackSamples, b: TrackSamples) -> float:
    """How many positions should agree were the pose right: where one often saw people, it sees the other's."""
    return max(_count_observable(se2.inverse(T_a_b), pairs.a, b), _count_observable(T_a_b, pairs.b, a))


def _count_observable(T: Array, samples: TrackSamples, other: TrackSamples) -> float:
    overlapping = (samples.tick >= other.tick.min()) & (samples.tick <= other.tick.max())
    x = samples.positions[overlapping]
    sampled = x[:: max(1, len(x) // _MAX_QUERIES)]
    return float(np.mean(_count_neighbours(sampled, T, other, _NEIGHBOUR_RADIUS) >= _MIN_NEIGHBOURS)) * len(x)


def _count_neighbours(x: Array, T: Array, samples: TrackSamples, radius: float) -> NDArray[np.intp]:
    """How many samples of all times are within the radius of each point (N, 2) moved by T."""
    near = samples.tree.query_ball_point(se2.apply(T, x), radius, return_length=True)
    return np.asarray(near, dtype=np.intp)


def _align_with_background(h: PoseHypothesis, a: _ScannerData, b: _ScannerData) -> PoseHypothesis:
    """The hypothesis with what the static background adds, unless it contradicts or has nothing to say."""
    covariance = np.asarray(np.linalg.inv(h.information), dtype=np.float64)
    sigma = float(np.hypot(a.sigma, b.sigma))
    alignment = align_backgrounds(h.T_a_b, covariance, a.background, b.background, sigma)
    if isinstance(alignment, Rejected):
        return h
    T_a_b, information = alignment.fuse(h.T_a_b, h.information)
    return replace(h, T_a_b=T_a_b, information=information, uses_background=True)
