"""Whether the model of a network's joint solution holds, or the averaged pairs have to replace it."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from calgraph.config import Lidar2dUncertainty
from calgraph.geometry import Array, Index, se2
from calgraph.network.checks.consistency_tests import (
    FALSE_ALARM_PROBABILITY,
    Scatter,
    find_disagreement,
    find_inconsistent_parts,
    measure_excess,
    measure_scatter,
)
from calgraph.network.graph.network_graph import compute_joint_covariance
from calgraph.network.graph.network_initialization import NetworkInitialization
from calgraph.network.joint.body_equations import predict_beams
from calgraph.network.joint.contributions import split_contributions
from calgraph.network.joint.estimate import NetworkSolution
from calgraph.network.joint.model_error import MAX_HEADING_SIGMA, MAX_POSITION_SIGMA
from calgraph.network.joint.planar_poses import complete_covariance
from calgraph.network.joint.problem import BodyObservations, BodyPath, NetworkProblem, NetworkState
from calgraph.network.joint.range_noise import MAX_EXCESS
from calgraph.network.joint.scanner_unknowns import TILT_ERRORS, SystematicErrors
from calgraph.network.joint.solver import MAX_JOINT_COVARIANCE, NetworkEquations
from calgraph.network.tracking.track import ScannerTracks
from calgraph.result.finding import Finding
from calgraph.verdict.parameter_estimates import (
    MAX_PARAMETER_CORRELATION,
    MAX_PRIOR_DEVIATION,
    MIN_LEARNED_SHARE,
    DescribedParameter,
    ParameterEstimates,
)


@dataclass(frozen=True, eq=False)
class ModelAssessment:
    """What the tests of a joint solution leave of it."""

    joint: NetworkSolution | None
    """The joint solution, with a covariance that contains the scatter of its parts and, where it is contradicted,
    its difference from averaged poses; None where these have to replace it."""
    findings: tuple[Finding, ...] = ()
    """What contradicts it."""
    averaged_variance: float = 1.0
    """Variances of the averaged poses that replace it, over those of their pairs."""


def assess_network_model(
    joint: NetworkSolution,
    tracked: Sequence[ScannerTracks],
    initialization: NetworkInitialization,
    *,
    replaceable: bool = True,
    max_stddev: float = np.inf,
) -> ModelAssessment:
    """Tests the model of a joint solution on the recording that it was fitted to, and its systematic errors.

    The model is refuted where an estimate is at its limit or parts of the data contradict each other strongly; and
    where anything but the averaged pairs contradicts it, and these do as well. Where it is contradicted, variances
    contain the difference of joint and averaged poses.

    Args:
        joint: the joint solution.
        tracked: the tracks of each of its scanners.
        initialization: averaged poses of the same from the pairs alone.
        replaceable: whether averaged poses may replace the joint solution.
        max_stddev: of the position of a scanner whose pose is good, m.
    """
    assessment = _test_model(joint, tracked, initialization, replaceable, max_stddev)
    if assessment.joint is None or assessment.joint.systematic is None:
        return assessment
    errors = find_systematic_errors(assessment.joint.systematic, initialization.names)
    # A wrong clock or tilt comes before what it does to the fit.
    return replace(assessment, findings=(*errors, *assessment.findings))


CORRELATED_BEAMS = "correlated beams"
"""The source of what errors of outlines add to variances."""
DIFFERENCE = "difference from averages"
"""The source of what the difference of contradicted poses from averaged ones adds to variances."""
_MODEL_REMEDY = (
    "state in rig.yaml what the scanners measure of people (target: height, axes), set clocks, or record people "
    "who carry nothing"
)

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
    joint: NetworkSolution,
    tracked: Sequence[ScannerTracks],
    initialization: NetworkInitialization,
    replaceable: bool,
    max_stddev: float,
) -> ModelAssessment:
    """The tests of the model; those of systematic errors need one that holds."""
    if (solved := joint.solved) is None or not solved.network.bodies:
        return ModelAssessment(joint)
    names, averaged = initialization.names, initialization.solution
    background = np.array([one.sigma for one in tracked])
    correlation = correlate_adjacent_beams(solved)
    errors = measure_outline_errors(solved, background, correlation)
    findings = [
        *find_poor_fit(solved, names, background),
        *find_correlated_beams(names, correlation, errors, max_stddev),
    ]
    scatter, inconsistent = _test_parts(solved, names)
    findings += inconsistent
    joint = joint.scale_covariance(max(scatter.ratio, 1.0), "scatter of parts")
    joint = add_position_errors(joint, errors)
    if scattered := scatter.p < FALSE_ALARM_PROBABILITY and scatter.ratio > _MAX_GOOD_SCATTER:
        findings.append(_describe_scatter(scatter, names))
    refuted = any(finding.refutes for finding in findings)
    whole = solved.network.bodies[0].kind != "legs"  # a track follows a person
    variance = 1.0 if whole else _LEG_AVERAGING_VARIANCE
    inliers = initialization.graph.select_edges(averaged.inliers)
    of_pairs = variance * compute_joint_covariance(inliers, averaged.T_root_node)
    disagreement: list[Finding] = []
    if comparable := not whole or _measure_radius_deviation(solved) < _MAX_RADIUS_DEVIATION:
        disagreement = [*find_disagreement(joint, averaged.T_root_node, of_pairs, names)]
        refuted |= bool(findings and disagreement)
        findings += disagreement
    averaged_variance = 1.0
    if refuted or (comparable and (scattered or disagreement)):
        replaced = refuted and replaceable
        factor = _measure_difference(joint, averaged.T_root_node, of_pairs, of_averages=replaced)
        if replaced:
            averaged_variance = variance * factor
        else:
            joint = joint.scale_covariance(factor, DIFFERENCE)
    if not refuted:
        return ModelAssessment(joint, tuple(findings))
    consequence = "poses are averages of pairs instead, less precise" if replaceable else "its poses may be wrong"
    summary = Finding(
        f"the model of the joint solution does not hold (see the remarks): {consequence}; {_MODEL_REMEDY}",
        tuple(names),
    )
    # One reason is enough for the verdicts; what led to it are remarks.
    causes = [replace(finding, sensors=()) for finding in findings]
    return ModelAssessment(None if replaceable else joint, (summary, *causes), averaged_variance)


def _measure_difference(
    joint: NetworkSolution, T_root_averaged: Array, of_pairs: Array, *, of_averages: bool
) -> float:
    """Factor of the covariance of joint or averaged poses with which it contains their difference.

    Where people are not as modelled, parts of the recording have errors in common, which their scatter lacks. Over
    12 simulated offices and labs (scanners at 12 to 68 cm, or tilted by 2°), the NEES of poses is 2.7 without this
    difference and 1.5 with it; that of the worst is 12.8 and 7.4.

    Args:
        joint: the joint solution.
        T_root_averaged: (S, 3, 3) averaged poses.
        of_pairs: (3S, 3S) their covariance, zero for the root.
        of_averages: whether the factor is that of averaged poses.
    """
    difference = se2.difference(joint.T_root_scanner, T_root_averaged)[1:].ravel()
    of_joint, of_averaged = complete_covariance(joint.pose_covariance)[3:, 3:], of_pairs[3:, 3:]
    if of_averages:
        return measure_excess(difference, of_averaged, of_joint)
    return measure_excess(difference, of_joint, of_averaged)


# Length of the intervals whose contributions are compared, s: several strides, over which the deviations of
# walking people average out, and a tenth of a short recording.
_INTERVAL = 5.0
# Intervals of all bodies together; they are longer where there are more. The scatter of 2000 has a standard
# deviation of 3 %, and a part of a walk past 20 scanners takes 0.3 MB.
_MAX_PARTS = 2000


def _test_parts(solved: NetworkEquations, names: Sequence[str]) -> tuple[Scatter, list[Finding]]:
    """How far parts of the data scatter, and which of them give other poses."""
    walked = sum(body.knots.duration for body in solved.network.bodies)
    parts = split_contributions(solved, max(_INTERVAL, walked / _MAX_PARTS))
    scatter = measure_scatter(parts)
    groups = parts.group_scanners(MAX_JOINT_COVARIANCE)
    findings = [
        finding
        for group in groups
        for finding in find_inconsistent_parts(parts.select(group), names, max(scatter.ratio, 1.0), len(groups))
    ]
    return scatter, findings


# Ratio of the observed to the expected variance of contributions beyond which the model is refuted: parts of the
# recording contradict each other by twice what noise explains.
_REFUTING_SCATTER = 4.0


def _describe_scatter(scatter: Scatter, names: Sequence[str]) -> Finding:
    return Finding(
        f"contributions of parts of the recording to the poses scatter {np.sqrt(scatter.ratio):.1f} times as much "
        f"as noise explains (p = {scatter.p:.0e}), by which standard deviations are enlarged: people are not as "
        f"modelled, or clocks or ranges are wrong; {_MODEL_REMEDY}",
        tuple(names),
        refutes=scatter.ratio > _REFUTING_SCATTER,
    )


def _measure_radius_deviation(solved: NetworkEquations) -> float:
    """Largest relative deviation of the mean radii of all bodies from the stated ones."""
    stated, _ = solved.network.bodies[0].shape_prior
    beams = [sum(len(scans.ranges) for scans in body.scans) for body in solved.network.bodies]
    radii = np.average([path.shape for path in solved.state.paths], axis=0, weights=beams)
    return float(np.max(np.abs(radii / stated - 1)))


# What an error means: beside those of a scanner's beams, those by the tilt of its scan plane and by its clock.
_CLAUSES = {one.quantity: one.clause for one in Lidar2dUncertainty().beam_errors()} | {
    "stretch along x": "ranges of {of} along its x axis are {size} longer|shorter than on average, as by a tilt "
    "of its scan plane",
    "stretch along diagonal": "ranges of {of} at 45° are {size} longer|shorter than on average, as by a tilt of "
    "its scan plane",
    "clock drift": "the clock of {of} is {size} faster|slower than that of the root",
}


def find_systematic_errors(errors: SystematicErrors, names: Sequence[str]) -> Iterator[Finding]:
    """Systematic errors that are larger than their priors allow, one of each scanner: the largest.

    Those that the data do not distinguish, such as range scales of all scanners, are named together; in large
    networks, those of scanners that measured common bodies. Stretches grow with the square of the tilt that causes
    them: a tilt of ``t`` standard deviations stretches ranges by ``t² / 2`` of the prior's, which is compared with
    the limit of ``t``.

    Args:
        errors: of the joint solution.
        names: of its scanners, the root first.
    """
    named = set[tuple[str, str]]()
    for scanner, name in enumerate(names):
        alone = _select_estimates(errors, names, np.array([scanner]))
        ratios = np.abs(alone.normalized)
        if not len(ratios) or ratios.max() <= MAX_PRIOR_DEVIATION:
            continue
        quantity = alone.parameters[int(np.argmax(ratios))].quantity
        if (name, quantity) in named:
            continue
        estimates = _select_estimates(errors, names, errors.covariance.list_near(scanner))
        keys = [(one.of, one.quantity) for one in estimates.parameters]
        i = keys.index((name, quantity))
        others = estimates.indistinguishable(i, MAX_PARAMETER_CORRELATION)
        named.update(keys[j] for j in others)
        text, causes = estimates.describe(i, others)
        scanners = {estimates.parameters[j].of for j in causes}
        # All poses are relative to the root.
        yield Finding(text, tuple(names) if names[0] in scanners else tuple(n for n in names if n in scanners))


def _select_estimates(errors: SystematicErrors, names: Sequence[str], scanners: Index) -> ParameterEstimates:
    """The estimated errors of some scanners; those of scanners far from each other are independent."""
    selected = errors.select(scanners)
    summary = selected.summarize([names[scanner] for scanner in scanners])
    by_tilt = np.array([one.quantity in TILT_ERRORS for one in summary])
    estimated = np.flatnonzero(selected.prior)
    return ParameterEstimates(
        [DescribedParameter(one.of, one.quantity, one.unit, clause=_CLAUSES[one.quantity]) for one in summary],
        np.array([one.value - one.stated for one in summary]),
        np.array([one.prior for one in summary]) * np.where(by_tilt, MAX_PRIOR_DEVIATION / 2, 1),
        selected.covariance.expand(0.0)[np.ix_(estimated, estimated)],
        MIN_LEARNED_SHARE,
    )


def find_poor_fit(solved: NetworkEquations, names: Sequence[str], background: Array) -> Iterator[Finding]:
    """The findings of all tests of the fit.

    Args:
        solved: the joint solution.
        names: of its scanners, the root first.
        background: (S,) noise of each scanner's static background, m.
    """
    yield from _find_noise_at_limit(solved, names, background)
    yield from _find_model_error_at_limit(solved, names)
    yield from _find_unused_beams(solved, names)


# A range noise or model error of more than this share of its limit counts as at the limit: an estimate that is
# cut off there. Valid models reach 0.3 of them, also with swinging arms.
_LIMIT_SHARE = 0.95


def _find_noise_at_limit(solved: NetworkEquations, names: Sequence[str], background: Array) -> Iterator[Finding]:
    network = solved.network
    limit = np.hypot(background, MAX_EXCESS)
    if len(scanners := np.flatnonzero(network.range_sigma > _LIMIT_SHARE * limit)):
        ratio = float(np.max(network.range_sigma[scanners] / background[scanners]))
        yield Finding(
            f"the range noise of {_list_names(scanners, names)} at people is at its limit, {ratio:.0f} times that "
            "at walls: they are of another shape than target in rig.yaml states, or clocks differ; "
            f"{_MODEL_REMEDY}",
            _make_weak(scanners, names),
            refutes=True,
        )


def _find_model_error_at_limit(solved: NetworkEquations, names: Sequence[str]) -> Iterator[Finding]:
    position, heading = np.sqrt(solved.network.model_error_variance).tolist()
    sizes = []
    if far := position > _LIMIT_SHARE * MAX_POSITION_SIGMA:
        sizes.append(f"{1000 * position:.0f} mm")
    if heading > _LIMIT_SHARE * MAX_HEADING_SIGMA:
        sizes.append(f"{np.degrees(heading):.0f}°")
    if sizes:
        yield Finding(
            f"scanners disagree about people by {' and '.join(sizes)} in each scan, the limit of the model error: "
            "people are of another shape than target in rig.yaml states, or clocks, ranges or angles are wrong; "
            f"{_MODEL_REMEDY}",
            tuple(names),
            refutes=far,
        )


# Minimum share of a scanner's beams on bodies that have a weight: robust estimates hold up to about half of
# outliers. 0.89 to 0.95 in simulation, 0.63 and more where arms swing by 0.15 m; 0.4 to 0.56 where ellipses are
# fitted to two people's legs.
_MIN_WEIGHTED_SHARE = 0.6


def _find_unused_beams(solved: NetworkEquations, names: Sequence[str]) -> Iterator[Finding]:
    used, total = np.zeros((2, len(names)))
    for body in solved.network.bodies:
        for scans in body.scans:
            used[scans.scanner] += np.count_nonzero(scans.weight)
            total[scans.scanner] += len(scans.weight)
    share = np.where(total > 0, used / np.maximum(total, 1), 1.0)
    if len(scanners := np.flatnonzero(share < _MIN_WEIGHTED_SHARE)):
        yield Finding(
            f"only {share[scanners].min():.0%} of the beams of {_list_names(scanners, names)} at people agree "
            "with the joint solution: record people without loads, of the shape that target in rig.yaml states",
            _make_weak(scanners, names),
        )


# Correlation of the residuals of a scanner's adjacent beams on a body up to which swinging arms explain it: below
# 0.02 without them, below 0.1 with them. A body of another shape leaves residuals of one sign along its outline.
_MAX_BEAM_CORRELATION = 0.2


def find_correlated_beams(
    names: Sequence[str], correlation: Array, errors: Array, max_stddev: float
) -> Iterator[Finding]:
    """A finding if residuals of adjacent beams are correlated.

    Args:
        names: of the S scanners, the root first.
        correlation: (S,) of :func:`correlate_adjacent_beams`.
        errors: (S,) of :func:`measure_outline_errors`, m; beyond the next they make poses weak by themselves.
        max_stddev: of the position of a scanner whose pose is good, m.
    """
    if len(scanners := np.flatnonzero(correlation > _MAX_BEAM_CORRELATION)):
        consequence = (
            f"for which up to {1000 * errors.max():.1f} mm are added to the standard deviations of positions: "
            "people are of another shape than target in rig.yaml states, or clocks, ranges or angles are wrong; "
            f"{_MODEL_REMEDY}"
            if errors.any()
            else "with no more noise than at walls: standard deviations contain it"
        )
        yield Finding(
            f"residuals of adjacent beams of {_list_names(scanners, names)} at people have a correlation of "
            f"{correlation[scanners].max():.2f}, {consequence}",
            _make_weak(np.flatnonzero(errors > max_stddev), names),
        )


def measure_outline_errors(solved: NetworkEquations, background: Array, correlation: Array) -> Array:
    """(S,) standard deviations of what adjacent beams on a body have in common and walls do not show, m.

    Noise that walls have as well is that of the scanner: the model error and the scatter of parts contain its
    correlation (NEES of 0.3 to 0.7 with 0.5 to 0.9). The rest is an error of the modelled outline: it may be the
    same in all scans, so that no test by parts shows it.

    Args:
        solved: the joint solution.
        background: (S,) noise of each scanner's static background, m.
        correlation: (S,) of :func:`correlate_adjacent_beams`.
    """
    excess = np.maximum(solved.network.range_sigma**2 - background**2, 0)
    return np.asarray(np.sqrt(np.where(correlation > _MAX_BEAM_CORRELATION, correlation * excess, 0)))


def add_position_errors(joint: NetworkSolution, errors: Array) -> NetworkSolution:
    """The solution with position variances that are larger by squares of errors (S,), m, and others in proportion.

    An error of the root is one of all others.
    """
    stated = np.mean(joint.covariance.stddev[1:, :2] ** 2, axis=1)
    factor = 1 + (errors[1:] ** 2 + errors[0] ** 2) / np.maximum(stated, np.finfo(float).tiny)
    return joint.scale_covariance(np.concatenate([[1.0], factor]), CORRELATED_BEAMS)


def correlate_adjacent_beams(solved: NetworkEquations) -> Array:
    """(S,) correlation of the weighted residuals of each scanner's adjacent beams on a body; 0 without beams."""
    products, squares = np.zeros((2, solved.network.count))
    for of_body in solved.batches.map(_multiply_adjacent, solved.network, solved.state):
        for scanner, product, square in of_body:
            products[scanner] += product
            squares[scanner] += square
    return np.asarray(products / np.maximum(squares, np.finfo(float).tiny))


def _multiply_adjacent(
    network: NetworkProblem, state: NetworkState, body: BodyObservations, path: BodyPath
) -> list[tuple[int, float, float]]:
    """Each scanner of a body, with the weighted sums of products and of mean squares of adjacent residuals."""
    sums = []
    for beams in predict_beams(network, state, body, path):
        weights = beams.scans.weight
        weight = np.sqrt(weights[:-1] * weights[1:]) * (beams.scan[:-1] == beams.scan[1:])
        first, second = beams.residual[:-1], beams.residual[1:]
        product, square = weight @ (first * second), weight @ (first**2 + second**2) / 2
        sums.append((beams.scans.scanner, float(product), float(square)))
    return sums


def _make_weak(scanners: NDArray[np.integer[Any]], names: Sequence[str]) -> tuple[str, ...]:
    """Names of those whose poses are weak if these scanners are wrong: all, where the root is among them."""
    return tuple(names) if 0 in scanners else tuple(names[s] for s in scanners)


def _list_names(scanners: NDArray[np.integer[Any]], names: Sequence[str]) -> str:
    return ", ".join(names[s] for s in scanners)
