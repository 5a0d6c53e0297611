"""Relative pose of two sensors from their detections of the board: RANSAC with a solver for each (kind, kind)."""

import itertools
from collections.abc import Callable, Mapping
from types import MappingProxyType

import numpy as np
from numpy.typing import NDArray

from calgraph.config.settings import BoardPairSettings
from calgraph.errors import Rejected
from calgraph.geometry import Array, se3
from calgraph.graph.pairwise_estimate import (
    FLATNESS,
    MODEL_ERROR,
    Matches,
    PairwiseEstimate,
    compute_information,
    compute_normalized_rms,
    linearize_at,
    refine_pose,
    resolve_ambiguity,
    squared_residual_function,
)
from calgraph.rig.pairs.board_matches import (
    Candidates,
    build_matches,
    explain_disagreement,
    geometric_kind,
    group_alternatives,
    tabulate_matches,
)
from calgraph.rig.pairs.line_matches import PlaneLineMatches
from calgraph.solver.ransac import find_consensus, select_best_of_groups

# Probability of a sample without outliers at which RANSAC stops: a pair fails by chance once in 10,000.
_RANSAC_CONFIDENCE = 0.9999
# Limit on samples of RANSAC: enough for that confidence with one board among 8 candidates in every capture (9400
# samples of 3 plane matches, half of which take the first candidates), and with up to 61 % outliers in samples of
# 8 line matches.
_RANSAC_MAX_SAMPLES = 20_000
# Inliers, in addition to the minimum number, of a pose that less than half of the shared captures support: with
# eight candidates of a LiDAR and its captures shuffled, 11 of 60 pairs had a pose of three or four inliers, none
# of five.
_MINORITY_INLIERS = 2


