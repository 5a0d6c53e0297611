"""The pose of two 2-D scanners from pairs of coplanar lines, by linear algebra alone.

Two scan planes meet in one line: the hinge. A board cuts each scan plane in a line, and both lines cross the hinge
where the board does. That is all that coplanarity says: which line the hinge is in either scan plane, and how the
two are shifted along it. How far the hinge is folded it does not say.
"""

import numpy as np

from calgraph.geometry import Array, se3

# The fold is open, and is chosen small: it brings what was seen of one board as near together as the scan planes
# allow. Smaller, the scan planes would nearly be one, in which all lines are coplanar, rad.
_DIHEDRAL_ANGLE = 0.15


def solve_coplanar_lines(a: Array, b: Array) -> Array:
    """Poses under which the lines of each sample are coplanar.

    In coordinates (direction, moment) of lines in their scan planes, ``l_a @ E @ l_b = 0`` with a matrix E, zero
    in its last element, of which seven pairs of lines fix the other eight up to scale. The hinge is coplanar with
    all lines of the other scan plane, so it spans E's null space on either side.

    Args:
        a: (K, m, 2, 3) end points of m >= 7 segments in K samples, frame a, z = 0, m.
        b: (K, m, 2, 3) their partners in frame b.

    Returns:
        T_a_b (K, 4, 4); NaN where a sample's hinge lies at infinity.
    """
    scale = np.sqrt(np.mean(a**2, axis=(1, 2, 3)) + np.mean(b**2, axis=(1, 2, 3)))[:, None]
    lines_a, lines_b = _lines(a, scale), _lines(b, scale)
    products = (lines_a[..., :, None] * lines_b[..., None, :]).reshape(*lines_a.shape[:2], 9)[..., :8]
    # The smallest eigenvector of 8 x 8 is found faster than the singular one, and is refined later anyway.
    _, vectors = np.linalg.eigh(np.swapaxes(products, -1, -2) @ products)
    E = np.concatenate([vectors[..., 0], np.zeros((len(a), 1))], axis=1).reshape(-1, 3, 3)
    U, _, Vt = np.linalg.svd(E)
    hinge_a, hinge_b = _normalize_line(U[..., 2]), _normalize_line(Vt[:, 2])
    at_a, sine_a = _intersect_lines(lines_a, hinge_a)
    at_b, sine_b = _intersect_lines(lines_b, hinge_b)
    weights = (sine_a * sine_b) ** 2
    weights /= weights.sum(axis=1, keepdims=True)
    shift, misfit = np.stack([_fit_shift(at_a, turn * at_b, weights) for turn in (1.0, -1.0)], axis=1)
    reversed_ = misfit[1] < misfit[0]
    hinge_b = np.where(reversed_[:, None], -hinge_b, hinge_b)
    along_a, along_b = _line_frame(hinge_a), _line_frame(hinge_b)
    # The scan planes fold so that both scanners look at the boards on one side of the hinge.
    sides = np.sum(_signed_distances(a, hinge_a, scale) * _signed_distances(b, hinge_b, scale), axis=1)
    R = (
        along_a
        @ _rotation_about_x(np.where(sides < 0, np.pi - _DIHEDRAL_ANGLE, _DIHEDRAL_ANGLE))
        @ np.swapaxes(along_b, -1, -2)
    )
    origin_a = _closest_point(hinge_a) + np.where(reversed_, shift[1], shift[0])[:, None] * along_a[..., 0]
    return se3.pose(R, scale * (origin_a - (R @ _closest_point(hinge_b)[..., None])[..., 0]))


def _lines(segments: Array, scale: Array) -> Array:
    """Lines (K, m, 3) through segments (K, m, 2, 3): unit direction and moment ``x × direction`` over scale."""
    along = segments[..., 1, :2] - segments[..., 0, :2]
    along = along / np.linalg.norm(along, axis=-1, keepdims=True)
    x = segments.mean(axis=-2)
    moment = (x[..., 0] * along[..., 1] - x[..., 1] * along[..., 0]) / scale
    return np.concatenate([along, moment[..., None]], axis=-1)


def _normalize_line(line: Array) -> Array:
    """Lines (K, 3) with directions of length one; NaN for a line at infinity."""
    length = np.linalg.norm(line[:, :2], axis=1, keepdims=True)
    return line / np.where(length > 1e-6, length, np.nan)


def _intersect_lines(lines: Array, hinge: Array) -> tuple[Array, Array]:
    """Where lines (K, m, 3) cross the hinge (K, 3), as coordinates along it, and the sines of the angles there."""
    sine = lines[..., 0] * hinge[:, None, 1] - lines[..., 1] * hinge[:, None, 0]
    sine = np.where(np.abs(sine) < 1e-6, 1e-6, sine)
    cosine = np.sum(lines[..., :2] * hinge[:, None, :2], axis=-1)
    return (hinge[:, 2:] * cosine - lines[..., 2]) / sine, sine


def _fit_shift(at_a: Array, at_b: Array, weights: Array) -> tuple[Array, Array]:
    """The shifts (K,) that bring crossings b to crossings a, and the mean squares (K,) of what they leave."""
    gap = at_a - at_b
    shift = np.sum(weights * gap, axis=1)
    return shift, np.sum(weights * (gap - shift[:, None]) ** 2, axis=1)


def _line_frame(hinge: Array) -> Array:
    """Axes (K, 3, 3) along the hinge, across it in the scan plane, and along the scan plane's normal z."""
    frame = np.zeros((len(hinge), 3, 3))
    frame[:, 0, 0], frame[:, 1, 0] = hinge[:, 0], hinge[:, 1]
    frame[:, 0, 1], frame[:, 1, 1] = -hinge[:, 1], hinge[:, 0]
    frame[:, 2, 2] = 1
    return frame


def _rotation_about_x(angle: Array) -> Array:
    """Rotations (K, 3, 3) about the first axis."""
    R = np.zeros((len(angle), 3, 3))
    R[:, 0, 0] = 1
    R[:, 1, 1] = R[:, 2, 2] = np.cos(angle)
    R[:, 2, 1], R[:, 1, 2] = np.sin(angle), -np.sin(angle)
    return R


def _signed_distances(segments: Array, hinge: Array, scale: Array) -> Array:
    """Distances (K, m) of the segments' middles across the hinge, over scale."""
    x = segments.mean(axis=-2)[..., :2] / scale[..., None]
    return np.asarray(x[..., 1] * hinge[:, None, 0] - x[..., 0] * hinge[:, None, 1] + hinge[:, None, 2])


def _closest_point(hinge: Array) -> Array:
    """The points (K, 3) of the hinges that lie nearest to the scanner."""
    return hinge[:, 2:] * np.stack([hinge[:, 1], -hinge[:, 0], np.zeros(len(hinge))], axis=1)
