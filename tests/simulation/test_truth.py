"""truth.yaml: what is damaged is named."""

from pathlib import Path

import pytest

from calgraph.errors import InputError
from calgraph.simulation import load_truth

TRUTH = """format: calgraph-truth/1
root: lidar
sensors:
  lidar: {translation: [0, 0, 0], rotation: [0, 0, 0, 1]}
captures:
- {trigger: 1.0, end: 2.0, translation: [0, 0, 1], rotation: [0, 0, 0, 1], disturbed: []}
people:
- {axes: [0.2, 0.1], start: 0, interval: 0.1, path: [[0, 0, 0]]}
"""


def test_the_example_is_read(tmp_path: Path) -> None:
    (tmp_path / "truth.yaml").write_text(TRUTH)
    truth = load_truth(tmp_path / "truth.yaml")
    assert (len(truth.boards), len(truth.people)) == (1, 1)


@pytest.mark.parametrize(
    ("old", "new"),
    [
        ("translation: [0, 0, 1]", "translation: 3"),
        ("translation: [0, 0, 0]", "translation: [0, 0]"),
        ("rotation: [0, 0, 0, 1]", "rotation: []"),
        ("rotation: [0, 0, 0, 1]", "rotation: x"),
        ("rotation: [0, 0, 0, 1]", "rotation: 1"),
        ("rotation: [0, 0, 0, 1]", "rotation: [1, 2]"),
        ("rotation: [0, 0, 0, 1]", "rotation: {a: 1}"),
        ("rotation: [0, 0, 0, 1]", "rotation: [0, 0, 0, 0]"),
        ("rotation: [0, 0, 0, 1]", "rotation: [0, 0, 0, 1e300]"),
        ("rotation: [0, 0, 0, 1]", "rotation: [0, 0, 0, .nan]"),
        ("captures:\n-", "captures:\n- 3\n-"),
        ("captures:\n-", "captures: 3\nother:\n-"),
        ("sensors:\n  lidar:", "sensors: []\nother:\n  lidar:"),
        ("lidar: {", "lidar: 3\n  other: {"),
        ("path: [[0, 0, 0]]", "path: [0, 0]"),
        ("interval: 0.1", "interval: x"),
        ("root: lidar", "root: !!int abc"),
    ],
)  # fmt: skip
def test_what_is_damaged_is_named(tmp_path: Path, old: str, new: str) -> None:
    assert old in TRUTH
    path = tmp_path / "truth.yaml"
    path.write_text(TRUTH.replace(old, new))
    with pytest.raises(InputError, match=r"truth\.yaml"):
        load_truth(path)
