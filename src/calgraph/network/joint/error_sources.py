"""The covariance of a network's poses as a sum over the sources of their errors: measurements, bodies and priors.

With the information H of the measurements and of the priors of bodies, and ``L_g`` of each group of priors of
scanners, their covariance is ``P = inv(H + sum L_g) = P H P + sum P L_g P``. H is a sum over scans of ``J' A J``,
where J are the derivatives of a scan's parameters with path and shape of the body following the scanners, and
``A = inv(inv(N) + Q)`` has two parts: ``A Q A`` by the model error of the body in the scan with covariance Q, and
the rest by the noise of ranges, of information N. Priors of paths and shapes follow the scanners, too.

Source: Koch, "Parameter estimation and hypothesis testing in linear models", 1999, section 3.3 (propagation of
errors).
"""

from collections import defaultdict
from collections.abc import Iterator, Mapping, Sequence
from functools import partial

import numpy as np

from calgraph.geometry import Array
from calgraph.network.joint.body_equations import linearize_scans
from calgraph.network.joint.estimate import NetworkSolution
from calgraph.network.joint.path_equations import compute_smoothness_information, compute_stretch
from calgraph.network.joint.planar_poses import PLANAR_AXES, NearCovariances, lift_covariance
from calgraph.network.joint.problem import BodyObservations, BodyPath, NetworkProblem, NetworkState, PathPrior
from calgraph.network.joint.scanner_matrix import ScannerMatrix
from calgraph.network.joint.scanner_unknowns import (
    CLOCK,
    FIRST_SYSTEMATIC,
    RANGE_SCALE,
    SCANNER_UNKNOWNS,
    SYSTEMATIC_ERRORS,
    TILT_ERRORS,
    list_columns,
    split_by_priors,
)
from calgraph.network.joint.schur import BodyEquations, compute_back_substitution
from calgraph.network.joint.solver import MAX_JOINT_COVARIANCE, NetworkEquations, add_walls, list_known_pairs
from calgraph.network.joint.splines import evaluate_spline
from calgraph.network.pairs.scanner_pair import CLOCK_SIGMA
from calgraph.result.budget import ErrorBudget, ErrorSource

EARLIER = ErrorSource("earlier calibration")
"""Errors of the poses that a calibration extends."""
UNMEASURED = ErrorSource("nothing measured")
"""What the equations of directions that no measurement determines are regular by."""
# Scanners whose sources are stated one by one; in larger networks, those of one kind are one source. A scanner has
# eight: those of 30 scanners are matrices of (180, 180) with 60 MB in all.
_MAX_SEPARATE = 30


def compute_error_budget(
    joint: NetworkSolution, names: Sequence[str], T_root_sensor: Sequence[Array]
) -> ErrorBudget | None:
    """What the covariance of the poses comes from; None where only the result of a solution is given.

    Covariances between scanners are those of networks that state all of them.

    Args:
        joint: the joint solution, with what was added to its covariance.
        names: of its scanners, the root first.
        T_root_sensor: poses (4, 4) of the same.
    """
    if joint.solved is None:
        return None
    parts = split_covariance(joint.solved, names)
    pairs = next(iter(parts.values())).pairs
    total = NearCovariances(len(names), pairs, np.sum([part.blocks for part in parts.values()], axis=0))
    for kind, factors in joint.variance_factors:
        enlarged = total.scale(factors)
        parts[ErrorSource(kind)] = NearCovariances(len(names), pairs, enlarged.blocks - total.blocks)
        total = enlarged
    sources = [source for source, part in parts.items() if part.blocks.any()]
    if len(names) <= MAX_JOINT_COVARIANCE:
        covariance = np.array([lift_covariance(parts[source].expand()) for source in sources])
        return ErrorBudget.of_poses(sources, covariance, T_root_sensor)
    blocks = np.zeros((len(sources), len(names), 6, 6))
    blocks[:, :, PLANAR_AXES[:, None], PLANAR_AXES] = [parts[source].own for source in sources]
    return ErrorBudget.of_blocks(sources, blocks, T_root_sensor)


