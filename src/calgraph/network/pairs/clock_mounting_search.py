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
from numpy.typing import NDArray

from calgraph.config.settings import ScannerPairSettings
from calgraph.geometry import Array, se2
from calgraph.network.pairs.candidate_pairs import select_pairs_between_parts
from calgraph.network.pairs.hypothesis_evidence import (
    PoseHypothesis,
    build_hypothesis,
    compute_chance_evidence,
    subsample_pairs,
)
from calgraph.network.pairs.pose_hypotheses import propose_poses
from calgraph.network.pairs.scanner_pair import ScannerPairEstimate
from calgraph.network.pairs.synchronized_tracks import Indices, SimultaneousPairs, pair_samples
from calgraph.network.pairs.track_registration import NuisancePrior, compute_pose_costs, register_tracks
from calgraph.network.pairs.track_similarity import compute_track_similarity
from calgraph.network.pairs.visibility_map import ScannerObservations, contradicts_visibility
from calgraph.parallel.engine import THIS_PROCESS, Engine

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


def describe_difference(pair: ScannerPairEstimate, settings: ScannerPairSettings) -> ClockMountingHypothesis:
    """The best hypothesis of a pair that was registered with the same mountings."""
    return _summarize_hypothesis((pair.sensor_a, pair.sensor_b), False, pair.hypotheses[0], settings)


def _summarize_hypothesis(
    names: tuple[str, str], mirrored: bool, h: PoseHypothesis, settings: ScannerPairSettings
) -> ClockMountingHypothesis:
    return ClockMountingHypothesis(
        *names,
        mirrored,
        h.clock_offset,
        h.clock_stddev,
        h.weight_of_evidence(settings.hypotheses),
        h.weight_of_reflection(settings.hypotheses, settings.registration.depth_stddev),
        h.lateral_spread,
    )


def is_firm(pair: ScannerPairEstimate, clock_sigma: float, settings: ScannerPairSettings) -> bool:
    """Whether a pair, registered as if clocks and mountings were the same, shows that they are.

    Tracks on one line fit mirrored ones as well: the matched positions must spread to the sides, too.
    """
    best, limits = pair.hypotheses[0], settings.clock_mounting
    return (
        best.weight_of_evidence(settings.hypotheses) >= limits.firm_evidence
        and abs(best.clock_offset) <= clock_sigma
        and best.lateral_spread >= limits.min_lateral_spread
    )


def may_differ_by_chance(
    h: ClockMountingHypothesis, scanners: int, clock_sigma: float, settings: ScannerPairSettings
) -> bool:
    """Whether different people may match like this in a search of a network of this number of scanners.

    With other clocks, far more alternatives are compared: matches may then be by chance also where they determine
    the clocks.
    """
    limits = settings.hypotheses.chance
    undetermined = h.clock_stddev > limits.max_clock_stddev or abs(h.clock_offset) > clock_sigma
    return undetermined and h.evidence < compute_chance_evidence(scanners, settings.hypotheses)


