"""Every command that a page shows runs as it stands, in the order in which a reader would type it."""

import os
import re
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import typer
from typer.core import TyperGroup
from typer.main import get_command

from calgraph.cli.app import app

pytestmark = pytest.mark.without_coverage

ROOT = Path(__file__).resolve().parents[1]
BUILT = {"_build", "gallery", "generated"}
FIRST = "docs/quickstart.md"
"""It makes the recordings and results that other pages' commands take."""
PAGES = sorted(
    path.relative_to(ROOT).as_posix()
    for path in [*ROOT.glob("*.md"), *ROOT.glob("docs/**/*.md")]
    if not BUILT & set(path.relative_to(ROOT).parts)
)
NOT_RUN = {
    "pip install": "needs a network",
    "make": "is what runs the tests, and what they test by themselves",
    "ros2": "needs ROS",
    "rosbag": "needs ROS",
    "xacro": "needs ROS",
}
"""Commands that are shown but not run, by what they begin with, and why."""


def blocks(page: str) -> list[str]:
    """The shell blocks of a page, without commands that cannot be run."""
    text = (ROOT / page).read_text(encoding="utf-8")
    found = re.findall(r"^```(?:sh|bash|shell|console)\n(.*?)^```", text, re.MULTILINE | re.DOTALL)
    return [kept for block in found if (kept := runnable(block)).strip()]


def runnable(block: str) -> str:
    joined = re.sub(r"\\\n\s*", " ", block).replace("\n$ ", "\n").removeprefix("$ ")
    return "\n".join(line for line in joined.splitlines() if not any(line.startswith(word) for word in NOT_RUN))


def run(page: str, folder: Path) -> None:
    """Runs a page's commands in a folder, and stops at the first that fails."""
    path = os.pathsep.join([str(Path(sys.executable).parent), os.environ["PATH"]])
    for block in blocks(page):
        done = subprocess.run(
            ["bash", "-euo", "pipefail", "-c", block],
            cwd=folder,
            # Commands find earlier detections of a recording in the cache, as those of a reader do.
            env={**os.environ, "PATH": path, "CALGRAPH_CACHE": str(folder / "cache")},
            stdin=subprocess.DEVNULL,
            capture_output=True,
            text=True,
            check=False,
        )
        assert done.returncode == 0, f"{page}:\n{block}\n{done.stdout}\n{done.stderr}"


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("reader")
    run(FIRST, folder)
    return folder


@pytest.mark.timeout(600)
def test_quick_start_ends_with_a_result_to_use(folder: Path) -> None:
    made = ("rig.yaml", "result/report.html", "again/calibration.yaml", "sensors.launch.py", "robot.urdf")
    assert [name for name in made if not (folder / name).exists()] == []


@pytest.mark.timeout(600)
@pytest.mark.parametrize("page", [page for page in PAGES if page != FIRST and blocks(page)])
def test_commands_run(page: str, folder: Path) -> None:
    run(page, folder)


@pytest.mark.parametrize("page", PAGES)
def test_no_command_hides_in_an_indented_block(page: str) -> None:
    text = re.sub(r"^```.*?^```", "", (ROOT / page).read_text(encoding="utf-8"), flags=re.MULTILINE | re.DOTALL)
    assert not re.findall(r"^ {4,}(?:calgraph|pip|make) .*", text, re.MULTILINE)


def commands(command: Any, name: str = "calgraph") -> Iterator[tuple[str, set[str]]]:
    """All commands with their options."""
    if isinstance(command, TyperGroup):
        context = typer.Context(command)
        for part in command.list_commands(context):
            # Which imports the command: as it is listed, it has no options.
            yield from commands(command.resolve_command(context, [part])[1], f"{name} {part}")
    options = {option for param in command.params for option in (*param.opts, *param.secondary_opts)}
    yield name, options | {"--help"}


OF_PIP = "--require-hashes"
OPTIONS = dict(commands(get_command(app)))


def inline(page: str, start: str) -> list[str]:
    """Code within the lines of a page that begins so."""
    return re.findall(rf"`({start}[^`\n]*)`", (ROOT / page).read_text(encoding="utf-8"))


@pytest.mark.parametrize("page", PAGES)
def test_commands_within_lines_exist(page: str) -> None:
    for shown in inline(page, "calgraph "):
        name = max((name for name in OPTIONS if f"{shown} ".startswith(f"{name} ")), key=len)
        assert name != "calgraph" or shown.split()[1].startswith("-"), f"{shown}: there is no such command"
        unknown = {word.split("=")[0] for word in shown.split() if re.match("--?[a-z]", word)} - OPTIONS[name]
        assert not unknown, f"{shown}: {name} has no {', '.join(unknown)}"


@pytest.mark.parametrize("page", [page for page in PAGES if page != "docs/troubleshooting.md"])
def test_options_within_lines_exist(page: str) -> None:
    known = {OF_PIP}.union(*OPTIONS.values())
    assert not {shown.split()[0] for shown in inline(page, "--[a-z]")} - known
