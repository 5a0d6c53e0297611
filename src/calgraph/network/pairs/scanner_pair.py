"""Relative poses of stationary scanners from simultaneous tracks.

Source: Quenzel, Papenberg, Behnke, "Robust extrinsic calibration of multiple stationary laser range finders",
2016, section III.D: every combination of two tracks gives hypotheses, which are scored on all tracks of all
periods. Its truncation at the scanner's range, which mixes metres with Mahalanobis distances, is a χ² gate here.
"""

import itertools
from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from calgraph.errors import Rejected
from calgraph.geometry import Array
from calgraph.network.pairs.candidate_pairs import (
    Ends,
    select_implied_pairs,
    select_separated_pairs,
    select_similar_pairs,
)
from calgraph.network.pairs.hypothesis_evidence import (
    MIN_MATCHED_SHARE,
    PoseHypothesis,
    build_hypothesis,
    count_expected,
    is_credible,
    propose_poses,
    select_distinct,
    subsample_pairs,
)
from calgraph.network.pairs.icp import StaticBackground, align_backgrounds
from calgraph.network.pairs.synchronized_tracks import TICK_PERIOD, SimultaneousPairs, pair_samples, to_ticks
from calgraph.network.pairs.track_registration import (
    MAX_MODEL_ERROR,
    NuisancePrior,
    TrackRegistration,
    compute_pose_costs,
    register_tracks,
)
from calgraph.network.pairs.track_similarity import compute_track_similarity
from calgraph.network.pairs.visibility_map import ScannerObservations, miss_detections
from calgraph.network.tracking.track import ScannerTracks
from calgraph.parallel.engine import THIS_PROCESS, Engine
from calgraph.parallel.kept_values import Kept

# Fewer pairs than these are evaluated faster than other processes start.
_MIN_PARALLEL_PAIRS = 6


@dataclass(frozen=True, eq=False)
class _ScannerData:
    """Data of one scanner, shared by all its pairs."""

    observations: ScannerObservations
    background: StaticBackground
    sigma: float
    """Standard deviation of the background's ranges, m."""

    @classmethod
    def from_tracks(cls, tracked: ScannerTracks) -> "_ScannerData":
        observations = ScannerObservations.from_tracks(tracked)
        return cls(observations, StaticBackground(tracked.background), tracked.sigma)


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


ScannerPairs = Mapping[tuple[str, str], ScannerPairEstimate | Rejected]
"""By the names of both scanners: what they tracked together, or why there is no pose."""


# Prior standard deviation of clock offsets, s: clocks set by NTP or by hand of a driver's start time.
CLOCK_SIGMA = 0.1
# Prior standard deviation of the distance from tracked to true centres along the beam, m, for ellipses of fixed
# size: bodies differ from it by some centimetres.
DEPTH_STDDEV = 0.03
# Scanners up to which all pairs are registered: 28 pairs take less than a second.
MAX_EXHAUSTIVE = 8


def estimate_scanner_pairs(
    tracked: Mapping[str, ScannerTracks],
    rng: np.random.Generator,
    *,
    icp: bool = True,
    depth_stddev: float = DEPTH_STDDEV,
    engine: Engine = THIS_PROCESS,
    progress: Callable[[float], None] = lambda _done: None,
) -> dict[tuple[str, str], ScannerPairEstimate | Rejected]:
    """Estimates the relative poses of pairs of scanners from the people that both tracked.

    Pairs of networks with many scanners that cannot have tracked the same people are left out, see
    :mod:`calgraph.network.pairs.candidate_pairs`.

    Args:
        tracked: tracks and background of each scanner, by its name.
        rng: random generator for the selection of hypotheses.
        icp: whether to match the static background, too.
        depth_stddev: prior standard deviation of the distance from tracked to true centres along the beam, m.
        engine: evaluates pairs; does not affect the result.
        progress: called with the completed fraction, 0..1.

    Returns:
        The pairs that were registered, in the order of the scanners.
    """
    scanners = tuple(_ScannerData.from_tracks(tracks) for tracks in tracked.values())
    batch = _PairBatch(
        tuple(tracked),
        scanners,
        tuple(Kept.of(scanner) for scanner in scanners),
        icp,
        NuisancePrior(CLOCK_SIGMA, depth_stddev),
        engine,
    )
    names = batch.names
    if len(names) <= MAX_EXHAUSTIVE:
        every = list(itertools.combinations(range(len(names)), 2))
        found = dict(zip(every, batch.estimate(every, [rng] * len(every), progress), strict=True))
    else:
        found = _estimate_candidates(batch, int(rng.integers(2**63)), progress)
    return {(names[a], names[b]): found[a, b] for a, b in sorted(found)}


