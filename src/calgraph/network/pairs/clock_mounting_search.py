"""Clock offsets and relative mountings of pairs of scanners, from the tracks of both.

A scanner that is mounted upside-down observes the plane from below: its tracks are mirrored. Neither mirrored
tracks nor those of a clock that differs by some tenths of a second match others under any pose. Pairs are
therefore registered with and without a reflection of b's samples, and with its clock shifted in steps that the
registration bridges; the evidence of the fits is compared.
"""

import itertools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from calgraph.config.settings import ScannerPairSettings
from calgraph.geometry import Array, Index, se2
from calgraph.network.pairs.candidate_pairs import select_pairs_between_parts
from calgraph.network.pairs.hypothesis_evidence import (
    MAX_CLOCK_STDDEV,
    PoseHypothesis,
    build_hypothesis,
    compute_chance_evidence,
    propose_poses,
    subsample_pairs,
)
from calgraph.network.pairs.scanner_pair import (
    CLOCK_SIGMA,
    COARSE_PAIRS,
    DEPTH_STDDEV,
    FINE_MODEL_ERROR,
    MAX_EXHAUSTIVE,
    MIN_MATCHED_TIME,
    PROPOSAL_STDDEV,
    ROUGH_PAIRS,
    SAME_ANGLE,
    SAME_POSITION,
    ScannerPairEstimate,
)
from calgraph.network.pairs.synchronized_tracks import TICK_PERIOD, pair_samples, to_ticks
from calgraph.network.pairs.track_registration import (
    MAX_MODEL_ERROR,
    NuisancePrior,
    compute_pose_costs,
    register_tracks,
)
from calgraph.network.pairs.track_similarity import compute_track_similarity
from calgraph.network.pairs.visibility_map import ScannerObservations, miss_detections
from calgraph.parallel.engine import THIS_PROCESS, Engine
from calgraph.parallel.kept_values import Kept

# Most registrations of a hypothesis, each with the samples shifted to the clock offset of the previous one.
_MAX_SHIFTS = 3


@dataclass(frozen=True)
class ClockMountingHypothesis:
    """How clocks and mountings of two scanners differ, with the evidence of the best pose for it."""

    sensor_a: str
    sensor_b: str
    mirrored: bool
    """Whether one of the two is mounted upside-down, relative to the other."""
    clock_offset: float
    """Clock of b minus clock of a, s."""
    clock_stddev: float
    """Its standard deviation, s."""
    evidence: float
    """Weight of evidence of the pose, see :meth:`PoseHypothesis.weight_of_evidence`."""
    reflected_evidence: float
    """That of the same matches with the other mounting, see :meth:`PoseHypothesis.weight_of_reflection`."""
    lateral_spread: float
    """Standard deviation of the matched positions across their main direction, m."""


def describe_difference(pair: ScannerPairEstimate) -> ClockMountingHypothesis:
    """The best hypothesis of a pair that was registered with the same mountings."""
    return _summarize_hypothesis((pair.sensor_a, pair.sensor_b), False, pair.hypotheses[0])


def _summarize_hypothesis(names: tuple[str, str], mirrored: bool, h: PoseHypothesis) -> ClockMountingHypothesis:
    return ClockMountingHypothesis(
        *names,
        mirrored,
        h.clock_offset,
        h.clock_stddev,
        h.weight_of_evidence(),
        h.weight_of_reflection(DEPTH_STDDEV),
        h.lateral_spread,
    )


# Weight of evidence from which a pair is not searched, if clocks and mountings are those expected. Over 372 pairs
# of simulated offices, labs and halls, the correct clock and mounting always had the most evidence.
FIRM_EVIDENCE = 150.0
# Minimum standard deviation of matched positions across their main direction for that, m: mirrored tracks are
# then off by 0.6 m, far more than the distance of two people who are taken for one.
MIN_LATERAL_SPREAD = 0.3


