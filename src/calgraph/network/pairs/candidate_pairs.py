"""Pairs of scanners whose tracks are registered, in networks of too many scanners to register all.

First those with the most similar tracks. Then pairs whose common neighbour implies a pose under which they tracked
the same people, until there are no more. Then pairs between parts that are not connected.
"""

from collections.abc import Collection, Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from calgraph.geometry import Array, Index, se2
from calgraph.network.pairs.synchronized_tracks import TrackSamples, pair_samples, to_ticks
from calgraph.solver.connected_parts import label_parts

Ends = tuple[int, int]
"""Indices of two scanners, ascending."""


def select_similar_pairs(similarity: Array, partners: int) -> set[Ends]:
    """Pairs of each scanner with those of the most similar tracks.

    Args:
        similarity: (N, N) from :func:`calgraph.network.pairs.track_similarity.compute_track_similarity`.
        partners: number of pairs of each scanner; it may be in more pairs that others select.
    """
    others = ~np.eye(len(similarity), dtype=np.bool_)
    ranked = _rank_partners(similarity, partners, others)
    return {(min(a, b), max(a, b)) for a, of_a in enumerate(ranked) for b in of_a}


def select_implied_pairs(
    samples: Sequence[TrackSamples],
    poses: Mapping[Ends, Array],
    registered: Collection[Ends],
    tried: Collection[Ends],
) -> set[Ends]:
    """Pairs that tracked the same people under the pose that their pairs with a third scanner imply.

    Args:
        samples: of each scanner.
        poses: ``T_a_b`` (3, 3) of all pairs with a pose.
        registered: those of them since the last selection: only they imply poses that were not tested before.
        tried: pairs that were registered, with or without a pose.
    """
    neighbours: dict[int, dict[int, Array]] = {}
    for (a, b), T_a_b in poses.items():
        neighbours.setdefault(a, {})[b] = T_a_b
        neighbours.setdefault(b, {})[a] = se2.inverse(T_a_b)
    implied: set[Ends] = set()
    for ends in registered:
        for a, via in (ends, ends[::-1]):
            for b, T_via_b in neighbours[via].items():
                pair = min(a, b), max(a, b)
                if a == b or pair in tried or pair in implied:
                    continue
                if _have_common_tracks(samples[a], samples[b], neighbours[a][via] @ T_via_b):
                    implied.add(pair)
    return implied


# Pairs of each scanner with other parts where parts remain unconnected: most have fewer in view.
_PARTNERS_BETWEEN_PARTS = 30
# Maximum of these, doubled while parts remain: it has right pairs for 10 of 14 such scanners of 1000.
_MAX_PARTNERS_BETWEEN_PARTS = 150
# Pairs that all scanners of a part select then: more than all between two halves of 30 scanners.
_PAIRS_OF_PART = 300


def select_separated_pairs(similarity: Array, sure: Collection[Ends], tried: Collection[Ends]) -> set[Ends]:
    """Untried pairs of scanners that sure pairs (not by chance) do not connect, of the most similar tracks.

    The number of partners of each scanner is doubled up to its maximum until there are untried ones.
    """
    part = label_parts(len(similarity), np.array(sorted(sure), dtype=np.intp).reshape(-1, 2))
    partners, most = _PARTNERS_BETWEEN_PARTS, _MAX_PARTNERS_BETWEEN_PARTS
    while True:
        untried = select_pairs_between_parts(similarity, part, partners, _PAIRS_OF_PART) - set(tried)
        if untried or partners >= most:
            return untried
        partners = min(2 * partners, most)


def select_pairs_between_parts(similarity: Array, part: Index, partners: int, pairs_of_part: int) -> set[Ends]:
    """Pairs of scanners of different parts, of the most similar tracks: at least one alignment agrees.

    Args:
        similarity: (N, N) symmetric.
        part: (N,) of each scanner.
        partners: most pairs that a scanner selects, and that a part selects for each scanner outside of it: a
            large part has few pairs with the few scanners that are apart from it.
        pairs_of_part: most pairs that all scanners of a part select.
    """
    between = (part[:, None] != part) & (similarity > 0)
    of_parts: dict[int, set[Ends]] = {}
    for a, partners_of_a in enumerate(_rank_partners(similarity, partners, between)):
        of_parts.setdefault(int(part[a]), set()).update((min(a, b), max(a, b)) for b in partners_of_a)
    outside = len(part) - np.bincount(part)
    selected: set[Ends] = set()
    for one, pairs in of_parts.items():
        limit = min(pairs_of_part, partners * int(outside[one]))
        selected.update(sorted(pairs, key=lambda ends: (-similarity[ends], ends))[:limit])
    return selected


def _rank_partners(similarity: Array, partners: int, allowed: NDArray[np.bool_]) -> list[list[int]]:
    """Of each scanner those allowed with the most similar tracks, the most similar first."""
    ranked = np.argsort(np.where(allowed, -similarity, np.inf), axis=1, kind="stable")[:, :partners]
    return [[b for b in of_a if allowed[a, b]] for a, of_a in enumerate(ranked.tolist())]


# Distance up to which both may have tracked one person under an implied pose, m: at 10 m, two angles that are off
# by 3 degrees displace it by 0.7 m.
_COMMON_RADIUS = 1.0
# Duration of such samples from which a pair is registered, s: half of the least duration of matches.
_MIN_COMMON_TIME = 1.0


def _have_common_tracks(a: TrackSamples, b: TrackSamples, T_a_b: Array) -> bool:
    """Whether simultaneous samples of both are near each other under a pose, for long enough."""
    pairs = pair_samples(a, b)
    x, y = (se2.apply(T_a_b, b.positions)[pairs.row_b] - pairs.x_a).T
    near = a.tick[pairs.row_a[x * x + y * y < _COMMON_RADIUS**2]]
    return len(np.unique(near)) >= to_ticks(_MIN_COMMON_TIME)
