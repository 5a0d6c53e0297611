"""Relative poses of stationary scanners from simultaneous tracks.

Source: Quenzel, Papenberg, Behnke, "Robust extrinsic calibration of multiple stationary laser range finders",
2016, section III.D: every combination of two tracks gives hypotheses, which are scored on all tracks of all
periods. Its truncation at the scanner's range, which mixes metres with Mahalanobis distances, is a χ² gate here.
"""

import itertools
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from calgraph.config.settings import HypothesisSettings, NetworkEstimationSettings, ScannerPairSettings
from calgraph.errors import Rejected
from calgraph.geometry import Array
from calgraph.network.pairs.candidate_pairs import (
    Ends,
    select_implied_pairs,
    select_separated_pairs,
    select_similar_pairs,
)
from calgraph.network.pairs.hypothesis_evidence import (
    PoseHypothesis,
    build_hypothesis,
    count_expected,
    is_credible,
    select_distinct,
    select_distinct_rows,
    subsample_pairs,
)
from calgraph.network.pairs.icp import StaticBackground, align_backgrounds
from calgraph.network.pairs.pose_hypotheses import propose_poses
from calgraph.network.pairs.synchronized_tracks import SimultaneousPairs, pair_samples
from calgraph.network.pairs.track_registration import (
    NuisancePrior,
    TrackRegistration,
    compute_pose_costs,
    register_tracks,
)
from calgraph.network.pairs.track_similarity import compute_track_similarity
from calgraph.network.pairs.visibility_map import ScannerObservations, contradicts_visibility
from calgraph.network.tracking.track import ScannerTracks
from calgraph.parallel.engine import THIS_PROCESS, Engine

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
    def from_tracks(cls, tracked: ScannerTracks, settings: ScannerPairSettings) -> "_ScannerData":
        observations = ScannerObservations.from_tracks(tracked, settings)
        return cls(observations, StaticBackground(tracked.background, settings), tracked.sigma)


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
    depth_stddev: float | None = None,
    clock_sigma: float = NetworkEstimationSettings().clock_sigma,
    engine: Engine = THIS_PROCESS,
    progress: Callable[[float], None] = lambda _done: None,
    settings: ScannerPairSettings = ScannerPairSettings(),
) -> dict[tuple[str, str], ScannerPairEstimate | Rejected]:
    """Estimates the relative poses of pairs of scanners, as :func:`estimate_scanner_pair` does.

    Pairs of networks with many scanners that cannot have tracked the same people are left out, see
    :mod:`calgraph.network.pairs.candidate_pairs`.

    Args:
        tracked: tracks and background of each scanner, by its name.
        rng: random generator for the selection of hypotheses.
        icp: whether to match the static background, too.
        depth_stddev: prior standard deviation of the distance from tracked to true centres along the beam, m; that
            of the settings if None.
        clock_sigma: prior standard deviation of the clock offset of two scanners, s.
        engine: evaluates pairs; does not affect the result.
        progress: called with the completed fraction, 0..1.
        settings: gates, priors and limits.

    Returns:
        The pairs that were registered, in the order of the scanners.
    """
    scanners = tuple(_ScannerData.from_tracks(tracks, settings) for tracks in tracked.values())
    batch = _PairBatch(
        tuple(tracked),
        scanners,
        tuple(engine.put(scanners)),
        icp,
        _nuisance_prior(clock_sigma, depth_stddev, settings),
        settings,
        engine,
    )
    names = batch.names
    if len(names) <= settings.candidates.max_exhaustive:
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
    handles: tuple[Any, ...]
    """Of the scanners, for calls of the engine."""
    icp: bool
    prior: NuisancePrior
    settings: ScannerPairSettings
    engine: Engine

    def estimate(
        self, pairs: Sequence[Ends], generators: Sequence[np.random.Generator], progress: Callable[[float], None]
    ) -> list[ScannerPairEstimate | Rejected]:
        """Estimates pairs of scanners, given by their indices, each with its random generator."""
        divided = len(pairs) >= _MIN_PARALLEL_PAIRS
        engine, data = (self.engine, self.handles) if divided else (THIS_PROCESS, self.scanners)
        work = []
        for (i, j), rng in zip(pairs, generators, strict=True):
            # Random numbers are drawn here, so that results do not depend on the engine.
            proposals = _propose_hypotheses(self.scanners[i], self.scanners[j], rng, self.settings)
            ends = self.names[i], self.names[j]
            work.append((ends, data[i], data[j], proposals, self.icp, self.prior, self.settings))
        return engine.map(_evaluate_hypotheses, work, progress)


