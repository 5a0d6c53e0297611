"""How far bodies stray from ellipses on smooth paths: measured by how scanners contradict each other about them.

Arms and shoulders swing with the steps: what one scan is off by, the next ones are, too, and scanners on the other
side see something else. So scans are compared by strides, not one by one: as independent as the estimator takes
them to be, so much are they then allowed to scatter that a stride is told as well as it really is.
"""

import numpy as np

from calgraph.geometry import Array
from calgraph.refinement.network.trajectories import Body, Motion, Network, State, along, says

# Two steps of a walk, s.
_STRIDE = 1.0
# Beams count the less the farther they are off (Tukey, at 2.5 standard deviations). Of normal ones, the weights
# mean 0.755, and what they pull by has a mean square of 0.248: so much less than its information does a scan pull.
_PULLED = 0.248 / 0.755


def contradiction(network: Network, state: State) -> float:
    """Squared contradiction of scanners about bodies' places, over what the network's sway and noise explain.

    Where no two scanners see a body within one stride, there is nothing to compare, and it is 1.
    """
    each = [_of_body(network, state, *own) for own in zip(network.bodies, state.motions, strict=True)]
    shown, explained = np.sum([np.zeros(2), *each], axis=0)
    return float(shown / (_PULLED * explained)) if explained > 0 else 1.0


def _of_body(network: Network, state: State, body: Body, motion: Motion) -> Array:
    """(2,) squared contradiction, and what is explained of it.

    Each scanner's beams of one stride pull the body by ``b``, with covariance ``A``, which is their information on
    its place. Where all pulls together hold the body, those of single scanners have the covariance
    ``A - A (Σ A)⁻¹ A``.
    """
    strides = int((body.knots.count - 3) * body.knots.step / _STRIDE) + 1
    A, b = np.zeros((strides, len(body.glimpses), 3, 3)), np.zeros((strides, len(body.glimpses), 3))
    for k, seen in enumerate(body.glimpses):
        _, _, pose, rate = along(state, body, motion, seen)
        scans = says(network, state, motion, seen, pose, rate).swayed(network.sway[[0, 0, 1]])
        when = (seen.times - state.offset[seen.scanner] - body.knots.start) / _STRIDE
        stride = np.clip(when.astype(np.intp), 0, strides - 1)
        np.add.at(A[:, k], stride, scans.information[:, :3, :3])
        np.add.at(b[:, k], stride, scans.gradient[:, :3])
    # Each scanner may see the heading as it likes.
    turn = A[..., :2, 2:] / np.maximum(A[..., 2:, 2:], 1e-9)
    A, b = A[..., :2, :2] - turn @ A[..., 2:, :2], b[..., :2] - turn[..., 0] * b[..., 2:]
    scanners = np.sum(np.trace(A, axis1=-2, axis2=-1) > 0, axis=1)
    A, b = A[scanners > 1], b[scanners > 1]
    spread = np.linalg.inv(A.sum(axis=1) + 1e-9 * np.eye(2))
    held = b - (A @ (spread @ b.sum(axis=1)[..., None])[:, None])[..., 0]
    left = A - A @ spread[:, None] @ A
    return np.array([np.sum(held**2), np.sum(np.trace(left, axis1=-2, axis2=-1))])