def select_searched_pairs(
    observations: Mapping[str, ScannerObservations], part: Indices, settings: ScannerPairSettings
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
    if len(names) <= settings.candidates.max_exhaustive:
        ends = [(a, b) for a, b in itertools.combinations(range(len(names)), 2) if part[a] != part[b]]
    else:
        to_ticks = samples[0].to_ticks
        step, farthest = to_ticks(limits.similarity_step), to_ticks(limits.max_clock_offset)
        delays = range(-(farthest // step) * step, farthest + 1, step)
        # Scanners of the largest part are compared with the others, which are few as a rule.
        others = part != np.argmax(np.bincount(part))
        compared = others[:, None] & (part[:, None] != part)
        compared &= ~(others & np.tri(len(names), dtype=np.bool_))
        similarity = compute_track_similarity(
            samples, settings, compared=compared, delays=delays, mirrored=(False, True)
        )
        ends = sorted(select_pairs_between_parts(similarity, part, limits.partners, limits.pairs_of_part))
    return [(names[a], names[b]) for a, b in ends]


def search_clocks_and_mountings(
    pairs: Sequence[tuple[str, str]],
    observations: Mapping[str, ScannerObservations],
    clock_sigma: float,
    rng: np.random.Generator,
    *,
    engine: Engine = THIS_PROCESS,
    settings: ScannerPairSettings = ScannerPairSettings(),
) -> list[ClockMountingHypothesis]:
    """Searches the clock offsets and relative mountings of pairs of scanners.

    Args:
        pairs: names of their scanners.
        observations: by scanner.
        clock_sigma: prior standard deviation of the clock offset of two scanners, s.
        rng: random generator for the selection of poses.
        engine: evaluates pairs.
        settings: range and steps of the search, gates and limits of registrations.

    Returns:
        The hypotheses of each pair and mounting: the registrations from the starts that fit best.
    """
    prior = NuisancePrior(clock_sigma, settings.registration.depth_stddev)
    generators = rng.spawn(len(pairs))
    data = dict(zip(observations, engine.put(list(observations.values())), strict=True))
    work = [
        (ends, data[ends[0]], data[ends[1]], prior, generator, settings)
        for ends, generator in zip(pairs, generators, strict=True)
    ]
    return [found for of_pair in engine.map(_search_pair, work) for found in of_pair]


def _search_pair(
    names: tuple[str, str],
    a: ScannerObservations,
    b: ScannerObservations,
    prior: NuisancePrior,
    rng: np.random.Generator,
    settings: ScannerPairSettings,
) -> list[ClockMountingHypothesis]:
    found = []
    for mirrored in (False, True):
        starts = _select_starts(a, b, mirrored, rng, settings)
        found += [
            _summarize_hypothesis(names, mirrored, hypothesis, settings)
            for delay, T in starts
            if (hypothesis := _register(T, a, b, mirrored, delay, prior, settings)) is not None
        ]
    return found


def _select_starts(
    a: ScannerObservations,
    b: ScannerObservations,
    mirrored: bool,
    rng: np.random.Generator,
    settings: ScannerPairSettings,
) -> list[tuple[int, Array]]:
    """Delays of b, in ticks, and poses (3, 3) that fit best, distinct from each other."""
    limits, wanted = settings.clock_mounting, settings.hypotheses
    reduced_settings = settings.proposals.model_copy(update={"max_count": limits.proposals})
    step, farthest = a.samples.to_ticks(limits.clock_step), a.samples.to_ticks(limits.max_clock_offset)
    candidates: list[tuple[float, int, Array]] = []
    for delay in range(-(farthest // step) * step, farthest + 1, step):
        moved = b.transform(mirrored, delay)
        pairs = pair_samples(a.samples, moved.samples)
        if len(np.unique(pairs.row_a)) < pairs.a.to_ticks(wanted.min_matched_time):
            continue
        T = propose_poses(subsample_pairs(pairs, limits.pairs, wanted.min_samples), reduced_settings, rng)
        rough = subsample_pairs(pairs, wanted.rough_pairs, wanted.min_samples)
        T = T[~_contradicts(T, a, moved, rough, len(pairs), wanted.proposal_stddev, settings)]
        coarse = subsample_pairs(pairs, wanted.coarse_pairs, wanted.min_samples)
        costs = compute_pose_costs(T, coarse, wanted.proposal_stddev, settings.registration.gate)
        candidates += [(float(costs[k]), delay, T[k]) for k in np.argsort(costs)[: limits.registered]]
    starts: list[tuple[int, Array]] = []
    for _, delay, T in sorted(candidates, key=lambda candidate: candidate[0]):
        if len(starts) < limits.registered and not any(
            abs(delay - other) <= step and _is_same(T, T_other, settings) for other, T_other in starts
        ):
            starts.append((delay, T))
    return starts


def _is_same(T: Array, other: Array, settings: ScannerPairSettings) -> bool:
    x, y, angle = se2.difference(T, other)
    limits = settings.hypotheses
    return bool(np.hypot(x, y) < limits.same_position and abs(angle) < limits.same_angle)


def _register(
    T_a_b: Array,
    a: ScannerObservations,
    b: ScannerObservations,
    mirrored: bool,
    delay: int,
    prior: NuisancePrior,
    settings: ScannerPairSettings,
) -> PoseHypothesis | None:
    """The credible pose near a start; shifts the samples until the rest of the clock offset is below a tick."""
    period, model_error = a.samples.tick_period, settings.registration.max_model_error
    for shift in range(_MAX_SHIFTS):
        moved = b.transform(mirrored, delay)
        pairs = pair_samples(a.samples, moved.samples)
        if not len(pairs):
            return None
        sampled = subsample_pairs(pairs, settings.clock_mounting.pairs, settings.hypotheses.min_samples)
        of_rest = NuisancePrior(prior.clock_sigma, prior.depth_sigma, -delay * period)
        fit = register_tracks(T_a_b, sampled, model_error, of_rest, settings.registration)
        if fit is None:
            return None
        T_a_b, model_error = fit.T_a_b, settings.registration.fine_model_error
        rest = round(float(fit.nuisance[0]) / period)
        if rest and shift + 1 < _MAX_SHIFTS:
            delay += rest
            continue
        if _contradicts(T_a_b[None], a, moved, sampled, len(pairs), 0.0, settings)[0]:
            return None
        return build_hypothesis(fit, sampled, a.samples, moved.samples, len(pairs), of_rest, settings)
    return None


def _contradicts(
    T: Array,
    a: ScannerObservations,
    b: ScannerObservations,
    sampled: SimultaneousPairs,
    count: int,
    pose_error: float,
    settings: ScannerPairSettings,
) -> NDArray[np.bool_]:
    """(K,) which poses imply too many missed detections, by a selection of ``count`` pairs."""
    limits = settings.visibility
    return contradicts_visibility(
        T, sampled, a.visibility, b.visibility,
        radius=limits.detection_radius + pose_error,
        min_expected=limits.min_expected * len(sampled) / count,
        max_missed_share=limits.max_missed_share,
    )  # fmt: skip
