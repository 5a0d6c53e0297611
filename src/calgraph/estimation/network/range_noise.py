"""How noisy ranges are: measured by how they scatter about bodies.

A scanner's background tells its noise, too, but by medians that take steps as coarse as ranges are sent in, and
clothes are no walls. Paths follow the noise, though, the more so the fewer beams they have: how much the scatter
has become smaller is known from how much the beams hold the path, which is their leverage (Huber, "Robust
statistics", 1981, section 7.2).
"""

import numpy as np

from calgraph.estimation.network.scan_equations import COUNTED, SHRUNK, Scans, summed
from calgraph.estimation.network.schur import path_covariance
from calgraph.estimation.network.solver import Network, State, System, along, outlines, residuals
from calgraph.geometry import Array, Index

# Standard deviations of Gaussian noise in one median of absolute values.
_NORMAL = 1.4826
# So many beams tell the noise of a scanner to a few percent. But ranges may have none at all.
_ENOUGH, _LEAST = 300, 0.5
# What scatters more, m, is not noise: the beams are not of these bodies.
_MOST = 0.05
# Where beams tell hardly more than the path, what is left of their noise is not trusted to tell it.
_MOST_HELD = 0.3


def measured_noise(network: Network, state: State, system: System, background: Array) -> Array:
    """(S,) noise of ranges, m: as they scatter about bodies, and as much more as paths followed it.

    Between half of what the background says, and 5 cm beyond it.

    Args:
        network: as it was solved last, with the weights of then.
        state: where bodies are.
        system: of that solution.
        background: (S,) noise of each scanner's background, m: where few beams meet bodies, this one is.
    """
    off: list[list[Array]] = [[] for _ in background]
    held, told = np.zeros((2, len(background)))
    for body, motion, equations in zip(network.bodies, state.motions, system.bodies, strict=True):
        spread = path_covariance(equations.band)
        for one in body.glimpses:
            first, weights, pose, rate = along(state, body, motion, one)
            hits = outlines(state, motion, one, pose, rate)
            off[one.scanner].append(np.abs(hits.ranges - one.ranges)[hits.squarely])
            scans = summed(*residuals(network, one, hits), one.weight, one.start).swayed(network.sway[[0, 0, 1]])
            held[one.scanner] += _held(weights, first, scans, spread)
            told[one.scanner] += one.weight.sum() / COUNTED
    beams = [np.concatenate([np.zeros(0), *own]) for own in off]
    followed = SHRUNK * np.minimum(held / np.maximum(told, 1), _MOST_HELD)
    scatter = [
        _NORMAL * np.median(own) / (1 - share) if len(own) >= _ENOUGH else stated
        for own, share, stated in zip(beams, followed, background, strict=True)
    ]
    return np.asarray(np.clip(scatter, _LEAST * background, np.hypot(background, _MOST)))


def _held(weights: Array, first: Index, scans: Scans, spread: Array) -> float:
    """The sum of the leverages that scans have on a path whose control points vary by ``spread``."""
    A = scans.information[:, :3, :3]
    held = 0.0
    for i in range(4):
        for j in range(i, 4):
            own = np.einsum("vij,vji->v", A, spread[first + i, j - i])
            held += (1 + (i < j)) * float((weights[:, i] * weights[:, j]) @ own)
    return held
