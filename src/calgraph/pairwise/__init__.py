"""Relative poses of sensor pairs by consensus over captures."""

from calgraph.pairwise.estimate import PairwiseEstimate
from calgraph.pairwise.lines import coplanarity
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

__all__ = [
    "Candidates", "Pairs", "PairwiseEstimate", "coplanarity", "estimate_pair", "estimate_pairs", "estimated",
    "match_table", "reconsider", "reconsider_pairs",
]  # fmt: skip
