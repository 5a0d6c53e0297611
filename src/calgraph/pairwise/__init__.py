"""Relative poses of sensor pairs: RANSAC over captures of a board, or registration of simultaneous tracks."""

from calgraph.pairwise.board_pair import (
    Candidates,
    PairwiseEstimates,
    estimate_pair,
    estimate_pairs,
    reselect_all_inliers,
    reselect_inliers,
    select_successful,
    tabulate_matches,
)
from calgraph.pairwise.line_matches import evaluate_coplanarity
from calgraph.pairwise.pairwise_estimate import MatchFilter, PairwiseEstimate, select_matches
from calgraph.pairwise.scanner_pair import (
    PoseHypothesis,
    ScannerPairEstimate,
    estimate_scanner_pair,
    estimate_scanner_pairs,
)
from calgraph.pairwise.visibility_map import ScannerObservations

__all__ = [
    "Candidates", "MatchFilter", "PairwiseEstimate", "PairwiseEstimates", "PoseHypothesis",
    "ScannerObservations", "ScannerPairEstimate", "estimate_pair", "estimate_pairs", "estimate_scanner_pair",
    "estimate_scanner_pairs", "evaluate_coplanarity", "reselect_all_inliers", "reselect_inliers",
    "select_matches", "select_successful", "tabulate_matches",
]  # fmt: skip
