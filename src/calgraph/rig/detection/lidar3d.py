"""The board in the clouds of a 3-D scanner: a free-standing flat patch of the board's size.

Source: MSG-Cal, section III-B.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import ConvexHull, QhullError, cKDTree

from calgraph.boards.detections import PlanePatch, to_beams
from calgraph.config import Board, RangeNoise
from calgraph.config.settings import DetectionSettings
from calgraph.errors import Rejected
from calgraph.geometry import Array, find_median, measure_lengths, plane
from calgraph.rig.detection.capture_background import CaptureBackground, CloudBackground
from calgraph.rig.detection.lidar2d import MAX_CANDIDATES, RANSAC_CONFIDENCE, SURROUNDINGS
from calgraph.rig.detection.line_plane_fit import (
    MIN_COSINE,
    OUTLIER_SIGMAS,
    find_board_edges,
    fit_plane,
    select_beams_with_margin,
)
from calgraph.rig.detection.rectangle_fit import (
    OUTLINE_BLUR,
    BoardRectangle,
    SceneBeams,
    fit_rectangle,
    measure_solidity_and_isolation,
)
from calgraph.rig.detection.scan_averaging import MIN_THICKNESS, SAME_SURFACE_SIGMAS
from calgraph.rig.detection.voxel_normals import Cells, Indices, grow_flat_regions, make_cells
from calgraph.sensors import PointCloud
from calgraph.solver.ransac import find_consensus

# Rounding of coordinates, m.
_ROUNDING = 1e-9
# Points with equal sums of coordinates times these are equal: no sensible coordinates have this ratio.
_IRRATIONAL = np.array([1.0, np.sqrt(2.0), np.sqrt(3.0)])


# Maximum number of points of the scene, evenly chosen, that show whether a candidate stands free: bounds the
# time.
_MAX_SCENE_POINTS = 30_000
# Minimum score of a candidate, the product of coverage, containment, solidity, isolation and resolution.
_MIN_SCORE = 0.1
# Minimum score over that of the best candidate: worse ones only cost time in the pairwise step.
_MIN_SCORE_RATIO = 0.25


def find_patches(
    clouds: Sequence[PointCloud],
    boards: Sequence[Board],
    noise: RangeNoise,
    background: CloudBackground | CaptureBackground | None,
    rng: np.random.Generator,
    settings: DetectionSettings,
) -> tuple[PlanePatch, ...] | Rejected:
    """Finds the board in the clouds of one capture.

    Args:
        clouds: all sweeps of one scanner that were measured while the board rested.
        boards: the boards to look for.
        noise: of a single beam.
        background: model of the scene without the board; without it all flat patches of the scene are candidates.
        rng: for the random sampling.
        settings: of the detection.

    Returns:
        Candidates for the board, the best score first, or why there is none.
    """
    if not clouds:
        return Rejected("no cloud was measured while the board rested")
    limits = settings.lidar3d
    # Drivers send empty clouds where packets are lost: they hold neither rings nor edges.
    clouds = [_drop_repeated_points(cloud) for cloud in clouds if len(cloud.points)] or clouds
    scene = np.concatenate([cloud.points for cloud in clouds])
    of_clouds = [cloud.rings for cloud in clouds if cloud.rings is not None]
    rings = np.concatenate(of_clouds) if len(of_clouds) == len(clouds) else None
    ranges = measure_lengths(scene)
    valid = ranges > limits.min_range
    foreground = valid if background is None else valid & background.foreground(scene)
    if foreground.sum() < limits.min_points:
        return Rejected(
            f"{foreground.sum()} foreground points: the board is not in view, or the background window "
            "(capture.background, or found at the start) contains it"
            if background is not None
            else f"the clouds hold {foreground.sum()} points"
        )
    points = scene.take(np.flatnonzero(foreground), axis=0)  # a mask takes four times as long
    count_text = f"{len(points)} {'points' if background is None else 'foreground points'}"
    ring_count = limits.min_rings if rings is None else len(np.unique(rings[foreground]))
    if ring_count < limits.min_rings:
        return Rejected(
            f"only {ring_count} of the rings hit the board ({count_text}), a plane needs {limits.min_rings}: "
            "bring the board nearer or turn its longer side across the rings"
        )
    cells = make_cells(points, None if rings is None else rings[foreground], settings)
    sigma = float(noise.at(find_median(ranges[foreground])))
    thickness = max(OUTLIER_SIGMAS * sigma, MIN_THICKNESS)
    regions = [] if cells is None else grow_flat_regions(cells, thickness)
    if cells is None or not regions:
        return Rejected(f"{count_text} hold no flat patch: the board is not in view, too far or edge-on")
    if isinstance(background, CaptureBackground):
        # Where the board often stood, its points may be taken for background; those on its plane belong to it.
        points = np.concatenate([points, scene.take(np.flatnonzero(valid & ~foreground), axis=0)])
    step = max(1, len(scene) // _MAX_SCENE_POINTS)
    subsampled = scene[::step], ranges[::step]
    candidates = _select_candidate_regions(cells, regions, boards, subsampled, thickness, settings)
    measured = [
        _measure_patch(points, cells, region, boards, thickness, subsampled, rng, settings)
        for region in candidates
    ]
    found: list[PlanePatch] = []
    for patch in sorted((p for p in measured if p is not None), key=lambda p: -p.match):
        least = max(_MIN_SCORE, _MIN_SCORE_RATIO * found[0].match if found else 0.0)
        fitted = _fit_patch(points, patch, noise, settings) if patch.match >= least else None
        if fitted is not None:
            found.append(fitted)
    if not found:
        return _explain_no_match(cells, regions, boards)
    lines = _order_by_scan_line(clouds[0], ranges[: len(clouds[0].points)], settings)
    radius = max(0.5 * float(np.hypot(*board.size)) for board in boards) + SURROUNDINGS
    thickness = max(SAME_SURFACE_SIGMAS * sigma, MIN_THICKNESS)
    return tuple(replace(p, edges=_find_edges(lines, p, thickness, radius, settings)) for p in found)


def _select_candidate_regions(
    cells: Cells,
    regions: Sequence[Indices],
    boards: Sequence[Board],
    scene: SceneBeams,
    thickness: float,
    settings: DetectionSettings,
) -> list[Indices]:
    """The regions with the best scores, from their cells alone."""
    scored = []
    for region in regions:
        points = cells.points[region]
        surface = plane.fit(points)
        possible = [board for board in boards if _has_plausible_size(points, board, cells.spacing)]
        if possible:
            scores = [
                _score_patch(surface, points, board, cells.spacing, scene, thickness, settings)[0]
                for board in possible
            ]
            scored.append((max(scores), region))
    scored.sort(key=lambda s: -s[0])
    best = scored[:MAX_CANDIDATES]
    return [region for score, region in best if score >= _MIN_SCORE]


@dataclass(frozen=True, eq=False)
class _MeasuredPatch:
    """A flat region as the board."""

    members: Indices
    """Points on it."""
    rectangle: BoardRectangle
    match: float
    """Score."""


def _measure_patch(
    points: Array,
    cells: Cells,
    region: Indices,
    boards: Sequence[Board],
    thickness: float,
    scene: SceneBeams,
    rng: np.random.Generator,
    settings: DetectionSettings,
) -> _MeasuredPatch | None:
    """The points, rectangle and score of one flat region; cells are of the first of the points."""
    in_region = np.zeros(len(cells.points) + 1, dtype=np.bool_)  # the last one is that of points without a cell
    in_region[region] = True
    chosen = points.take(np.flatnonzero(in_region[cells.cell_of_point]), axis=0)
    surface = _find_consensus_plane(chosen, thickness, rng)
    if surface is None:
        return None
    members = _collect_plane_points(points, cells, region, surface, thickness)
    flat = cells.points[np.unique(cells.cell_of_point[members[members < len(cells.cell_of_point)]])]
    match, rectangle = max(
        (_score_patch(surface, flat, board, cells.spacing, scene, thickness, settings) for board in boards),
        key=lambda matched: matched[0],
    )
    return _MeasuredPatch(members, rectangle, match)


def _fit_patch(
    points: Array, patch: _MeasuredPatch, noise: RangeNoise, settings: DetectionSettings
) -> PlanePatch | None:
    """The patch with the plane fitted to its points away from its outline."""
    rectangle, members = patch.rectangle, patch.members
    interior = members[_select_interior(points[members], rectangle, patch.match, settings.lidar3d.min_points)]
    ranges, directions = to_beams(points[interior])
    fit = fit_plane(ranges, directions, noise.of_beams(ranges, directions), noise.angle, rectangle.surface)
    if fit is None or fit.inliers.sum() < settings.lidar3d.min_points:
        return None
    n, d = fit.parameters[:3], fit.parameters[3]
    center = rectangle.center - (n @ rectangle.center + d) * n
    return PlanePatch(
        fit.parameters, fit.covariance, ranges[fit.inliers], directions[fit.inliers], center, patch.match
    )


# Maximum number of points that RANSAC draws from and scores: the share of inliers is accurate to 2.5 %.
_MAX_RANSAC_POINTS = 400
# Samples of RANSAC: a plane with a third of the points is drawn with 99.9 %.
_RANSAC_SAMPLES = 200


def _find_consensus_plane(points: Array, threshold: float, rng: np.random.Generator) -> Array | None:
    """The plane (4,) with the most inliers among the points (N, 3)."""
    if len(points) > _MAX_RANSAC_POINTS:
        points = points[rng.choice(len(points), _MAX_RANSAC_POINTS, replace=False)]

    def solve(samples: Indices) -> Array:
        chosen = points[samples]
        centre = chosen.mean(axis=1)
        offsets = chosen - centre[:, None]
        values, vectors = np.linalg.eigh(np.einsum("kmi,kmj->kij", offsets, offsets))
        n = np.where(values[:, 1:2] > 1e-12, vectors[..., 0], np.nan)
        return plane.towards_origin(np.column_stack([n, -np.sum(n * centre, axis=1)]))

    def squared_residuals(planes: Array) -> Array:
        return plane.distance(planes, points[None]) ** 2

    consensus = find_consensus(
        np.arange(len(points)), 3, solve, squared_residuals, threshold**2, rng=rng,
        confidence=RANSAC_CONFIDENCE, max_samples=_RANSAC_SAMPLES,
    )  # fmt: skip
    return None if consensus is None else consensus.model


def _collect_plane_points(
    points: Array, cells: Cells, region: Indices, surface: Array, thickness: float
) -> Indices:
    """All points on the plane next to cells of the region, those of edge cells without a normal included."""
    near = np.flatnonzero(np.abs(plane.distance(surface, points)) < thickness)
    around, on_plane = cells.points.take(region, axis=0), points.take(near, axis=0)
    low, high = around.min(axis=0), around.max(axis=0)
    reach = cells.spacing * measure_lengths(on_plane)
    columns = zip(on_plane.T, low, high, strict=True)
    inside = np.flatnonzero(np.all([(x > a - reach) & (x < b + reach) for x, a, b in columns], axis=0))
    reach = reach[inside]
    distance, _ = cKDTree(around, balanced_tree=False).query(
        on_plane.take(inside, axis=0), distance_upper_bound=reach.max(initial=0.0)
    )
    return np.asarray(near[inside[distance < reach]])


# Score from which the fitted rectangle selects the points on the board: below it the fit may be wrong.
_RECTANGLE_SCORE = 0.5
# Points closer to the outline, m, may be mixed pixels of board and background, and are not fitted.
_EDGE_MARGIN = 0.02
# Minimum share of points left by _EDGE_MARGIN; otherwise all are fitted: a patch of few rings is outline.
_MIN_INTERIOR_RATIO = 0.6


def _select_interior(points: Array, rectangle: BoardRectangle, match: float, min_points: int) -> NDArray[np.bool_]:
    """Selects the points (N, 3) inside the patch's outline, with a margin; all if too few would be left."""
    surface = rectangle.surface
    # The intersection of the beam with the plane, not the noisy point: on an inclined board a cut by points would
    # keep the far ones at one edge and the near ones at the other, which rotates the plane.
    # No beam meets a plane through the sensor, as rings have in one azimuth: its points are not finite, and stay.
    with np.errstate(divide="ignore", invalid="ignore"):
        flat = rectangle.coordinates(points * (-surface[3] / (points @ surface[:3]))[:, None])
    kept: NDArray[np.bool_] = np.ones(len(flat), dtype=np.bool_)
    if match > _RECTANGLE_SCORE:
        # The rectangle excludes stand and arms.
        kept = np.asarray(np.all(np.abs(flat) < 0.5 * np.array(rectangle.size), axis=1), dtype=np.bool_)
    try:
        hull = ConvexHull(flat[kept])
    except (QhullError, ValueError):
        return kept
    depth = np.max(hull.equations[:, :2] @ flat.T + hull.equations[:, 2:], axis=0)
    clear: NDArray[np.bool_] = np.asarray(kept & (depth < -_EDGE_MARGIN), dtype=np.bool_)
    return clear if clear.sum() > max(min_points, _MIN_INTERIOR_RATIO * kept.sum()) else kept


