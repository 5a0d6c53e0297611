"""Where a sheet ends in a scan: between the last beam on it and the first one that goes past it.

An end tells where the sheet is only if what comes next lies behind it. Where something nearer begins (a hand, an
occluder), or the field of view ends, the sheet goes on unseen.
"""

import numpy as np
from numpy.typing import NDArray

from calgraph.geometry import Array, Index

BLUR = 0.002
"""Sheets are not cut, and beams not bundled, more sharply than this, m (standard deviation)."""
# What is farther behind the sheet than this, m, is certainly not part of it.
_BEHIND = 0.10
# A beam that hits the edge averages both depths: this much before the next beam, m, it is taken for one.
_MIXED = 0.3
_FAR = 1e3
# Beams of one scan line that are farther apart than so many steps have something unknown between them.
_STEPS = 4.0


def beams_about(near: NDArray[np.bool_]) -> Index:
    """Numbers of those of N beams, in order, that pass near the sheet, and of the two beside them on each side."""
    return np.flatnonzero(np.convolve(near, np.ones(5), mode="same") > 0.5)


def sheet_edges(directions: Array, excess: Array, line: Index, thickness: float, parallax: float = 0.0) -> Array:
    """Pairs of beams between which the sheet ends.

    Args:
        directions: (N, 3) unit vectors of beams that measured something, line by line, each in order of angle.
        excess: (N,) by how much each went past the sheet's plane, m; negative where it was stopped before it, and
            where it never meets it.
        line: (N,) scan line of each beam.
        thickness: up to this far from it, a beam ends on the sheet, m.
        parallax: by how much directions of beams that miss the sheet may be off, as seen from the sensor's origin,
            rad: then it tells neither how many steps there are to the next beam, nor what is missing.

    Returns:
        (M, 2, 3) unit vectors: the last beam on the sheet, and where the first one past it points.

    """
    excess = np.maximum(excess, -_FAR)
    on = np.abs(excess) < thickness
    together = on[1:] & on[:-1] & (line[1:] == line[:-1])
    steps = np.linalg.norm(np.diff(directions, axis=0), axis=1)[together]
    if not len(steps):
        return np.empty((0, 2, 3))
    step = float(np.median(steps))
    ways = (np.arange(len(line)), np.arange(len(line))[::-1])
    found = [_leaving(directions[w], excess[w], on[w], line[w], step, parallax) for w in ways]
    return np.concatenate(found)


def _leaving(
    directions: Array, excess: Array, on: NDArray[np.bool_], line: Index, step: float, parallax: float
) -> Array:
    """Edges at which beams, in this order, leave the sheet."""
    # Behind the last beam, a line of its own that nothing is on.
    directions, excess = np.pad(directions, ((0, 1), (0, 0)), mode="edge"), np.append(excess, 0.0)
    on, line = np.append(on, False), np.append(line, line.max() + 1)
    if len(line) < 4:
        return np.empty((0, 2, 3))
    before, last, first, second = (slice(i, len(line) - 3 + i) for i in range(4))
    gap = np.linalg.norm(directions[first] - directions[last], axis=1)
    tread = directions[last] - directions[before]
    length = np.linalg.norm(tread, axis=1)
    same = (line[before] == line[last]) & (line[last] == line[first])
    ends = same & on[before] & on[last] & ~on[first] & (length < _STEPS * step) & (length > 0)
    # Beams that are missing between others went where nothing is.
    near = gap < _STEPS * step + parallax
    silent = ~near & (parallax == 0)
    # Between two depths, a beam has hit the edge: the outline is on either side of it.
    follows = near & (line[second] == line[first]) & (excess[second] > _BEHIND)
    mixed = follows & (excess[first] > 0) & (excess[second] - excess[first] > _MIXED)
    leaves = ends & (silent | (near & (excess[first] > _BEHIND)) | mixed)
    count = np.where(near, np.maximum(np.rint(gap / step), 1.0), 1.0) if parallax == 0 else np.ones(len(gap))
    reach = step * (count + mixed)
    past = directions[last] + tread * np.divide(reach, length, out=np.zeros_like(reach), where=length > 0)[:, None]
    pair = np.stack([directions[last], past / np.linalg.norm(past, axis=1)[:, None]], axis=1)
    return np.asarray(pair[leaves])