def is_firm(pair: ScannerPairEstimate) -> bool:
    """Whether a pair, registered as if clocks and mountings were the same, shows that they are.

    Tracks on one line fit mirrored ones as well: the matched positions must spread to the sides, too.
    """
    best = pair.hypotheses[0]
    return (
        best.weight_of_evidence() >= FIRM_EVIDENCE
        and abs(best.clock_offset) <= CLOCK_SIGMA
        and best.lateral_spread >= MIN_LATERAL_SPREAD
    )


def may_differ_by_chance(h: ClockMountingHypothesis, scanners: int) -> bool:
    """Whether different people may match like this in a search of a network of this number of scanners.

    With other clocks, far more alternatives are compared: matches may then be by chance also where they determine
    the clocks.
    """
    undetermined = h.clock_stddev > MAX_CLOCK_STDDEV or abs(h.clock_offset) > CLOCK_SIGMA
    return undetermined and h.evidence < compute_chance_evidence(scanners)


# Step of clock offsets at which tracks of more than 8 scanners are compared, s, to select searched pairs.
_SIMILARITY_STEP = 0.4
# Pairs of each scanner that are searched then: a clock takes several pairs to confirm.
_PARTNERS = 8
# Pairs that all scanners of a connected part select then; ten suffice to confirm a clock offset.
_PAIRS_OF_PART = 100


