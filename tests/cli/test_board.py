"""calgraph board: a PDF, and the target that belongs to it."""

from collections.abc import Callable
from pathlib import Path

import pypdfium2
import pytest
from typer.testing import Result

from calgraph.config import AprilGrid, Charuco, Checkerboard, load_rig
from calgraph.printing import read_boards

Run = Callable[..., Result]


def pages(path: Path) -> int:
    with pypdfium2.PdfDocument(path) as pdf:
        return len(pdf)


@pytest.mark.parametrize(
    ("kind", "pattern"),
    [("tags", type(None)), ("aprilgrid", AprilGrid), ("charuco", Charuco), ("checkerboard", Checkerboard)],
)
def test_each_kind_gives_a_page_and_a_target_that_loads(
    run: Run, kind: str, pattern: type, tmp_path: Path
) -> None:
    result = run("board", "--kind", kind, "-o", tmp_path / "board.pdf")
    assert result.exit_code == 0, result.output
    assert pages(tmp_path / "board.pdf") == 1
    (tmp_path / "target.yaml").write_text(result.stdout)
    (board,) = read_boards(tmp_path / "target.yaml")
    assert (board.size, type(board.pattern)) == ((1.2, 0.9), pattern)


def page_sizes(path: Path) -> list[tuple[int, int]]:
    """Width and height of the pages of a PDF, mm."""
    with pypdfium2.PdfDocument(path) as pdf:
        return [(round(page.get_width() * 25.4 / 72), round(page.get_height() * 25.4 / 72)) for page in pdf]


@pytest.mark.parametrize(
    ("options", "page", "board"),
    [
        ([], (1230, 930), (1.2, 0.9)),
        (["--paper", "A4"], (297, 210), (0.297, 0.21)),
        (["--paper", "a3"], (420, 297), (0.42, 0.297)),
        (["--size", "200x150"], (297, 210), (0.2, 0.15)),
        (["--size", "400x280"], (420, 297), (0.4, 0.28)),
        (["--size", "1100x800"], (1189, 841), (1.1, 0.8)),
        (["--size", "1300x800"], (1330, 830), (1.3, 0.8)),
        (["--size", "200x150", "--paper", "A3"], (297, 420), (0.2, 0.15)),
        (["--size", "200x150", "--paper", "fit"], (230, 180), (0.2, 0.15)),
    ],
)
def test_a_board_is_one_page_of_the_smallest_common_paper_or_of_its_size(
    run: Run, tmp_path: Path, options: list[str], page: tuple[int, int], board: tuple[float, float]
) -> None:
    result = run("board", *options, "-o", tmp_path / "board.pdf")
    assert page_sizes(tmp_path / "board.pdf") == [page]
    assert f"1 page of {page[0]}x{page[1]} mm" in result.stderr
    assert ("--tile A4" in result.stderr) == (page[0] > 420)
    (tmp_path / "target.yaml").write_text(result.stdout)
    assert read_boards(tmp_path / "target.yaml")[0].size == board


def test_a_large_board_is_spread_over_pages_where_asked_for(run: Run, tmp_path: Path) -> None:
    result = run("board", "--tile", "A3", "-o", tmp_path / "board.pdf")
    assert "15 pages of 297x420 mm, to be joined; print at 100 %" in result.stderr
    assert page_sizes(tmp_path / "board.pdf") == [(297, 420)] * 15


def test_pages_without_print_are_named(run: Run, tmp_path: Path) -> None:
    """The lower corners of the sheet are white: two tags are above, one is below them."""
    result = run("board", "--size", "1200x900", "--tile", "A4", "-o", tmp_path / "board.pdf")
    assert "28 pages of 210x297 mm" in result.stderr
    assert (
        "without print, to be left out on a white board: A4, B4, C1, C2, C6, C7, D1, D2, D6, D7" in result.stderr
    )


