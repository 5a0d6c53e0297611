"""Systematic errors of sensors and boards, which every bundle estimates with the priors of rig.yaml.

What the data do not determine, the prior does: its standard deviation is part of the covariance of all poses.
"""

import math
from collections.abc import Hashable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import chain

import numpy as np

from calgraph.boards.printed_boards import compute_landmarks
from calgraph.config import Board, CameraSpec, Lidar2dSpec, Lidar3dUncertainty, Rig, SensorSpec
from calgraph.geometry import Array, Index
from calgraph.result import EstimatedParameter
from calgraph.rig.bundle.bundle_parameters import LocalParameters, SystematicParameter
from calgraph.rig.bundle.bundle_solver import Bundle, BundleEquations, BundleState
from calgraph.rig.bundle.corner_observations import CornerObservations, PrintedCorners
from calgraph.rig.bundle.observations import BoardViews, view_indices
from calgraph.rig.bundle.outline_observations import FOOTPRINTS, OutlineObservations
from calgraph.rig.bundle.range_observations import RangeObservations, bow_shape
from calgraph.rig.bundle.residual_distortion import ResidualDistortion
from calgraph.sensors import CameraModel
from calgraph.sensors.kinds.stated import BeamError, RangeUncertainty
from calgraph.sensors.lens_errors import ESTIMATED_COEFFICIENTS, with_estimated_distortion
from calgraph.verdict.lens_parameters import list_lens_errors, readout_error

DISTORTION, RESIDUAL_DISTORTION, RINGS, TAGS = "distortion", "residual distortion", "rings", "tags"
"""Families of parameters, see :class:`SystematicParameter`."""
COEFFICIENTS = frozenset({DISTORTION, RESIDUAL_DISTORTION})
"""Those of parameters that have a meaning together only."""
_EDGES = "edges of the board in scans of {of} are {size} too far out|in"


_Blocks = Mapping[str, Sequence[SystematicParameter | None]]
"""Systematic parameters before their views are known, by the names of their blocks; None for those left out."""


@dataclass
class ParameterTable:
    """The systematic parameters of a bundle while its views are given theirs."""

    parameters: list[SystematicParameter] = field(default_factory=list)
    _number: dict[Hashable, int] = field(default_factory=dict)

    @classmethod
    def of_bundle(cls, parameters: Sequence[SystematicParameter]) -> "ParameterTable":
        """The table of a bundle's parameters, to which others are added."""
        return cls(list(parameters), {(one.of, one.quantity): i for i, one in enumerate(parameters)})

    def assign(self, view_set: int, candidates: Sequence[_Blocks], board: Index) -> LocalParameters:
        """The local parameters of a set of views.

        Args:
            view_set: index of the views in the bundle.
            candidates: of each kind of board, in blocks of the same sizes.
            board: (V,) index of each view's kind of board; -1 for the last.
        """
        none = LocalParameters.exact(len(board), {name: len(block) for name, block in candidates[0].items()})
        rows = np.full((len(candidates), none.index.shape[1]), -1, dtype=np.intp)
        for b in np.unique(board):
            rows[b] = [self._add(one, view_set) for one in chain(*candidates[b].values())]
        of_view = rows[board].reshape(none.index.shape)
        used = np.array([i for i, one in enumerate(self.parameters) if view_set in one.view_sets], dtype=np.intp)
        index = np.where(of_view < 0, -1, np.searchsorted(used, of_view))
        return replace(none, index=index, count=len(used))

    def _add(self, one: SystematicParameter | None, view_set: int) -> int:
        """The number of a parameter of these views; -1 for one that is exact."""
        if one is None or one.prior_stddev == 0:
            return -1
        number = self._number.setdefault((one.of, one.quantity), len(self.parameters))
        if number == len(self.parameters):
            self.parameters.append(one)
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
    prints = [_print_of(board, of) for of, board in name_boards(rig)]
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
        name, spec = bundle.sensors[sensor], rig.sensors[bundle.sensors[sensor]]
        assert isinstance(spec.uncertainty, RangeUncertainty)
        turns = tuple(error for error in spec.uncertainty.beam_errors() if error.turn)
        own: _Blocks = {
            "beams": [_error_of(name, error) for error in turns],
            "varying": [
                SystematicParameter(name, quantity, "m", _OFFSET_STDDEV, clause=_EDGES)
                if quantity == FOOTPRINTS[0] or not isinstance(spec, Lidar2dSpec)
                else None
                for quantity in FOOTPRINTS
            ],
        }
        of_boards: list[_Blocks] = [
            {"size": list(_sizes(of, board)), "print": list(_print_position(of, board)), **own}
            for of, board in name_boards(rig)
        ]
        # A board that no camera identified has its only outline, and no print.
        of_boards.append({**of_boards[0], "print": [None, None, None]})
        parameters = table.assign(len(bundle.views) + i, of_boards, board_number[outline.board])
        found.append(replace(outline, turns=turns, parameters=parameters))
    return found, tuple(table.parameters)


