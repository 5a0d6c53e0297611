"""The calibration target: a planar board with its printed pattern, people, a cylinder, or the surroundings."""

from functools import cache
from itertools import combinations
from typing import Annotated, Any, Literal

import cv2
import numpy as np
import pydantic
from pydantic import AfterValidator, Discriminator, Field, Strict, field_validator, model_validator

from calgraph.geometry import Array
from calgraph.io.quantities import DegreeLimit, LengthLimit, LengthStddev, Ratio
from calgraph.io.strict_model import StrictModel, invalid, limit_to

APRILTAGS = {"tag36h11": "DICT_APRILTAG_36h11", "tag25h9": "DICT_APRILTAG_25h9", "tag16h5": "DICT_APRILTAG_16h5"}
"""OpenCV's dictionary of each family of AprilTags."""
DICTIONARIES = (
    *(f"DICT_{n}X{n}_{count}" for n in (4, 5, 6, 7) for count in (50, 100, 250, 1000)),
    "DICT_ARUCO_ORIGINAL", "DICT_APRILTAG_16h5", "DICT_APRILTAG_25h9", "DICT_APRILTAG_36h10",
    "DICT_APRILTAG_36h11", "DICT_ARUCO_MIP_36h12",
)  # fmt: skip
"""OpenCV's names."""
FAMILIES = APRILTAGS | {name: name for name in DICTIONARIES if not name.startswith("DICT_APRILTAG")}
"""OpenCV's dictionary of each family of tags: of AprilTags, and of ArUco markers by OpenCV's names."""


def _read_family(value: str) -> str:
    """A family by its name in ``FAMILIES``, or that of a dictionary as others spell it: 4x4_50, aruco_4x4_50."""
    known = {name.upper(): name for name in FAMILIES} | {name.upper(): f for f, name in APRILTAGS.items()}
    upper = value.upper()
    for spelled in (upper, f"DICT_{upper}", f"DICT_{upper.removeprefix('ARUCO_')}"):
        if spelled in known:
            return known[spelled]
    apriltags = ", ".join(repr(family) for family in APRILTAGS)
    raise invalid(
        "", f"must be {apriltags} or an ArUco dictionary from 'DICT_4X4_50' to 'DICT_7X7_1000', got {value!r}"
    )


Family = Annotated[str, Strict(), AfterValidator(_read_family)]


@cache
def dictionary(name: str) -> cv2.aruco.Dictionary:
    """OpenCV's dictionary of one of the names in ``DICTIONARIES``."""
    return cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, name))


def marker_count(name: str) -> int:
    """How many markers a dictionary has; they are numbered from 0."""
    return len(dictionary(name).bytesList)


def marker_bitmap(name: str, number: int, border: int = 1) -> Array:
    """A marker upright as OpenCV draws it: (n, n), a value for each module, 0 black and 1 white.

    The black border, ``border`` modules wide, is part of it.
    """
    edge = dictionary(name).markerSize + 2 * border
    image = cv2.aruco.generateImageMarker(dictionary(name), number, edge, borderBits=border)
    return np.asarray(image, dtype=np.float64) / 255


class BoardUncertainty(StrictModel):
    """Prior standard deviations of a board's geometry; 0 means exact."""

    print_scale: Ratio = 0.005
    """Relative, of the whole print. Laser printers are off by 0.2 to 1 %, and paper grows by some 0.1 % with
    humidity."""
    print_aspect: Ratio = 0.003
    """Relative, of the print's width over its height. Printers feed paper with another error than they scan
    with: two real boards measured 0.4 % and 0.7 %."""
    tag_size: Ratio = 0.005
    """Relative, of all tags about their centres; only for boards with several. Each is a print, with the error of
    print_scale, and people measure the black square to 1 mm in 0.2 m."""
    tag_position: LengthStddev = 0.001
    """m, of each tag along both axes; only for boards with ``tags:``. Tags glued on separately are placed, and
    measured, to the millimetre marks of a ruler."""
    bow: LengthStddev = 0.002
    """m, of the middle of the board over its edges. Foam boards and plywood of 1 m bend by this under their
    weight and with humidity."""
    size: LengthStddev = 0.002
    """m, of the width and of the height. Cuts and tape measures are this good."""
    print_position: LengthStddev = 0.002
    """m, of the print on the board, along both axes. Prints are glued on to the cut edge no better than it is
    cut."""


