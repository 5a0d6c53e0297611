"""What the checkout promises: pages that are true, and an environment that is pinned."""

import doctest
import re
import tomllib
from pathlib import Path

import pytest
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

from calgraph.config import load_rig

ROOT = Path(__file__).resolve().parents[1]
PAGES = sorted([*ROOT.glob("*.md"), *ROOT.glob("docs/**/*.md")])
PINNED = ("requirements/dev.txt", "requirements/runtime.txt")


def code_of(page: str, language: str) -> list[str]:
    """The fenced blocks of a page in one language."""
    return re.findall(rf"```{language}\n(.*?)```", (ROOT / page).read_text(encoding="utf-8"), re.DOTALL)


def requirements() -> list[tuple[str, Requirement]]:
    """Every requirement of pyproject.toml, with the files that must pin it."""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    of_users = [(file, Requirement(line)) for line in project["dependencies"] for file in PINNED]
    extras = [Requirement(line) for lines in project["optional-dependencies"].values() for line in lines]
    # Developers have all extras of calgraph itself.
    of_developers = [(PINNED[0], needed) for needed in extras if needed.name != project["name"]]
    return of_users + of_developers


def pins(file: str) -> dict[str, list[str]]:
    """Pinned versions by package; several where they differ between Pythons."""
    found: dict[str, list[str]] = {}
    for name, version in re.findall(r"^([\w.-]+)==([^ ;\\]+)", (ROOT / file).read_text(), re.MULTILINE):
        found.setdefault(canonicalize_name(name), []).append(version)
    return found


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.relative_to(ROOT).as_posix())
def test_links_lead_somewhere(page: Path) -> None:
    links = re.findall(r"\]\((?!https?:)([^)#]+)", page.read_text(encoding="utf-8"))
    missing = [link for link in links if not (page.parent / link).exists()]
    assert not missing


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.relative_to(ROOT).as_posix())
def test_files_that_pages_name_exist(page: Path) -> None:
    named = re.findall(r"`((?:\w+/)+[\w.]+\.py)`", page.read_text(encoding="utf-8"))
    missing = [
        name for name in named if not (ROOT / name).exists() and not (ROOT / "src/calgraph" / name).exists()
    ]
    assert not missing


def test_worked_example_of_the_conventions_gives_what_it_says() -> None:
    example = "\n".join(code_of("docs/conventions.md", "python"))
    test = doctest.DocTestParser().get_doctest(example, {}, "conventions.md", "docs/conventions.md", 0)
    report: list[str] = []
    doctest.DocTestRunner(verbose=False).run(test, out=report.append)
    assert not report, "".join(report)


def test_rig_yaml_of_the_readme_is_read(tmp_path: Path) -> None:
    (tmp_path / "rig.yaml").write_text(code_of("README.md", "yaml")[0], encoding="utf-8")
    assert list(load_rig(tmp_path / "rig.yaml").sensors) == ["lidar", "laser", "camera"]


@pytest.mark.parametrize(("file", "needed"), requirements(), ids=str)
def test_requirement_is_pinned_to_a_version_it_allows(file: str, needed: Requirement) -> None:
    versions = pins(file).get(canonicalize_name(needed.name), [])
    assert versions, f"{file} does not pin {needed}: run make requirements"
    assert all(needed.specifier.contains(version) for version in versions)


@pytest.mark.parametrize("file", PINNED)
def test_every_pinned_version_has_hashes(file: str) -> None:
    entries = re.split(r"^(?=\S+==)", (ROOT / file).read_text(), flags=re.MULTILINE)[1:]
    assert len(entries) > 10
    assert all("--hash=sha256:" in entry for entry in entries)


@pytest.mark.parametrize("file", PINNED)
def test_pinned_files_name_no_registry(file: str) -> None:
    assert not re.search(r"https?:|--index|--find-links|--trusted-host", (ROOT / file).read_text())
