"""Relative poses of sensor pairs: by consensus over captures, or from what both saw moving."""

from calgraph.pairwise.estimate import Filter, PairwiseEstimate, selected_matches
from calgraph.pairwise.lines import coplanarity
from calgraph.pairwise.open_view import Sights
from calgraph.pairwise.pair import (
    Candidates,
    Pairs,
    estimate_pair,
    estimate_pairs,
    estimated,
    match_table,
    reconsider,
    reconsider_pairs,
)
from calgraph.pairwise.tracks import Hypothesis, TrackPair, estimate_network_pair, estimate_network_pairs

__all__ = [
    "Candidates", "Filter", "Hypothesis", "Pairs", "PairwiseEstimate", "Sights", "TrackPair", "coplanarity",
    "estimate_network_pair", "estimate_network_pairs", "estimate_pair", "estimate_pairs", "estimated",
    "match_table", "reconsider", "reconsider_pairs", "selected_matches",
]  # fmt: skip