class Tolerance(StrictModel):
    """The largest acceptable error of a pose along and about each axis; a good pose is within it with 95 %."""

    translation: LengthLimit = 0.01
    """m. The range noise of a good scanner: a smaller error does not show in its measurements."""
    rotation: DegreeLimit = 0.3
    """Degrees. It moves a point by 0.01 m, the tolerance of translations, at 2 m."""

    @property
    def limits(self) -> Array:
        """(6,) the tolerance along x, y, z (m) and about them (rad)."""
        return np.repeat([self.translation, np.radians(self.rotation)], 3)


# Strict: YAML has types, so a quoted number or a `yes` where a number belongs is reported as an error.
Length = Annotated[float, Strict(), Field(gt=0, allow_inf_nan=False)]
# Larger boards and bodies are numbers in mm or cm.
BoardLength = Annotated[Length, limit_to(10, "m")]
BodyLength = Annotated[Length, limit_to(5, "m")]
Coordinate = Annotated[float, Strict(), Field(allow_inf_nan=False)]
Index = Annotated[int, Strict(), Field(ge=0)]
AtLeastOne = Annotated[int, Strict(), Field(ge=1)]
# More rows or columns than any printed board has; corners are made for all of them.
_MAX_PATTERN_COUNT = 1000
CornerCount = Annotated[int, Strict(), Field(ge=2, le=_MAX_PATTERN_COUNT)]
TagCount = Annotated[int, Strict(), Field(ge=1, le=_MAX_PATTERN_COUNT)]
Pair = tuple[Coordinate, Coordinate]

# Rounding in rig.yaml makes prints overlap an edge by up to a millimetre; more is an error of unit or sign.
_MAX_PRINT_OVERLAP = 1e-3


class Tag(StrictModel):
    """An upright AprilTag or ArUco marker on the board."""

    id: Index
    size: Length
    """Edge of the black square, m."""
    center: Pair = (0.0, 0.0)
    """Centre in the board frame, m."""


class Checkerboard(StrictModel):
    """A chessboard pattern."""

    kind: Literal["checkerboard"]
    columns: CornerCount
    """Inner corners along the board's x."""
    rows: CornerCount
    """Inner corners along the board's y."""
    square: Length
    """Edge of a square, m."""
    center: Pair = (0.0, 0.0)
    """Centre of the pattern in the board frame, m."""

    @property
    def extent(self) -> Pair:
        """Width and height that must lie within the board, m; the outermost squares may be cropped to half."""
        return self.columns * self.square, self.rows * self.square


class Charuco(StrictModel):
    """A ChArUco board: chessboard with markers in its white squares."""

    kind: Literal["charuco"]
    columns: CornerCount
    """Squares along the board's x."""
    rows: CornerCount
    """Squares along the board's y."""
    square: Length
    """Edge of a square, m."""
    marker: Length
    """Edge of a marker, m; smaller than a square."""
    dictionary: str
    """OpenCV's name, e.g. DICT_5X5_100."""
    first_id: Index = 0
    """Number of the marker at the top left; the others follow row by row."""
    center: Pair = (0.0, 0.0)
    """Centre of the pattern in the board frame, m."""

    @field_validator("dictionary")
    @classmethod
    def _dictionary_exists(cls, value: str) -> str:
        if value not in DICTIONARIES:
            raise invalid("", f"must be one of OpenCV's dictionaries, {', '.join(DICTIONARIES)}, got {value!r}")
        return value

    @model_validator(mode="after")
    def _marker_fits(self) -> "Charuco":
        if self.marker >= self.square:
            raise invalid("marker", f"must be smaller than square ({self.square:g} m), got {self.marker:g}")
        return self

    @model_validator(mode="after")
    def _markers_exist(self) -> "Charuco":
        last, count = self.first_id + self.columns * self.rows // 2 - 1, marker_count(self.dictionary)
        if last >= count:
            raise invalid("dictionary", f"needs marker {last}, but {self.dictionary} ends at {count - 1}")
        return self

    @property
    def extent(self) -> Pair:
        """Width and height of the pattern, m."""
        return self.columns * self.square, self.rows * self.square


class AprilGrid(StrictModel):
    """Kalibr's grid of AprilTags (2-bit borders)."""

    kind: Literal["aprilgrid"]
    columns: TagCount
    """Tags along the board's x."""
    rows: TagCount
    """Tags along the board's y."""
    tag_size: Length
    """Edge of a tag's black square, m."""
    tag_spacing: Length
    """Gap between tags as a fraction of tag_size, as Kalibr states it."""
    first_id: Index = 0
    """Id of the tag at the bottom left."""
    center: Pair = (0.0, 0.0)
    """Centre of the pattern in the board frame, m."""

    @model_validator(mode="after")
    def _ids_exist(self) -> "AprilGrid":
        last, count = self.first_id + self.columns * self.rows - 1, marker_count(FAMILIES["tag36h11"])
        if last >= count:
            raise invalid("first_id", f"the last tag would be {last}, but tag36h11 ends at {count - 1}")
        return self

    @property
    def extent(self) -> Pair:
        """Width and height of the pattern, m."""
        gap = self.tag_size * self.tag_spacing
        return self.columns * (self.tag_size + gap) - gap, self.rows * (self.tag_size + gap) - gap


