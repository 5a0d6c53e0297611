"""Where a stationary scanner would not have overlooked anybody, and which poses that refutes.

What two scanners saw together speaks for a pose; what one of them should have seen, and did not, speaks against
it. People who walk alike are matched for some seconds under many a wrong pose. Hardly one of these explains why
all others whom one scanner saw went through the other's open view unnoticed.
"""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import convolve

from calgraph.geometry import Array, se2
from calgraph.pairwise.synchronized_tracks import Meetings, Samples, sample
from calgraph.tracking import Tracked

Flags = NDArray[np.bool_]

# Side of a map's cells; how far before what stands still somebody surely stands out; and how near is too near, m.
_CELL = 0.2
_CLEAR = 0.5
_NEAREST = 0.4
# Nobody is overlooked up to the range beyond which only this share of the sights lies.
_RARE = 0.05
# Nor where the scanner saw somebody so often, in a cell or those around it.
_SEEN = 3
# Between two beams farther apart nobody knows, rad.
_NEXT = np.radians(2)


@dataclass(frozen=True, eq=False)
class OpenView:
    """A map of the places at which a scanner does not overlook anybody."""

    open: Flags
    """(N, N) by x and y in cells of the scanner's frame, the scanner in the middle; nothing along the border."""
    watched: Array
    """(W, 2) from when to when the scanner measured, s, ascending."""

    def covers(self, x: Array) -> Flags:
        """(...) whether positions (..., 2), m, are open to the scanner."""
        size = len(self.open)
        cell = np.clip(x * (1 / _CELL) + size / 2, 0, size - 1).astype(np.intp)
        return np.asarray(self.open.ravel()[cell[..., 0] * size + cell[..., 1]])

    @property
    def reach(self) -> float:
        """Nothing farther from the scanner is open to it, m."""
        return float(np.sqrt(0.5) * _CELL * len(self.open))

    def watches(self, times: Array) -> Flags:
        """(M,) whether the scanner measured at some times (M,), s."""
        stretch = np.searchsorted(self.watched[:, 0], times, "right") - 1
        return np.asarray((stretch >= 0) & (times <= np.append(self.watched[:, 1], -np.inf)[stretch]))


@dataclass(frozen=True, eq=False)
class Sights:
    """What one scanner saw moving, and where it would have seen anybody."""

    samples: Samples
    view: OpenView

    @classmethod
    def of(cls, tracked: Tracked) -> "Sights":
        """What a scanner followed, at the ticks that all scanners share."""
        samples = sample(tracked)
        return cls(samples, open_view(tracked, samples))

    def every(self, step: int) -> "Sights":
        """Of every ``step``-th tick alone; the view is as it was."""
        return replace(self, samples=self.samples.every(step))


def open_view(tracked: Tracked, samples: Samples) -> OpenView:
    """The open view of a scanner: before what stands still, up to where it usually sees people; and where it did.

    Args:
        tracked: what the scanner knows.
        samples: of what it saw moving.
    """
    ranges = np.linalg.norm(samples.positions, axis=1)
    reach = float(np.quantile(ranges, 1 - _RARE)) if len(ranges) else 0.0
    half = int(np.ceil(reach / _CELL)) + 1
    middles = (np.arange(-half, half) + 0.5) * _CELL
    x = np.stack(np.meshgrid(middles, middles, indexing="ij"), axis=-1).reshape(-1, 2)
    r = np.linalg.norm(x, axis=1)
    within = (r > _NEAREST) & (r < reach) & looks_past(tracked.background, x, _CLEAR)
    cells = np.clip(samples.positions / _CELL + half, 0, 2 * half - 1).astype(np.intp)
    sights = np.bincount(cells @ [2 * half, 1], minlength=len(x)).reshape(2 * half, 2 * half)
    often = convolve(sights, np.ones((3, 3)), mode="constant") >= _SEEN
    is_open = within.reshape(sights.shape) | often
    is_open[[0, -1]] = is_open[:, [0, -1]] = False
    return OpenView(is_open, _own_times(samples) if tracked.watched is None else tracked.watched)


def _own_times(samples: Samples) -> Array:
    """(W, 2) from the first sample to the last one, s."""
    return samples.times[[0, -1]][None] if len(samples.tick) else np.zeros((0, 2))


def looks_past(background: Array, x: Array, margin: float) -> Flags:
    """(M,) whether a scanner looks past points (M, 2) of its frame to something farther by more than a margin, m.

    Args:
        background: (N, 2) its static points, m; NaN rows are breaks.
        x: the points, m.
        margin: m.
    """
    seen = background[np.isfinite(background).all(axis=1)]
    if len(seen) < 2:
        return np.zeros(len(x), dtype=np.bool_)
    bearing = np.arctan2(seen[:, 1], seen[:, 0])
    order = np.argsort(bearing)
    bearing, ranges = bearing[order], np.linalg.norm(seen, axis=1)[order]
    at, r = np.arctan2(x[:, 1], x[:, 0]), np.linalg.norm(x, axis=1)
    k = np.clip(np.searchsorted(bearing, at), 1, len(bearing) - 1)
    # Between two beams that hit things at different depths nobody knows.
    known = (at - bearing[k - 1] < _NEXT) & (bearing[k] - at < _NEXT)
    return np.asarray(known & (r < np.minimum(ranges[k - 1], ranges[k]) - margin))


def overlooked(
    T_a_b: Array, met: Meetings, view_a: OpenView, view_b: OpenView, near: float
) -> tuple[Flags, Flags]:
    """What each of two scanners should have seen of what the other one saw, and what it did see.

    Args:
        T_a_b: (K, 3, 3).
        met: all simultaneous observations.
        view_a: of scanner a.
        view_b: of scanner b.
        near: how far from a position the other scanner may have seen it, m.

    Returns:
        Of all samples of a, followed by those of b, (K, A + B) each: whether the other scanner should have seen
        it, under this pose, and whether it saw anything there.
    """
    a, b = met.a, met.b
    moved = se2.apply(T_a_b, b.positions)
    sights_a = view_b.covers(se2.apply(se2.inverse(T_a_b), a.positions)) & view_b.watches(a.times)
    sights_b = view_a.covers(moved) & view_a.watches(b.times)
    expected = np.concatenate([sights_a, sights_b], axis=1)
    off = moved[:, met.row_b] - met.x_a
    pose, together = np.nonzero(off[..., 0] ** 2 + off[..., 1] ** 2 < near**2)
    noticed = np.zeros_like(expected)
    noticed[pose, met.row_a[together]] = noticed[pose, len(a.tick) + met.row_b[together]] = True
    return expected, noticed


def refuted(
    T_a_b: Array,
    met: Meetings,
    view_a: OpenView,
    view_b: OpenView,
    *,
    near: float,
    fewest: float,
    missed: float,
) -> Flags:
    """(K,) which poses let too much of what one scanner saw in the other's open view pass unnoticed.

    Args:
        T_a_b: (K, 3, 3).
        met: all simultaneous observations.
        view_a: of scanner a.
        view_b: of scanner b.
        near: how far from a position the other scanner may have seen it, m.
        fewest: positions that should have been seen, at least.
        missed: share of them that may have been missed.
    """
    expected, noticed = overlooked(T_a_b, met, view_a, view_b, near)
    count = np.count_nonzero(expected, axis=1)
    unseen = np.count_nonzero(expected & ~noticed, axis=1)
    return np.asarray((count >= fewest) & (unseen > missed * count))
