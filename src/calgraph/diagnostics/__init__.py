"""Whether a result can be trusted: verdicts, cross-validation, bootstrap, comparisons, suggestions."""

from calgraph.diagnostics.comparison import Audit, AxisAudit, Misfit, SensorAudit, Tolerance
from calgraph.diagnostics.network.assemble import NetworkPairs, assemble_network
from calgraph.diagnostics.network.extension import agreed_prior, earlier_poses, extended, without
from calgraph.diagnostics.network.extrinsics_check import audit_network
from calgraph.diagnostics.rig.assemble import assemble
from calgraph.diagnostics.rig.assessment import with_outlook
from calgraph.diagnostics.rig.bootstrap import CONFIDENCE, Scatter, resample
from calgraph.diagnostics.rig.extrinsics_check import audit
from calgraph.diagnostics.verdict import axis_names

__all__ = [
    "CONFIDENCE",
    "Audit",
    "AxisAudit",
    "Misfit",
    "NetworkPairs",
    "Scatter",
    "SensorAudit",
    "Tolerance",
    "agreed_prior",
    "assemble",
    "assemble_network",
    "audit",
    "audit_network",
    "axis_names",
    "earlier_poses",
    "extended",
    "resample",
    "with_outlook",
    "without",
]
