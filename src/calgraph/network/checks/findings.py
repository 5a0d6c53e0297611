"""Findings about the poses of a network that its pairs and its recording give."""

from collections.abc import Mapping, Sequence

import numpy as np

from calgraph.errors import Rejected
from calgraph.geometry import se2
from calgraph.graph.spanning_tree import fundamental_cuts
from calgraph.network.graph.cuts import AmbiguousPart
from calgraph.network.graph.network_initialization import NetworkInitialization
from calgraph.network.tracking.track import ScannerBump, ScannerTracks
from calgraph.result.finding import Finding

# Minimum share of matched positions of a pair that alone connects a part of the network: the majority. Right
# pairs of simulated rooms match 0.6 to 0.9; one that matched reflections in mirrors matched 0.37.
_MIN_MATCHED_SHARE = 0.5


def collect_network_findings(
    root: str, tracks: Mapping[str, ScannerTracks | Rejected], initialization: NetworkInitialization, start: float
) -> Sequence[Finding]:
    """Scanners that were bumped, or may be elsewhere, or rest on a pair that disagrees about most positions.

    Args:
        root: name of the root of the result.
        tracks: of each scanner, or why it has none.
        initialization: averaged poses of the connected scanners.
        start: of the recording, s.
    """
    return (
        *describe_bumps(root, tracks, start),
        *_describe_ambiguous_parts(initialization.names, initialization.ambiguous),
        *find_poorly_supported_parts(initialization),
    )


def find_poorly_supported_parts(initialization: NetworkInitialization) -> list[Finding]:
    """Finds parts of a network that one pair alone connects to the first, and in which few positions match.

    No cycle checks such a pair. Where both scanners detect people at most times, but at other places, the pair may
    match the wrong people, or reflections of people in a mirror.
    """
    names, pairs, averaged = initialization.names, initialization.pairs, initialization.solution
    inliers, T_root_scanner = initialization.graph.select_edges(averaged.inliers), averaged.T_root_node
    findings = []
    ends = np.sort(inliers.edges, axis=1)
    cuts = fundamental_cuts(inliers, np.ones(len(ends)))
    for edge, part in sorted(cuts, key=lambda cut: tuple(ends[cut[0]])):
        across = part[ends[:, 0]] != part[ends[:, 1]]
        if len(np.unique(inliers.pair_of_edge[across])) > 1:
            continue
        i, j = ends[edge].tolist()
        found = pairs.get((names[i], names[j])) or pairs.get((names[j], names[i]))
        if found is None or isinstance(found, Rejected):
            continue
        T_a_b = se2.inverse(T_root_scanner[i]) @ T_root_scanner[j]
        nearest = min(
            found.hypotheses, key=lambda one: float(np.linalg.norm(se2.difference(T_a_b, one.T_a_b)[:2]))
        )
        if nearest.matched_share >= _MIN_MATCHED_SHARE:
            continue
        scanners = tuple(names[node] for node in np.flatnonzero(part).tolist())
        findings.append(
            Finding(
                f"only the pair {names[i]} and {names[j]} connects {', '.join(scanners)} to {names[0]}, and they "
                f"agree on {100 * nearest.matched_share:.0f} % of the positions that both should measure: they "
                "may have matched different people, or reflections; let people walk where others measure them",
                scanners,
            )
        )
    return findings


def _describe_ambiguous_parts(names: Sequence[str], parts: Sequence[AmbiguousPart]) -> list[Finding]:
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


# Intervals shorter than this are stated as one time, s.
_MAX_INSTANT = 1.5


def describe_bumps(
    root: str, followed: Mapping[str, ScannerTracks | Rejected], start: float
) -> tuple[Finding, ...]:
    """What moved, when, and from which data each of these scanners is calibrated.

    A pose from before the last bump is weak, as the scanner has moved since; if it is the root's, those of all
    scanners are.

    Args:
        root: name of the root.
        followed: the tracks of each scanner, or why it has none.
        start: of the recording, s.
    """
    return tuple(
        _describe(name, one, start, tuple(followed) if name == root else (name,), is_root=name == root)
        for name, one in followed.items()
        if isinstance(one, ScannerTracks) and one.bumps
    )


def _describe(
    name: str, tracks: ScannerTracks, start: float, depending: tuple[str, ...], *, is_root: bool
) -> Finding:
    """The finding about one scanner; the poses that depend on it are weak unless its last data suffice."""
    moved = f"{name} moved {', and '.join(_describe_step(bump, start) for bump in tracks.bumps)}"
    frame = ", and all poses are in its frame at that time" if is_root else ""
    begin, end = tracks.interval[0] - start, tracks.interval[1] - start
    if np.isinf(end):
        data = f"from its data after {begin:.1f} s"
        return Finding(f"{moved}: the result is its pose after that{frame}, {data}")
    return Finding(
        f"{moved}: its data after that are too short, the result is its pose between {max(begin, 0.0):.1f} and "
        f"{end:.1f} s{frame}: fix it to its place, and record again",
        depending,
    )


def _describe_step(bump: ScannerBump, start: float) -> str:
    begin, end = bump.interval[0] - start, bump.interval[1] - start
    time = (
        f"at {(begin + end) / 2:.1f} s" if end - begin < _MAX_INSTANT else f"between {begin:.1f} and {end:.1f} s"
    )
    if np.isnan(bump.translation):
        return f"{time}, by more than its background determines"
    translation = f"{1000 * bump.translation:.0f} ± {1000 * bump.translation_stddev:.0f} mm"
    rotation = f"{np.degrees(bump.rotation):+.2f} ± {np.degrees(bump.rotation_stddev):.2f}°"
    return f"by {translation} and {rotation} (σ) {time}"
