"""Joint estimators over all sensors, and what they say for themselves."""

from calgraph.refinement.evidence import assemble
from calgraph.refinement.hypergraph import Filter, Joint, solve_hypergraph
from calgraph.refinement.network_evidence import assemble_network

__all__ = ["Filter", "Joint", "assemble", "assemble_network", "solve_hypergraph"]
