"""Joint estimators over all sensors and captures, and what they say for themselves."""

from calgraph.refinement.evidence import Pairs, assemble, why_alone
from calgraph.refinement.hypergraph import Filter, Joint, Start, solve_hypergraph

__all__ = ["Filter", "Joint", "Pairs", "Start", "assemble", "solve_hypergraph", "why_alone"]
