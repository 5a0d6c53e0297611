"""Boards on paper, seen again: what is printed is where the board's target says, to a tenth of a millimetre."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pypdfium2
import pytest
from numpy.typing import NDArray

from calgraph.boards.camera import CameraDetector
from calgraph.boards.printed_boards import compute_landmarks
from calgraph.config import Board, PixelNoise, Tag
from calgraph.config.settings import CameraDetectionSettings
from calgraph.geometry import Array
from calgraph.printing import BoardOptions, Page, design_board, layout_pages, parse_paper
from calgraph.printing.pdf import describe_board, write_pdf
from calgraph.sensors import CameraModel, Image

Gray = NDArray[np.uint8]

PER_MM = 8.0
"""Pixels, 203 dpi."""
A4 = parse_paper("A4")
KINDS = {
    "tags": BoardOptions(),
    "tag25h9": BoardOptions(family="tag25h9", first_id=7),
    "tag16h5": BoardOptions(family="tag16h5"),
    "aprilgrid": BoardOptions(kind="aprilgrid"),
    "charuco": BoardOptions(kind="charuco"),
    "checkerboard": BoardOptions(kind="checkerboard"),
}
ODD = {
    "tags anywhere": BoardOptions(
        tags=(Tag(id=3, size=0.0523, center=(-0.0611, 0.031)), Tag(id=586, size=0.0417, center=(0.0803, -0.0297)))
    ),
    "small squares": BoardOptions(kind="checkerboard", square=11.7, columns=9, rows=6),
    "markers of another dictionary": BoardOptions(
        kind="charuco", square=31.3, dictionary="DICT_4X4_50", first_id=11
    ),
    "wide gaps": BoardOptions(kind="aprilgrid", columns=3, rows=2, spacing=0.5, first_id=100),
}


def printed(board: Board, pages: Sequence[Page], path: Path, per_mm: float = PER_MM) -> list[Gray]:
    """The board's pages as rasters; papers are whole pixels wide and high."""
    write_pdf(path, [(board, pages)])
    # The renderer rounds up to whole pixels, 1485.00001 to 1486, and stretches the page to them.
    scale = per_mm * 25.4 / 72 * (1 - 1e-6)
    with pypdfium2.PdfDocument(path) as pdf:
        rasters = [np.asarray(page.render(scale=scale, grayscale=True).to_numpy(), dtype=np.uint8) for page in pdf]
    return [raster.reshape(raster.shape[:2]) for raster in rasters]


def errors(board: Board, raster: Gray, corner: tuple[float, float], per_mm: float = PER_MM) -> tuple[Array, int]:
    """How far each corner seen is from where the board says, mm (N,); and how many corners there are.

    Args:
        board: what was printed.
        raster: of it.
        corner: where in the raster, from its lower left, the lower left corner of the sheet is, mm.
        per_mm: pixels.
    """
    height, width = raster.shape
    # A camera 1 m before the paper that sees it as it was rasterised.
    K = np.array([[1000 * per_mm, 0, width / 2], [0, 1000 * per_mm, height / 2], [0, 0, 1]])
    camera = CameraModel("pinhole", width, height, K, np.zeros(0))
    found = CameraDetector([board], camera, PixelNoise(pixel=0.3), settings=CameraDetectionSettings()).find(
        [Image(0.0, "", raster)]
    )
    assert isinstance(found, tuple), found
    (seen,) = found
    # Pixel centres are whole numbers, the raster's lower left corner is at (-0.5, height - 0.5).
    on_paper = np.column_stack([seen.pixels[:, 0] + 0.5, height - 0.5 - seen.pixels[:, 1]]) / per_mm
    half = 500 * np.array(board.size)
    expected = 1000 * seen.corners_board[:, :2] + half + corner
    return np.linalg.norm(on_paper - expected, axis=1), compute_landmarks(board).corners[..., 0].size


