"""How far bodies stray from ellipses on smooth paths: measured by how scanners contradict each other about them.

Arms and shoulders swing with the steps: what one scan is off by, the next ones are, too, and scanners on the other
side see something else. So scans are compared by strides, not one by one: as independent as the estimator takes
them to be, so much are they then allowed to scatter that a stride is told as well as it really is.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.optimize import brentq

from calgraph.estimation.network.scan_equations import PULLED, Scans
from calgraph.estimation.network.solver import Body, Motion, Network, State, along, says
from calgraph.geometry import Array, Index

# Two steps of a walk, s.
_STRIDE = 1.0
# The sway is found to so much of itself, as a logarithm of its variance.
_PRECISE = 0.02
# Information (1/m², 1/rad²) that is as good as none.
_NONE = 1e-6


@dataclass(frozen=True, eq=False)
class _Kind:
    """What of a pose sways by one variance."""

    rows: Index
    """Of the pose."""
    least: float
    """Nobody is an ellipse to a smaller standard deviation, m or rad; what sways less does no harm."""
    most: float
    """Nobody strays farther."""


# Place and heading, in the order of :attr:`Network.sway`.
_KINDS = (_Kind(np.array([0, 1]), 0.0005, 0.1), _Kind(np.array([2]), 0.002, 0.5))


@dataclass(frozen=True, eq=False)
class _Seen:
    """What one scanner says of one body, which does not sway yet."""

    scans: Scans
    stride: Index
    """(V,) of each scan."""


def measured_sway(network: Network, state: State) -> Array:
    """(2,) variances of places (m²) and headings (rad²) that explain how scanners contradict each other.

    Each is searched for, the other being as it is: to multiply it by how many times more than explained the
    contradiction is leads there, too, but the slower, the smaller the sway is beside the noise of a scan.
    Where no two scanners see a body within one stride, there is nothing to compare, and it stays as it is.
    """
    bodies = [_of_body(network, state, *own) for own in zip(network.bodies, state.motions, strict=True)]
    sway = network.sway.copy()
    for which, kind in enumerate(_KINDS):
        sway[which] = _explaining(bodies, sway, which, kind)
    return sway


def _explaining(bodies: Sequence[tuple[_Seen, ...]], sway: Array, which: int, kind: _Kind) -> float:
    """The variance of one kind, the other being as in ``sway`` (2,)."""

    def shown_and_explained(log_variance: float) -> Array:
        trial = sway.copy()
        trial[which] = np.exp(log_variance)
        return np.asarray(np.sum([np.zeros(2), *(_contradiction(own, trial, kind) for own in bodies)], axis=0))

    def excess(log_variance: float) -> float:
        shown, explained = shown_and_explained(log_variance)
        return float(np.log(shown / (PULLED * explained)))

    low, high = 2 * np.log([kind.least, kind.most])
    if shown_and_explained(low)[1] < kind.most**-2:
        return float(sway[which])
    if excess(low) <= 0:
        return kind.least**2
    if excess(high) >= 0:
        return kind.most**2
    return float(np.exp(brentq(excess, low, high, xtol=_PRECISE)))


def _of_body(network: Network, state: State, body: Body, motion: Motion) -> tuple[_Seen, ...]:
    """By scanner."""
    found = []
    for seen in body.glimpses:
        _, _, pose, rate = along(state, body, motion, seen)
        stride = (seen.times - state.offset[seen.scanner] - body.knots.start) / _STRIDE
        found.append(_Seen(says(network, state, motion, seen, pose, rate), np.maximum(stride, 0).astype(np.intp)))
    return tuple(found)


def _contradiction(body: tuple[_Seen, ...], sway: Array, kind: _Kind) -> Array:
    """(2,) squared contradiction of scanners about a body that sways (2,), and what is explained of it.

    Each scanner's beams of one stride pull the body by ``b``, with covariance ``A``, which is their information.
    What is not of this kind each scanner may see as it likes. Where all pulls together hold the body, those of
    single scanners have the covariance ``A - A (Σ A)⁻¹ A``.
    """
    strides = 1 + max(int(seen.stride.max(initial=0)) for seen in body)
    A, b = np.zeros((strides, len(body), 3, 3)), np.zeros((strides, len(body), 3))
    for k, seen in enumerate(body):
        scans = seen.scans.swayed(sway[[0, 0, 1]])
        np.add.at(A[:, k], seen.stride, scans.information[:, :3, :3])
        np.add.at(b[:, k], seen.stride, scans.gradient[:, :3])
    own, other = kind.rows, np.setdiff1d(np.arange(3), kind.rows)
    mixed = A[..., own[:, None], other]
    gain = mixed @ np.linalg.inv(A[..., other[:, None], other] + _NONE * np.eye(len(other)))
    A = A[..., own[:, None], own] - gain @ np.swapaxes(mixed, -1, -2)
    b = b[..., own] - (gain @ b[..., other, None])[..., 0]
    several = np.sum(np.trace(A, axis1=-2, axis2=-1) > 0, axis=1) > 1
    A, b = A[several], b[several]
    spread = np.linalg.inv(A.sum(axis=1) + _NONE * np.eye(len(own)))
    held = b - (A @ (spread @ b.sum(axis=1)[..., None])[:, None])[..., 0]
    left = A - A @ spread[:, None] @ A
    return np.array([np.sum(held**2), np.sum(np.trace(left, axis1=-2, axis2=-1))])
