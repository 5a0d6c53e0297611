"""The board in the clouds of a 3-D scanner: a flat patch of the board's size that stands free.

Source: MSG-Cal, section III-B.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import ConvexHull, QhullError, cKDTree

from calgraph.config import Board, RangeNoise
from calgraph.detection.board_edges import beams_about, sheet_edges
from calgraph.detection.cloud_background import CloudBackground
from calgraph.detection.detections import PlanePatch
from calgraph.detection.line_plane_fit import fit_plane
from calgraph.detection.rectangle_fit import Sheet, lay_sheet, standing_free
from calgraph.detection.region_growing import flat_regions
from calgraph.detection.voxel_normals import Cells, Indices, make_cells
from calgraph.errors import Rejected
from calgraph.geometry import Array, plane
from calgraph.ransac import find_consensus
from calgraph.sensors import PointCloud

_MAX_CANDIDATES = 8
_MIN_MATCH = 0.1
_MIN_POINTS = 20
_MIN_RINGS = 3
_MIN_RANGE = 0.1
# Scanners bias and scatter their rings against each other by this much, whatever their noise is said to be, m.
_MIN_THICKNESS = 0.03
_SAMPLE_POINTS = 400
_SCENE_POINTS = 30_000
# From this match on the board's rectangle says which points are the board's.
_TRUSTED = 0.5
# Of worse matches than this share of the best one the board is none.
_WORTH = 0.25
# Within this of the outline a beam may have hit the edge and averaged board and background, m.
_EDGE = 0.02
# Around the board, so much is looked at for where it ends, m.
_BESIDE = 0.15
# Beams of spinning 2-D scanners start beside the origin: what is behind the board seems so far aside, rad.
_PARALLAX = 0.03
# Flatter than this a beam grazes the board.
_MIN_COSINE = 0.05


def find_patches(
    clouds: Sequence[PointCloud],
    boards: Sequence[Board],
    noise: RangeNoise,
    background: CloudBackground | None,
    rng: np.random.Generator,
) -> tuple[PlanePatch, ...] | Rejected:
    """Finds the board in the clouds of one capture.

    Args:
        clouds: all sweeps of one scanner that were measured while the board rested.
        boards: the boards to look for.
        noise: of a single beam.
        background: what the scanner sees without the board; without it all flat patches of the scene that could
            be a board are candidates.
        rng: for the random sampling.

    Returns:
        Up to eight candidates, the best match first, or why there is none.

    """
    if not clouds:
        return Rejected("no cloud was measured while the board rested")
    scene = np.concatenate([cloud.points for cloud in clouds])
    rings = _joined_rings(clouds)
    fresh = np.linalg.norm(scene, axis=1) > _MIN_RANGE
    if background is not None:
        fresh &= background.foreground(scene)
    if fresh.sum() < _MIN_POINTS:
        return Rejected(
            f"{fresh.sum()} foreground points: the board is not in view, or the background window contains it"
            if background is not None
            else f"the clouds hold {fresh.sum()} points"
        )
    points = scene[fresh]
    what = f"{len(points)} {'points' if background is None else 'foreground points'}"
    hit = _MIN_RINGS if rings is None else len(np.unique(rings[fresh]))
    if hit < _MIN_RINGS:
        return Rejected(
            f"only {hit} of the rings hit the board ({what}), a plane needs {_MIN_RINGS}: "
            "bring the board nearer or turn its longer side across the rings"
        )
    cells = make_cells(points, None if rings is None else rings[fresh])
    thickness = max(3 * noise.range, _MIN_THICKNESS)
    regions = [] if cells is None else flat_regions(cells, thickness)
    if cells is None or not regions:
        return Rejected(f"{what} hold no flat patch: the board is not in view, too far or seen edge-on")
    few = scene[:: max(1, len(scene) // _SCENE_POINTS)]
    likely = _most_likely(cells, regions, boards, few, thickness)
    patches = [_patch(points, cells, region, boards, noise, thickness, few, rng) for region in likely]
    found = sorted((p for p in patches if p is not None and p.match >= _MIN_MATCH), key=lambda p: -p.match)
    if not found:
        return _no_match(cells, regions, boards)
    lines, reach = _scan_lines(clouds[0]), max(0.5 * float(np.hypot(*board.size)) for board in boards) + _BESIDE
    return tuple(
        replace(p, edges=_edges(lines, p, max(4 * noise.range, _MIN_THICKNESS), reach))
        for p in found
        if p.match >= _WORTH * found[0].match
    )


def _most_likely(
    cells: Cells, regions: Sequence[Indices], boards: Sequence[Board], scene: Array, thickness: float
) -> list[Indices]:
    """The regions that look most like a board, before any work on their single points."""
    scored = []
    for region in regions:
        points = cells.points[region]
        surface = plane.fit(points)
        possible = [board for board in boards if _size_possible(points, board, cells.spacing)]
        if possible:
            match = max(_match(surface, points, board, cells.spacing, scene, thickness)[0] for board in possible)
            scored.append((match, region))
    scored.sort(key=lambda s: -s[0])
    return [region for match, region in scored[:_MAX_CANDIDATES] if match >= _MIN_MATCH]


def _patch(
    points: Array,
    cells: Cells,
    region: Indices,
    boards: Sequence[Board],
    noise: RangeNoise,
    thickness: float,
    scene: Array,
    rng: np.random.Generator,
) -> PlanePatch | None:
    """The plane and the points of one flat region, and how well it fits a board."""
    surface = _consensus_plane(points[np.isin(cells.of_point, region)], thickness, rng)
    if surface is None:
        return None
    members = _gather(points, cells, region, surface, thickness)
    flat = cells.points[np.unique(cells.of_point[members])]
    match, sheet = max(
        (_match(surface, flat, board, cells.spacing, scene, thickness) for board in boards),
        key=lambda matched: matched[0],
    )
    interior = members[_interior(points[members], sheet, match)]
    fit = fit_plane(points[interior], noise.range, noise.angle, surface)
    if fit is None or fit.inliers.sum() < _MIN_POINTS:
        return None
    n, d = fit.parameters[:3], fit.parameters[3]
    center = sheet.center - (n @ sheet.center + d) * n
    return PlanePatch(fit.parameters, fit.covariance, points[interior[fit.inliers]], center, match)


def _consensus_plane(points: Array, threshold: float, rng: np.random.Generator) -> Array | None:
    """The plane (4,) that most of the points (N, 3) agree with."""
    if len(points) > _SAMPLE_POINTS:
        points = points[rng.choice(len(points), _SAMPLE_POINTS, replace=False)]

    def solve(samples: Indices) -> Array:
        chosen = points[samples]
        centre = chosen.mean(axis=1)
        offsets = chosen - centre[:, None]
        values, vectors = np.linalg.eigh(np.einsum("kmi,kmj->kij", offsets, offsets))
        n = np.where(values[:, 1:2] > 1e-12, vectors[..., 0], np.nan)
        return plane.towards_origin(np.column_stack([n, -np.sum(n * centre, axis=1)]))

    def squared_residuals(planes: Array) -> Array:
        return plane.distance(planes, points[None]) ** 2

    groups = np.arange(len(points))
    found = find_consensus(groups, 3, solve, squared_residuals, threshold**2, rng=rng, max_samples=200)
    return None if found is None else found.model


def _gather(points: Array, cells: Cells, region: Indices, surface: Array, thickness: float) -> Indices:
    """All points on the plane within reach of the region: edge cells without a normal of their own too."""
    near = np.flatnonzero(np.abs(plane.distance(surface, points)) < thickness)
    distance, _ = cKDTree(cells.points[region]).query(points[near])
    return np.asarray(near[distance < cells.spacing * np.linalg.norm(points[near], axis=1)])


def _interior(points: Array, sheet: Sheet, match: float) -> NDArray[np.bool_]:
    """Which points (N, 3) lie clear of the patch's outline; all if that would leave too few."""
    surface = sheet.surface
    # Where the beam meets the plane, not where noise put the point: on an inclined board that would keep the far
    # points at one edge and the near ones at the other, and turn the plane.
    flat = sheet.coordinates(points * (-surface[3] / (points @ surface[:3]))[:, None])
    kept: NDArray[np.bool_] = np.ones(len(flat), dtype=np.bool_)
    if match > _TRUSTED:
        # The sheet leaves out stand and arms.
        kept = np.asarray(np.all(np.abs(flat) < 0.5 * np.array(sheet.size), axis=1), dtype=np.bool_)
    try:
        hull = ConvexHull(flat[kept])
    except (QhullError, ValueError):
        return kept
    depth = np.max(hull.equations[:, :2] @ flat.T + hull.equations[:, 2:], axis=0)
    clear: NDArray[np.bool_] = np.asarray(kept & (depth < -_EDGE), dtype=np.bool_)
    return clear if clear.sum() > max(_MIN_POINTS, 0.6 * kept.sum()) else kept


