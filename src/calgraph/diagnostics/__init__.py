"""Tests of a result: verdicts, cross-validation, bootstrap, comparisons, suggestions."""

from typing import TYPE_CHECKING

from calgraph.lazy_names import import_on_use

if TYPE_CHECKING:
    from calgraph.diagnostics.comparison import (
        AxisComparison,
        ExtrinsicsComparison,
        ResidualComparison,
        SensorComparison,
    )
    from calgraph.diagnostics.finding import Finding
    from calgraph.diagnostics.network.assemble import NetworkPairs, assemble_network
    from calgraph.diagnostics.network.clock_findings import report_clocks_and_mountings
    from calgraph.diagnostics.network.extension import (
        build_consistent_prior,
        extract_earlier_poses,
        merge_calibrations,
        remove_scanners,
    )
    from calgraph.diagnostics.network.extrinsics_check import compare_network_poses
    from calgraph.diagnostics.network.findings import collect_network_findings
    from calgraph.diagnostics.network.model_assessment import ModelAssessment, assess_network_model
    from calgraph.diagnostics.network.track_bumps import find_track_bump
    from calgraph.diagnostics.rig.assemble import assemble_rig
    from calgraph.diagnostics.rig.bootstrap import BootstrapScatter, bootstrap_poses
    from calgraph.diagnostics.rig.bump_tests import Bump, find_bumps
    from calgraph.diagnostics.rig.cross_validation import cross_validate
    from calgraph.diagnostics.rig.drift_tests import include_drifts
    from calgraph.diagnostics.rig.extrinsics_check import compare_rig_poses
    from calgraph.diagnostics.rig.next_best_pose import suggest_board_poses
    from calgraph.diagnostics.rig.suggestions import add_suggestions
    from calgraph.diagnostics.verdict import axis_names
else:
    __getattr__ = import_on_use(
        __name__,
        [
            "finding",
            "verdict",
            "rig.assemble",
            "rig.bump_tests",
            "rig.cross_validation",
            "rig.drift_tests",
            "rig.next_best_pose",
            "rig.suggestions",
            "rig.bootstrap",
            "rig.extrinsics_check",
            "comparison",
            "network.assemble",
            "network.clock_findings",
            "network.extension",
            "network.extrinsics_check",
            "network.findings",
            "network.model_assessment",
            "network.track_bumps",
        ],
    )

__all__ = [
    "AxisComparison", "BootstrapScatter", "Bump", "ExtrinsicsComparison", "Finding", "ModelAssessment",
    "NetworkPairs", "ResidualComparison", "SensorComparison", "add_suggestions", "assemble_network",
    "assemble_rig", "assess_network_model", "axis_names", "bootstrap_poses", "build_consistent_prior",
    "collect_network_findings", "compare_network_poses", "compare_rig_poses", "cross_validate",
    "extract_earlier_poses", "find_bumps", "find_track_bump", "include_drifts",
    "merge_calibrations", "remove_scanners", "report_clocks_and_mountings", "suggest_board_poses",
]  # fmt: skip
