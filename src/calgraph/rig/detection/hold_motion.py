"""Whether a board that a scanner detected moved between the messages of a hold."""

from collections.abc import Sequence

import numpy as np
from scipy.special import chdtri

from calgraph.boards.detections import Detection, PlanePatch, Segment
from calgraph.errors import Rejected
from calgraph.geometry import Array, estimate_spread, find_median, measure_lengths, plane

# Distance from the board's surface, m, beyond which a return is of another one: five times the noise of a 2-D
# scanner (20 mm).
_NEAR = 0.1
# Probability by chance of a motion that is found: that of four standard deviations.
_CHANCE = 6e-5
# Root mean square displacement, m, that is accepted: by as much a board that is held by hand moves, and its mean
# over the hold is that of the other sensors.
_MAX_DISPLACEMENT = 0.005
# Least ratio of the numbers of returns on the board in both halves of a hold: lost packets change a tenth.
_MIN_RATIO = 0.5


def drop_moved(found: Sequence[Detection], messages: Sequence[Array]) -> tuple[Detection, ...] | Rejected:
    """The candidates of one scanner and capture that :func:`has_moved` does not refuse."""
    kept = tuple(one for one in found if not (isinstance(one, PlanePatch | Segment) and has_moved(one, messages)))
    return kept or Rejected("board moved between messages: hold it still")


def has_moved(board: PlanePatch | Segment, messages: Sequence[Array]) -> bool:
    """Whether the board was in one place in the first half of the messages and in another in the second.

    A surface is fitted to the returns of each half; their difference is compared with its covariance.

    Args:
        board: as detected in all messages.
        messages: (N_k, 3) the points of each, sensor frame, m.
    """
    middle = len(messages) // 2
    if not middle:
        return False
    if isinstance(board, PlanePatch):
        n, axes = board.plane[:3], plane.tangent_basis(board.plane[:3])
    else:
        along = board.endpoints[1] - board.endpoints[0]
        axes = (along / measure_lengths(along[None])[0])[:, None]
        n = np.array([-axes[1, 0], axes[0, 0], 0.0])
    # Half of the beams on the board are as near to its centre, away from its edges.
    radius = find_median(measure_lengths(board.points - board.center))
    halves = []
    for half in (messages[:middle], messages[-middle:]):
        points = np.concatenate(half)
        near = points.take(np.flatnonzero(np.abs(points @ n - board.center @ n) < _NEAR), axis=0) - board.center
        halves.append(near[measure_lengths(near) < radius])
    fewer, more = sorted(len(points) for points in halves)
    if fewer < _MIN_RATIO * more:
        return True
    if fewer <= axes.shape[1]:
        return False
    designs = [np.column_stack([np.ones(len(points)), points @ axes]) for points in halves]
    fits = [np.linalg.lstsq(A, points @ n)[0] for A, points in zip(designs, halves, strict=True)]
    residuals = [points @ n - A @ fit for A, points, fit in zip(designs, halves, fits, strict=True)]
    variance = estimate_spread(np.concatenate(residuals)) ** 2
    step = fits[1] - fits[0]
    if np.sqrt(np.mean((designs[0] @ step) ** 2)) < _MAX_DISPLACEMENT:
        return False
    covariance = variance * sum(np.linalg.pinv(A.T @ A) for A in designs)
    return bool(step @ np.linalg.pinv(covariance) @ step > chdtri(len(step), _CHANCE))
