"""Similarity of the tracks of all pairs of scanners: which of them are likely to have tracked the same people.

The moments of all pairs of trajectories within a stretch of time are matrix products, so that the similarity of a
pair costs microseconds, and the registration of its tracks milliseconds. It ranks pairs, and rejects none.
Sums over alignments take far more time than the moments: of each trajectory within a stretch, those with the best
fits count.
"""

import itertools
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from calgraph.geometry import Array, Index, join_rows, select_rows
from calgraph.network.pairs.synchronized_tracks import TrackSamples, to_ticks

# Pairs of trajectories, of all stretches, that are compared together: their moments take about 100 MB.
_MAX_COMPARED = 500_000


@dataclass(frozen=True, eq=False)
class _Stretch:
    """Trajectories of scanners during one stretch of time: R, ascending by scanner."""

    scanner: Index
    """(R,)."""
    positions: NDArray[np.complex128]
    """(R, ticks) x + iy in the frame of the scanner, m; 0 where it has none."""
    detected: Array
    """(R, ticks) 1 where the scanner tracked the trajectory, 0 elsewhere."""


@dataclass(frozen=True, eq=False)
class _Alignments:
    """Least-squares alignments of a trajectory of a with one of b: M."""

    pair: Index
    """(M,) index of a times the number of scanners plus index of b."""
    angle: Array
    """(M,) of b in a, rad."""
    center_a: NDArray[np.complex128]
    """(M,) mean position in a, m."""
    center_b: NDArray[np.complex128]
    """(M,) mean position in b, m."""
    weight: Array
    """(M,) number of common ticks times the logarithm of the largest RMS distance over that of the alignment."""
    score: Array
    """(M,) extent over RMS distance, as of proposals."""


def compute_track_similarity(
    samples: Sequence[TrackSamples],
    *,
    compared: NDArray[np.bool_] | None = None,
    delays: Sequence[int] = (0,),
    mirrored: Sequence[bool] = (False,),
) -> Array:
    """Scores pairs of scanners by the stretches of trajectories that one pose aligns.

    Every stretch of a trajectory of a is aligned with every simultaneous one of b (Kabsch, in complex numbers). Of
    the alignments of a stretch, the best are kept, so that their number is linear in that of scanners. Those of a
    pair with the best fits are compared with all others of the pair: those with the same pose add to the score of
    the pair, by their number of ticks and fit. As only motions within a stretch are compared, clock offsets of
    some tenths of a second change little.

    Args:
        samples: of each scanner.
        compared: (N, N) which a and b to compare; all pairs, once, if None.
        delays: of b, in ticks, and
        mirrored: whether b is mirrored, of which combinations the highest score counts.

    Returns:
        (N, N) symmetric, >= 0; the diagonal is 0.
    """
    count = len(samples)
    compared = np.triu(np.ones((count, count), dtype=np.bool_), 1) if compared is None else compared
    similarity = np.zeros((count, count))
    origin = min((int(one.tick[0]) for one in samples if len(one.tick)), default=0) + min(delays)
    of_a = _cut_stretches(samples, np.asarray(compared.any(axis=1)), origin)
    for is_mirrored, delay in itertools.product(mirrored, delays):
        moved = [one.transform(is_mirrored, delay) for one in samples]
        of_b = _cut_stretches(moved, np.asarray(compared.any(axis=0)), origin)
        common = [(of_a[block], of_b[block]) for block in sorted(of_a.keys() & of_b.keys())]
        for first, end in _split_scanners(common, count):
            found = join_rows(_align_trajectories(a, b, first, end, compared) for a, b in common)
            pairs, votes = _count_votes(found)
            a, b = pairs // count, pairs % count
            similarity[a, b] = np.maximum(similarity[a, b], votes)
    return np.maximum(similarity, similarity.T)


# Length of the stretches of trajectories that are compared, s: the shorter one of proposals.
_STRETCH_DURATION = 3.0
# Shortest part of a stretch that both tracked, s.
MIN_DURATION = 0.6


def _cut_stretches(samples: Sequence[TrackSamples], wanted: NDArray[np.bool_], origin: int) -> dict[int, _Stretch]:
    """Successive stretches of equal duration by number, of wanted scanners (N,); no trajectory is too short."""
    occupied = [k for k in np.flatnonzero(wanted).tolist() if len(samples[k].tick)]
    if not occupied:
        return {}
    scanner = np.concatenate([np.full(len(samples[k].tick), k) for k in occupied])
    tick = np.concatenate([samples[k].tick for k in occupied])
    trajectory = np.concatenate([samples[k].trajectory for k in occupied])
    x, y = np.concatenate([samples[k].positions for k in occupied]).T
    length, least = to_ticks(_STRETCH_DURATION), to_ticks(MIN_DURATION)
    block, column = np.divmod(tick - origin, length)
    # A trajectory within a block is one row.
    order = np.lexsort((trajectory, scanner, block))
    keys = np.column_stack([block, scanner, trajectory])[order]
    begins = np.any(np.diff(keys, axis=0, prepend=-1) != 0, axis=1)
    row = np.cumsum(begins) - 1
    positions = np.zeros((row[-1] + 1, length), dtype=np.complex128)
    detected = np.zeros(positions.shape)
    positions[row, column[order]], detected[row, column[order]] = (x + 1j * y)[order], 1.0
    block, scanner = keys[begins, 0], keys[begins, 1]
    kept = detected.sum(axis=1) >= least
    block, scanner, positions, detected = block[kept], scanner[kept], positions[kept], detected[kept]
    starts = np.flatnonzero(np.diff(block, prepend=-1))
    return {
        int(block[begin]): _Stretch(scanner[begin:end], positions[begin:end], detected[begin:end])
        for begin, end in zip(starts, np.append(starts[1:], len(block)), strict=True)
    }


