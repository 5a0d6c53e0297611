"""Clock offsets and mountings of a network's scanners, from those of their pairs.

Mountings are consistent in cycles: an even number of pairs of every cycle is mirrored. Those of most evidence are
an Ising problem, solved along the spanning tree of clearest pairs and by flips of single scanners. Clock offsets
are resolved over the pairs that agree with the mountings.

One pair alone is weak evidence for a clock that differs: where people walk behind each other, or push carts, one
of its scanners may detect what is ahead and the other one what follows, and both fit perfectly with a delay. Wrong
delays show in cycles: correct offsets of all pairs across a cut agree.
"""

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csc_array, csr_array
from scipy.sparse.linalg import splu

from calgraph.config.settings import ScannerPairSettings
from calgraph.geometry import Array
from calgraph.graph.spanning_tree import TreeStep, list_parts, walk_tree
from calgraph.network.pairs.clock_mounting_search import FIRM_EVIDENCE, MIN_LATERAL_SPREAD, ClockMountingHypothesis
from calgraph.network.pairs.hypothesis_evidence import MIN_WEIGHT_OF_EVIDENCE

# Rounds of reweighting, after which weights of clock offsets change by less than a percent.
_ROUNDS = 20
# Scanners up to which dense equations are solved faster than sparse ones.
_MAX_DENSE = 100


@dataclass(frozen=True, eq=False)
class ClockSolution:
    """Clock offsets that the pairs of a network confirm."""

    offset: Array
    """(N,) from node 0, s; 0 where no pair connects a node to it."""
    stddev: Array
    """(N,) their standard deviations, s."""
    refused: tuple[ClockMountingHypothesis, ...]
    """The hypothesis of most evidence of each pair whose clock offset is not confirmed."""
    on_a_line: tuple[ClockMountingHypothesis, ...]
    """Hypotheses that are used, and that a clock offset rests on alone though people walked on one line."""


def resolve_clocks(node: Mapping[str, int], hypotheses: Sequence[ClockMountingHypothesis]) -> ClockSolution:
    """Averages the clock offsets of pairs, without those that other pairs do not confirm.

    Each edge of the maximum spanning tree by evidence defines a fundamental cut. If its clocks differ, more pairs
    across the cut have to agree with the offset than not; a pair alone has to be firm, with clearly more evidence
    than for any other offset. Hypotheses that are not confirmed are left out, until all are.

    Args:
        node: index of each scanner, of which 0 is the reference.
        hypotheses: of pairs with the selected mountings, with more evidence than chance.
    """
    remaining, refused = list(hypotheses), list[ClockMountingHypothesis]()
    while True:
        used = _best_of_pairs(remaining)
        tree = _ClockTree.grow(node, used)
        offset, stddev = _average_clocks(node, used, tree)
        cuts = range(len(tree.steps))
        found = (_unconfirmed(k, tree, node, hypotheses, offset) for k in cuts)
        unconfirmed = next(filter(None, found), None)
        if unconfirmed is None:
            on_a_line = tuple(tree.hypotheses[k] for k in cuts if _rests_on_a_line(k, tree, node, used))
            return ClockSolution(offset, stddev, _best_of_pairs(refused), on_a_line)
        refused += [h for h in remaining if h in unconfirmed]
        remaining = [h for h in remaining if h not in unconfirmed]


def average_clocks(names: Sequence[str], hypotheses: Sequence[ClockMountingHypothesis]) -> Array:
    """(N, 2) clock offsets of connected scanners from the first one, and their standard deviations, s.

    NaN for the first one, whose clock is the reference, and for those that no clock offset connects to it.

    Args:
        names: of the scanners.
        hypotheses: of pairs that agree with the poses.
    """
    node = {name: k for k, name in enumerate(names)}
    used = _best_of_pairs([h for h in hypotheses if np.isfinite(h.clock_stddev)])
    tree = _ClockTree.grow(node, used)
    offset, stddev = _average_clocks(node, used, tree)
    clocks = np.column_stack([offset, np.sqrt(_variance_factor(node, used, offset, len(tree.steps))) * stddev])
    clocks[clocks[:, 1] == 0] = np.nan
    return clocks