def test_the_target_goes_into_a_rig(run: Run, simulated: Path, tmp_path: Path) -> None:
    rig = tmp_path / "rig.yaml"
    rig.write_text((simulated / "rig.yaml").read_text())
    before = load_rig(rig)
    assert run("board", "--kind", "charuco", "-o", tmp_path / "b.pdf", "--into", rig).exit_code == 0
    after = load_rig(rig)
    assert isinstance(after.boards[0].pattern, Charuco)
    assert after.sensors == before.sensors


def test_an_inverted_board_says_so_in_its_target(run: Run, tmp_path: Path) -> None:
    for options, inverted in ((["--inverted"], True), ([], False)):
        result = run("board", *options, "-o", tmp_path / "board.pdf")
        assert result.exit_code == 0, result.output
        assert ("inverted: true" in result.stdout, "inverted" in result.stdout) == (inverted, inverted)
        (tmp_path / "target.yaml").write_text(result.stdout)
        assert read_boards(tmp_path / "target.yaml")[0].inverted == inverted


def test_the_boards_of_a_rig_are_printed(run: Run, tmp_path: Path) -> None:
    target = tmp_path / "target.yaml"
    boards = [f"- {{size: [0.2, 0.2], tags: [{{id: {number}, size: 0.1}}]}}" for number in (3, 4)]
    target.write_text("\n".join(["target:", *boards]))
    result = run("board", target, "-o", tmp_path / "b.pdf")
    assert result.exit_code == 0, result.output
    assert pages(tmp_path / "b.pdf") == 2


def test_a_rig_and_wishes_contradict_each_other(run: Run, tmp_path: Path) -> None:
    (tmp_path / "target.yaml").write_text("target: {size: [0.2, 0.2], tags: [{id: 3, size: 0.1}]}")
    result = run("board", tmp_path / "target.yaml", "--kind", "charuco", "-o", tmp_path / "b.pdf")
    assert (result.exit_code, (tmp_path / "b.pdf").exists()) == (2, False)
    assert "defines the boards to print; give either it, or options of another" in result.stderr


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["--kind", "circles"], "--kind: must be 'tags', 'aprilgrid', 'charuco' or 'checkerboard', got 'circles'"),
        (["--kind", "charuco", "--square", "-3"], "--square: must be greater than 0, got -3"),
        (["--paper", "B7"], "--paper: is none of a0, a1"),
        (["--size", "12"], "--size: must be WIDTHxHEIGHT in mm, such as 1200x900; got '12'"),
        (
            ["--size", "1.2x0.9"],
            "--size: must be WIDTHxHEIGHT in mm, such as 1200x900; got '1.2x0.9', which seems to be in m",
        ),
        (["--size", "1.2x0.9m"], "'1.2x0.9m', which seems to be in m"),
        (["--paper", "A3", "--tile", "A4"], "--tile: spreads the board over pages"),
        (
            ["--size", "1200x900", "--paper", "A3"],
            "--paper: a board of 1200x900 mm does not fit on one page of A3; leave --paper out for one page of "
            "its size, or give --tile A3 for 15 pages to be joined",
        ),
        (["--dictionary", "DICT_5X5_50"], "--dictionary: applies to charuco only"),
        (["-o", "missing/board.pdf"], "missing"),
    ],
)
def test_what_is_wrong_is_named(
    run: Run, options: list[str], message: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    result = run("board", *options)
    assert (result.exit_code, list(tmp_path.iterdir())) == (2, [])
    assert message in result.stderr


def test_tags_are_put_where_they_are_asked_for(run: Run, tmp_path: Path) -> None:
    result = run("board", "--tags", "[{id: 9, size: 0.06, center: [0.05, -0.02]}]", "-o", tmp_path / "b.pdf")
    (tmp_path / "target.yaml").write_text(result.stdout)
    (tag,) = read_boards(tmp_path / "target.yaml")[0].tags
    assert (tag.id, tag.size, tag.center) == (9, 0.06, (0.05, -0.02))
