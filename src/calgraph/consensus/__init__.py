"""Robust estimation from data of which many are wrong."""

from calgraph.consensus.search import Consensus, search

__all__ = ["Consensus", "search"]
