"""The page on settings names every setting with its default and limits."""

import pytest
from pydantic import BaseModel

from calgraph.config.settings import Settings
from calgraph.config.settings_tables import settings_tables
from test_settings import leaves

PAGE = settings_tables()


def rows() -> dict[str, list[str]]:
    """Default, limits and meaning by key."""
    found, heading = {}, ""
    for line in PAGE.splitlines():
        if line.startswith("## "):
            heading = line.removeprefix("## ")
        elif line.startswith("| `"):
            name, *cells = (cell.strip() for cell in line.strip("| ").split(" | "))
            found[f"{heading}.{name.strip('`')}"] = cells
    return found


def test_every_setting_has_its_row() -> None:
    assert sorted(rows()) == sorted(name for name, _ in leaves(Settings))


@pytest.mark.parametrize("name", ["detection.lidar3d.min_points", "captures.min_hold"])
def test_a_row_has_default_limits_and_meaning(name: str) -> None:
    settings: BaseModel = Settings()
    *stages, key = name.split(".")
    for stage in stages:
        settings = getattr(settings, stage)
    default, limits, meaning = rows()[name]
    assert float(default) == getattr(settings, key)
    assert limits[:1] in (">", "≥")
    assert len(meaning.split()) >= 6
