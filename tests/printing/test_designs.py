"""Boards made to fill a sheet, and the target that goes with them."""

from pathlib import Path

import pytest

from calgraph.config import AprilGrid, Board, Charuco, Checkerboard, Tag, load_rig
from calgraph.errors import InputError
from calgraph.printing import Wishes, design, put_target, read_boards, target_block
from calgraph.printing.pages import sheet_ink

A4 = (297.0, 210.0)
ALL = {
    "tags": Wishes(),
    "aprilgrid": Wishes(kind="aprilgrid"),
    "charuco": Wishes(kind="charuco"),
    "checkerboard": Wishes(kind="checkerboard"),
}
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
@pytest.mark.parametrize("wishes", ALL.values(), ids=ALL.keys())
def test_a_print_fills_the_sheet_but_for_a_rim(wishes: Wishes, size: tuple[float, float]) -> None:
    black = sheet_ink(design(size, wishes))
    low, high = black[:, :2].min(axis=0), black[:, 2:].max(axis=0)
    assert min(*low, *(size - high)) > 20 - 1e-6
    # Along one axis it is as large as whole millimetres of its squares, and whole squares, allow.
    assert min(size - (high - low) - 40) < 12


def test_the_paper_s_board_has_three_tags() -> None:
    board = design((1200, 900), Wishes())
    assert [tag.id for tag in board.tags] == [0, 1, 2]
    assert len({tag.size for tag in board.tags}) == 1


def test_tags_of_one_board_keep_a_quiet_zone() -> None:
    """A tag of 8 modules needs a white one around it."""
    for size in (A4, (210, 297), (600, 200), (1200, 900)):
        a, _, c = design(size, Wishes()).tags
        gap = max(abs(p - q) for p, q in zip(a.center, c.center, strict=True)) - a.size
        assert gap > a.size / 8


def test_stated_lengths_are_kept_and_the_rest_is_fitted() -> None:
    pattern = design(A4, Wishes(kind="checkerboard", square=21.5)).pattern
    assert isinstance(pattern, Checkerboard)
    assert (pattern.square, pattern.columns, pattern.rows) == (0.0215, 10, 5)


def test_stated_numbers_are_kept_and_the_squares_fitted() -> None:
    pattern = design(A4, Wishes(kind="charuco", columns=10, rows=5)).pattern
    assert isinstance(pattern, Charuco)
    assert (pattern.columns, pattern.rows, pattern.square) == (10, 5, 0.025)


def test_an_aprilgrid_leaves_room_for_its_outer_squares() -> None:
    pattern = design(A4, Wishes(kind="aprilgrid", columns=2, rows=1, spacing=0.5)).pattern
    assert isinstance(pattern, AprilGrid)
    assert pattern.tag_size == 0.073  # 2 tags and 3 gaps of half a tag: 3.5 of them in 257 mm


@pytest.mark.parametrize("size", [A4, (210, 297), (420, 297), (1189, 841)])
def test_a_checkerboard_has_an_upper_end(size: tuple[float, float]) -> None:
    for wishes in (Wishes(kind="checkerboard"), Wishes(kind="checkerboard", square=20)):
        pattern = design(size, wishes).pattern
        assert isinstance(pattern, Checkerboard)
        assert (pattern.columns + pattern.rows) % 2 == 1


@pytest.mark.parametrize(
    ("wishes", "message"),
    [
        (Wishes(square=20), "`square`: is for charuco and checkerboard"),
        (Wishes(kind="charuco", spacing=0.3), "`spacing`: is for aprilgrid"),
        (Wishes(kind="checkerboard", first_id=3), "`first_id`: is for tags and aprilgrid and charuco"),
        (Wishes(kind="checkerboard", square=80, columns=8, rows=5), "pattern: extends beyond the board"),
        (Wishes(kind="charuco", dictionary="DICT_9X9"), "must be one of OpenCV's dictionaries"),
        (Wishes(kind="charuco", square=8), "needs marker 335, but DICT_5X5_100 ends at 99"),
        (Wishes(family="tag99"), "family: must be 'tag36h11', 'tag25h9' or 'tag16h5'"),
        (Wishes(family="tag16h5", first_id=28), "tag16h5 ends at 29, got 30"),
    ],
)
def test_what_cannot_be_had_is_refused(wishes: Wishes, message: str) -> None:
    with pytest.raises(InputError, match=message):
        design(A4, wishes)


def test_a_sheet_without_room_is_refused() -> None:
    with pytest.raises(InputError, match="`size`: leaves no room"):
        design((50, 300), Wishes())


@pytest.mark.parametrize("wishes", ALL.values(), ids=ALL.keys())
def test_the_block_is_read_as_the_same_board(wishes: Wishes, tmp_path: Path) -> None:
    board = design(A4, wishes)
    (tmp_path / "target.yaml").write_text(target_block([board]))
    assert read_boards(tmp_path / "target.yaml") == (board,)


def test_several_boards_are_a_list(tmp_path: Path) -> None:
    boards = (design(A4, Wishes()), design(A4, Wishes(kind="charuco")))
    (tmp_path / "target.yaml").write_text(target_block(boards))
    assert read_boards(tmp_path / "target.yaml") == boards


def test_a_block_replaces_that_of_a_rig_and_nothing_else(tmp_path: Path) -> None:
    path = tmp_path / "rig.yaml"
    path.write_text(RIG)
    board = design(A4, Wishes(kind="charuco"))
    text = put_target(path, [board])
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
    board = design(A4, Wishes())
    path.write_text(put_target(path, [board]))
    assert load_rig(path).boards == (board,)


def test_a_target_that_cannot_be_replaced_is_left_alone(tmp_path: Path) -> None:
    path = tmp_path / "rig.yaml"
    path.write_text("{root: lidar, target: {size: [1, 1]},\n sensors: {lidar: {kind: lidar3d, topic: /points}}}\n")
    with pytest.raises(InputError, match="paste the block by hand"):
        put_target(path, [design(A4, Wishes())])


def test_people_are_not_printed(tmp_path: Path) -> None:
    (tmp_path / "rig.yaml").write_text("target: {kind: people}\n")
    with pytest.raises(InputError, match=r"target.kind: must be board to be printed, got people"):
        read_boards(tmp_path / "rig.yaml")


def test_tags_go_where_they_are_put() -> None:
    tags = (Tag(id=7, size=0.05, center=(0.06, -0.03)),)
    assert design(A4, Wishes(tags=tags)) == Board(size=(0.297, 0.21), tags=tags)


def test_boards_that_cannot_be_told_apart_are_not_printed(tmp_path: Path) -> None:
    (tmp_path / "target.yaml").write_text(target_block([design(A4, Wishes()), design(A4, Wishes(first_id=2))]))
    with pytest.raises(InputError, match=r"target\[1\].tags\[0\].id: is also on target\[0\], got 2"):
        read_boards(tmp_path / "target.yaml")