def _split_scanners(stretches: Sequence[tuple[_Stretch, _Stretch]], count: int) -> list[tuple[int, int]]:
    """Splits scanners a into ranges that are few enough for their comparisons to fit into memory."""
    if not stretches:
        return []
    compared = np.zeros(count)
    for a, b in stretches:
        compared += np.bincount(a.scanner, minlength=count) * float(len(b.scanner))
    group = np.floor(np.cumsum(compared) / _MAX_COMPARED).astype(np.intp)
    starts = np.flatnonzero(np.diff(group, prepend=-1))
    return list(zip(starts.tolist(), [*starts[1:].tolist(), count], strict=True))


# Maximum RMS distance of an aligned stretch, m: twice the registration's MAX_MODEL_ERROR.
MAX_RMS = 0.3
# RMS distance of tracks of one person, m, below which a better fit does not rank higher.
NOISE = 0.05
# Minimum standard deviation of the positions in a stretch, m: a shorter one does not determine the angle.
MIN_EXTENT = 0.15
# Best alignments of a stretch with others, which are kept: bounds the time of many scanners. With 4 in a grid of
# 100, 97 % of the right pairs are selected that are selected with all.
_KEPT_ALIGNMENTS = 64


def _align_trajectories(
    of_a: _Stretch, of_b: _Stretch, first: int, end: int, compared: NDArray[np.bool_]
) -> _Alignments:
    """Aligns trajectories of scanners a from ``first`` to ``end`` with those of all b; keeps the best of each."""
    rows = slice(*np.searchsorted(of_a.scanner, [first, end]))
    scanner_a, z_a, in_a = of_a.scanner[rows], of_a.positions[rows], of_a.detected[rows]
    scanner_b, z_b, in_b = of_b.scanner, of_b.positions, of_b.detected
    ticks = in_a @ in_b.T
    least = max(to_ticks(MIN_DURATION), 1)
    a, b = np.nonzero((ticks >= least) & compared[np.ix_(scanner_a, scanner_b)])
    n = ticks[a, b]
    center_a, center_b = (z_a @ in_b.T)[a, b] / n, (in_a @ z_b.T)[a, b] / n
    spread_a = ((np.abs(z_a) ** 2) @ in_b.T)[a, b] / n - np.abs(center_a) ** 2
    spread_b = (in_a @ (np.abs(z_b) ** 2).T)[a, b] / n - np.abs(center_b) ** 2
    product = (z_a @ z_b.conj().T)[a, b] / n - center_a * center_b.conj()
    rms = np.sqrt(np.maximum(spread_a + spread_b - 2 * np.abs(product), 0))
    extent = np.sqrt(np.maximum(np.minimum(spread_a, spread_b), 0))
    weight = n * np.log(np.hypot(MAX_RMS, NOISE) / np.hypot(rms, NOISE))
    usable = (rms < MAX_RMS) & (extent > MIN_EXTENT)
    weights = np.zeros(ticks.shape)
    weights[a[usable], b[usable]] = weight[usable]
    kept = usable & (weight >= _find_least_kept(weights)[a])
    pair = scanner_a[a] * len(compared) + scanner_b[b]
    score = extent / (rms + NOISE)
    columns = pair, np.angle(product), center_a, center_b, weight, score
    return select_rows(_Alignments(*columns), kept)


def _find_least_kept(weights: Array) -> Array:
    """(R,) the least of the largest of each row of weights (R, C) that are kept."""
    if weights.shape[1] <= _KEPT_ALIGNMENTS:
        return np.zeros(len(weights))
    return np.asarray(np.partition(weights, -_KEPT_ALIGNMENTS, axis=1)[:, -_KEPT_ALIGNMENTS])


# Best alignments of a pair, with which all others are compared: with 16, ranks are the same.
_COMPARED_POSES = 8
# Distance up to which two alignments agree, m: that of two hypotheses that are one.
_SAME_POSITION = 0.5
# Angle up to which two alignments agree, rad (20 degrees): the error of that of a stretch of 1 m.
_SAME_ANGLE = float(np.radians(20))


def _count_votes(found: _Alignments) -> tuple[Index, Array]:
    """Pairs (P,) and the largest weight (P,) of alignments that agree with one of the best of their pair."""
    order = np.lexsort((-found.score, found.pair))
    pair, angle, center_a, center_b, weight, _ = (column[order] for column in vars(found).values())
    pairs, start, size = np.unique(pair, return_index=True, return_counts=True)
    group = np.repeat(np.arange(len(pairs)), size)
    votes = np.zeros(len(pairs))
    for k in range(_COMPARED_POSES):
        best = (start + np.minimum(k, size - 1))[group]
        turn = np.exp(1j * angle[best])
        off = np.abs(turn * (center_b - center_b[best]) + center_a[best] - center_a)
        agrees = (off < _SAME_POSITION) & (np.abs(np.angle(np.exp(1j * angle) / turn)) < _SAME_ANGLE)
        votes = np.maximum(votes, np.bincount(group, weight * agrees, len(pairs)))
    return np.asarray(pairs, dtype=np.intp), votes
