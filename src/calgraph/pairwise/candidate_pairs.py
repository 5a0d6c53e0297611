"""Pairs of scanners whose tracks are registered, in networks of too many scanners to register all.

First those with the most similar tracks. Then pairs whose common neighbour implies a pose under which they tracked
the same people, until there are no more. Then pairs between parts that are not connected.
"""

from collections.abc import Collection, Mapping, Sequence

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from calgraph.config.settings import CandidateSettings
from calgraph.geometry import Array, se2
from calgraph.pairwise.synchronized_tracks import TrackSamples, pair_samples

Ends = tuple[int, int]
"""Indices of two scanners, ascending."""


def select_similar_pairs(similarity: Array, partners: int, allowed: NDArray[np.bool_] | None = None) -> set[Ends]:
    """Pairs of each scanner with those of the most similar tracks.

    Args:
        similarity: (N, N) from :func:`calgraph.pairwise.track_similarity.compute_track_similarity`.
        partners: number of pairs of each scanner; it may be in more pairs that others select.
        allowed: (N, N) pairs to select from; all if None.
    """
    allowed = np.ones(similarity.shape, dtype=np.bool_) if allowed is None else allowed
    allowed = allowed & ~np.eye(len(similarity), dtype=np.bool_)
    ranked = np.argsort(np.where(allowed, -similarity, np.inf), axis=1, kind="stable")[:, :partners]
    return {(min(a, b), max(a, b)) for a, of_a in enumerate(ranked.tolist()) for b in of_a if allowed[a, b]}


def select_implied_pairs(
    samples: Sequence[TrackSamples],
    poses: Mapping[Ends, Array],
    registered: Collection[Ends],
    tried: Collection[Ends],
    settings: CandidateSettings,
) -> set[Ends]:
    """Pairs that tracked the same people under the pose that their pairs with a third scanner imply.

    Args:
        samples: of each scanner.
        poses: ``T_a_b`` (3, 3) of all pairs with a pose.
        registered: those of them since the last selection: only they imply poses that were not tested before.
        tried: pairs that were registered, with or without a pose.
        settings: how long and how near their samples have to be.
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
                if _have_common_tracks(samples[a], samples[b], neighbours[a][via] @ T_via_b, settings):
                    implied.add(pair)
    return implied


def select_separated_pairs(
    similarity: Array, poses: Collection[Ends], tried: Collection[Ends], settings: CandidateSettings
) -> set[Ends]:
    """Untried pairs of scanners that poses do not connect: of each scanner those with the most similar tracks."""
    count = len(similarity)
    ends = np.array(sorted(poses), dtype=np.intp).reshape(-1, 2)
    adjacency = coo_array((np.ones(len(ends)), ends.T), shape=(count, count))
    _, part = connected_components(adjacency, directed=False)
    between = part[:, None] != part
    return select_similar_pairs(similarity, settings.partners_between_parts, between) - set(tried)


def _have_common_tracks(a: TrackSamples, b: TrackSamples, T_a_b: Array, settings: CandidateSettings) -> bool:
    """Whether simultaneous samples of both are near each other under a pose, for long enough."""
    pairs = pair_samples(a, b)
    x, y = (se2.apply(T_a_b, b.positions)[pairs.row_b] - pairs.x_a).T
    near = a.tick[pairs.row_a[x * x + y * y < settings.common_radius**2]]
    return len(np.unique(near)) >= a.to_ticks(settings.min_common_time)
