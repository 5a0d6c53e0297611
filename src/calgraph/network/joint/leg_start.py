"""Start values of the paths of legs, and the headings that their walk predicts."""

import numpy as np
from scipy.linalg import solveh_banded

from calgraph.config.settings import LegBodySettings, LegSettings
from calgraph.geometry import Array
from calgraph.network.joint.leg_association import LegCandidate
from calgraph.network.joint.leg_problem import LegPath, compute_shape_prior
from calgraph.network.joint.leg_tracks import LegTrack
from calgraph.network.joint.path_equations import compute_smoothness_information
from calgraph.network.joint.splines import Knots

# Information, 1/m², that keeps control points without positions invertible; the smoothness determines them.
_RIDGE = 1e-6


def initialize_leg(track: LegTrack, settings: LegSettings) -> LegCandidate:
    """The smoothing spline through the positions of a track, with the shape of the prior."""
    start, end, interval = float(track.times[0]), float(track.times[-1]), settings.body.knot_interval
    knots = Knots.spanning(start - interval, end + interval, interval)
    first, weights, _ = knots.basis_at(track.times)
    band, right = np.zeros((4, knots.count)), np.zeros((knots.count, 2))
    information = track.sigma**-2
    for i in range(4):
        np.add.at(right, first + i, (information * weights[:, i])[:, None] * track.positions)
        for j in range(i, 4):
            np.add.at(band[j - i], first + i, information * weights[:, i] * weights[:, j])
    smooth = compute_smoothness_information(interval, settings.tracks.acceleration_density)
    for i in range(3):
        for j in range(i, 3):
            band[j - i, i : knots.count - 2 + i] += smooth[i, j]
    band[0] += _RIDGE
    positions = solveh_banded(band, right, lower=True)
    heading, _ = predict_headings(positions, interval, settings.body)
    shape, _ = compute_shape_prior(settings.body)
    return LegCandidate(
        knots, start, end, LegPath.from_shape(np.column_stack([positions, heading]), shape, np.zeros(0))
    )


def predict_headings(positions: Array, step: float, settings: LegBodySettings) -> tuple[Array, Array]:
    """The direction of a path over a stride at its control points.

    Args:
        positions: (K, 2) control points, m.
        step: time between two of them, s.
        settings: of legs.

    Returns:
        Headings (K,), rad, and their information (K,), 1/rad²: zero where the person stands. The information of a
        quarter of a stride is that of one heading.
    """
    half = max(round(settings.stride_duration / 2 / step), 1)
    index = np.arange(len(positions))
    low, high = np.maximum(index - half, 0), np.minimum(index + half, len(positions) - 1)
    x, y = (positions[high] - positions[low]).T
    walking = np.hypot(x, y) > settings.min_walking_speed * step * (high - low)
    heading = np.arctan2(y, x)
    if walking.any():
        heading = np.interp(index, index[walking], np.unwrap(heading[walking]))
    return heading, walking * 4 * step / settings.stride_duration / settings.heading_sigma**2
