"""fleet.yaml: what is refused, and in which words."""

from pathlib import Path

import pytest

from calgraph.config import load_fleet
from calgraph.errors import InputError

START = "rig: rig.yaml\nrecordings: '{robot}/*.mcap'\n"


def read(tmp_path: Path, text: str) -> str:
    path = tmp_path / "fleet.yaml"
    path.write_text(text)
    with pytest.raises(InputError) as refused:
        load_fleet(path)
    return str(refused.value).removeprefix(f"{path}: ")


def test_one_pattern_is_a_list_of_one(tmp_path: Path) -> None:
    (tmp_path / "fleet.yaml").write_text(START + "robots: {a: {}, b: {recordings: [1.bag, 2.bag]}}")
    config = load_fleet(tmp_path / "fleet.yaml")
    assert config.recordings == ("{robot}/*.mcap",)
    assert config.robots["b"].recordings == ("1.bag", "2.bag")


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("robots: {a: {}}", "robots.a.rig: is missing, and the fleet has no rig"),
        ("rig: rig.yaml\nrobots: {a: {}}", "robots.a.recordings: is missing, and the fleet has no recordings"),
        (START + "action: check\nrobots: {a: {}}", "robots.a.reference: is missing, and the fleet has no ref"),
        (START + "robots: {a: {rigs: x}}", "unknown key robots.a.rigs; did you mean 'rig'?"),
        (START + "robots: {../a: {}}", "robots: names have up to 100 letters"),
        (START + "robots: {}", "robots: must not be empty"),
        (START + "robots: {a: {recordings: []}}", "robots.a.recordings: must not be empty"),
        (START + "robots: {a: {}}\naction: verify", "action: must be 'calibrate' or 'check', got 'verify'"),
        (START + "robots: {a: {}}\nchanges: {min_translation: 3}", "changes.min_translation: is in m"),
    ],
)  # fmt: skip
def test_what_is_wrong_is_named(tmp_path: Path, text: str, message: str) -> None:
    assert read(tmp_path, text).startswith(message)
