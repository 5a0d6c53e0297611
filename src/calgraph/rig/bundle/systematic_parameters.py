"""Systematic errors of sensors and boards, which every bundle estimates with the priors of rig.yaml.

What the data do not determine, the prior does: its standard deviation is part of the covariance of all poses.
"""

import math
from collections.abc import Hashable, Iterator, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from calgraph.boards.printed_boards import compute_landmarks
from calgraph.config import Board, CameraSpec, Lidar2dSpec, Lidar2dUncertainty, Lidar3dUncertainty, Rig, SensorSpec
from calgraph.geometry import Array, Index
from calgraph.result import EstimatedParameter
from calgraph.rig.bundle.bundle_parameters import SystematicParameter
from calgraph.rig.bundle.bundle_solver import Bundle, BundleEquations, BundleState
from calgraph.rig.bundle.corner_observations import TIME_PARAMETERS, CornerObservations, PrintedCorners
from calgraph.rig.bundle.covariances import parameter_covariance
from calgraph.rig.bundle.observations import BoardViews, view_indices
from calgraph.rig.bundle.outline_observations import FOOTPRINTS, OutlineObservations
from calgraph.rig.bundle.range_observations import RangeObservations, bow_shape
from calgraph.rig.bundle.residual_distortion import ResidualDistortion
from calgraph.sensors import DISTORTION_NAMES, CameraModel
from calgraph.sensors.kinds.stated import RangeUncertainty

_ESTIMATED_COEFFICIENTS = {"pinhole": 5, "fisheye": 4}
"""Number of estimated distortion coefficients: those of the denominator of a rational model, which come after
these, have nearly the same effect."""

_PRINT_SCALE = "print scale"
RESIDUAL_DISTORTION = "residual distortion"
"""First words of the quantities of its coefficients."""


@dataclass(frozen=True)
class _Candidate:
    """A systematic parameter, before the views that depend on it are known."""

    of: str
    quantity: str
    unit: str
    prior_stddev: float
    stated: float = 0.0
    scale: float = 1.0


@dataclass
class ParameterTable:
    """The systematic parameters of a bundle while its views are given theirs."""

    parameters: list[SystematicParameter] = field(default_factory=list)
    _number: dict[Hashable, int] = field(default_factory=dict)

    @classmethod
    def of_bundle(cls, parameters: Sequence[SystematicParameter]) -> "ParameterTable":
        """The table of a bundle's parameters, to which others are added."""
        return cls(list(parameters), {(one.of, one.quantity): i for i, one in enumerate(parameters)})

    def index_extra(
        self, view_set: int, candidates: Sequence[Sequence[_Candidate | None]], board: Index
    ) -> tuple[Index, int]:
        """Numbers the parameters of a set of views.

        Args:
            view_set: index of the views in the bundle.
            candidates: of each kind of board the local parameters; None for those that do not exist.
            board: (V,) index of each view's kind of board; -1 for the last.

        Returns:
            ``extra_of_local`` (V, m) and the number of extra parameters.
        """
        rows = np.full((len(candidates), len(candidates[0])), -1, dtype=np.intp)
        for b in np.unique(board):
            rows[b] = [self._add(one, view_set) for one in candidates[b]]
        of_view = rows[board].reshape(len(board), rows.shape[1])
        used = np.array([i for i, one in enumerate(self.parameters) if view_set in one.view_sets], dtype=np.intp)
        return np.where(of_view < 0, -1, np.searchsorted(used, of_view)), len(used)

    def _add(self, one: _Candidate | None, view_set: int) -> int:
        """The number of a parameter of these views; -1 for one that is exact."""
        if one is None or one.prior_stddev == 0:
            return -1
        number = self._number.setdefault((one.of, one.quantity), len(self.parameters))
        if number == len(self.parameters):
            self.parameters.append(
                SystematicParameter(one.of, one.quantity, one.unit, one.prior_stddev, (), one.stated, one.scale)
            )
        before = self.parameters[number]
        if view_set not in before.view_sets:
            self.parameters[number] = replace(before, view_sets=(*before.view_sets, view_set))
        return number


