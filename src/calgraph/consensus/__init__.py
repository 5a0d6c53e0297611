"""Robust estimation from data of which many are wrong."""

from calgraph.consensus.search import Consensus, best_of_groups, search

__all__ = ["Consensus", "best_of_groups", "search"]
