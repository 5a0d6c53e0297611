"""Parts of a network whose place rests on one pair of scanners that disagrees, or that may be elsewhere."""

from collections.abc import Mapping, Sequence

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from calgraph.errors import Rejected
from calgraph.geometry import Array, se2
from calgraph.graph.pose_graph import PoseGraph
from calgraph.network.graph.ambiguous_parts import AmbiguousPart
from calgraph.network.pairs.scanner_pair import ScannerPairEstimate
from calgraph.result.finding import Finding


def find_poorly_supported_parts(
    inliers: PoseGraph,
    names: Sequence[str],
    T_root_scanner: Array,
    pairs: Mapping[tuple[str, str], ScannerPairEstimate | Rejected],
    min_matched_share: float,
) -> list[Finding]:
    """Finds parts of a network that one pair alone connects to the root, and in which few positions match.

    No cycle checks such a pair. Where both scanners detect people at most times, but at other places, the pair may
    match the wrong people, or reflections of people in a mirror.

    Args:
        inliers: the pairs that agree with the poses.
        names: of the S scanners, the root first.
        T_root_scanner: (S, 3, 3) their poses.
        pairs: hypotheses by pair of scanners.
        min_matched_share: least share of matched positions among those that both scanners should detect.
    """
    findings = []
    ends = np.unique(np.sort(inliers.edges, axis=1), axis=0)
    for k, (i, j) in enumerate(ends.tolist()):
        found = pairs.get((names[i], names[j])) or pairs.get((names[j], names[i]))
        if found is None or isinstance(found, Rejected):
            continue
        T_a_b = se2.inverse(T_root_scanner[i]) @ T_root_scanner[j]
        nearest = min(
            found.hypotheses, key=lambda one: float(np.linalg.norm(se2.difference(T_a_b, one.T_a_b)[:2]))
        )
        if nearest.matched_share >= min_matched_share:
            continue
        part = _separate(np.delete(ends, k, axis=0), len(names))
        if not part.any():
            continue
        scanners = tuple(names[node] for node in np.flatnonzero(part).tolist())
        findings.append(
            Finding(
                f"only the pair {names[i]} and {names[j]} connects {', '.join(scanners)} to the root, and they "
                f"agree on {100 * nearest.matched_share:.0f} % of the positions that both should measure: they "
                "may have matched different people, or reflections; let people walk where others measure them",
                scanners,
            )
        )
    return findings


def describe_ambiguous_parts(names: Sequence[str], parts: Sequence[AmbiguousPart]) -> list[Finding]:
    """Reasons why scanners are weak that may as well be elsewhere."""
    return [
        Finding(
            f"another pose of {' and '.join(names[k] for k in part.pair)}, {part.distance:.1f} m and "
            f"{np.degrees(part.rotation):.0f}° off, matches the tracks nearly as well, as where people walk "
            "side by side: let people walk alone or apart",
            tuple(names[k] for k in part.nodes),
        )
        for part in parts
    ]


def _separate(ends: Array, count: int) -> Array:
    """(count,) mask of the nodes that these edges (E, 2) do not connect to the root."""
    adjacency = coo_array((np.ones(len(ends)), (ends[:, 0], ends[:, 1])), shape=(count, count))
    part = connected_components(adjacency, directed=False)[1]
    return np.asarray(part != part[0])
