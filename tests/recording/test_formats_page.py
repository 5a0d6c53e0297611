"""What docs/formats.md shows must be accepted as it is."""

import re
from pathlib import Path

import pytest
from ruamel.yaml import YAML

from calgraph.config import Intrinsics, load_rig
from calgraph.recording.camera_info import camera_from_yaml


@pytest.fixture
def examples() -> list[str]:
    page = Path(__file__).resolve().parents[2] / "docs" / "formats.md"
    return re.findall(r"```yaml\n(.*?)```", page.read_text(encoding="utf-8"), re.DOTALL)


def test_rig_yaml_of_the_page_is_read(examples: list[str], tmp_path: Path) -> None:
    (tmp_path / "rig.yaml").write_text(next(text for text in examples if text.startswith("root:")))
    assert set(load_rig(tmp_path / "rig.yaml").sensors) == {"camera", "lidar", "laser"}


def test_intrinsics_of_the_page_are_read(examples: list[str]) -> None:
    text = next(text for text in examples if text.startswith("intrinsics:"))
    assert Intrinsics(**YAML(typ="safe").load(text)["intrinsics"]).to_camera().distortion.size == 4


def test_camera_info_of_the_page_is_read(examples: list[str]) -> None:
    text = next(text for text in examples if text.startswith("width:"))
    assert camera_from_yaml(YAML(typ="safe").load(text)).model == "fisheye"
