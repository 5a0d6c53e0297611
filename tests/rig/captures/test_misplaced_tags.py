"""Tags that contradict the board in rig.yaml are named."""

from dataclasses import replace

import numpy as np
import pytest

from calgraph.boards.detections import BoardCorners, InconsistentTags
from calgraph.rig.captures.detect import find_misplaced_tags


@pytest.fixture(autouse=True)
def name_tags_of_three_captures(monkeypatch: pytest.MonkeyPatch) -> None:
    """Tags are named that contradict half of three captures."""
    monkeypatch.setattr("calgraph.rig.captures.detect._MIN_CAPTURES", 3)
    monkeypatch.setattr("calgraph.rig.captures.detect._MIN_SHARE", 0.5)


def board(tags: int, outlier_tags: tuple[int, ...] = ()) -> BoardCorners:
    corners = np.zeros((4 * tags, 3))
    found = BoardCorners(corners, corners[:, :2], np.eye(4), np.eye(6), np.ones(4), np.eye(3), 0.1)
    return replace(found, outlier_tags=outlier_tags)


def find_texts(boards: list[BoardCorners], inconsistent: int = 0) -> list[str]:
    rejected = [InconsistentTags("no two of them agree", (0, 1))] * inconsistent
    found = list(find_misplaced_tags("camera", [(one,) for one in boards], rejected))
    assert all(one.sensors == ("camera",) for one in found)
    return [one.text for one in found]


@pytest.mark.parametrize(
    ("outliers", "inliers", "named"), [(3, 0, True), (2, 0, False), (5, 5, True), (5, 6, False)]
)
def test_tag_is_named_if_it_is_an_outlier_in_half_of_the_captures_and_three(
    outliers: int, inliers: int, named: bool
) -> None:
    texts = find_texts([board(2, (7,))] * outliers + [board(3)] * inliers)
    assert [text.startswith(f"tag 7 is an outlier in up to {outliers} of the ") for text in texts] == [
        True
    ] * named


def test_captures_with_one_tag_do_not_count() -> None:
    (text,) = find_texts([board(2, (7,))] * 3 + [board(1)] * 20)
    assert "3 of the 3 captures in which camera detected several tags" in text


def test_tags_that_never_fit_together_are_all_named() -> None:
    (text,) = find_texts([board(1)] * 4, inconsistent=6)
    assert text.startswith("tags 0, 1 are outliers in up to 6 of the 6 captures")