Pattern = Annotated[Checkerboard | Charuco | AprilGrid, Field(discriminator="kind")]


class Board(StrictModel):
    """A rectangular board with either tags or one pattern printed on it.

    Its frame: origin at the centre of the board, x right, y up, z out of the printed face.
    """

    kind: Literal["board"] = "board"
    size: tuple[BoardLength, BoardLength]
    """Width (x) and height (y), m."""
    family: Family = "tag36h11"
    """Family of the AprilTags, or dictionary of the ArUco markers."""
    tags: tuple[Tag, ...] = ()
    """The tags on the board."""
    pattern: Pattern | None = None
    """The pattern that is printed instead of tags."""
    inverted: Annotated[bool, Strict()] = False
    """Whether black and white of the print are exchanged: white tags, or a white top left square, on black."""
    uncertainty: BoardUncertainty = BoardUncertainty()

    @model_validator(mode="after")
    def _one_print(self) -> "Board":
        if self.tags and self.pattern:
            raise invalid("pattern", "a board has either tags or a pattern, not both")
        if self.pattern:
            _check_within_board("pattern", self.size, self.pattern.center, self.pattern.extent)
        last = marker_count(FAMILIES[self.family]) - 1
        for i, tag in enumerate(self.tags):
            _check_within_board(f"tags[{i}]", self.size, tag.center, (tag.size, tag.size))
            if tag.id > last:
                raise invalid(f"tags[{i}].id", f"{self.family} ends at {last}, got {tag.id}")
        return self

    @model_validator(mode="after")
    def _tags_apart(self) -> "Board":
        for (i, a), (j, b) in combinations(enumerate(self.tags), 2):
            if a.id == b.id:
                raise invalid(f"tags[{j}].id", f"must differ from that of tags[{i}], got {b.id} twice")
            gap = max(abs(p - q) for p, q in zip(a.center, b.center, strict=True)) - (a.size + b.size) / 2
            if gap < -_MAX_PRINT_OVERLAP:
                raise invalid(f"tags[{j}]", f"overlaps tags[{i}] by {-gap:.3f} m")
        return self


def _check_within_board(key: str, board_size: Pair, center: Pair, extent: Pair) -> None:
    for axis, direction in enumerate(("width", "height")):
        reach = abs(center[axis]) + extent[axis] / 2
        if reach > board_size[axis] / 2 + _MAX_PRINT_OVERLAP:
            raise invalid(
                key,
                f"extends beyond the board: it reaches {reach:.3f} m from the centre, "
                f"half the board's {direction} is {board_size[axis] / 2:.3f} m",
            )


class People(StrictModel):
    """Walking people, whose cross-sections are ellipses to horizontal scanners, or two legs below the hip."""

    kind: Literal["people"] = "people"
    axes: tuple[BodyLength, BodyLength] = (0.25, 0.15)
    """Start values of the ellipse's radii, m."""
    height: BodyLength | None = None
    """Of the scan plane above the floor, m; without it, the widths of objects show whether they are legs."""


class Cylinder(StrictModel):
    """A moving vertical cylinder."""

    kind: Literal["cylinder"] = "cylinder"
    diameter: BodyLength
    """Its diameter, m."""


class Surroundings(StrictModel):
    """What a robot drives past: walls, floors and furniture, at unknown places."""

    kind: Literal["surroundings"] = "surroundings"
    boards: tuple[Board, ...] = ()
    """Boards that are fixed there, for cameras."""


def _kind_of_target(value: Any) -> str | None:
    """The discriminator of a target's model; None, which is an error, unless it is a list or has a kind."""
    if isinstance(value, list | tuple):
        return "boards"
    kind = value.get("kind") if isinstance(value, dict) else getattr(value, "kind", None)
    return kind if isinstance(kind, str) else None


Target = Annotated[
    Annotated[Board, pydantic.Tag("board")]
    | Annotated[People, pydantic.Tag("people")]
    | Annotated[Cylinder, pydantic.Tag("cylinder")]
    | Annotated[Surroundings, pydantic.Tag("surroundings")]
    | Annotated[tuple[Board, ...], pydantic.Tag("boards"), Field(min_length=1)],
    Discriminator(_kind_of_target),
]