def summarize_systematic_parameters(
    bundle: Bundle, state: BundleState, equations: BundleEquations
) -> tuple[EstimatedParameter, ...]:
    """The systematic parameters with their priors and posterior standard deviations."""
    variances = np.diag(equations.covariance)[6 * bundle.body_count :]
    return tuple(
        one.estimate(float(value), float(np.sqrt(variance)))
        for one, value, variance in zip(bundle.extra_parameters, state.extra, variances, strict=True)
        if one.family != RESIDUAL_DISTORTION
    )


def board_name(number: int, count: int) -> str:
    """What a board of the rig is called."""
    return f"board {number + 1}" if count > 1 else "board"


def name_boards(rig: Rig) -> list[tuple[str, Board]]:
    """The boards with what they are called."""
    return [(board_name(b, len(rig.boards)), board) for b, board in enumerate(rig.boards)]


def _add_to_camera(
    table: ParameterTable,
    k: int,
    name: str,
    views: CornerObservations,
    spec: CameraSpec,
    prints: Sequence["_Print"],
    number: Index,
) -> CornerObservations:
    camera = with_estimated_distortion(views.camera)
    corner_number = number[view_indices(views.start, len(views.pixels))]
    behind = np.unique(corner_number[views.printed.on_back])
    prints = [replace(one, on_back=b in behind) for b, one in enumerate(prints)]
    most_tags = max((len(one.placed_tags) or one.on_back for one in prints), default=0)
    readout = SystematicParameter(**vars(readout_error(name, spec.uncertainty)))
    # A board at rest is the same at all times.
    of_times = [_stamp_delay(k, name, spec), readout] if len(views.twist) else []
    # Of lenses whose intrinsics were estimated; others, and those like their models, have none.
    size = spec.stated_intrinsics.model_error if spec.stated_intrinsics else None
    field = ResidualDistortion.over_images(camera) if size else None
    coefficients = [
        SystematicParameter(name, f"{RESIDUAL_DISTORTION} {i + 1}", "px", stddev, family=RESIDUAL_DISTORTION)
        for i, stddev in enumerate((size * field.stddev).tolist() if size and field else ())
    ]
    lens = list(_lens_parameters(name, camera, spec))
    candidates: list[_Blocks] = [
        {
            "lens": lens,
            "print": list(one.parameters()),
            "tags": list(one.places_of_tags(most_tags)),
            "times": of_times,
            "residual distortion": coefficients,
        }
        for one in prints
    ]
    parameters = table.assign(k, candidates, number)
    printed = _locate_corners(views.printed, corner_number, prints)
    return replace(views, camera=camera, printed=printed, parameters=parameters, residual_distortion=field)


def _stamp_delay(k: int, name: str, spec: SensorSpec) -> SystematicParameter | None:
    """That of sensor k; delays are relative to the root's, as a common one is a displacement of all boards."""
    clause = "{of} measures {size} later|earlier than its stamps state"
    delay = SystematicParameter(name, "stamp delay", "s", spec.uncertainty.stamp_delay, clause=clause)
    return delay if k else None


def _lens_parameters(name: str, camera: CameraModel, spec: CameraSpec) -> Iterator[SystematicParameter | None]:
    estimated = 4 + ESTIMATED_COEFFICIENTS[camera.model]
    for i, one in enumerate(list_lens_errors(name, camera, spec.uncertainty)):
        yield SystematicParameter(**vars(one), family=DISTORTION if i >= 4 else "") if i < estimated else None


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

    def parameters(self) -> Iterator[SystematicParameter | None]:
        """In the order in which :meth:`PrintedCorners.displace` takes them."""
        prior, several = self.board.uncertainty, len(self.tags) > 1
        yield SystematicParameter(
            self.name, "print scale", "", prior.print_scale, stated=1.0,
            clause="the print on the {of} is {size} larger|smaller than stated",
        )  # fmt: skip
        yield SystematicParameter(
            self.name, "print aspect", "", prior.print_aspect, stated=1.0,
            clause="the print on the {of} is {size} wider|narrower for its height than stated",
        )  # fmt: skip
        size = SystematicParameter(
            self.name, "tag size", "", prior.tag_size, stated=1.0,
            clause="tags on the {of} are {size} larger|smaller than stated",
        )  # fmt: skip
        # A single tag defines the board's frame and scale: it has no other tags to disagree with.
        yield size if several else None
        yield from _bow_parameters(self.name, self.board)
        thickness = SystematicParameter(self.name, "thickness", "m", _THICKNESS_STDDEV, stated=_THICKNESS)
        yield thickness if self.on_back else None

    def places_of_tags(self, most_tags: int) -> Iterator[SystematicParameter | None]:
        """Places x, y and rotation of each of ``most_tags`` tags at most; a print on the back counts as one."""
        placed = self.placed_tags if len(self.tags) > 1 else ()
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
            stddev = self.board.uncertainty.tag_position
            yield from _place(tag, "", stddev, stddev / arm, "{of}", TAGS)