def split_covariance(equations: NetworkEquations, names: Sequence[str]) -> dict[ErrorSource, NearCovariances]:
    """The covariances of the poses in the root's fixed axes, by source.

    Of all pairs of scanners in small networks; in large ones, of each scanner with itself.

    Args:
        equations: at the solution.
        names: of its scanners.
    """
    count, H = equations.network.count, equations.eliminate_bodies()[0]
    of = names if count <= _MAX_SEPARATE else [""] * count
    factor, information = H.factor(), _split_information(equations, of)
    complete = count <= MAX_JOINT_COVARIANCE
    pairs = list_known_pairs(equations.network) if complete else np.repeat(np.arange(count)[:, None], 2, axis=1)
    parts: dict[ErrorSource, Array] = {}
    for scanners in np.array_split(np.arange(count), -(-count // MAX_JOINT_COVARIANCE)):
        columns = list_columns(scanners.tolist()).reshape(-1, SCANNER_UNKNOWNS)[:, :CLOCK].ravel()
        unit = np.zeros((len(equations.estimated), len(columns)))
        unit[columns, np.arange(len(columns))] = equations.estimated[columns]
        by_gradient, here = factor.solve(unit), np.isin(pairs[:, 0], scanners)
        for source, left, right in _list_factors(equations, of, information, by_gradient):
            if complete:
                joint = (left.T @ right).reshape(count, CLOCK, count, CLOCK)
                blocks = joint[pairs[:, 0], :, pairs[:, 1]]
            else:
                by_scanner = (one.reshape(len(one), -1, CLOCK) for one in (left, right))
                blocks = np.einsum("msi,msj->sij", *by_scanner)
            parts.setdefault(source, np.zeros((len(pairs), CLOCK, CLOCK)))[here] += blocks
    return {source: NearCovariances(count, pairs, blocks) for source, blocks in parts.items()}


def _list_factors(
    equations: NetworkEquations,
    of: Sequence[str],
    information: Mapping[ErrorSource, ScannerMatrix],
    by_gradient: Array,
) -> Iterator[tuple[ErrorSource, Array, Array]]:
    """Pairs of matrices (m, n) whose products add up to the covariance (n, n) by each source.

    Args:
        equations: at the solution.
        of: what the sources of each scanner are of.
        information: of other sources than the priors of scanners.
        by_gradient: (US, n) derivatives of n components of poses by the gradient of the scanners.
    """
    for source, of_source in information.items():
        yield source, by_gradient, of_source.multiply(by_gradient)
    by_scanner = by_gradient.reshape(len(of), SCANNER_UNKNOWNS, -1)
    own, common = split_by_priors(equations.network.systematic_sigma, by_scanner[:, FIRST_SYSTEMATIC:])
    for kind, part in zip(SYSTEMATIC_ERRORS, common[:, None], strict=False):
        yield ErrorSource(kind), part, part
    kinds = ["clock offset", *("tilt" if one in TILT_ERRORS else one for one in SYSTEMATIC_ERRORS)]
    parts = np.concatenate([by_scanner[:, [CLOCK]] / CLOCK_SIGMA, own], axis=1)
    for name in dict.fromkeys(of):
        of_scanners = parts[[one == name for one in of]]
        for k, kind in enumerate(kinds):
            yield ErrorSource(kind, name), of_scanners[:, k], of_scanners[:, k]


def _split_information(equations: NetworkEquations, of: Sequence[str]) -> dict[ErrorSource, ScannerMatrix]:
    """Information (US, US) on the scanners by source, but for priors of their clocks and systematic errors."""
    network, state, g = equations.network, equations.state, np.zeros_like(equations.g)
    of_source = defaultdict[ErrorSource, ScannerMatrix](partial(ScannerMatrix.zeros, equations.H.order))
    of_source[UNMEASURED] = of_source[UNMEASURED].add_diagonal(equations.regularizer)
    add_walls(state, network.walls, of_source[ErrorSource("walls")], g)
    if network.prior:
        network.prior.add_to_equations(state.T_root_scanner, of_source[EARLIER], g)
    of_bodies = equations.map(_split_body, [[of[s] for s in scanners] for scanners in equations.scanners])
    for scanners, of_body in zip(equations.scanners, of_bodies, strict=True):
        for source, part in of_body.items():
            of_source[source].add(scanners, part)
    return dict(of_source)


def _split_body(
    network: NetworkProblem,
    state: NetworkState,
    body: BodyObservations,
    path: BodyPath,
    equations: BodyEquations,
    of: Sequence[str],
) -> dict[ErrorSource, Array]:
    """Information (UL, UL) on the L scanners that measured a body, by source, given what each is ``of``."""
    count, substitution = body.knots.count, compute_back_substitution(equations)[:, :-1]
    by_path, by_shape = -substitution[: 3 * count].reshape(count, 3, -1), -substitution[3 * count :]
    parts: dict[ErrorSource, Array] = {}

    def add(source: ErrorSource, left: Array, right: Array) -> None:
        product = left.reshape(-1, left.shape[-1]).T @ right.reshape(-1, left.shape[-1])
        parts[source] = parts.get(source, 0.0) + product

    biased, (_, of_shape) = body.has_biases, body.shape_prior
    whitened = np.sqrt(of_shape)[:, None] * by_shape
    outline = len(whitened) - biased * len(body.scans)
    add(ErrorSource("body shapes"), whitened[:outline], whitened[:outline])
    for k, name in enumerate(of):
        noise, of_body = ErrorSource("noise", name), ErrorSource("body model", name)
        terms = linearize_scans(network, state, body, path, k)
        J = np.zeros((*terms.equations.gradient.shape, substitution.shape[1]))
        of_pose = evaluate_spline(by_path.reshape(count, -1), terms.first, terms.weights)
        J[:, :3] = of_pose.reshape(len(J), 3, -1)
        J[:, terms.shape_rows] = by_shape[terms.shape_columns]
        J[..., SCANNER_UNKNOWNS * k : SCANNER_UNKNOWNS * (k + 1)] += terms.scanner_jacobian
        gradient = terms.equations.information @ J
        add(noise, J, gradient)
        if biased:
            add(of_body, whitened[[outline + k]], whitened[[outline + k]])
        else:
            shift = np.sqrt(network.model_error_variance[[0, 0, 1], None]) * gradient[:, :3]
            add(of_body, shift, shift)
            add(noise, -shift, shift)
    steady, ridge = _follow_path(state, body, path, by_path, body.find_path_prior(network, path))
    add(ErrorSource("body paths"), steady, steady)
    add(UNMEASURED, ridge, ridge)
    return parts


def _follow_path(
    state: NetworkState, body: BodyObservations, path: BodyPath, by_path: Array, prior: PathPrior
) -> tuple[Array, Array]:
    """Whitened derivatives (m, UL) of a path's smoothness and headings, and of its ridge, as it follows scanners.

    Args:
        state: of the network.
        body: that of the path.
        path: at the state.
        by_path: (K, 3, UL) of the control points.
        prior: of the path.
    """
    (_, _, size), scanners, step = by_path.shape, len(body.scans), body.knots.step
    bend = compute_stretch(state, body) * np.diff(by_path[:, :2], 2, axis=0)
    by_stretch = FIRST_SYSTEMATIC + RANGE_SCALE + SCANNER_UNKNOWNS * np.arange(scanners)
    bend[..., by_stretch] += np.diff(path.control[:, :2], 2, axis=0)[..., None] / scanners
    smooth = compute_smoothness_information(step, prior.acceleration_density)[0, 0]
    steady = [
        np.sqrt(smooth) * bend.reshape(-1, size),
        np.diff(by_path[:, 2], axis=0) / np.sqrt(step * prior.turning_density),
        np.sqrt(prior.heading_information)[:, None] * by_path[:, 2],
    ]
    of_positions, of_headings = prior.ridge
    ridge = np.sqrt([of_positions, of_positions, of_headings])[:, None] * by_path
    return np.concatenate(steady), ridge