# Reach of a cell on the plane, in spacings of cells: half of its footprint, and a tenth.
_FOOTPRINT_REACH = 0.6
# Minimum cosine of incidence (73°) in the footprint of a cell: flatter, footprints overlap their neighbours.
_MIN_FOOTPRINT_COSINE = 0.3
# Maximum reach over the shorter side of the board: farther, single cells would cover it.
_MAX_REACH_RATIO = 0.25
# Minimum width of the frame around a board that must be empty, in spacings of cells: it contains a cell.
_MIN_FRAME_CELLS = 1.5
# Cells across the shorter side from which the score is not reduced: a few cells fit any outline, as of far walls.
_RESOLVED_CELLS = 4.0


def _score_patch(
    surface: Array,
    cells: Array,
    board: Board,
    spacing: float,
    scene: SceneBeams,
    thickness: float,
    settings: DetectionSettings,
) -> tuple[float, BoardRectangle]:
    """Score, 0 to 1, of a patch as the board, and the rectangle of the board in it."""
    centre = cells.mean(axis=0)
    step = spacing * float(np.linalg.norm(centre))
    cosine = abs(float(surface[:3] @ centre)) / float(np.linalg.norm(centre))
    footprint = _FOOTPRINT_REACH * step / max(cosine, _MIN_FOOTPRINT_COSINE)
    reach = min(footprint, _MAX_REACH_RATIO * min(board.size))
    rectangle = fit_rectangle(surface, cells, board.size, reach, OUTLINE_BLUR)
    if rectangle.covered * rectangle.contained < _MIN_SCORE:
        return 0.0, rectangle
    frame = max(SURROUNDINGS, _MIN_FRAME_CELLS * step)
    solidity, isolation = measure_solidity_and_isolation(rectangle, scene, thickness, frame, settings)
    resolution = min(1.0, min(board.size) / (_RESOLVED_CELLS * step))
    return rectangle.covered * rectangle.contained * solidity * isolation * resolution, rectangle