def add_systematic_parameters(
    bundle: Bundle, state: BundleState, rig: Rig, board_number: Index
) -> tuple[Bundle, BundleState]:
    """The bundle with the systematic parameters of all sensors and boards.

    Args:
        bundle: without systematic parameters and outlines.
        state: its start values.
        rig: with the prior standard deviations; 0 means exact.
        board_number: (C,) index of the rig's board of each observed board; -1 where no camera identified it.
    """
    table = ParameterTable()
    all_views: list[BoardViews] = []
    prints = [_print_of(board, i, len(rig.boards)) for i, board in enumerate(rig.boards)]
    for k, (name, views) in enumerate(zip(bundle.sensors, bundle.views, strict=True)):
        spec, number = rig.sensors[name], board_number[views.board]
        if isinstance(views, CornerObservations):
            assert isinstance(spec, CameraSpec)
            all_views.append(_add_to_camera(table, k, name, views, spec, prints, number))
        else:
            assert isinstance(views, RangeObservations)
            assert not isinstance(spec, CameraSpec)
            all_views.append(_add_to_scanner(table, k, name, views, spec, rig, number))
    extended = replace(bundle, views=tuple(all_views), extra_parameters=tuple(table.parameters))
    return extended, replace(state, extra=np.zeros(len(table.parameters)))


# Prior standard deviation of the offset by which a scanner measures sides too far out: half the footprint of a
# beam of 3 mrad at 6 m.
_OFFSET_STDDEV = 0.01


def add_outline_parameters(
    bundle: Bundle, outlines: Sequence[OutlineObservations], scanners: Sequence[int], rig: Rig, board_number: Index
) -> tuple[list[OutlineObservations], tuple[SystematicParameter, ...]]:
    """Outlines with their systematic parameters, and those of the bundle and of the outlines.

    Args:
        bundle: without outlines.
        outlines: of each scanner.
        scanners: index of the sensor of each.
        rig: with the prior standard deviations of boards.
        board_number: (C,) as of :func:`add_systematic_parameters`; -1 where the print does not define the pose.
    """
    table = ParameterTable.of_bundle(bundle.extra_parameters)
    found = []
    for i, (outline, sensor) in enumerate(zip(outlines, scanners, strict=True)):
        footprints: list[_Candidate | None] = [
            _Candidate(bundle.sensors[sensor], quantity, "m", _OFFSET_STDDEV) for quantity in FOOTPRINTS
        ]
        azimuths: _Candidate | None = None
        if isinstance(spec := rig.sensors[bundle.sensors[sensor]], Lidar2dSpec):
            footprints[1] = None
            azimuths = _Candidate(bundle.sensors[sensor], "angle scale", "", spec.uncertainty.angle_scale, 1.0)
        of_boards: list[list[_Candidate | None]] = []
        for b, board in enumerate(rig.boards):
            name, prior = board_name(b, len(rig.boards)), board.uncertainty
            size = [
                _Candidate(name, quantity, "m", prior.size, stated)
                for quantity, stated in zip(("width", "height"), board.size, strict=True)
            ]
            of_boards.append([*size, *_print_position(name, board), azimuths, *footprints])
        # A board that no camera identified has its only outline, and no print.
        of_boards.append([*of_boards[0][:2], None, None, None, azimuths, *footprints])
        extra_of_local, count = table.index_extra(len(bundle.views) + i, of_boards, board_number[outline.board])
        found.append(replace(outline, extra_of_local=extra_of_local, extra_count=count))
    return found, tuple(table.parameters)


def summarize_systematic_parameters(
    bundle: Bundle, state: BundleState, equations: BundleEquations
) -> tuple[EstimatedParameter, ...]:
    """The systematic parameters with their priors and posterior standard deviations."""
    variances = np.diag(parameter_covariance(equations))[6 * bundle.body_count :]
    return tuple(
        EstimatedParameter(
            of=one.of,
            quantity=one.quantity,
            unit=one.unit,
            stated=one.stated,
            prior=one.prior_stddev * abs(one.scale),
            value=one.stated + one.scale * float(value),
            stddev=float(np.sqrt(variance)) * abs(one.scale),
        )
        for one, value, variance in zip(bundle.extra_parameters, state.extra, variances, strict=True)
        if not one.quantity.startswith(RESIDUAL_DISTORTION)
    )


