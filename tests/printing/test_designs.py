"""Boards made to fill a sheet, and the target that goes with them."""

from pathlib import Path

import pytest

from calgraph.config import AprilGrid, Board, Charuco, Checkerboard, Tag, load_rig
from calgraph.errors import InputError
from calgraph.printing import BoardOptions, design_board, format_target, read_boards, replace_target
from calgraph.printing.pages import black_rectangles_mm
from calgraph.simulation import RigScenario

A4 = (297.0, 210.0)
ALL = {
    "tags": BoardOptions(),
    "aprilgrid": BoardOptions(kind="aprilgrid"),
    "charuco": BoardOptions(kind="charuco"),
    "checkerboard": BoardOptions(kind="checkerboard"),
}
PATTERNS = {kind: options for kind, options in ALL.items() if kind != "tags"}
RIG = """\
# My robot.
root: lidar
# The board.
target:
  kind: board
  size: [1.0, 0.8]   # measured

  tags:
  - {id: 3, size: 0.3}
  # Or a pattern.

# When.
capture:
  background: [0.0, 5.0]
sensors:
  lidar: {kind: lidar3d, topic: /points}   # roof
"""


@pytest.mark.parametrize("size", [A4, (210.0, 297.0), (1189.0, 841.0), (1200.0, 900.0), (600.0, 200.0)])
@pytest.mark.parametrize("options", PATTERNS.values(), ids=PATTERNS.keys())
def test_a_pattern_fills_the_board_within_its_rim(options: BoardOptions, size: tuple[float, float]) -> None:
    black = black_rectangles_mm(design_board(size, options))
    low, high = black[:, :2].min(axis=0), black[:, 2:].max(axis=0)
    assert min(*low, *(size - high)) > 20 - 1e-6
    # Along one axis it is as large as whole millimetres of its squares, and whole squares, allow.
    assert min(size - (high - low) - 40) < 12


def test_the_default_board_has_three_tags() -> None:
    board = design_board((1200, 900), BoardOptions())
    assert [tag.id for tag in board.tags] == [0, 1, 2]
    assert len({tag.size for tag in board.tags}) == 1


def test_the_default_board_is_the_simulators() -> None:
    assert design_board((1200, 900), BoardOptions()) == RigScenario().board


@pytest.mark.parametrize("size", [A4, (210.0, 297.0), (1189.0, 841.0), (600.0, 600.0), (600.0, 200.0)])
def test_default_tags_keep_a_rim(size: tuple[float, float]) -> None:
    black = black_rectangles_mm(design_board(size, BoardOptions()))
    assert min(*black[:, :2].min(axis=0), *(size - black[:, 2:].max(axis=0))) > 20 - 1e-6


def test_tags_of_one_board_keep_a_quiet_zone() -> None:
    """A tag of 8 modules needs a white one around it."""
    for size in (A4, (210, 297), (600, 200), (1200, 900)):
        a, _, c = design_board(size, BoardOptions()).tags
        gap = max(abs(p - q) for p, q in zip(a.center, c.center, strict=True)) - a.size
        assert gap > a.size / 8


def test_stated_lengths_are_kept_and_the_rest_is_fitted() -> None:
    pattern = design_board(A4, BoardOptions(kind="checkerboard", square=21.5)).pattern
    assert isinstance(pattern, Checkerboard)
    assert (pattern.square, pattern.columns, pattern.rows) == (0.0215, 10, 5)


def test_stated_numbers_are_kept_and_the_squares_fitted() -> None:
    pattern = design_board(A4, BoardOptions(kind="charuco", columns=10, rows=5)).pattern
    assert isinstance(pattern, Charuco)
    assert (pattern.columns, pattern.rows, pattern.square) == (10, 5, 0.025)


def test_an_aprilgrid_leaves_room_for_its_outer_squares() -> None:
    pattern = design_board(A4, BoardOptions(kind="aprilgrid", columns=2, rows=1, spacing=0.5)).pattern
    assert isinstance(pattern, AprilGrid)
    assert pattern.tag_size == 0.073  # 2 tags and 3 gaps of half a tag: 3.5 of them in 257 mm