def _measure_extent(points: Array) -> tuple[float, float]:
    """Length and width of a flat set of points along its principal axes, m."""
    centred = points - points.mean(axis=0)
    _, vectors = np.linalg.eigh(centred.T @ centred)
    spans = np.ptp(centred @ vectors, axis=0)
    return float(spans[2]), float(spans[1])


# Maximum length of a region over the diagonal of the board: stand and arms add to it; longer ones are walls.
_MAX_PATCH_LENGTH_RATIO = 1.5
# Minimum length of a region over the shorter side of the board, less one spacing of cells: half of a board that
# is partly hidden. Smaller regions are not scored, which saves time.
_MIN_PATCH_LENGTH_RATIO = 0.5
# The same of its width: less, as few rings across a board hold only a part of it.
_MIN_PATCH_WIDTH_RATIO = 0.25
# Minimum shorter side of the board, in spacings of cells at a region: with fewer cells across it, the outline is
# not measured.
_MIN_PATCH_CELLS = 2.0


def _has_plausible_size(points: Array, board: Board, spacing: float) -> bool:
    """Whether a region may be a board, by wide limits that save the time of scoring walls and small objects."""
    length, width = _measure_extent(points)
    step = spacing * float(np.linalg.norm(points.mean(axis=0)))
    short, diagonal = min(board.size), float(np.hypot(*board.size))
    return (
        length < _MAX_PATCH_LENGTH_RATIO * diagonal
        and length > _MIN_PATCH_LENGTH_RATIO * short - step
        and width > _MIN_PATCH_WIDTH_RATIO * short - step
        and step < short / _MIN_PATCH_CELLS
    )


