"""Relative poses of sensor pairs by consensus over captures."""

from calgraph.pairwise.estimate import PairwiseEstimate
from calgraph.pairwise.lines import coplanarity
from calgraph.pairwise.pair import Candidates, estimate_pair, match_table, reconsider

__all__ = ["Candidates", "PairwiseEstimate", "coplanarity", "estimate_pair", "match_table", "reconsider"]