# Standard deviation of errors of a pair's clock offset that its covariance does not contain, s: in those pairs, a
# tenth of the offsets were off by more than 3 ms.
_CLOCK_NOISE = 0.005


def _variance_factor(
    node: Mapping[str, int], used: Sequence[ClockMountingHypothesis], offset: Array, unknowns: int
) -> float:
    """Mean squared residual over its expectation, of offsets that cycles test; at least 1."""
    if len(used) <= unknowns:
        return 1.0
    residuals = [_residual(h, node, offset) / np.hypot(h.clock_stddev, _CLOCK_NOISE) for h in used]
    return max(float(np.sum(np.square(residuals))) / (len(used) - unknowns), 1.0)


def _best_of_pairs(hypotheses: Sequence[ClockMountingHypothesis]) -> tuple[ClockMountingHypothesis, ...]:
    """The hypothesis of most evidence of each pair, by descending evidence."""
    best: dict[tuple[str, str], ClockMountingHypothesis] = {}
    for h in sorted(hypotheses, key=lambda h: -h.evidence):
        best.setdefault((h.sensor_a, h.sensor_b), h)
    return tuple(best.values())


@dataclass(frozen=True, eq=False)
class _ClockTree:
    """The maximum spanning tree of descending hypotheses, with its fundamental cuts."""

    steps: Sequence[TreeStep]
    hypotheses: Sequence[ClockMountingHypothesis]
    """That of each step."""
    parts: NDArray[np.bool_]
    """(T, N) the nodes that each connects to node 0."""

    @classmethod
    def grow(cls, node: Mapping[str, int], used: Sequence[ClockMountingHypothesis]) -> "_ClockTree":
        steps = walk_tree(len(node), [(node[h.sensor_a], node[h.sensor_b]) for h in used], [0])
        return cls(steps, [used[step.edge] for step in steps], list_parts(len(node), steps))

    def crosses(self, k: int, node: Mapping[str, int], h: ClockMountingHypothesis) -> bool:
        """Whether a hypothesis is across the k-th cut."""
        return bool(self.parts[k, node[h.sensor_a]] != self.parts[k, node[h.sensor_b]])


# Offset from which tracks are corrected before poses are estimated, s: smaller ones are within the prior of clock
# offsets, and both estimators find them.
MIN_CLOCK_OFFSET = 0.1
# Difference up to which the clock offsets of two pairs agree, s: people walk 15 cm in it.
SAME_CLOCK = 0.1
# Ratio of the evidence of the other mounting to that of the best one from which a mounting is ambiguous: in those
# pairs it was below 0.5; it is 1 where all people walk on one line.
MAX_EVIDENCE_RATIO = 0.7


def _unconfirmed(
    k: int, tree: _ClockTree, node: Mapping[str, int], hypotheses: Sequence[ClockMountingHypothesis], offset: Array
) -> list[ClockMountingHypothesis]:
    """The hypotheses across the k-th cut that agree with its clock offset, if that is not confirmed."""
    edge = tree.hypotheses[k]
    if abs(edge.clock_offset) <= MIN_CLOCK_OFFSET:
        return []
    across = [h for h in hypotheses if tree.crosses(k, node, h)]
    agreeing = [h for h in across if abs(_residual(h, node, offset)) <= SAME_CLOCK]
    supporting = {(h.sensor_a, h.sensor_b) for h in agreeing}
    contradicting = {(h.sensor_a, h.sensor_b) for h in across} - supporting
    if len(supporting) > max(len(contradicting), 1):
        return []
    others = max((h.evidence for h in across if h not in agreeing), default=0.0)
    alone_but_firm = not contradicting and edge.evidence >= FIRM_EVIDENCE
    return [] if alone_but_firm and others <= MAX_EVIDENCE_RATIO * edge.evidence else agreeing


def _rests_on_a_line(
    k: int, tree: _ClockTree, node: Mapping[str, int], used: Sequence[ClockMountingHypothesis]
) -> bool:
    """Whether clocks across a cut differ by what no other pair confirms, where people may follow each other."""
    edge = tree.hypotheses[k]
    differs = abs(edge.clock_offset) > MIN_CLOCK_OFFSET
    if not differs or edge.lateral_spread >= MIN_LATERAL_SPREAD:
        return False
    return sum(tree.crosses(k, node, h) for h in used) == 1