def board_name(number: int, count: int) -> str:
    """What a board of the rig is called."""
    return f"board {number + 1}" if count > 1 else "board"


def _add_to_camera(
    table: ParameterTable,
    k: int,
    name: str,
    views: CornerObservations,
    spec: CameraSpec,
    prints: Sequence["_Print"],
    number: Index,
) -> CornerObservations:
    camera = _with_estimated_distortion(views.camera)
    lens: list[_Candidate | None] = list(_lens_parameters(name, camera, spec))
    corner_number = number[view_indices(views.start, len(views.pixels))]
    behind = np.unique(corner_number[views.printed.on_back])
    prints = [replace(one, on_back=b in behind) for b, one in enumerate(prints)]
    most_tags = max((len(one.placed_tags) or one.on_back for one in prints), default=0)
    # A board at rest is the same at all times.
    timed = len(views.twist) > 0
    of_times = [_stamp_delay(k, name, spec), _readout_time(name, spec)] if timed else []
    # Of lenses whose intrinsics were estimated; others, and those like their models, have none.
    size = spec.stated_intrinsics.model_error if spec.stated_intrinsics else None
    field = ResidualDistortion.over_images(camera) if size else None
    coefficients = [
        _Candidate(name, f"{RESIDUAL_DISTORTION} {i + 1}", "px", stddev)
        for i, stddev in enumerate((size * field.stddev).tolist() if size and field else ())
    ]
    candidates = [[*lens, *one.parameters(most_tags), *of_times, *coefficients] for one in prints]
    extra_of_local, count = table.index_extra(k, candidates, number)
    printed = _locate_corners(views.printed, corner_number, prints)
    return replace(
        views, camera=camera, printed=printed, extra_of_local=extra_of_local, extra_count=count, timed=timed,
        residual_distortion=field,
    )  # fmt: skip


def _stamp_delay(k: int, name: str, spec: SensorSpec) -> _Candidate | None:
    """That of sensor k; delays are relative to the root's, as a common one is a displacement of all boards."""
    return _Candidate(name, TIME_PARAMETERS[0], "s", spec.uncertainty.stamp_delay) if k else None


def _readout_time(name: str, spec: CameraSpec) -> _Candidate:
    return _Candidate(name, TIME_PARAMETERS[1], "s", spec.uncertainty.readout_time)


def _lens_parameters(name: str, camera: CameraModel, spec: CameraSpec) -> Iterator[_Candidate | None]:
    prior = spec.uncertainty
    fx, fy = camera.focal.tolist()
    mean = (fx + fy) / 2
    yield _Candidate(name, "focal length", "px", prior.focal_length, mean, mean)
    yield _Candidate(name, "pixel aspect", "", prior.pixel_aspect, fx / fy, fx / fy)
    for quantity, stated in zip(("cx", "cy"), camera.principal_point.tolist(), strict=True):
        yield _Candidate(name, quantity, "px", prior.principal_point, stated)
    effect = _displacement_at_corner(camera)
    estimated = _ESTIMATED_COEFFICIENTS[camera.model]
    for i, (quantity, stated) in enumerate(zip(DISTORTION_NAMES[camera.model], camera.distortion, strict=False)):
        yield _Candidate(name, quantity, "", prior.distortion / effect[i], stated) if i < estimated else None


def _with_estimated_distortion(camera: CameraModel) -> CameraModel:
    """The camera with zeros for the coefficients that it does not state."""
    missing = max(_ESTIMATED_COEFFICIENTS[camera.model] - len(camera.distortion), 0)
    return replace(camera, distortion=np.append(camera.distortion, np.zeros(missing)))


def _displacement_at_corner(camera: CameraModel) -> Array:
    """(n,) displacement of the pixel at a corner of the image by one unit of each distortion coefficient, px."""
    size = np.array([camera.width, camera.height], dtype=np.float64)
    corner = np.where(camera.principal_point > size / 2, 0.0, size)
    # A model may end within the image: the farthest valid pixel towards the corner counts.
    share = np.linspace(1.0, 0.1, 19)[:, None]
    rays = camera.rays(camera.principal_point + share * (corner - camera.principal_point))
    valid = rays[np.isfinite(rays).all(axis=-1)]
    if not len(valid):
        return np.ones(len(camera.distortion))
    return np.asarray(np.linalg.norm(camera.project_by_intrinsics(valid[:1])[0, :, 4:], axis=0))