@dataclass(frozen=True, eq=False)
class _PairBatch:
    """Scanners, and how their pairs are estimated."""

    names: tuple[str, ...]
    scanners: tuple[_ScannerData, ...]
    kept: tuple[Kept, ...]
    """The scanners, for calls of the engine."""
    icp: bool
    prior: NuisancePrior
    engine: Engine

    def estimate(
        self, pairs: Sequence[Ends], generators: Sequence[np.random.Generator], progress: Callable[[float], None]
    ) -> list[ScannerPairEstimate | Rejected]:
        """Estimates pairs of scanners, given by their indices, each with its random generator."""
        engine = self.engine if len(pairs) >= _MIN_PARALLEL_PAIRS else THIS_PROCESS
        work = []
        for (i, j), rng in zip(pairs, generators, strict=True):
            # Random numbers are drawn here, so that results do not depend on the engine.
            proposals = _propose_hypotheses(self.scanners[i], self.scanners[j], rng)
            ends = self.names[i], self.names[j]
            work.append((ends, self.kept[i], self.kept[j], proposals, self.icp, self.prior))
        estimates = []
        for found in engine.map(_evaluate_hypotheses, work):
            estimates.append(found)
            progress(len(estimates) / len(work))
        return estimates


# Pairs of each scanner that are registered first, those with the most similar tracks. In simulated grids of 30
# and 100 scanners, 3 connect all that any pairs connect; two more for paths that resemble each other.
_PARTNERS = 5
# Weight of evidence of a clear pose, twice the least: 395 of 478 right pairs of a grid have it, 5 of 53 wrong
# ones.
_CLEAR_EVIDENCE = 90.0
# Implied pairs of a scanner without a clear pose, after which only clear poses imply further ones: wrong poses
# imply ever more in large networks. With 10, a grid of 100 loses no pair: 711 are tried, 853 before.
_MAX_UNCLEAR_TRIES = 10


def _estimate_candidates(
    batch: _PairBatch, seed: int, progress: Callable[[float], None]
) -> dict[Ends, ScannerPairEstimate | Rejected]:
    """Estimates the most similar pairs, those that they imply, and those between parts, until none are left."""
    samples = [scanner.observations.samples for scanner in batch.scanners]
    similarity = compute_track_similarity(samples)
    tried: dict[Ends, ScannerPairEstimate | Rejected] = {}
    poses: dict[Ends, Array] = {}
    clear_poses: dict[Ends, Array] = {}
    sure: set[Ends] = set()
    unclear_tries: Counter[int] = Counter()
    implied: set[Ends] = set()
    wanted = select_similar_pairs(similarity, _PARTNERS)
    for rounds in itertools.count():
        if not wanted:
            break
        pairs = sorted(wanted)
        # Random numbers of a pair do not depend on the other pairs.
        generators = [np.random.default_rng((seed, *ends)) for ends in pairs]

        # ``left`` is bound now, as ``rounds`` changes.
        def report(done: float, left: float = 0.5**rounds) -> None:
            # Each round takes half of what is left; their number is not known before the last.
            progress(1 - left * (1 - done / 2))

        found = dict(zip(pairs, batch.estimate(pairs, generators, report), strict=True))
        tried |= found
        registered = {ends: pair for ends, pair in found.items() if isinstance(pair, ScannerPairEstimate)}
        poses |= {ends: pair.T_a_b for ends, pair in registered.items()}
        clear = {
            ends: pair.T_a_b
            for ends, pair in registered.items()
            if pair.hypotheses[0].weight_of_evidence() >= _CLEAR_EVIDENCE
        }
        clear_poses |= clear
        sure |= {
            ends for ends, pair in registered.items() if not pair.hypotheses[0].may_be_by_chance(len(batch.names))
        }
        unclear_tries.update(end for ends in implied - set(clear) for end in ends)
        implied = select_implied_pairs(samples, clear_poses, clear, tried) | {
            ends
            for ends in select_implied_pairs(samples, poses, registered, tried)
            if max(unclear_tries[end] for end in ends) < _MAX_UNCLEAR_TRIES
        }
        wanted = implied or select_separated_pairs(similarity, sure, tried)
    progress(1.0)
    return tried


