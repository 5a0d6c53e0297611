"""AprilTags in an image: the search near predicted corners, and decision margins."""

import cv2
import numpy as np
import pytest

from calgraph.boards.tags import Gray, TagFinder, _refine_saddles
from calgraph.config.settings import TagSettings
from calgraph.geometry import Array

DICTIONARY = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_APRILTAG_36h11)


def draw_tag(size: int, corner: tuple[int, int] = (200, 150), contrast: float = 1.0) -> tuple[Gray, Array]:
    """An image (480, 640) of tag 5 with a white border, and the tag's corners (1, 4, 2)."""
    image = np.full((480, 640), 128, dtype=np.uint8)
    x, y = corner
    image[y - size // 4 : y + size + size // 4, x - size // 4 : x + size + size // 4] = 255
    image[y : y + size, x : x + size] = cv2.aruco.generateImageMarker(DICTIONARY, 5, size)
    blurred = cv2.GaussianBlur(128 + contrast * (image.astype(float) - 128), (0, 0), 0.8)
    image = np.rint(blurred).astype(np.uint8)
    left, top, right, bottom = x - 0.5, y - 0.5, x + size - 0.5, y + size - 0.5
    return image, np.array([[[left, top], [right, top], [right, bottom], [left, bottom]]])


def test_a_tag_is_found_within_its_predicted_corners() -> None:
    """Its white border lies outside them: a search without a margin would cut it off."""
    image, corners = draw_tag(80)
    found = TagFinder("tag36h11", settings=TagSettings()).find_within(image, corners)
    assert found.ids.tolist() == [5]
    np.testing.assert_allclose(found.pixels, corners, atol=0.25)


@pytest.mark.parametrize("shift", [(60.0, 0.0), (-60.0, 0.0), (0.0, 60.0), (0.0, -60.0), (40.0, 40.0)])
def test_predictions_may_be_off_by_a_part_of_the_tags_edge(shift: tuple[float, float]) -> None:
    image, corners = draw_tag(160)
    assert TagFinder("tag36h11", settings=TagSettings()).find_within(image, corners + shift).ids.tolist() == [5]


def test_predictions_of_small_tags_may_be_off_by_some_pixels(monkeypatch: pytest.MonkeyPatch) -> None:
    image, corners = draw_tag(24)
    finder = TagFinder("tag36h11", settings=TagSettings())
    assert finder.find_within(image, corners + np.array([13.0, 0.0])).ids.tolist() == [5]
    monkeypatch.setattr("calgraph.boards.tags._MIN_SEARCH_MARGIN", 0)
    narrow = TagFinder("tag36h11", settings=TagSettings())
    assert len(narrow.find_within(image, corners + np.array([13.0, 0.0]))) == 0


def test_the_search_is_limited_to_the_prediction() -> None:
    image, corners = draw_tag(80)
    assert (
        len(TagFinder("tag36h11", settings=TagSettings()).find_within(image, corners + np.array([150.0, 0.0])))
        == 0
    )


def test_the_margin_is_of_one_tag_where_several_are_predicted() -> None:
    """Four tags in a row, 2 by 2 edges apart on average: half of an edge is not half of all."""
    image, corners = draw_tag(40, (40, 60))
    row = np.concatenate([corners + np.array([offset, 0.0]) for offset in (250.0, 310.0, 370.0, 430.0)])
    # The range of all is 220 px, of which an average tag of four has 110; the margin is 65 px.
    assert len(TagFinder("tag36h11", settings=TagSettings()).find_within(image, row)) == 0
    assert TagFinder("tag36h11", settings=TagSettings()).find_within(
        image, row - np.array([200.0, 0.0])
    ).ids.tolist() == [5]


def test_tags_at_the_borders_of_the_image_are_cut_nowhere_else() -> None:
    image, corners = draw_tag(80, (20, 20))
    np.testing.assert_allclose(
        TagFinder("tag36h11", settings=TagSettings()).find_within(image, corners).pixels, corners, atol=0.25
    )
    image, corners = draw_tag(80, (540, 380))
    np.testing.assert_allclose(
        TagFinder("tag36h11", settings=TagSettings()).find_within(image, corners).pixels, corners, atol=0.25
    )


@pytest.mark.parametrize(("contrast", "count"), [(0.05, 1), (0.03, 0)])
def test_tags_of_low_contrast_are_rejected_by_their_decision_margin(contrast: float, count: int) -> None:
    """The margins are 5.6 and 3.8 grey values; 5 are required."""
    image, _ = draw_tag(80, contrast=contrast)
    assert len(TagFinder("tag36h11", settings=TagSettings()).find(image)) == count


@pytest.mark.parametrize(("contrast", "count"), [(0.15, 1), (0.1, 0)])
def test_a_tag_with_a_wrong_bit_needs_a_larger_margin(contrast: float, count: int) -> None:
    """The margins are 18 and 12 grey values; 15 are required."""
    image, corners = draw_tag(80, contrast=contrast)
    x, y = (corners[0, 0] + 0.5).astype(int)
    # The second of the eight cells in the second row, of 10 px.
    cell = image[y + 10 : y + 20, x + 10 : x + 20]
    cell[:] = 255 - cell
    assert len(TagFinder("tag36h11", settings=TagSettings()).find(image)) == count


def test_large_images_are_searched_at_half_resolution() -> None:
    """A tag of 20 pixels is found at full resolution only."""
    image, _ = draw_tag(20)
    fine, coarse = TagSettings(half_resolution_above=640 * 480), TagSettings(half_resolution_above=640 * 480 - 1)
    assert len(TagFinder("tag36h11", fine).find(image)) == 1
    assert len(TagFinder("tag36h11", coarse).find(image)) == 0


def draw_saddles(edge: int) -> tuple[Gray, Array]:
    """A dark square with small squares at its corners, as tags of Kalibr's grids have, and its corners (4, 2)."""
    scale, small = 8, round(0.3 * edge * 8)
    image = np.full((60 * scale, 60 * scale), 255, dtype=np.uint8)
    low, high = 20 * scale, (20 + edge) * scale
    image[low:high, low:high] = 0
    for x in (low - small, high):
        for y in (low - small, high):
            image[y : y + small, x : x + small] = 0
    fine = cv2.resize(image, (60, 60), interpolation=cv2.INTER_AREA)
    a, b = 19.5, 19.5 + edge
    return np.asarray(cv2.GaussianBlur(fine, (0, 0), 0.7), np.uint8), np.array([[a, a], [b, a], [b, b], [a, b]])


@pytest.mark.parametrize("side", [-1.0, 1.0])
def test_corners_of_a_small_grid_are_moved_by_an_eighth_of_an_edge(side: float) -> None:
    """Tags of 10 pixels: in a window of 1 pixel, corners stay; in one of 3, they move to the next saddle point."""
    image, corners = draw_saddles(10)
    start = corners + side * 10 / 8 * np.sqrt(0.5)
    refined = _refine_saddles(image, start.astype(np.float32))
    np.testing.assert_allclose(refined, corners, atol=0.5)