# Usual thickness of a board with a print on either side, m: panels are 2 to 6 mm thick, films less.
_THICKNESS = 0.003
# Prior standard deviation of the thickness, m: zero and 6 mm are 1.5 of it away.
_THICKNESS_STDDEV = 0.002


@dataclass(frozen=True, eq=False)
class _Print:
    """What is printed on a board, and its systematic parameters."""

    name: str
    board: Board
    tags: tuple[tuple[int, Array], ...]
    """Id and corners (4, 3) of each tag."""
    on_back: bool = False
    """Whether a camera detects a print on the back, of no placed tags."""

    @property
    def placed_tags(self) -> tuple[tuple[int, Array], ...]:
        """The tags, if each was placed by itself; those of a grid are one print."""
        return self.tags if self.board.tags else ()

    def parameters(self, most_tags: int) -> Iterator[_Candidate | None]:
        """In the order of a corner's local parameters, for up to ``most_tags`` tags."""
        prior, several = self.board.uncertainty, len(self.tags) > 1
        placed = self.placed_tags if several else ()
        yield _Candidate(self.name, _PRINT_SCALE, "", prior.print_scale, 1.0)
        yield _Candidate(self.name, "print aspect", "", prior.print_aspect, 1.0)
        # A single tag defines the board's frame and scale: it has no other tags to disagree with.
        yield _Candidate(self.name, "tag size", "", prior.tag_size, 1.0) if several else None
        yield from _bow_parameters(self.name, self.board)
        yield _Candidate(self.name, "thickness", "m", _THICKNESS_STDDEV, _THICKNESS) if self.on_back else None
        if self.on_back:
            # It is glued on to the edge of the board as the print on the front is.
            yield from _print_position(self.name, self.board, "print on the back", math.sqrt(2))
        for i in range(int(self.on_back), most_tags):
            if i >= len(placed):
                yield from (None, None, None)
                continue
            number, corners = placed[i]
            tag = f"tag {number}" if self.name == "board" else f"tag {number} of {self.name}"
            arm = float(np.linalg.norm(corners[0] - corners[1])) / 2
            yield _Candidate(tag, "x", "m", prior.tag_position)
            yield _Candidate(tag, "y", "m", prior.tag_position)
            yield _Candidate(tag, "rotation", "rad", prior.tag_position / arm)


def _print_of(board: Board, number: int, count: int) -> _Print:
    marks = compute_landmarks(board)
    tags = zip(marks.ids.tolist(), marks.corners, strict=True) if marks.corners.shape[1] == 4 else ()
    return _Print(board_name(number, count), board, tuple(tags))


def _bow_parameters(name: str, board: Board) -> Iterator[_Candidate]:
    yield _Candidate(name, "bow along x", "m", board.uncertainty.bow)
    yield _Candidate(name, "bow along y", "m", board.uncertainty.bow)


def _print_position(name: str, board: Board, of: str = "print", factor: float = 1.0) -> Iterator[_Candidate]:
    prior = factor * board.uncertainty.print_position
    yield _Candidate(name, f"{of} x", "m", prior)
    yield _Candidate(name, f"{of} y", "m", prior)
    yield _Candidate(name, f"{of} rotation", "rad", prior / (0.5 * max(board.size)))


def _locate_corners(printed: PrintedCorners, number: Index, prints: Sequence[_Print]) -> PrintedCorners:
    """Corners (N,) of boards (N,) with their tags and places on the board."""
    nominal = printed.nominal + printed.height_shape * [0.0, 0.0, _THICKNESS]
    places = {
        (b, *corner.tolist()): (i if one.placed_tags else -1, corners.mean(axis=0)[:2])
        for b, one in enumerate(prints)
        for i, (_, corners) in enumerate(one.tags)
        for corner in corners
    }
    center, tag = nominal[:, :2].copy(), np.full(len(nominal), -1, dtype=np.intp)
    for n, (b, corner) in enumerate(zip(number.tolist(), nominal.tolist(), strict=True)):
        if (b, *corner) in places:
            tag[n], center[n] = places[b, *corner]
    center[printed.on_back], tag[printed.on_back] = 0.0, 0
    half = np.array([one.board.size for one in prints])[number] / 2
    shape = np.column_stack([bow_shape(nominal[:, :2], half.reshape(-1, 2)), printed.height_shape[:, 2]])
    return PrintedCorners(nominal, center, tag, shape)


