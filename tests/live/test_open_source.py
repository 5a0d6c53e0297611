"""What the user may give as a source."""

from pathlib import Path

import pytest

from calgraph.config.settings import Settings
from calgraph.errors import InputError
from calgraph.live.open_source import open_source


def test_a_path_is_a_recording_to_replay(tmp_path: Path) -> None:
    path = tmp_path / "a recording.mcap"
    path.touch()
    assert open_source(str(path), Settings()).name == str(path)


def test_a_path_that_does_not_exist_is_refused_with_the_likely_name(tmp_path: Path) -> None:
    (tmp_path / "walk.mcap").touch()
    with pytest.raises(
        InputError, match=r"is neither an address nor an existing recording; did you mean .*walk\.mcap"
    ):
        open_source(str(tmp_path / "walks.mcap"), Settings())