def _match(
    surface: Array, cells: Array, board: Board, spacing: float, scene: Array, thickness: float
) -> tuple[float, Sheet]:
    """How much a patch looks like the board, 0 to 1, and where the board would be."""
    centre = cells.mean(axis=0)
    step = spacing * float(np.linalg.norm(centre))
    cosine = max(abs(float(surface[:3] @ centre)) / float(np.linalg.norm(centre)), 0.3)
    sheet = lay_sheet(surface, cells, board.size, min(0.6 * step / cosine, min(board.size) / 4))
    if sheet.covered * sheet.inside < _MIN_MATCH:
        return 0.0, sheet
    solid, free = standing_free(sheet, scene, thickness, max(0.15, 1.5 * step))
    # A few cells fit any outline: far walls seen by few rings must not pass for boards.
    resolved = min(1.0, min(board.size) / (4 * step))
    return sheet.covered * sheet.inside * solid * free * resolved, sheet


def _extent(points: Array) -> tuple[float, float]:
    """Length and width of a flat set of points along its principal axes, m."""
    centred = points - points.mean(axis=0)
    _, vectors = np.linalg.eigh(centred.T @ centred)
    spans = np.ptp(centred @ vectors, axis=0)
    return float(spans[2]), float(spans[1])


def _size_possible(points: Array, board: Board, spacing: float) -> bool:
    length, width = _extent(points)
    step = spacing * float(np.linalg.norm(points.mean(axis=0)))
    short, diagonal = min(board.size), float(np.hypot(*board.size))
    return (
        length < 1.5 * diagonal
        and length > 0.5 * short - step
        and width > 0.25 * short - step
        and step < short / 2
    )