def _explain_no_match(cells: Cells, regions: Sequence[Indices], boards: Sequence[Board]) -> Rejected:
    extents = [_measure_extent(cells.points[region]) for region in regions]
    length, width = max(extents, key=lambda e: e[0] * e[1])
    sizes = " or ".join(f"{b.size[0]:g} x {b.size[1]:g} m" for b in boards)
    return Rejected(
        f"no flat patch has a board's size: the largest is {length:.2f} x {width:.2f} m, the board is {sizes}"
    )


@dataclass(frozen=True, eq=False)
class _ScanLines:
    """The beams of one sweep in scan order. Sweeps have the same beams: one shows all edges."""

    ranges: Array
    """(N,) m."""
    directions: Array
    """(N, 3) unit vectors."""
    scan_line: Indices
    """(N,) scan line of each."""
    parallax: float
    """Error of directions, as beams do not start in the sensor's origin, rad."""


# Error of directions to the background for clouds without rings, rad: beams of spinning 2-D scanners start up to
# some centimetres from the origin, and pass the board at one metre and more.
_PARALLAX = 0.03


def _order_by_scan_line(cloud: PointCloud, ranges: Array, settings: DetectionSettings) -> _ScanLines:
    """Rings, each by azimuth; without rings, points as they were sent, which is as they were measured."""
    order = np.flatnonzero(ranges > settings.lidar3d.min_range)
    scan_line, parallax = np.zeros(len(order), dtype=np.intp), _PARALLAX
    if cloud.rings is not None:
        x, y, _ = cloud.points.take(order, axis=0).T
        order = order[np.lexsort([np.arctan2(y, x), cloud.rings[order]])]
        scan_line, parallax = cloud.rings[order].astype(np.intp), 0.0
    ranges = ranges[order]
    return _ScanLines(ranges, cloud.points.take(order, axis=0) / ranges[:, None], scan_line, parallax)