@pytest.mark.parametrize("size", [A4, (210, 297), (420, 297), (1189, 841)])
def test_a_checkerboard_has_an_upper_end(size: tuple[float, float]) -> None:
    for options in (BoardOptions(kind="checkerboard"), BoardOptions(kind="checkerboard", square=20)):
        pattern = design_board(size, options).pattern
        assert isinstance(pattern, Checkerboard)
        assert (pattern.columns + pattern.rows) % 2 == 1


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (BoardOptions(square=20), "`square`: applies to charuco and checkerboard only"),
        (BoardOptions(kind="charuco", spacing=0.3), "`spacing`: applies to aprilgrid only"),
        (
            BoardOptions(kind="checkerboard", first_id=3),
            "`first_id`: applies to tags and aprilgrid and charuco only",
        ),
        (BoardOptions(kind="checkerboard", square=80, columns=8, rows=5), "pattern: extends beyond the board"),
        (BoardOptions(kind="charuco", dictionary="DICT_9X9"), "must be one of OpenCV's dictionaries"),
        (BoardOptions(kind="charuco", square=8), "needs marker 335, but DICT_5X5_100 ends at 99"),
        (BoardOptions(family="tag99"), "family: must be 'tag36h11', 'tag25h9', 'tag16h5' or an ArUco dictionary"),
        (BoardOptions(family="tag16h5", first_id=28), "tag16h5 ends at 29, got 30"),
    ],
)
def test_inapplicable_options_are_errors(options: BoardOptions, message: str) -> None:
    with pytest.raises(InputError, match=message):
        design_board(A4, options)


def test_a_board_without_space_is_an_error() -> None:
    with pytest.raises(InputError, match="`size`: leaves no space"):
        design_board((50, 300), BoardOptions())


@pytest.mark.parametrize("options", ALL.values(), ids=ALL.keys())
def test_the_block_is_read_as_the_same_board(options: BoardOptions, tmp_path: Path) -> None:
    board = design_board(A4, options)
    (tmp_path / "target.yaml").write_text(format_target([board]))
    assert read_boards(tmp_path / "target.yaml") == (board,)


def test_several_boards_are_a_list(tmp_path: Path) -> None:
    boards = (design_board(A4, BoardOptions()), design_board(A4, BoardOptions(kind="charuco")))
    (tmp_path / "target.yaml").write_text(format_target(boards))
    assert read_boards(tmp_path / "target.yaml") == boards


def test_a_block_replaces_that_of_a_rig_and_nothing_else(tmp_path: Path) -> None:
    path = tmp_path / "rig.yaml"
    path.write_text(RIG)
    board = design_board(A4, BoardOptions(kind="charuco"))
    text = replace_target(path, [board])
    path.write_text(text)
    assert load_rig(path).boards == (board,)
    for kept in ("# My robot.", "# The board.\n", "# When.\n", "background: [0.0, 5.0]", "# roof"):
        assert kept in text
    assert "measured" not in text
    assert "Or a pattern" not in text


@pytest.mark.parametrize(
    "target",
    [
        "target: {kind: board, size: [1, 1], tags: [{id: 3, size: 0.3}]}\n",
        "target:\n- size: [1.0, 1.0]\n  tags: [{id: 3, size: 0.3}]\n- size: [1.0, 1.0]\n",
        "",
    ],
)
def test_targets_written_in_other_ways_are_replaced(target: str, tmp_path: Path) -> None:
    path = tmp_path / "rig.yaml"
    path.write_text(f"root: lidar\n{target}sensors: {{lidar: {{kind: lidar3d, topic: /points}}}}")
    board = design_board(A4, BoardOptions())
    path.write_text(replace_target(path, [board]))
    assert load_rig(path).boards == (board,)


def test_an_unsupported_target_block_is_an_error(tmp_path: Path) -> None:
    path = tmp_path / "rig.yaml"
    path.write_text("{root: lidar, target: {size: [1, 1]},\n sensors: {lidar: {kind: lidar3d, topic: /points}}}\n")
    with pytest.raises(InputError, match="replace the block by hand"):
        replace_target(path, [design_board(A4, BoardOptions())])


def test_people_are_not_printed(tmp_path: Path) -> None:
    (tmp_path / "rig.yaml").write_text("target: {kind: people}\n")
    with pytest.raises(InputError, match=r"target.kind: must be board to be printed, got people"):
        read_boards(tmp_path / "rig.yaml")


def test_tags_are_at_their_stated_positions() -> None:
    tags = (Tag(id=7, size=0.05, center=(0.06, -0.03)),)
    assert design_board(A4, BoardOptions(tags=tags)) == Board(size=(0.297, 0.21), tags=tags)


def test_indistinguishable_boards_are_an_error(tmp_path: Path) -> None:
    (tmp_path / "target.yaml").write_text(
        format_target([design_board(A4, BoardOptions()), design_board(A4, BoardOptions(first_id=2))])
    )
    with pytest.raises(InputError, match=r"target\[1\].tags\[0\].id: is also on target\[0\], got 2"):
        read_boards(tmp_path / "target.yaml")