def _print_of(board: Board, name: str) -> _Print:
    marks = compute_landmarks(board)
    tags = zip(marks.ids.tolist(), marks.corners, strict=True) if marks.corners.shape[1] == 4 else ()
    return _Print(name, board, tuple(tags))


def _bow_parameters(name: str, board: Board) -> Iterator[SystematicParameter]:
    for axis in "xy":
        clause = f"the {{of}} is bent by {{size}} along {axis}"
        yield SystematicParameter(name, f"bow along {axis}", "m", board.uncertainty.bow, clause=clause)
    clause = "the corners of the {of} are twisted by {size}"
    yield SystematicParameter(name, "twist", "m", board.uncertainty.bow, clause=clause)


def _print_position(
    name: str, board: Board, of: str = "print", factor: float = 1.0
) -> Iterator[SystematicParameter]:
    prior = factor * board.uncertainty.print_position
    return _place(name, f"{of} ", prior, prior / (0.5 * max(board.size)), "the print on the {of}")


def _place(
    of: str, prefix: str, position: float, rotation: float, what: str, family: str = ""
) -> Iterator[SystematicParameter]:
    """Place and rotation of something printed, with their prior standard deviations, m and rad."""
    for axis in "xy":
        clause = f"{what} is {{size}} along {axis} from the stated place"
        yield SystematicParameter(of, f"{prefix}{axis}", "m", position, family=family, clause=clause)
    clause = f"{what} is rotated by {{size}} from the stated place"
    yield SystematicParameter(of, f"{prefix}rotation", "rad", rotation, family=family, clause=clause)


def _sizes(name: str, board: Board) -> Iterator[SystematicParameter]:
    clauses = ("the {of} is {size} wider|narrower than stated", "the {of} is {size} higher|lower than stated")
    for quantity, stated, clause in zip(("width", "height"), board.size, clauses, strict=True):
        yield SystematicParameter(name, quantity, "m", board.uncertainty.size, stated=stated, clause=clause)


def _error_of(name: str, error: BeamError) -> SystematicParameter:
    return SystematicParameter(
        name, error.quantity, error.unit, error.stddev, stated=error.stated, clause=error.clause
    )


def _locate_corners(printed: PrintedCorners, number: Index, prints: Sequence[_Print]) -> PrintedCorners:
    """Corners (N,) of boards (N,) with their tags and places on the board."""
    nominal = printed.nominal + printed.height_shape[:, -1:] * [0.0, 0.0, _THICKNESS]
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
    shape = np.column_stack([bow_shape(nominal[:, :2], half.reshape(-1, 2)), printed.height_shape[:, -1]])
    return PrintedCorners(nominal, center, tag, shape)


def _add_to_scanner(
    table: ParameterTable, k: int, name: str, views: RangeObservations, spec: SensorSpec, rig: Rig, number: Index
) -> RangeObservations:
    prior = spec.uncertainty
    assert isinstance(prior, RangeUncertainty)
    biases: list[SystematicParameter] = []
    if isinstance(prior, Lidar3dUncertainty):
        elevations, ring = find_rings(views.directions)
        if len(elevations):
            views, biases = views.with_rings(ring), list(_ring_biases(name, prior, elevations))
    errors = prior.beam_errors()
    bows = [list(_bow_parameters(of, board)) for of, board in name_boards(rig)]
    # The last row is of boards that no camera identified: of several, it is not known which one each is.
    size, bow = (rig.boards[0].size, bows[0]) if len(bows) == 1 else ((np.inf, np.inf), [None] * len(bows[0]))
    candidates: list[_Blocks] = [
        {
            "beams": [_error_of(name, error) for error in errors],
            "bow": of_board,
            "delay": [_stamp_delay(k, name, spec)] if len(views.twist) else [],
            "varying": biases,
        }
        for of_board in (*bows, bow)
    ]
    parameters = table.assign(k, candidates, number)
    half = np.array([*(board.size for board in rig.boards), size])[number].reshape(-1, 2) / 2
    return replace(views, half_size=half, registered=number >= 0, errors=errors, parameters=parameters)


def _ring_biases(name: str, prior: Lidar3dUncertainty, elevations: Array) -> Iterator[SystematicParameter]:
    for number, elevation in enumerate(np.degrees(elevations).tolist(), 1):
        ring = f"ring {number} ({elevation:+.1f}°)"
        clause = f"ranges of {ring} of {{of}} are {{size}} longer|shorter than those of the others"
        yield SystematicParameter(name, f"bias of {ring}", "m", prior.ring_bias, family=RINGS, clause=clause)


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
