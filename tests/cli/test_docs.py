"""``calgraph docs``: pages that are installed with the package, to which the help of commands points."""

from collections.abc import Callable
from importlib.metadata import PackagePath
from pathlib import Path

import pytest
from typer.testing import Result

from calgraph.cli import docs
from calgraph.cli.app import COMMANDS, SIMULATIONS
from calgraph.cli.lazy_commands import LazyCommand

Run = Callable[..., Result]
PAGES = Path(__file__).resolve().parents[2] / "docs"


def test_pages_are_listed_in_the_order_of_learning(run: Run) -> None:
    names = [line.split()[0] for line in run("docs").stdout.splitlines()[1:]]
    assert names[:4] == ["quickstart", "concepts", "recording", "rigs"]
    assert {"troubleshooting", "method/rig"} <= set(names)


@pytest.mark.parametrize("command", [*COMMANDS.values(), *SIMULATIONS.values()], ids=lambda one: one.function)
def test_the_help_of_a_command_points_to_a_page(command: LazyCommand, run: Run) -> None:
    listed = [line.split()[0] for line in run("docs").stdout.splitlines()]
    assert command.page in listed


def test_a_page_in_a_pipe_is_markdown(run: Run) -> None:
    assert run("docs", "use").stdout == (PAGES / "use.md").read_text("utf-8")


def test_the_page_on_settings_has_them(run: Run) -> None:
    assert "| `lidar3d.min_points` |" in run("docs", "settings").stdout


def test_an_unknown_page_is_named_with_the_others(run: Run) -> None:
    result = run("docs", "handbook")
    assert result.exit_code == 2
    assert "handbook: is no page, which are quickstart, concepts" in result.stderr


def test_installed_pages_are_those_of_the_package(
    run: Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder = tmp_path / "share/doc/calgraph"
    folder.mkdir(parents=True)
    (folder / "index.md").write_text("# Index\nquickstart\n", encoding="utf-8")
    (folder / "quickstart.md").write_text("# First steps\n", encoding="utf-8")
    record = PackagePath("../../../share/doc/calgraph/quickstart.md")
    record.dist = Located(folder / "quickstart.md")  # type: ignore[assignment]
    monkeypatch.setattr(docs, "_CHECKOUT", tmp_path / "none")
    monkeypatch.setattr(docs, "files", lambda _: [record])
    assert run("docs", "quickstart").stdout == "# First steps\n"
    monkeypatch.setattr(docs, "files", lambda _: [])
    assert "are in the folder docs of the source" in run("docs").stderr


class Located:
    """In place of an installed distribution."""

    def __init__(self, path: Path) -> None:
        self.path = path

    def locate_file(self, _: object) -> Path:
        return self.path
