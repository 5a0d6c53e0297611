"""Relative poses of sensor pairs: RANSAC over captures of a board, or registration of simultaneous tracks."""

from typing import TYPE_CHECKING

from calgraph.lazy_names import import_on_use

if TYPE_CHECKING:
    from calgraph.pairwise.board_matches import Candidates, tabulate_matches
    from calgraph.pairwise.board_pair import (
        PairwiseEstimates,
        estimate_pair,
        estimate_pairs,
        reselect_all_inliers,
        reselect_inliers,
        select_successful,
    )
    from calgraph.pairwise.clock_mounting_search import (
        ClockMountingHypothesis,
        describe_difference,
        is_firm,
        may_differ_by_chance,
        search_clocks_and_mountings,
        select_searched_pairs,
    )
    from calgraph.pairwise.hypothesis_evidence import PoseHypothesis
    from calgraph.pairwise.line_matches import evaluate_coplanarity
    from calgraph.pairwise.pairwise_estimate import MatchFilter, PairwiseEstimate, select_matches
    from calgraph.pairwise.scanner_pair import (
        ScannerPairEstimate,
        estimate_scanner_pair,
        estimate_scanner_pairs,
    )
    from calgraph.pairwise.visibility_map import ScannerObservations
else:
    __getattr__ = import_on_use(
        __name__,
        [
            "pairwise_estimate",
            "board_matches",
            "board_pair",
            "line_matches",
            "hypothesis_evidence",
            "visibility_map",
            "scanner_pair",
            "clock_mounting_search",
        ],
    )

__all__ = [
    "Candidates",
    "ClockMountingHypothesis",
    "MatchFilter",
    "PairwiseEstimate",
    "PairwiseEstimates",
    "PoseHypothesis",
    "ScannerObservations",
    "ScannerPairEstimate",
    "describe_difference",
    "estimate_pair",
    "estimate_pairs",
    "estimate_scanner_pair",
    "estimate_scanner_pairs",
    "evaluate_coplanarity",
    "is_firm",
    "may_differ_by_chance",
    "reselect_all_inliers",
    "reselect_inliers",
    "search_clocks_and_mountings",
    "select_matches",
    "select_searched_pairs",
    "select_successful",
    "tabulate_matches",
]  # fmt: skip