def _no_match(cells: Cells, regions: Sequence[Indices], boards: Sequence[Board]) -> Rejected:
    extents = [_extent(cells.points[region]) for region in regions]
    length, width = max(extents, key=lambda e: e[0] * e[1])
    sizes = " or ".join(f"{b.size[0]:g} x {b.size[1]:g} m" for b in boards)
    return Rejected(
        f"no flat patch has a board's size: the largest is {length:.2f} x {width:.2f} m, the board is {sizes}"
    )


@dataclass(frozen=True, eq=False)
class _ScanLines:
    """One sweep, beam by beam as they scan. Sweeps have the same beams: a further one would not tell more."""

    points: Array
    """(N, 3) m."""
    line: Indices
    """(N,) scan line of each."""
    parallax: float
    """How far beams may start from the sensor's origin, as an angle, rad."""


def _scan_lines(cloud: PointCloud) -> _ScanLines:
    """Rings, each by azimuth; without rings, points as they were sent, which is as they were measured."""
    there = np.linalg.norm(cloud.points, axis=1) > _MIN_RANGE
    points = cloud.points[there]
    if cloud.rings is None:
        return _ScanLines(points, np.zeros(len(points), dtype=np.intp), _PARALLAX)
    rings = cloud.rings[there]
    order = np.lexsort([np.arctan2(points[:, 1], points[:, 0]), rings])
    return _ScanLines(points[order], rings[order].astype(np.intp), 0.0)


def _edges(lines: _ScanLines, patch: PlanePatch, thickness: float, reach: float) -> Array:
    """(M, 2, 3) where beams leave the patch's plane within so far of its centre."""
    n, d = patch.plane[:3], patch.plane[3]
    ranges = np.linalg.norm(lines.points, axis=1)
    directions = lines.points / ranges[:, None]
    facing = -(directions @ n)
    meets = np.where(facing > _MIN_COSINE, d / np.maximum(facing, _MIN_COSINE), np.inf)
    at = np.minimum(meets, np.linalg.norm(patch.center) + 2 * reach)[:, None] * directions
    near = beams_about(np.linalg.norm(at - patch.center, axis=1) < reach)
    # Where other beams of the line lie between, another one begins.
    _, line = np.unique(np.stack([lines.line[near], near - np.arange(len(near))]), axis=1, return_inverse=True)
    return sheet_edges(directions[near], (ranges - meets)[near], np.ravel(line), thickness, lines.parallax)


def _joined_rings(clouds: Sequence[PointCloud]) -> NDArray[np.int32] | None:
    rings = [cloud.rings for cloud in clouds if cloud.rings is not None]
    return np.concatenate(rings) if len(rings) == len(clouds) else None
