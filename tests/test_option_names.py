"""The library names its own parameters; only the command line knows of options."""

import re
from pathlib import Path

import pytest

import calgraph

SOURCE = Path(calgraph.__file__).parent
OF_OTHER_PROGRAMS = {
    "parallel/open_cluster.py": "options of dask worker",
    "config/draft.py": "options of ros2 topic pub",
    "report/figures.py": "variables of CSS",
    "result/exports/launch.py": "options of tf2_ros's static_transform_publisher",
    "result/exports/tf.py": "options of ros2 topic pub",
}
OPTION = re.compile(r"(?<![\w-])--[a-z][\w-]*")


@pytest.mark.parametrize(
    "path",
    [
        path.relative_to(SOURCE).as_posix()
        for path in sorted(SOURCE.rglob("*.py"))
        if path.relative_to(SOURCE).parts[0] != "cli"
        and path.relative_to(SOURCE).as_posix() not in OF_OTHER_PROGRAMS
    ],
)
def test_no_module_outside_the_command_line_names_an_option(path: str) -> None:
    assert OPTION.findall((SOURCE / path).read_text(encoding="utf-8")) == []