def assembled(pages: tuple[Page, ...], rasters: list[Gray], size: tuple[float, float], per_mm: float) -> Gray:
    """Pages cut and glued as they say: each over its left and upper neighbours; 5 mm of table around the sheet."""
    table = np.full([round((length + 10) * per_mm) for length in size[::-1]], 255, dtype=np.uint8)
    for page, raster in zip(pages, rasters, strict=True):
        w = page.window
        left, top = page.to_page(w.left, w.top)
        row, column = round((page.paper.height - top) * per_mm), round(left * per_mm)
        down, right = round((size[1] - w.top + 5) * per_mm), round((w.left + 5) * per_mm)
        shape = round(w.height * per_mm), round(w.width * per_mm)
        table[down : down + shape[0], right : right + shape[1]] = raster[
            row : row + shape[0], column : column + shape[1]
        ]
    return table


@pytest.mark.parametrize("options", [*KINDS.values(), *ODD.values()], ids=[*KINDS, *ODD])
def test_a_print_is_true_to_scale(options: BoardOptions, tmp_path: Path) -> None:
    board = design_board((297, 210), options)
    (page,) = layout_pages(board, A4)
    (raster,) = printed(board, (page,), tmp_path / "board.pdf")
    away, count = errors(board, raster, page.origin)
    assert len(away) == count
    assert away.max() < 0.05


@pytest.mark.parametrize("options", KINDS.values(), ids=KINDS.keys())
def test_tiled_pages_are_true_to_scale(options: BoardOptions, tmp_path: Path) -> None:
    """All cuts are between pixels."""
    per_mm = 6.0
    board = design_board((520, 370), options)
    pages = layout_pages(board, A4)
    assert len(pages) > 3
    rasters = printed(board, pages, tmp_path / "board.pdf", per_mm)
    table = assembled(pages, rasters, (520, 370), per_mm)
    away, count = errors(board, table, (5, 5), per_mm)
    assert len(away) == count
    assert away.max() < 0.05


def test_where_pages_overlap_they_show_the_same(tmp_path: Path) -> None:
    board = design_board((520, 370), BoardOptions(kind="charuco"))
    pages = layout_pages(board, A4)
    rasters = printed(board, pages, tmp_path / "board.pdf", 4.0)
    first, second = (assembled((p,), [r], (520, 370), 4.0) for p, r in zip(pages[:2], rasters[:2], strict=True))
    left, right = (round(4 * (x + 5)) for x in (pages[1].window.left, pages[0].window.right))
    rows = slice(round(4 * (370 - pages[0].window.top + 5)), round(4 * (370 - pages[0].window.bottom + 5)))
    assert right - left == 40
    common = first[rows, left:right].astype(int), second[rows, left:right].astype(int)
    assert (common[0] < 128).any()
    assert (np.abs(common[0] - common[1]) > 128).mean() < 0.01


def test_rulers_have_a_tick_at_every_millimetre(tmp_path: Path) -> None:
    """Just below the sheet's edge, where even short ticks are."""
    board = design_board((200, 140), BoardOptions())
    (page,) = layout_pages(board, A4)
    (raster,) = printed(board, (page,), tmp_path / "board.pdf", 40.0)
    x, y = page.to_page(0, -0.8)
    row = 255.0 - raster[round((page.paper.height - y) * 40)]
    row = row[round((x - 0.5) * 40) : round((x + 200.5) * 40)].reshape(201, 40)
    middles = (row * (np.arange(40) + 0.5)).sum(axis=1) / row.sum(axis=1) / 40 - 0.5
    np.testing.assert_allclose(middles, 0, atol=0.03)


def test_the_black_of_a_tag_has_no_seams(tmp_path: Path) -> None:
    board = design_board((297, 210), BoardOptions(tags=(Tag(id=0, size=0.1237),)))
    (page,) = layout_pages(board, A4)
    (raster,) = printed(board, (page,), tmp_path / "board.pdf", 3.7)
    x, y = page.to_page(297 / 2 - 60, 210 / 2 + 60)
    # The outermost ring of modules, 15 mm wide, and the rest of the first row of bits.
    corner = raster[round((210 - y) * 3.7) :, round(x * 3.7) :]
    assert corner[:400, :30].max() == 0