# Minimum duration of matches, s: two steps of a person, which determine position and direction.
MIN_MATCHED_TIME = 2.0


def _propose_hypotheses(a: _ScannerData, b: _ScannerData, rng: np.random.Generator) -> Array | Rejected:
    """Proposes poses (K, 3, 3)."""
    pairs = pair_samples(a.observations.samples, b.observations.samples)
    count, needed = len(np.unique(pairs.a.tick[pairs.row_a])), MIN_MATCHED_TIME
    if count < to_ticks(needed):
        return Rejected(
            f"both tracked people at the same time for {count * TICK_PERIOD:.1f} s, {needed:.1f} s are needed"
        )
    poses = propose_poses(pairs, rng)
    if not len(poses):
        return Rejected("no trajectory of one has the shape of one of the other, or all are too short")
    return poses


# Simultaneous pairs on which all proposals are tested for missed detections; bounds the time.
ROUGH_PAIRS = 300
# Simultaneous pairs on which proposals are scored and registered coarsely; bounds the time.
COARSE_PAIRS = 1200
# Simultaneous pairs on which the best hypotheses are registered; bounds the time.
_FINE_PAIRS = 6000

# Standard deviation of positions under a proposed pose, whose angle comes from a short stretch, m.
PROPOSAL_STDDEV = 0.3
# Proposals that are registered coarsely: with fewer, correct ones are lost in crowds.
_COARSE_COUNT = 6
# Distance below which two hypotheses are one if their angle is, too, m.
SAME_POSITION = 0.5
# Angle below which two hypotheses are one if their distance is, too, rad (8 degrees).
SAME_ANGLE = float(np.radians(8))
# Hypotheses of a pair that are kept at most.
_MAX_COUNT = 6
# Minimum ratio of a hypothesis's evidence to the best one's: alternatives below it are not kept.
_MIN_SCORE_RATIO = 0.4
# Hypotheses that are registered finely, and kept at most.
_FINE_COUNT = 4
# The same where the fine stage starts, m: coarse poses have errors of some centimetres.
FINE_MODEL_ERROR = 0.1
# Weight of evidence below which hypotheses that match the two people of a couple crosswise are searched, too: in
# simulated halls with a couple and no other people, wrong ones had up to 136.
_UNAMBIGUOUS_EVIDENCE = 250.0
# Standard deviation of positions in that search, m: a tenth of the distance of two people who walk side by side,
# so that poses between correct and crosswise matches are not the best.
_COUPLE_STDDEV = 0.06
# Proposals that are registered in that search: with 8, correct ones were missed in 2 of 44 pairs.
_COUPLE_COUNT = 12
# Distance below which two registered hypotheses are one, if their angle is, too, m: half that of people.
MIN_COUPLE_SHIFT = 0.2
# Angle below which two registered hypotheses are one, if their distance is, too, rad (2 degrees).
SAME_TURN = float(np.radians(2))