def _estimate_candidates(
    batch: _PairBatch, seed: int, progress: Callable[[float], None]
) -> dict[Ends, ScannerPairEstimate | Rejected]:
    """Estimates the most similar pairs, those that they imply, and those between parts, until none are left."""
    samples = [scanner.observations.samples for scanner in batch.scanners]
    settings = batch.settings.candidates
    similarity = compute_track_similarity(samples, batch.settings)
    tried: dict[Ends, ScannerPairEstimate | Rejected] = {}
    poses: dict[Ends, Array] = {}
    clear_poses: dict[Ends, Array] = {}
    sure: set[Ends] = set()
    unclear_tries: Counter[int] = Counter()
    implied: set[Ends] = set()
    wanted = select_similar_pairs(similarity, settings.partners)
    for rounds in itertools.count():
        if not wanted:
            break
        pairs = sorted(wanted)
        # Random numbers of a pair do not depend on the other pairs.
        generators = [np.random.default_rng((seed, *ends)) for ends in pairs]
        report = partial(_report_round, progress, rounds)
        found = dict(zip(pairs, batch.estimate(pairs, generators, report), strict=True))
        tried |= found
        registered = {ends: pair for ends, pair in found.items() if isinstance(pair, ScannerPairEstimate)}
        poses |= {ends: pair.T_a_b for ends, pair in registered.items()}
        clear = {
            ends: pair.T_a_b
            for ends, pair in registered.items()
            if pair.hypotheses[0].weight_of_evidence(batch.settings.hypotheses) >= settings.clear_evidence
        }
        clear_poses |= clear
        sure |= {
            ends
            for ends, pair in registered.items()
            if not pair.hypotheses[0].may_be_by_chance(len(batch.names), batch.settings.hypotheses)
        }
        unclear_tries.update(end for ends in implied - set(clear) for end in ends)
        implied = select_implied_pairs(samples, clear_poses, clear, tried, settings) | {
            ends
            for ends in select_implied_pairs(samples, poses, registered, tried, settings)
            if max(unclear_tries[end] for end in ends) < settings.max_unclear_tries
        }
        wanted = implied or select_separated_pairs(similarity, sure, tried, settings)
    progress(1.0)
    return tried


def _report_round(progress: Callable[[float], None], rounds: int, done: float) -> None:
    """Reports that each round takes half of what is left; their number is not known before the last."""
    progress(1 - 0.5**rounds * (1 - done / 2))


def estimate_scanner_pair(
    name_a: str,
    name_b: str,
    a: ScannerTracks,
    b: ScannerTracks,
    rng: np.random.Generator,
    *,
    icp: bool = True,
    depth_stddev: float | None = None,
    clock_sigma: float = NetworkEstimationSettings().clock_sigma,
    settings: ScannerPairSettings = ScannerPairSettings(),
) -> ScannerPairEstimate | Rejected:
    """Estimates ``T_a_b`` from the people that both scanners tracked.

    Args:
        name_a: name of scanner a.
        name_b: name of scanner b.
        a: its tracks and background.
        b: those of b.
        rng: random generator for the selection of hypotheses.
        icp: whether to match the static background, too.
        depth_stddev: prior standard deviation of the distance from tracked to true centres along the beam, m; that
            of the settings if None.
        clock_sigma: prior standard deviation of the clock offset of two scanners, s.
        settings: gates, priors and limits.

    Returns:
        The best hypotheses, or the reason why there is none.
    """
    of_a, of_b = _ScannerData.from_tracks(a, settings), _ScannerData.from_tracks(b, settings)
    proposals = _propose_hypotheses(of_a, of_b, rng, settings)
    prior = _nuisance_prior(clock_sigma, depth_stddev, settings)
    return _evaluate_hypotheses((name_a, name_b), of_a, of_b, proposals, icp, prior, settings)


def _nuisance_prior(
    clock_sigma: float, depth_stddev: float | None, settings: ScannerPairSettings
) -> NuisancePrior:
    return NuisancePrior(clock_sigma, settings.registration.depth_stddev if depth_stddev is None else depth_stddev)


def _propose_hypotheses(
    a: _ScannerData, b: _ScannerData, rng: np.random.Generator, settings: ScannerPairSettings
) -> Array | Rejected:
    """Proposes poses (K, 3, 3)."""
    pairs = pair_samples(a.observations.samples, b.observations.samples)
    count, needed = len(np.unique(pairs.a.tick[pairs.row_a])), settings.hypotheses.min_matched_time
    if count < pairs.a.to_ticks(needed):
        return Rejected(
            f"both tracked people at the same time for {count * pairs.a.tick_period:.1f} s, "
            f"{needed:.1f} s are needed"
        )
    poses = propose_poses(pairs, settings.proposals, rng)
    if not len(poses):
        return Rejected("no trajectory of one has the shape of one of the other, or all are too short")
    return poses