def estimate_pair(
    sensor_a: str,
    sensor_b: str,
    candidates_a: Candidates,
    candidates_b: Candidates,
    board_size: tuple[float, float],
    rng: np.random.Generator,
    *,
    refine: bool = True,
    settings: BoardPairSettings = BoardPairSettings(),
    known: Array | None = None,
) -> PairwiseEstimate | Rejected:
    """Estimates ``T_a_b`` from the captures in which both sensors have detections.

    Args:
        sensor_a: name of sensor a.
        sensor_b: name of sensor b.
        candidates_a: detections by a; all of one geometric kind (planes or lines).
        candidates_b: detections by b.
        board_size: width and height of the (largest) board, m.
        rng: random generator for the samples.
        refine: fit the inliers, weighted by their covariances, during and after RANSAC; the paper keeps the
            solution of its solver, which has equal weights.
        settings: gates, errors and limits.
        known: ``T_a_b`` (4, 4) from an earlier solution, which is kept without RANSAC if most captures agree.

    Returns:
        The estimate, or the reason why the pair cannot be estimated.
    """
    common = sorted(set(candidates_a) & set(candidates_b))
    if not common:
        return Rejected("no capture in which both detected the board")
    if not len(tabulate_matches(candidates_a, candidates_b)):
        return Rejected("no capture in which both detected the same board")
    kinds = geometric_kind(candidates_a[common[0]][0]), geometric_kind(candidates_b[common[0]][0])
    if kinds == ("line", "plane"):
        swapped = estimate_pair(
            sensor_b, sensor_a, candidates_b, candidates_a, board_size, rng,
            refine=refine, settings=settings, known=None if known is None else se3.inverse(known),
        )  # fmt: skip
        return swapped if isinstance(swapped, Rejected) else swapped.inverse()

    table, matches = build_matches(candidates_a, candidates_b, board_size)
    if len(common) < matches.sample_size:
        return Rejected(f"both detected the board in {len(common)} captures, {matches.sample_size} are needed")
    groups = group_alternatives(table, candidates_a, candidates_b)
    residuals = squared_residual_function(matches)
    # Matches with fewer residuals in all than the unknowns of a pose fit some pose without redundancy.
    residuals_per_match = matches.linearize(np.eye(4)[None]).residuals.size // len(table)
    enough = max(matches.sample_size, 7 // residuals_per_match + 1)
    if known is not None:
        inliers = select_best_of_groups(residuals(known[None])[0], groups)
        if inliers.sum() >= max(enough, len(common) / 2):
            return _evaluate_estimate((sensor_a, sensor_b), known, table, matches, inliers, 0.0)

    def fit(T: Array, inliers: NDArray[np.bool_]) -> Array:
        return refine_pose(T, matches, inliers, MODEL_ERROR, settings)

    found = find_consensus(
        groups, matches.sample_size, matches.solve, residuals, 1.0, rng=rng,
        confidence=_RANSAC_CONFIDENCE, max_samples=_RANSAC_MAX_SAMPLES,
        fit=fit if refine else None,
    )  # fmt: skip
    count = found.inlier_count if found else 0
    minority = _MINORITY_INLIERS if count < len(common) / 2 else 0
    min_inliers = enough + minority
    if found is None or count < min_inliers:
        return explain_disagreement(candidates_a, candidates_b, min_inliers, found)
    T_a_b, angle = found.model, 0.0
    if refine and isinstance(matches, PlaneLineMatches):
        minima = matches.find_local_minima(found.inliers)
        T_a_b, angle = resolve_ambiguity(T_a_b, minima, matches, found.inliers)
    if refine:
        T_a_b = refine_pose(T_a_b, matches, found.inliers, FLATNESS, settings)
    return _evaluate_estimate((sensor_a, sensor_b), T_a_b, table, matches, found.inliers, angle)


def _evaluate_estimate(
    sensors: tuple[str, str],
    T_a_b: Array,
    table: NDArray[np.intp],
    matches: Matches,
    inliers: NDArray[np.bool_],
    alternative_pose_angle: float,
) -> PairwiseEstimate:
    at = linearize_at(T_a_b, matches)
    rms = np.sqrt(np.mean(at.residuals**2, axis=-1))
    return PairwiseEstimate(
        *sensors, T_a_b, compute_information(at, inliers), table, inliers, rms,
        alternative_pose_angle, compute_normalized_rms(at, inliers, FLATNESS),
    )  # fmt: skip


PairwiseEstimates = Mapping[tuple[str, str], PairwiseEstimate | Rejected]
"""Estimate of each pair of sensors, or the reason for its rejection."""


def estimate_pairs(
    detections: Mapping[str, Candidates],
    board_size: tuple[float, float],
    rng: np.random.Generator,
    progress: Callable[[float], None] = lambda _done: None,
    *,
    refine: bool = True,
    settings: BoardPairSettings,
    known: Mapping[str, Array] = MappingProxyType({}),
) -> PairwiseEstimates:
    """Estimates the relative pose of every pair of sensors, as :func:`estimate_pair` does.

    Args:
        detections: by sensor and capture.
        board_size: width and height of the (largest) board, m.
        rng: random generator for the samples.
        progress: called with the completed fraction, 0..1.
        refine: as for :func:`estimate_pair`.
        settings: as for :func:`estimate_pair`.
        known: poses (4, 4) of sensors in one frame, from an earlier solution, as for :func:`estimate_pair`.
    """
    names = list(itertools.combinations(detections, 2))
    pairs = {}
    for done, (a, b) in enumerate(names, start=1):
        T_a_b = se3.inverse(known[a]) @ known[b] if a in known and b in known else None
        pairs[a, b] = estimate_pair(
            a, b, detections[a], detections[b], board_size, rng, refine=refine, settings=settings, known=T_a_b
        )
        progress(done / len(names))
    return pairs


def select_successful(pairs: PairwiseEstimates) -> list[PairwiseEstimate]:
    """Selects the pairs that were not rejected."""
    return [pair for pair in pairs.values() if not isinstance(pair, Rejected)]
