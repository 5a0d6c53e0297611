"""Joint estimators over all sensors, and what they say for themselves."""

from calgraph.refinement.evidence import assemble
from calgraph.refinement.hypergraph import Filter, Joint, solve_hypergraph
from calgraph.refinement.network_evidence import assemble_network
from calgraph.refinement.problem import Estimator, Problem, Solver
from calgraph.refinement.replay import load_problem, replayable, save_problem

__all__ = [
    "Estimator", "Filter", "Joint", "Problem", "Solver", "assemble", "assemble_network", "load_problem",
    "replayable", "save_problem", "solve_hypergraph",
]  # fmt: skip