@pytest.mark.parametrize("options", KINDS.values(), ids=KINDS)
def test_an_inverted_print_is_detected_as_inverted(options: BoardOptions, tmp_path: Path) -> None:
    board = design_board((260, 180), options.model_copy(update={"inverted": True}))
    (page,) = layout_pages(board, A4)
    (raster,) = printed(board, (page,), tmp_path / "board.pdf")
    away, count = errors(board, raster, page.origin)
    assert (len(away), away.max() < 0.1) == (count, True)


def test_an_inverted_board_has_margins_around_its_black() -> None:
    """Printers leave them white, and rulers lie in them."""
    options = BoardOptions(inverted=True)
    assert len(layout_pages(design_board((267, 180), options), A4)) == 1
    assert len(layout_pages(design_board((297, 210), options), A4)) > 1


def test_a_scaled_print_is_detected(tmp_path: Path) -> None:
    """The test above measures: 1 % larger is 2 mm off."""
    board = design_board((297, 210), BoardOptions(kind="checkerboard"))
    (page,) = layout_pages(board, A4)
    (raster,) = printed(board, (page,), tmp_path / "board.pdf")
    larger = design_board((297, 210), BoardOptions(kind="checkerboard", square=28 * 1.01, columns=8, rows=5))
    away, _ = errors(larger, raster, page.origin)
    assert away.max() > 0.9


@pytest.mark.parametrize("name", ["A0", "A3", "letter", "tabloid", "500x700"])
def test_pages_are_as_large_as_the_paper(name: str, tmp_path: Path) -> None:
    paper = parse_paper(name)
    board = design_board((paper.height, paper.width), BoardOptions())
    write_pdf(tmp_path / "board.pdf", [(board, layout_pages(board, paper))])
    with pypdfium2.PdfDocument(tmp_path / "board.pdf") as pdf:
        (width, height) = pdf[0].get_size()
    assert (width * 25.4 / 72, height * 25.4 / 72) == pytest.approx((paper.height, paper.width), abs=1e-3)


def test_the_same_board_gives_the_same_file(tmp_path: Path) -> None:
    board = design_board((297, 210), BoardOptions())
    files = [tmp_path / "a.pdf", tmp_path / "b.pdf"]
    for path in files:
        write_pdf(path, [(board, layout_pages(board, A4))])
    assert files[0].read_bytes() == files[1].read_bytes()


@pytest.mark.parametrize(
    ("options", "expected"),
    [
        (BoardOptions(), "tag36h11, ids 0, 1, 2, tags of 74 mm; board 297 x 210 mm"),
        (
            BoardOptions(kind="checkerboard"),
            "checkerboard, 8 x 5 inner corners, squares of 28 mm; board 297 x 210 mm",
        ),
    ],
)
def test_the_caption_has_the_numbers_of_the_board(options: BoardOptions, expected: str, tmp_path: Path) -> None:
    board = design_board((297, 210), options)
    assert describe_board(board) == expected
    write_pdf(tmp_path / "board.pdf", [(board, layout_pages(board, A4))])
    with pypdfium2.PdfDocument(tmp_path / "board.pdf") as pdf:
        assert expected in pdf[0].get_textpage().get_text_bounded()


def test_tiled_pages_are_labelled(tmp_path: Path) -> None:
    board = design_board((520, 370), BoardOptions())
    write_pdf(tmp_path / "board.pdf", [(board, layout_pages(board, A4))])
    with pypdfium2.PdfDocument(tmp_path / "board.pdf") as pdf:
        text = pdf[4].get_textpage().get_text_bounded()
    assert "page B2 of 6: cut along the left edge and glue it over B1 and upper edge and glue it over A2" in text


def test_two_boards_are_in_one_file(tmp_path: Path) -> None:
    boards = [design_board((297, 210), BoardOptions()), design_board((297, 210), BoardOptions(first_id=3))]
    write_pdf(tmp_path / "boards.pdf", [(board, layout_pages(board, A4)) for board in boards])
    with pypdfium2.PdfDocument(tmp_path / "boards.pdf") as pdf:
        assert len(pdf) == 2
