"""Whether the model of a network's joint solution holds, or the averaged pairs have to replace it."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from calgraph.config import Cylinder, People
from calgraph.geometry import Array
from calgraph.network.checks.consistency_tests import (
    FALSE_ALARM_PROBABILITY,
    Scatter,
    find_disagreement,
    find_inconsistent_parts,
    measure_scatter,
)
from calgraph.network.checks.fit_tests import find_poor_fit
from calgraph.network.checks.systematic_tests import find_systematic_errors
from calgraph.network.graph.network_graph import compute_joint_covariance
from calgraph.network.graph.network_initialization import NetworkInitialization
from calgraph.network.joint.contributions import split_contributions
from calgraph.network.joint.estimate import NetworkSolution, SolvedNetwork
from calgraph.network.joint.leg_problem import LegObservations
from calgraph.network.joint.solver import MAX_JOINT_COVARIANCE
from calgraph.network.tracking.track import ScannerTracks
from calgraph.result.finding import Finding


@dataclass(frozen=True, eq=False)
class ModelAssessment:
    """What the tests of a joint solution leave of it."""

    joint: NetworkSolution | None
    """The joint solution, with a covariance that contains the scatter of its parts; None where averaged poses
    have to replace it."""
    findings: tuple[Finding, ...] = ()
    """What contradicts it."""


def assess_network_model(
    target: People | Cylinder,
    joint: NetworkSolution,
    tracked: Sequence[ScannerTracks],
    initialization: NetworkInitialization,
    *,
    replaceable: bool = True,
) -> ModelAssessment:
    """Tests the model of a joint solution on the recording that it was fitted to, and its systematic errors.

    The model is refuted where an estimate is at its limit or parts of the data contradict each other strongly; and
    where anything but the averaged pairs contradicts it, and these do as well.

    Args:
        target: the kind of bodies, with their stated size.
        joint: the joint solution.
        tracked: the tracks of each of its scanners.
        initialization: averaged poses of the same from the pairs alone.
        replaceable: whether averaged poses may replace the joint solution.
    """
    assessment = _test_model(target, joint, tracked, initialization, replaceable)
    if assessment.joint is None or assessment.joint.systematic is None:
        return assessment
    errors = find_systematic_errors(assessment.joint.systematic, initialization.names)
    return replace(assessment, findings=(*assessment.findings, *errors))


# Ratio of the observed to the expected variance of contributions to the poses up to which the enlarged covariance
# is enough; beyond, poses are weak. Legs are not exactly as modelled: on 75 simulated recordings of them the
# ratio is 1.45 at most, and with many scanners and people even 1.2 is significant.
_MAX_GOOD_SCATTER = 2.0
# Averaging is not compared with the joint solution where the estimated radii of bodies differ from those of
# rig.yaml by more than this on average, relatively: averaging keeps the radii of rig.yaml, whose error its
# covariance does not contain.
_MAX_RADIUS_DEVIATION = 0.15
# Ratio of the variances of averaged poses to those stated where people are measured as legs, in this comparison:
# averaging takes both legs for one body, and tracks change from one leg to the other. Its NEES in simulated
# offices is 1.4 on average and 2.6 at most, and below 1 with whole bodies.
_LEG_AVERAGING_VARIANCE = 2.0


def _test_model(
    target: People | Cylinder,
    joint: NetworkSolution,
    tracked: Sequence[ScannerTracks],
    initialization: NetworkInitialization,
    replaceable: bool,
) -> ModelAssessment:
    """The tests of the model; those of systematic errors need one that holds."""
    if (solved := joint.solved) is None or not solved.problem.bodies:
        return ModelAssessment(joint)
    names, averaged = initialization.names, initialization.solution
    findings = [*find_poor_fit(solved, names, np.array([one.sigma for one in tracked]))]
    scatter, inconsistent = _test_parts(solved, names)
    findings += inconsistent
    joint = joint.scale_covariance(max(scatter.ratio, 1.0))
    if scatter.p < FALSE_ALARM_PROBABILITY and scatter.ratio > _MAX_GOOD_SCATTER:
        findings.append(_describe_scatter(scatter, names))
    refuted = any(finding.refutes for finding in findings)
    legs = isinstance(solved.problem.bodies[0], LegObservations)
    if legs or _measure_radius_deviation(target, solved) < _MAX_RADIUS_DEVIATION:
        inliers = initialization.graph.select_edges(averaged.inliers)
        covariance = compute_joint_covariance(inliers, averaged.T_root_node)
        covariance *= _LEG_AVERAGING_VARIANCE if legs else 1.0
        disagreement = [*find_disagreement(joint, averaged.T_root_node, covariance, names)]
        refuted |= bool(findings and disagreement)
        findings += disagreement
    if not refuted:
        return ModelAssessment(joint, tuple(findings))
    consequence = "poses are averages of pairs instead, less precise" if replaceable else "its poses may be wrong"
    summary = Finding(
        f"the model of the joint solution does not hold (see the remarks): {consequence}; state in rig.yaml what "
        "the scanners measure of people (target: height, axes), set clocks, or record people who carry nothing",
        tuple(names),
    )
    # One reason is enough for the verdicts; what led to it are remarks.
    causes = [replace(finding, sensors=()) for finding in findings]
    return ModelAssessment(None if replaceable else joint, (summary, *causes))


# Length of the intervals whose contributions are compared, s: several strides, over which the deviations of
# walking people average out, and a tenth of a short recording.
_INTERVAL = 5.0
# Intervals of all bodies together; they are longer where there are more. The scatter of 2000 has a standard
# deviation of 3 %, and a part of a walk past 20 scanners takes 0.3 MB.
_MAX_PARTS = 2000


def _test_parts(solved: SolvedNetwork, names: Sequence[str]) -> tuple[Scatter, list[Finding]]:
    """How far parts of the data scatter, and which of them give other poses."""
    walked = sum(body.knots.duration for body in solved.problem.bodies)
    parts = split_contributions(solved, max(_INTERVAL, walked / _MAX_PARTS))
    scatter = measure_scatter(parts)
    groups = parts.group_scanners(MAX_JOINT_COVARIANCE)
    findings = [
        finding
        for group in groups
        for finding in find_inconsistent_parts(parts.select(group), names, max(scatter.ratio, 1.0), len(groups))
    ]
    return scatter, findings


# The same ratio beyond which the model is refuted: parts of the recording that contradict each other by twice
# what noise explains.
_REFUTING_SCATTER = 4.0


def _describe_scatter(scatter: Scatter, names: Sequence[str]) -> Finding:
    return Finding(
        f"contributions of parts of the recording to the poses scatter {np.sqrt(scatter.ratio):.1f} times as much "
        f"as noise explains (p = {scatter.p:.0e}), by which standard deviations are enlarged: people are not as "
        "modelled, or clocks or ranges are wrong",
        tuple(names),
        refutes=scatter.ratio > _REFUTING_SCATTER,
    )


def _measure_radius_deviation(target: People | Cylinder, solved: SolvedNetwork) -> float:
    """Largest relative deviation of the mean radii of all bodies from the stated ones."""
    stated: Array = np.array(target.axes) if isinstance(target, People) else np.full(2, target.diameter / 2)
    beams = [sum(len(scans.ranges) for scans in body.scans) for body in solved.problem.bodies]
    radii = np.average([path.radii for path in solved.state.paths], axis=0, weights=beams)
    return float(np.max(np.abs(radii / stated - 1)))