def _residual(h: ClockMountingHypothesis, node: Mapping[str, int], offset: Array) -> float:
    return h.clock_offset - float(offset[node[h.sensor_b]] - offset[node[h.sensor_a]])


def _average_clocks(
    node: Mapping[str, int], used: Sequence[ClockMountingHypothesis], tree: _ClockTree
) -> tuple[Array, Array]:
    """(N,) offsets from node 0 and their standard deviations, s.

    Least squares with Cauchy weights, which start at the offsets along the tree.
    """
    count = len(node)
    offsets = np.zeros(count)
    for step, h in zip(tree.steps, tree.hypotheses, strict=True):
        forward = step.parent == node[h.sensor_a]
        offsets[step.child] = offsets[step.parent] + (h.clock_offset if forward else -h.clock_offset)
    free = sorted(step.child for step in tree.steps)
    stddev = np.zeros(count)
    if not free:
        return offsets, stddev
    ends: NDArray[np.intp] = np.array([(node[h.sensor_a], node[h.sensor_b]) for h in used], dtype=np.intp)
    measured = np.array([h.clock_offset for h in used])
    sigma = np.hypot([h.clock_stddev for h in used], _CLOCK_NOISE)
    signs, rows = np.tile([-1.0, 1.0], len(used)), np.repeat(np.arange(len(used)), 2)
    J_sparse = csr_array((signs, (rows, ends.ravel())), shape=(len(used), count))
    J = (J_sparse.toarray() if count <= _MAX_DENSE else J_sparse)[:, free]
    for _ in range(_ROUNDS):
        r = (measured - J_sparse @ offsets) / sigma
        w = 1 / (1 + r**2) / sigma**2
        H = J.T @ (J * w[:, None])
        offsets[free] = _solve(H, J.T @ (w * measured))
    stddev[free] = np.sqrt(np.diag(_solve(H, np.eye(len(free)))))
    return offsets, stddev


def _solve(H: Array | csr_array, right: Array) -> Array:
    """Solution of ``H x = right`` of a matrix that is dense or sparse."""
    if isinstance(H, np.ndarray):
        return np.asarray(np.linalg.solve(H, right))
    return np.asarray(splu(csc_array(H)).solve(right))


@dataclass(frozen=True)
class ClockMountingSolution:
    """Clocks and mountings of scanners, and what the tracks do not determine of them."""

    clock_offset: Mapping[str, float]
    """Clock of each scanner minus the root's, s; 0 where the pairs do not show that it differs."""
    inverted: frozenset[str]
    """Scanners whose tracks are mirrored relative to those of the root."""
    ambiguous: tuple[str, ...]
    """Scanners that fit nearly as well in the other mounting."""
    contradicted: tuple[str, ...]
    """Scanners whose stated mounting has clearly less evidence than the other one."""
    distant_clocks: Mapping[str, float]
    """Clock offsets beyond the range of the search, s."""
    refused: tuple[ClockMountingHypothesis, ...]
    """Of each pair the hypothesis of most evidence, where others do not confirm its clock offset."""
    on_a_line: tuple[ClockMountingHypothesis, ...]
    """Hypotheses that a clock offset rests on alone though people walked on one line."""


# Offset from which tracks are corrected, in its standard deviations: couples that are matched crosswise fit best
# with offsets of 0.1 to 0.3 s, which have standard deviations of 0.05 to 0.1 s.
_MIN_CLOCK_RATIO = 4.0


