"""Clock offsets and mountings of a network's scanners, from those of their pairs.

Mountings are consistent in cycles: an even number of pairs of every cycle is mirrored. Those of most evidence are
an Ising problem, solved along the spanning tree of clearest pairs and by flips of single scanners. Clock offsets
are resolved over the pairs that agree with the mountings.
"""

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from calgraph.config.settings import ScannerPairSettings
from calgraph.geometry import Array
from calgraph.graph.spanning_tree import list_parts, walk_tree
from calgraph.network.graph.clock_consensus import MAX_EVIDENCE_RATIO, MIN_CLOCK_OFFSET, resolve_clocks
from calgraph.network.pairs.clock_mounting_search import ClockMountingHypothesis
from calgraph.network.pairs.hypothesis_evidence import MIN_WEIGHT_OF_EVIDENCE


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
