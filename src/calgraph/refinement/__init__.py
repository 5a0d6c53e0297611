"""Joint estimators over all sensors and captures, and what they say for themselves."""

from calgraph.refinement.evidence import assemble
from calgraph.refinement.hypergraph import Filter, Joint, Start, solve_hypergraph

__all__ = ["Filter", "Joint", "Start", "assemble", "solve_hypergraph"]
