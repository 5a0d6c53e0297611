"""The papers' estimators, as published."""

from calgraph.baselines.hypergraph import solve_hypergraph

__all__ = ["solve_hypergraph"]