def _evaluate_hypotheses(
    names: tuple[str, str],
    a: _ScannerData,
    b: _ScannerData,
    proposals: Array | Rejected,
    icp: bool,
    prior: NuisancePrior,
    settings: ScannerPairSettings,
) -> ScannerPairEstimate | Rejected:
    """Registers and scores proposed poses, coarsely, then finely."""
    if isinstance(proposals, Rejected):
        return proposals
    limits = settings.hypotheses
    pairs = pair_samples(a.observations.samples, b.observations.samples)
    wanted = limits.rough_pairs, limits.coarse_pairs, limits.fine_pairs
    rough, coarse, fine = (subsample_pairs(pairs, count, limits.min_samples) for count in wanted)

    def contradict(poses: Array, subsampled: SimultaneousPairs, pose_error: float) -> NDArray[np.bool_]:
        visibility = settings.visibility
        return contradicts_visibility(
            poses, subsampled, a.observations.visibility, b.observations.visibility,
            radius=visibility.detection_radius + pose_error,
            min_expected=visibility.min_expected * len(subsampled) / len(pairs),
            max_missed_share=visibility.max_missed_share,
        )  # fmt: skip

    def register(T: Array, subsampled: SimultaneousPairs, model_error: float) -> TrackRegistration | None:
        return register_tracks(T, subsampled, model_error, prior, settings.registration)

    proposals = proposals[~contradict(proposals, rough, limits.proposal_stddev)]
    costs = compute_pose_costs(proposals, coarse, limits.proposal_stddev, settings.registration.gate)
    registrations = [
        fit
        for T in select_distinct(proposals, costs, limits.coarse_count, limits.same_position, limits.same_angle)
        if (fit := register(T, coarse, settings.registration.max_model_error))
    ]
    refuted = contradict(_stack_poses(registrations), coarse, 0.0)
    registrations = [fit for fit, wrong in zip(registrations, refuted, strict=True) if not wrong]
    if not registrations:
        return Rejected("under every proposed pose, one does not detect what the other tracks in its view")
    counts = np.array([len(fit.matches) for fit in registrations])
    samples = a.observations.samples, b.observations.samples
    shares = counts / [count_expected(fit.T_a_b, coarse, *samples, settings.hypotheses) for fit in registrations]
    promising = shares >= limits.min_matched_share
    promising &= counts * shares >= limits.min_score_ratio * np.max(counts * shares)
    poses = _stack_poses(registrations)[promising]
    scores = (counts * shares)[promising]
    poses = select_distinct(poses, -scores, limits.fine_count, limits.same_position, limits.same_angle)
    hypotheses = [
        build_hypothesis(fit, fine, *samples, len(pairs), prior, settings)
        for T in poses
        if (fit := register(T, fine, settings.registration.fine_model_error))
    ]
    least = pairs.a.to_ticks(limits.min_matched_time)
    kept = [h for h in hypotheses if is_credible(h, least, settings.hypotheses)]
    best = max((h.weight_of_evidence(settings.hypotheses) for h in kept), default=np.inf)
    if best < limits.unambiguous_evidence:
        # Registrations that start with a large model error settle between the two people of a couple.
        costs = compute_pose_costs(proposals, coarse, limits.couple_stddev, settings.registration.gate)
        distinct = select_distinct(
            proposals, costs, limits.couple_count, limits.min_couple_shift, limits.same_turn
        )
        fits = [fit for T in distinct if (fit := register(T, coarse, limits.couple_stddev))]
        fits = [fine_fit for fit in fits if (fine_fit := register(fit.T_a_b, fine, limits.couple_stddev))]
        refuted = contradict(_stack_poses(fits), fine, 0.0)
        fits = [fit for fit, wrong in zip(fits, refuted, strict=True) if not wrong]
        others = [build_hypothesis(fit, fine, *samples, len(pairs), prior, settings) for fit in fits]
        kept += [h for h in others if is_credible(h, least, settings.hypotheses)]
    if not kept:
        seconds = round(max(counts) * len(pairs) / len(coarse)) * pairs.a.tick_period
        return Rejected(
            f"no pose hypothesis is credible: the best one matches {seconds:.1f} s of tracks, which chance or "
            "similar trajectories explain as well"
        )
    kept = _select_hypotheses(kept, settings.hypotheses)
    if icp:
        kept = [_align_with_background(h, a, b) for h in kept]
    return ScannerPairEstimate(*names, tuple(kept))


def _select_hypotheses(hypotheses: Sequence[PoseHypothesis], settings: HypothesisSettings) -> list[PoseHypothesis]:
    """Those of comparable evidence that differ from each other, best first."""
    evidence = np.array([h.weight_of_evidence(settings) for h in hypotheses])
    T = np.array([h.T_a_b for h in hypotheses])
    kept = select_distinct_rows(T, -evidence, settings.max_count, settings.min_couple_shift, settings.same_turn)
    return [hypotheses[k] for k in kept if evidence[k] >= settings.min_score_ratio * evidence.max()]


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