def _add_to_scanner(
    table: ParameterTable, k: int, name: str, views: RangeObservations, spec: SensorSpec, rig: Rig, number: Index
) -> RangeObservations:
    prior = spec.uncertainty
    assert isinstance(prior, RangeUncertainty)
    shared: list[_Candidate | None] = [
        _Candidate(name, "range bias", "m", prior.range_bias),
        _Candidate(name, "range scale", "", prior.range_scale, 1.0),
    ]
    last: list[_Candidate | None] = []
    timed = len(views.twist) > 0
    delay = [_stamp_delay(k, name, spec)] if timed else []
    if isinstance(prior, Lidar2dUncertainty):
        views = replace(views, azimuth=np.arctan2(views.directions[:, 1], views.directions[:, 0]))
        last = [_Candidate(name, "angle scale", "", prior.angle_scale, 1.0), *delay]
    elif shapes := prior.error_shapes():
        views = replace(views, shapes=views.noise.error_shapes(views.ranges, views.directions))
        last = [*(_Candidate(name, quantity, "m", stddev) for quantity, stddev in shapes), *delay]
    else:
        last = [*delay]
        elevations, ring = find_rings(views.directions)
        if len(elevations) and isinstance(prior, Lidar3dUncertainty):
            views = views.with_rings(ring, len(elevations))
            last += [
                _Candidate(name, f"bias of ring {i + 1} ({np.degrees(e):+.1f}°)", "m", prior.ring_bias)
                for i, e in enumerate(elevations)
            ]
    bows = [list(_bow_parameters(board_name(b, len(rig.boards)), board)) for b, board in enumerate(rig.boards)]
    # The last row is of boards that no camera identified: of several, it is not known which one each is.
    size, bow = (rig.boards[0].size, bows[0]) if len(bows) == 1 else ((np.inf, np.inf), (None, None))
    candidates = [[*shared, *of_board, *last] for of_board in (*bows, bow)]
    extra_of_local, count = table.index_extra(k, candidates, number)
    half = np.array([*(board.size for board in rig.boards), size])[number].reshape(-1, 2) / 2
    views = replace(views, half_size=half, registered=number >= 0, timed=timed)
    return replace(views, extra_of_local=extra_of_local, extra_count=count)


# Minimum gap between the elevations of two rings of a 3-D scanner, rad (0.1°): the closest rings of scanners with
# 128 of them are 0.11° apart, and the elevations of one ring have no gaps.
_MIN_RING_GAP = math.radians(0.1)
# Maximum number of ring biases of a scanner; neighbouring rings of scanners with more share one. The mean bias of
# m rings is smaller by the root of m, and the time of a solution grows with the square of the number.
_MAX_RINGS = 32


def find_rings(directions: Array) -> tuple[Array, Index]:
    """Rings of a multi-beam scanner, by their elevations.

    Args:
        directions: (N, 3) unit vectors of beams, sensor frame.

    Returns:
        Mean elevations (R,) of the rings, rad, ascending, and the ring (N,) of each beam; none where elevations
        have no gaps, as those of scanners without rings.
    """
    elevation = np.arcsin(np.clip(directions[:, 2], -1, 1))
    order = np.argsort(elevation)
    first = np.diff(elevation[order], prepend=-np.inf) > _MIN_RING_GAP
    ring = np.empty(len(order), dtype=np.intp)
    ring[order] = np.cumsum(first) - 1
    count = int(first.sum())
    if count < 2:
        return np.zeros(0), np.zeros(len(directions), dtype=np.intp)
    if count > _MAX_RINGS:
        ring, count = ring * _MAX_RINGS // count, _MAX_RINGS
    return np.bincount(ring, elevation, count) / np.bincount(ring, minlength=count), ring
