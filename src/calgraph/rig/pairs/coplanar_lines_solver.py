"""Linear solver for the pose of two 2-D scanners from pairs of coplanar lines.

Two scan planes intersect in one line. A board intersects each scan plane in a line, and both lines cross the
intersection of the scan planes where the board does. Coplanarity therefore determines the position of the
intersection in either scan plane and the shift along it, but not the dihedral angle between the scan planes.
"""

import numpy as np

from calgraph.geometry import Array, se3, se_n

# Sine or length below which two lines count as parallel, and a line as at infinity: keeps quotients finite.
_SMALL = 1e-6


def solve_coplanar_lines(a: Array, b: Array, dihedral_angle: float) -> Array:
    """Solves for poses under which the lines of each sample are coplanar.

    In coordinates (direction, moment) of lines in their scan planes, ``l_a @ E @ l_b = 0``. The last element of
    the matrix E is zero; seven pairs of lines determine the other eight up to scale. The intersection of the scan
    planes is coplanar with all lines of the other scan plane, so it spans E's null space on either side.

    Args:
        a: (K, m, 2, 3) end points of m >= 7 segments in K samples, frame a, z = 0, m.
        b: (K, m, 2, 3) end points of the matching segments, frame b, z = 0, m.
        dihedral_angle: unobservable angle between the scan planes, rad.

    Returns:
        T_a_b (K, 4, 4); NaN for samples whose intersection lies at infinity.
    """
    scale = np.sqrt(np.mean(a**2, axis=(1, 2, 3)) + np.mean(b**2, axis=(1, 2, 3)))[:, None]
    lines_a, lines_b = _lines(a, scale), _lines(b, scale)
    products = (lines_a[..., :, None] * lines_b[..., None, :]).reshape(*lines_a.shape[:2], 9)[..., :8]
    # An eigendecomposition of 8 x 8 is faster than the SVD; its lower accuracy does not matter before refinement.
    _, vectors = np.linalg.eigh(se_n.transpose(products) @ products)
    E = np.concatenate([vectors[..., 0], np.zeros((len(a), 1))], axis=1).reshape(-1, 3, 3)
    U, _, Vt = np.linalg.svd(E)
    axis_a, axis_b = _normalize_line(U[..., 2]), _normalize_line(Vt[:, 2])
    crossing_a, sine_a = _intersect_lines(lines_a, axis_a)
    crossing_b, sine_b = _intersect_lines(lines_b, axis_b)
    weights = (sine_a * sine_b) ** 2
    weights /= weights.sum(axis=1, keepdims=True)
    shift, residual = np.stack([_fit_shift(crossing_a, s * crossing_b, weights) for s in (1.0, -1.0)], axis=1)
    reversed_ = residual[1] < residual[0]
    axis_b = np.where(reversed_[:, None], -axis_b, axis_b)
    frame_a, frame_b = _line_frame(axis_a), _line_frame(axis_b)
    # The dihedral angle is such that both scanners observe the boards on the same side of the intersection.
    sides = np.sum(_signed_distances(a, axis_a, scale) * _signed_distances(b, axis_b, scale), axis=1)
    dihedral = np.where(sides < 0, np.pi - dihedral_angle, dihedral_angle)
    R = frame_a @ _rotation_about_x(dihedral) @ se_n.transpose(frame_b)
    origin_a = _closest_point(axis_a) + np.where(reversed_, shift[1], shift[0])[:, None] * frame_a[..., 0]
    return se3.pose(R, scale * (origin_a - (R @ _closest_point(axis_b)[..., None])[..., 0]))


def _lines(segments: Array, scale: Array) -> Array:
    """Lines (K, m, 3) through segments (K, m, 2, 3): unit direction and moment ``x × direction`` over scale."""
    along = segments[..., 1, :2] - segments[..., 0, :2]
    along = along / np.linalg.norm(along, axis=-1, keepdims=True)
    x = segments.mean(axis=-2)
    moment = (x[..., 0] * along[..., 1] - x[..., 1] * along[..., 0]) / scale
    return np.concatenate([along, moment[..., None]], axis=-1)


def _normalize_line(line: Array) -> Array:
    """Normalizes lines (K, 3) to unit directions; NaN for a line at infinity."""
    length = np.linalg.norm(line[:, :2], axis=1, keepdims=True)
    return line / np.where(length > _SMALL, length, np.nan)


def _intersect_lines(lines: Array, axis: Array) -> tuple[Array, Array]:
    """Coordinates along an axis (K, 3) at which lines (K, m, 3) cross it, and the sines of the angles there."""
    sine = lines[..., 0] * axis[:, None, 1] - lines[..., 1] * axis[:, None, 0]
    sine = np.where(np.abs(sine) < _SMALL, _SMALL, sine)
    cosine = np.sum(lines[..., :2] * axis[:, None, :2], axis=-1)
    return (axis[:, 2:] * cosine - lines[..., 2]) / sine, sine


def _fit_shift(crossing_a: Array, crossing_b: Array, weights: Array) -> tuple[Array, Array]:
    """Weighted mean shifts (K,) from crossings b to crossings a, and mean squared residuals (K,)."""
    gap = crossing_a - crossing_b
    shift = np.sum(weights * gap, axis=1)
    return shift, np.sum(weights * (gap - shift[:, None]) ** 2, axis=1)


def _line_frame(axis: Array) -> Array:
    """Unit vectors (K, 3, 3) along the axis, across it in the scan plane, and along the scan plane's normal z."""
    frame = np.zeros((len(axis), 3, 3))
    frame[:, 0, 0], frame[:, 1, 0] = axis[:, 0], axis[:, 1]
    frame[:, 0, 1], frame[:, 1, 1] = -axis[:, 1], axis[:, 0]
    frame[:, 2, 2] = 1
    return frame


def _rotation_about_x(angle: Array) -> Array:
    """Rotations (K, 3, 3) about the first axis."""
    R = np.zeros((len(angle), 3, 3))
    R[:, 0, 0] = 1
    R[:, 1, 1] = R[:, 2, 2] = np.cos(angle)
    R[:, 2, 1], R[:, 1, 2] = np.sin(angle), -np.sin(angle)
    return R


def _signed_distances(segments: Array, axis: Array, scale: Array) -> Array:
    """Signed distances (K, m) of the segments' midpoints from the axis, over scale."""
    x = segments.mean(axis=-2)[..., :2] / scale[..., None]
    return np.asarray(x[..., 1] * axis[:, None, 0] - x[..., 0] * axis[:, None, 1] + axis[:, None, 2])


def _closest_point(axis: Array) -> Array:
    """Points (K, 3) of the axes closest to the scanner."""
    return axis[:, 2:] * np.stack([axis[:, 1], -axis[:, 0], np.zeros(len(axis))], axis=1)
