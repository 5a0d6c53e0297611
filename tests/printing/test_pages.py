"""Paper, and how boards are spread over it."""

import numpy as np
import pytest

from calgraph.config import Board, Tag
from calgraph.errors import InputError
from calgraph.printing import BoardOptions, Paper, design_board, layout_pages, parse_paper
from calgraph.printing.pages import black_rectangles_mm

A4 = parse_paper("A4")
BARE = Board(size=(1.2, 0.9), tags=(Tag(id=0, size=0.3),))


@pytest.mark.parametrize(
    ("text", "size"),
    [
        ("A4", (210, 297)),
        ("a0", (841, 1189)),
        ("Letter", (215.9, 279.4)),
        ("tabloid", (279.4, 431.8)),
        ("500x700", (500, 700)),
        ("500.5 x 700 mm", (500.5, 700)),
    ],
)
def test_paper_is_parsed_by_name_or_size(text: str, size: tuple[float, float]) -> None:
    assert parse_paper(text) == Paper(*size)


@pytest.mark.parametrize("text", ["B52", "500", "500x", "-1x500", "0x500", "axb", ""])
def test_unknown_paper_is_an_error_that_lists_names(text: str) -> None:
    with pytest.raises(InputError, match=r"`paper`: is none of a0, .*, letter, .* nor WIDTHxHEIGHT in mm"):
        parse_paper(text)


@pytest.mark.parametrize("text", ["50x300", "300x6000"])
def test_paper_of_extreme_size_is_an_error(text: str) -> None:
    with pytest.raises(InputError, match="edges must be from 60 to 5000 mm"):
        parse_paper(text)


def test_a_landscape_board_is_on_landscape_paper() -> None:
    (page,) = layout_pages(design_board((250, 150), BoardOptions()), A4)
    assert page.paper == Paper(297, 210)


def test_a_board_is_in_the_middle_of_its_page() -> None:
    (page,) = layout_pages(design_board((250, 150), BoardOptions()), A4)
    assert page.to_page(125, 75) == (297 / 2, 105)


def test_a_board_as_large_as_the_paper_is_on_one_page() -> None:
    """Its print keeps clear of the margins, only its white rim has the rulers on it."""
    for name in ("A4", "A0", "letter"):
        paper = parse_paper(name)
        (page,) = layout_pages(design_board((paper.height, paper.width), BoardOptions(kind="aprilgrid")), paper)
        assert page.origin == pytest.approx((0, 0))


def test_a_print_that_exceeds_the_margins_is_tiled() -> None:
    wide = Board(
        size=(0.29, 0.2), tags=(Tag(id=0, size=0.15, center=(-0.06, 0)), Tag(id=1, size=0.1, center=(0.09, 0)))
    )
    assert len(layout_pages(wide, A4)) == 2


@pytest.mark.parametrize("size", [(1.2, 0.9), (0.9, 1.2), (0.3, 0.3), (2.0, 0.1), (0.5207, 0.37031)])
@pytest.mark.parametrize("paper", ["A4", "A3", "letter", "330x60"])
@pytest.mark.parametrize("overlap", [0.0, 10.0, 14.0])
def test_every_place_of_a_board_is_on_some_page(size: tuple[float, float], paper: str, overlap: float) -> None:
    pages = layout_pages(Board(size=size), parse_paper(paper), overlap)
    places = np.random.default_rng(1).uniform(0, 1000, (500, 2)) * size
    on_page = [
        (places >= [p.window.left, p.window.bottom]).all(axis=1)
        & (places <= [p.window.right, p.window.top]).all(axis=1)
        for p in pages
    ]
    assert np.any(on_page, axis=0).all()


@pytest.mark.parametrize("size", [(1.2, 0.9), (0.5207, 0.37031)])
def test_what_is_on_a_page_keeps_clear_of_its_margins(size: tuple[float, float]) -> None:
    for page in layout_pages(Board(size=size), A4):
        w = page.window
        left, bottom = page.to_page(w.left, w.bottom)
        right, top = page.to_page(w.right, w.top)
        assert min(left, bottom, page.paper.width - right, page.paper.height - top) > 15 - 1e-9


def test_neighbours_have_the_stated_overlap() -> None:
    pages = {page.label: page for page in layout_pages(BARE, A4, 12.0)}
    assert pages["A1"].window.right - pages["A2"].window.left == pytest.approx(12)
    assert pages["B1"].window.top - pages["A1"].window.bottom == pytest.approx(12)


def test_pages_mark_the_edges_of_their_neighbours() -> None:
    pages = {page.label: page for page in layout_pages(BARE, A4)}
    assert pages["A1"].overlap_edges == ((pages["A2"].window.left,), (pages["B1"].window.top,))


def test_the_orientation_with_fewer_pages_is_chosen() -> None:
    """900 mm are 5 times 180 but 4 times 267, less the overlaps; 240 mm fit once into 267."""
    pages = layout_pages(Board(size=(0.9, 0.24)), A4)
    assert (len(pages), pages[0].paper) == (6, A4)


def test_fit_makes_one_page_as_large_as_the_board_needs() -> None:
    (page,) = layout_pages(BARE)
    assert page.paper == Paper(1230, 930)


def test_too_many_pages_are_an_error() -> None:
    with pytest.raises(InputError, match=r"`paper`: it would take \d+ pages"):
        layout_pages(Board(size=(9, 9)), A4)


@pytest.mark.parametrize("overlap", [-1.0, 90.0])
def test_an_overlap_of_a_whole_page_is_an_error(overlap: float) -> None:
    with pytest.raises(InputError, match="`overlap`: must be from 0 to 90 mm"):
        layout_pages(BARE, A4, overlap)


def test_black_rectangles_are_relative_to_the_lower_left_corner() -> None:
    black = black_rectangles_mm(BARE)
    np.testing.assert_allclose([*black[:, :2].min(axis=0), *black[:, 2:].max(axis=0)], [450, 300, 750, 600])
