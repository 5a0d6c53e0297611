"""What is carried through the sensors' views: a planar board with its printed pattern, people, or a cylinder."""

from typing import Annotated, Literal

from pydantic import Field, model_validator

from calgraph.rig.model import StrictModel

Length = Annotated[float, Field(gt=0, allow_inf_nan=False)]
Coordinate = Annotated[float, Field(allow_inf_nan=False)]
Pair = tuple[Coordinate, Coordinate]


class Tag(StrictModel):
    """An AprilTag on the sheet, upright."""

    id: Annotated[int, Field(ge=0)]
    size: Length
    """Edge of the black square, m."""
    center: Pair = (0.0, 0.0)
    """Centre in the board frame, m."""


class Checkerboard(StrictModel):
    """A chessboard pattern."""

    kind: Literal["checkerboard"]
    columns: Annotated[int, Field(ge=2)]
    """Inner corners along the board's x."""
    rows: Annotated[int, Field(ge=2)]
    """Inner corners along the board's y."""
    square: Length
    center: Pair = (0.0, 0.0)
    """Centre of the pattern on the sheet, m."""


class Charuco(StrictModel):
    """A ChArUco board: chessboard with markers in its white squares."""

    kind: Literal["charuco"]
    columns: Annotated[int, Field(ge=2)]
    """Squares along the board's x."""
    rows: Annotated[int, Field(ge=2)]
    """Squares along the board's y."""
    square: Length
    marker: Length
    """Edge of a marker, m; smaller than a square."""
    dictionary: str
    """OpenCV's name, e.g. DICT_5X5_100."""
    center: Pair = (0.0, 0.0)


class AprilGrid(StrictModel):
    """Kalibr's grid of AprilTags (2-bit borders)."""

    kind: Literal["aprilgrid"]
    columns: Annotated[int, Field(ge=1)]
    rows: Annotated[int, Field(ge=1)]
    tag_size: Length
    tag_spacing: Length
    """Gap between tags as a fraction of tag_size, as Kalibr states it."""
    first_id: Annotated[int, Field(ge=0)] = 0
    center: Pair = (0.0, 0.0)


Pattern = Annotated[Checkerboard | Charuco | AprilGrid, Field(discriminator="kind")]


class Board(StrictModel):
    """A rectangular sheet with either AprilTags or one pattern printed on it.

    Its frame: origin at the centre of the sheet, x right, y up, z out of the printed face.
    """

    kind: Literal["board"] = "board"
    size: tuple[Length, Length]
    """Width (x) and height (y) of the sheet, m."""
    family: Literal["tag36h11", "tag25h9", "tag16h5"] = "tag36h11"
    tags: tuple[Tag, ...] = ()
    pattern: Pattern | None = None

    @model_validator(mode="after")
    def _one_print(self) -> "Board":
        if self.tags and self.pattern:
            raise ValueError("a board has either tags or a pattern, not both")
        ids = [tag.id for tag in self.tags]
        if len(set(ids)) < len(ids):
            raise ValueError(f"tag ids on one board must differ, got {ids}")
        return self


class People(StrictModel):
    """Walking people, seen as ellipses by horizontal scanners."""

    kind: Literal["people"]
    axes: tuple[Length, Length] = (0.25, 0.15)
    """Start value of the ellipse's radii, m."""


class Cylinder(StrictModel):
    """A moving vertical cylinder."""

    kind: Literal["cylinder"]
    diameter: Length


Target = Annotated[Board | People | Cylinder, Field(discriminator="kind")]
