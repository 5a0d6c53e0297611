"""Relative poses of sensor pairs: by consensus over captures, or from what both saw moving."""

from calgraph.pairwise.board_pair import (
    Candidates,
    Pairs,
    estimate_pair,
    estimate_pairs,
    estimated,
    match_table,
    reconsider,
    reconsider_pairs,
)
from calgraph.pairwise.line_matches import coplanarity
from calgraph.pairwise.pairwise_estimate import Filter, PairwiseEstimate, selected_matches
from calgraph.pairwise.scanner_pair import Hypothesis, TrackPair, estimate_network_pair, estimate_network_pairs
from calgraph.pairwise.visibility_map import Sights

__all__ = [
    "Candidates", "Filter", "Hypothesis", "Pairs", "PairwiseEstimate", "Sights", "TrackPair", "coplanarity",
    "estimate_network_pair", "estimate_network_pairs", "estimate_pair", "estimate_pairs", "estimated",
    "match_table", "reconsider", "reconsider_pairs", "selected_matches",
]  # fmt: skip