def _evaluate_hypotheses(
    names: tuple[str, str],
    a: _ScannerData,
    b: _ScannerData,
    proposals: Array | Rejected,
    icp: bool,
    prior: NuisancePrior,
) -> ScannerPairEstimate | Rejected:
    """Registers and scores proposed poses, coarsely, then finely."""
    if isinstance(proposals, Rejected):
        return proposals
    pairs = pair_samples(a.observations.samples, b.observations.samples)
    wanted = ROUGH_PAIRS, COARSE_PAIRS, _FINE_PAIRS
    rough, coarse, fine = (subsample_pairs(pairs, count) for count in wanted)

    def contradict(poses: Array, subsampled: SimultaneousPairs, pose_error: float) -> NDArray[np.bool_]:
        return miss_detections(poses, a.observations, b.observations, subsampled, len(pairs), pose_error)

    def register(T: Iterable[Array], subsampled: SimultaneousPairs, error: float) -> list[TrackRegistration]:
        fits = (register_tracks(one, subsampled, error, prior) for one in T)
        return [fit for fit in fits if fit]

    def select_possible(fits: list[TrackRegistration], subsampled: SimultaneousPairs) -> list[TrackRegistration]:
        refuted = contradict(_stack_poses(fits), subsampled, 0.0)
        return [fit for fit, wrong in zip(fits, refuted, strict=True) if not wrong]

    proposals = proposals[~contradict(proposals, rough, PROPOSAL_STDDEV)]
    costs = compute_pose_costs(proposals, coarse, PROPOSAL_STDDEV)
    distinct = proposals[select_distinct(proposals, costs, _COARSE_COUNT, SAME_POSITION, SAME_ANGLE)]
    registrations = select_possible(register(distinct, coarse, MAX_MODEL_ERROR), coarse)
    if not registrations:
        return Rejected("under every proposed pose, one does not detect what the other tracks in its view")
    counts = np.array([len(fit.matches) for fit in registrations])
    samples = a.observations.samples, b.observations.samples
    shares = counts / [count_expected(fit.T_a_b, coarse, *samples) for fit in registrations]
    promising = shares >= MIN_MATCHED_SHARE
    promising &= counts * shares >= _MIN_SCORE_RATIO * np.max(counts * shares)
    poses = _stack_poses(registrations)[promising]
    scores = (counts * shares)[promising]
    distinct = poses[select_distinct(poses, -scores, _FINE_COUNT, SAME_POSITION, SAME_ANGLE)]
    fits = register(distinct, fine, FINE_MODEL_ERROR)
    hypotheses = [build_hypothesis(fit, fine, *samples, len(pairs), prior) for fit in fits]
    least = to_ticks(MIN_MATCHED_TIME)
    kept = [h for h in hypotheses if is_credible(h, least)]
    best = max((h.weight_of_evidence() for h in kept), default=np.inf)
    if best < _UNAMBIGUOUS_EVIDENCE:
        # Registrations that start with a large model error settle between the two people of a couple.
        costs = compute_pose_costs(proposals, coarse, _COUPLE_STDDEV)
        distinct = proposals[select_distinct(proposals, costs, _COUPLE_COUNT, MIN_COUPLE_SHIFT, SAME_TURN)]
        fits = register(distinct, coarse, _COUPLE_STDDEV)
        fits = select_possible(register((fit.T_a_b for fit in fits), fine, _COUPLE_STDDEV), fine)
        others = [build_hypothesis(fit, fine, *samples, len(pairs), prior) for fit in fits]
        kept += [h for h in others if is_credible(h, least)]
    if not kept:
        seconds = round(max(counts) * len(pairs) / len(coarse)) * TICK_PERIOD
        return Rejected(
            f"no pose hypothesis is credible: the best one matches {seconds:.1f} s of tracks, which chance or "
            "similar trajectories explain as well"
        )
    # Those of comparable evidence that differ from each other, best first.
    evidence = np.array([h.weight_of_evidence() for h in kept])
    T = np.array([h.T_a_b for h in kept])
    distinct_rows = select_distinct(T, -evidence, _MAX_COUNT, MIN_COUPLE_SHIFT, SAME_TURN)
    kept = [kept[k] for k in distinct_rows if evidence[k] >= _MIN_SCORE_RATIO * evidence.max()]
    if icp:
        kept = [_align_with_background(h, a, b) for h in kept]
    return ScannerPairEstimate(*names, tuple(kept))


def _stack_poses(fits: Sequence[TrackRegistration]) -> Array:
    """(K, 3, 3)."""
    return np.array([fit.T_a_b for fit in fits]).reshape(-1, 3, 3)


def _align_with_background(h: PoseHypothesis, a: _ScannerData, b: _ScannerData) -> PoseHypothesis:
    """Fuses the hypothesis with the alignment of the static backgrounds, unless that is rejected."""
    covariance = np.asarray(np.linalg.inv(h.information), dtype=np.float64)
    sigma = float(np.hypot(a.sigma, b.sigma))
    alignment = align_backgrounds(h.T_a_b, covariance, a.background, b.background, sigma)
    if isinstance(alignment, Rejected):
        return h
    T_a_b, information = alignment.fuse(h.T_a_b, h.information)
    return replace(h, T_a_b=T_a_b, information=information, uses_background=True)