def resolve_clocks_and_mountings(
    root: str,
    names: Sequence[str],
    hypotheses: Sequence[ClockMountingHypothesis],
    stated: Collection[str],
    settings: ScannerPairSettings,
) -> ClockMountingSolution:
    """Selects the mountings of most evidence, and averages the clock offsets of pairs.

    Args:
        root: its clock and mounting are the reference.
        names: of all scanners.
        hypotheses: of pairs, any number for each mounting.
        stated: scanners whose mounting is stated, and whose tracks are mirrored already if it differs from the
            root's.
        settings: of the search.
    """
    node = {name: k for k, name in enumerate([root, *(name for name in names if name != root)])}
    fixed = {node[name] for name in (root, *stated)}
    # Evidence (2, N, N) of the same mounting and of mirrored ones, as far as it exceeds that of chance.
    evidence = np.zeros((2, len(node), len(node)))
    for h in hypotheses:
        i, j = node[h.sensor_a], node[h.sensor_b]
        for mirrored, weight in ((h.mirrored, h.evidence), (not h.mirrored, h.reflected_evidence)):
            excess = max(weight - MIN_WEIGHT_OF_EVIDENCE, 0.0)
            evidence[int(mirrored), [i, j], [j, i]] = max(evidence[int(mirrored), i, j], excess)
    signs, ambiguous = _select_mountings(evidence, fixed)
    freely, unsure = _select_mountings(evidence, {node[root]})
    contradicted = (freely < 0) & ~unsure
    used = [h for h in hypotheses if h.mirrored == (signs[node[h.sensor_a]] != signs[node[h.sensor_b]])]
    used = [h for h in used if h.evidence > MIN_WEIGHT_OF_EVIDENCE]
    limits = settings.clock_mounting
    clocks = resolve_clocks(node, used)
    size = np.abs(clocks.offset)
    differs = (size > MIN_CLOCK_OFFSET) & (size > _MIN_CLOCK_RATIO * clocks.stddev)
    clock_offset = {name: float(clocks.offset[k]) if differs[k] else 0.0 for name, k in node.items()}
    return ClockMountingSolution(
        clock_offset,
        frozenset(name for name, k in node.items() if signs[k] < 0),
        tuple(name for name, k in node.items() if ambiguous[k]),
        tuple(name for name in stated if contradicted[node[name]]),
        {name: offset for name, offset in clock_offset.items() if abs(offset) > limits.max_clock_offset},
        clocks.refused,
        clocks.on_a_line,
    )


def _select_mountings(evidence: Array, fixed: Collection[int]) -> tuple[NDArray[np.intp], NDArray[np.bool_]]:
    """Signs (N,) of the mountings, and which are ambiguous: all those beyond a tree edge fit as well flipped.

    Of ambiguous parts, most scanners are mounted as the root.
    """
    gain = evidence[0] - evidence[1]
    count = len(gain)
    # The clearest pairs first; those without a difference connect what no other pair does with the root.
    i, j = np.nonzero(np.triu(gain))
    clearest = np.argsort(-np.abs(gain[i, j]), kind="stable")
    ranked = np.concatenate(
        [np.stack([i, j], axis=1)[clearest], np.stack([np.zeros(count - 1), np.arange(1, count)], axis=1)]
    )
    tree = walk_tree(count, ranked.astype(np.intp).tolist(), fixed)
    signs = np.ones(count, dtype=np.intp)
    for _, parent, child in tree:
        signs[child] = signs[parent] if gain[parent, child] >= 0 else -signs[parent]
    improved = True
    while improved:
        improved = False
        for _, _, k in tree:
            if signs[k] * float(gain[k] @ signs) < 0:
                signs[k] *= -1
                improved = True
    ambiguous = np.zeros(count, dtype=np.bool_)
    ends = np.argwhere(np.any(evidence > 0, axis=0))
    for part in list_parts(count, tree):
        chosen, other = _evidence_across(evidence, ends, signs, part)
        if chosen > 0 and other > MAX_EVIDENCE_RATIO * chosen:
            ambiguous |= part
            if signs[part].sum() < 0:
                signs[part] *= -1
    return signs, ambiguous


def _evidence_across(
    evidence: Array, ends: NDArray[np.intp], signs: NDArray[np.intp], part: NDArray[np.bool_]
) -> tuple[float, float]:
    """Evidence of the pairs between a part (N,) and the rest with its mountings, and with the part's flipped."""
    i, j = ends[part[ends[:, 0]] & ~part[ends[:, 1]]].T
    mirrored = (signs[i] != signs[j]).astype(np.intp)
    return float(evidence[mirrored, i, j].sum()), float(evidence[1 - mirrored, i, j].sum())
