"""Joint estimators over all sensors and captures."""

from calgraph.refinement.hypergraph import Filter, Joint, Start, solve_hypergraph

__all__ = ["Filter", "Joint", "Start", "solve_hypergraph"]