def select_searched_pairs(
    observations: Mapping[str, ScannerObservations], part: Index, settings: ScannerPairSettings
) -> list[tuple[str, str]]:
    """Pairs of scanners of different parts, in their order, whose clocks and mountings are to be searched.

    All of a few scanners; of many those with the most similar tracks, if these are delayed or mirrored.

    Args:
        observations: by scanner, N.
        part: (N,) of each scanner, of those that are known to have the same clock and mounting.
        settings: number of pairs, range and steps of the search.
    """
    names, limits = list(observations), settings.clock_mounting
    samples = [one.samples for one in observations.values()]
    if len(names) <= MAX_EXHAUSTIVE:
        ends = [(a, b) for a, b in itertools.combinations(range(len(names)), 2) if part[a] != part[b]]
    else:
        step, farthest = to_ticks(_SIMILARITY_STEP), to_ticks(limits.max_clock_offset)
        delays = range(-(farthest // step) * step, farthest + 1, step)
        # Scanners of the largest part are compared with the others, which are few as a rule.
        others = part != np.argmax(np.bincount(part))
        compared = others[:, None] & (part[:, None] != part)
        compared &= ~(others & np.tri(len(names), dtype=np.bool_))
        similarity = compute_track_similarity(samples, compared=compared, delays=delays, mirrored=(False, True))
        ends = sorted(select_pairs_between_parts(similarity, part, _PARTNERS, _PAIRS_OF_PART))
    return [(names[a], names[b]) for a, b in ends]


def search_clocks_and_mountings(
    pairs: Sequence[tuple[str, str]],
    observations: Mapping[str, ScannerObservations],
    rng: np.random.Generator,
    *,
    engine: Engine = THIS_PROCESS,
    settings: ScannerPairSettings,
) -> list[ClockMountingHypothesis]:
    """Searches the clock offsets and relative mountings of pairs of scanners.

    Args:
        pairs: names of their scanners.
        observations: by scanner.
        rng: random generator for the selection of poses.
        engine: evaluates pairs.
        settings: range and steps of the search, gates and limits of registrations.

    Returns:
        The hypotheses of each pair and mounting: the registrations from the starts that fit best.
    """
    generators = rng.spawn(len(pairs))
    data = {name: Kept.of(one) for name, one in observations.items()}
    work = [
        (ends, data[ends[0]], data[ends[1]], generator, settings)
        for ends, generator in zip(pairs, generators, strict=True)
    ]
    return [found for of_pair in engine.map(_search_pair, work) for found in of_pair]


def _search_pair(
    names: tuple[str, str],
    a: ScannerObservations,
    b: ScannerObservations,
    rng: np.random.Generator,
    settings: ScannerPairSettings,
) -> list[ClockMountingHypothesis]:
    found = []
    for mirrored in (False, True):
        starts = _select_starts(a, b, mirrored, rng, settings)
        found += [
            _summarize_hypothesis(names, mirrored, hypothesis)
            for delay, T in starts
            if (hypothesis := _register(T, a, b, mirrored, delay)) is not None
        ]
    return found


# Simultaneous pairs on which poses are proposed and registered; bounds the time.
_PAIRS = 2400
# Poses that are scored for each step and mounting: half of them the best, half random.
_PROPOSALS = 10
# Step of the search, s: at 1.5 m/s, half a step displaces people by 0.15 m, the largest model error.
_CLOCK_STEP = 0.2
# Poses that are registered for each mounting, and kept of each step at most.
_REGISTERED = 3


def _select_starts(
    a: ScannerObservations,
    b: ScannerObservations,
    mirrored: bool,
    rng: np.random.Generator,
    settings: ScannerPairSettings,
) -> list[tuple[int, Array]]:
    """Delays of b, in ticks, and poses (3, 3) that fit best, distinct from each other."""
    limits = settings.clock_mounting
    step, farthest = to_ticks(_CLOCK_STEP), to_ticks(limits.max_clock_offset)
    candidates: list[tuple[float, int, Array]] = []
    for delay in range(-(farthest // step) * step, farthest + 1, step):
        moved = b.transform(mirrored, delay)
        pairs = pair_samples(a.samples, moved.samples)
        if len(np.unique(pairs.row_a)) < to_ticks(MIN_MATCHED_TIME):
            continue
        T = propose_poses(subsample_pairs(pairs, _PAIRS), rng, _PROPOSALS)
        rough = subsample_pairs(pairs, ROUGH_PAIRS)
        T = T[~miss_detections(T, a, moved, rough, len(pairs), PROPOSAL_STDDEV)]
        coarse = subsample_pairs(pairs, COARSE_PAIRS)
        costs = compute_pose_costs(T, coarse, PROPOSAL_STDDEV)
        candidates += [(float(costs[k]), delay, T[k]) for k in np.argsort(costs)[:_REGISTERED]]
    starts: list[tuple[int, Array]] = []
    for _, delay, T in sorted(candidates, key=lambda candidate: candidate[0]):
        if len(starts) < _REGISTERED and not any(
            abs(delay - other) <= step and _is_same(T, T_other) for other, T_other in starts
        ):
            starts.append((delay, T))
    return starts


def _is_same(T: Array, other: Array) -> bool:
    x, y, angle = se2.difference(T, other)
    return bool(np.hypot(x, y) < SAME_POSITION and abs(angle) < SAME_ANGLE)


def _register(
    T_a_b: Array, a: ScannerObservations, b: ScannerObservations, mirrored: bool, delay: int
) -> PoseHypothesis | None:
    """The credible pose near a start; shifts the samples until the rest of the clock offset is below a tick."""
    model_error = MAX_MODEL_ERROR
    for shift in range(_MAX_SHIFTS):
        moved = b.transform(mirrored, delay)
        pairs = pair_samples(a.samples, moved.samples)
        if not len(pairs):
            return None
        sampled = subsample_pairs(pairs, _PAIRS)
        of_rest = NuisancePrior(CLOCK_SIGMA, DEPTH_STDDEV, -delay * TICK_PERIOD)
        fit = register_tracks(T_a_b, sampled, model_error, of_rest)
        if fit is None:
            return None
        T_a_b, model_error = fit.T_a_b, FINE_MODEL_ERROR
        rest = round(float(fit.nuisance[0]) / TICK_PERIOD)
        if rest and shift + 1 < _MAX_SHIFTS:
            delay += rest
            continue
        if miss_detections(T_a_b[None], a, moved, sampled, len(pairs), 0.0)[0]:
            return None
        return build_hypothesis(fit, sampled, a.samples, moved.samples, len(pairs), of_rest)
    return None
