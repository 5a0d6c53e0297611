"""Joint estimators over all sensors, and what they say for themselves."""

from calgraph.refinement.audit import Audit, AxisAudit, Misfit, SensorAudit, Tolerance
from calgraph.refinement.network.audit import audit_network
from calgraph.refinement.network.evidence import NetworkPairs, assemble_network
from calgraph.refinement.network.extension import agreed_prior, earlier_poses, extended, without
from calgraph.refinement.network.joint_network import JointNetwork, solve_network
from calgraph.refinement.network.prior import ScannerPrior
from calgraph.refinement.observability import axis_names
from calgraph.refinement.rig.audit import audit
from calgraph.refinement.rig.bundle_adjustment import cramer_rao, solve_bundle
from calgraph.refinement.rig.evidence import assemble
from calgraph.refinement.rig.hypergraph import Filter, solve_hypergraph
from calgraph.refinement.rig.joint import Adjusted, Joint, MeasuredNoise
from calgraph.refinement.rig.known import PosePrior, PriorFile, RigidFile, RigidGroup, attached
from calgraph.refinement.rig.outlook import with_outlook
from calgraph.refinement.rig.problem import Estimator, Problem, Solver, check_problem, knowing
from calgraph.refinement.rig.replay import load_problem, replayable, save_problem
from calgraph.refinement.rig.resampling import CONFIDENCE, Scatter, resample
from calgraph.refinement.rig.unknowns import Estimable

__all__ = [
    "CONFIDENCE",
    "Adjusted",
    "Audit",
    "AxisAudit",
    "Estimable",
    "Estimator",
    "Filter",
    "Joint",
    "JointNetwork",
    "MeasuredNoise",
    "Misfit",
    "NetworkPairs",
    "PosePrior",
    "PriorFile",
    "Problem",
    "RigidFile",
    "RigidGroup",
    "ScannerPrior",
    "Scatter",
    "SensorAudit",
    "Solver",
    "Tolerance",
    "agreed_prior",
    "assemble",
    "assemble_network",
    "attached",
    "audit",
    "audit_network",
    "axis_names",
    "check_problem",
    "cramer_rao",
    "earlier_poses",
    "extended",
    "knowing",
    "load_problem",
    "replayable",
    "resample",
    "save_problem",
    "solve_bundle",
    "solve_hypergraph",
    "solve_network",
    "with_outlook",
    "without",
]  # fmt: skip