def _find_edges(
    lines: _ScanLines, patch: PlanePatch, thickness: float, radius: float, settings: DetectionSettings
) -> Array:
    """(M, 2, 3) edges of the patch within ``radius`` of its centre."""
    n, d = patch.plane[:3], patch.plane[3]
    cosine, along = -(lines.directions @ n), lines.directions @ patch.center
    distance = float(np.linalg.norm(patch.center))

    def predict(beams: Indices) -> Array:
        """Ranges of some beams to the plane."""
        facing = cosine[beams]
        return np.where(facing > MIN_COSINE, d / np.maximum(facing, MIN_COSINE), np.inf)

    # Other beams do not pass the centre within the radius.
    least = np.sqrt(distance**2 - radius**2) - _ROUNDING if distance > radius else -np.inf
    passing = np.flatnonzero(along > least)
    bounded = np.minimum(predict(passing), distance + 2 * radius)
    # Squared distance from the centre to the intersection with the plane.
    squared = bounded**2 - 2 * bounded * along[passing] + distance**2
    within = np.zeros(len(along), dtype=np.bool_)
    within[passing[squared < radius**2]] = True
    if not within.any():
        return np.empty((0, 2, 3))
    near = select_beams_with_margin(within)
    # Beams of a scan line that are not consecutive are different scan lines.
    ends = (np.diff(lines.scan_line[near]) != 0) | (np.diff(near) != 1)
    scan_line = np.append(0, np.cumsum(ends))
    excess = lines.ranges[near] - predict(near)
    return find_board_edges(lines.directions[near], excess, scan_line, thickness, settings.scanner, lines.parallax)


def _drop_repeated_points(cloud: PointCloud) -> PointCloud:
    """Leaves out points that a cloud contains already, as of LiDARs whose strongest return is the last one, too.

    They are the same measurement: counted twice, they would decrease the standard deviations.
    """
    sums = cloud.points @ _IRRATIONAL
    ordered = np.sort(sums)  # np.unique takes several times as long
    if np.all(ordered[1:] != ordered[:-1]):
        return cloud
    kept = np.sort(np.unique(sums, return_index=True)[1])
    rings = None if cloud.rings is None else cloud.rings[kept]
    times = None if cloud.times is None else cloud.times[kept]
    return replace(cloud, points=cloud.points[kept], rings=rings, times=times)
