"""What the checkout promises: pages that are true, and an environment that is pinned."""

import doctest
import json
import re
import tomllib
from collections.abc import Callable
from importlib.metadata import distributions
from pathlib import Path
from typing import Any

import pytest
from packaging.requirements import Requirement
from packaging.specifiers import SpecifierSet
from packaging.utils import canonicalize_name
from ruamel.yaml import YAML

from calgraph.config import load_rig

ROOT = Path(__file__).resolve().parents[1]
PAGES = sorted([*ROOT.glob("*.md"), *ROOT.glob("docs/**/*.md")])
PINNED = ("requirements/dev.txt", "requirements/runtime.txt", "requirements/fuzz.txt")
WORKFLOW = ".github/workflows/ci.yml"
FORMS = sorted(form for form in ROOT.glob(".github/ISSUE_TEMPLATE/*.yml") if form.stem != "config")


def project() -> dict[str, Any]:
    return dict(tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"])


def yaml_of(file: str) -> Any:
    return YAML(typ="safe").load((ROOT / file).read_text(encoding="utf-8"))


def make_targets(text: str) -> set[str]:
    """Targets that a script or a workflow calls make with."""
    return set(re.findall(r"\bmake ([a-z]+)", re.sub(r"#.*", "", text)))


def code_of(page: str, language: str) -> list[str]:
    """The fenced blocks of a page in one language."""
    return re.findall(rf"```{language}\n(.*?)```", (ROOT / page).read_text(encoding="utf-8"), re.DOTALL)


def requirements() -> list[tuple[str, Requirement]]:
    """Every requirement of pyproject.toml, with the files that must pin it."""
    of_users = [(file, Requirement(line)) for line in project()["dependencies"] for file in PINNED]
    # Developers have all extras of calgraph itself, but for those that only the fuzzer needs.
    extras = [
        (f"requirements/{extra}.txt" if extra == "fuzz" else PINNED[0], Requirement(line))
        for extra, lines in project()["optional-dependencies"].items()
        for line in lines
    ]
    of_developers = [(file, needed) for file, needed in extras if needed.name != project()["name"]]
    return of_users + of_developers


def pins(file: str) -> dict[str, list[str]]:
    """Pinned versions by package; several where they differ between Pythons."""
    found: dict[str, list[str]] = {}
    for pin in pinned(file):
        found.setdefault(canonicalize_name(pin.name), []).append(str(pin.specifier).removeprefix("=="))
    return found


def pinned(file: str) -> list[Requirement]:
    """The lines of a file of requirements/, without hashes."""
    lines = (ROOT / file).read_text(encoding="utf-8").splitlines()
    return [Requirement(line.rstrip("\\")) for line in lines if line[:1].isalnum()]


def holds(requirement: Requirement, environment: dict[str, str], extras: set[str]) -> bool:
    """Whether a requirement is one of an environment, with any of these extras of the package that has it."""
    marker = requirement.marker
    return marker is None or any(marker.evaluate({**environment, "extra": extra}) for extra in {"", *extras})


def open_requirements(pins: list[Requirement], environment: dict[str, str]) -> list[str]:
    """What packages installed by some pins require in an environment, and the pins do not install."""
    required = json.loads((ROOT / "requirements/requires.json").read_text(encoding="utf-8"))
    chosen = {canonicalize_name(pin.name): pin for pin in pins if holds(pin, environment, set())}
    left = [
        f"requires.json lacks {pin}" for name, pin in chosen.items() if f"{name}{pin.specifier}" not in required
    ]
    for name, pin in chosen.items():
        for needed in map(Requirement, required.get(f"{name}{pin.specifier}", [])):
            if holds(needed, environment, pin.extras):
                of_needed = chosen.get(canonicalize_name(needed.name))
                version = str(of_needed.specifier).removeprefix("==") if of_needed else ""
                if (
                    of_needed is None
                    or not needed.specifier.contains(version, prereleases=True)
                    or not needed.extras <= of_needed.extras
                ):
                    left.append(f"{pin.name} requires {needed}")
    return left


def named_in_pages(pattern: str) -> list[tuple[Path, str]]:
    """Each page with what a pattern matches in it."""
    return [(page, name) for page in PAGES for name in re.findall(pattern, page.read_text(encoding="utf-8"))]


def test_links_lead_somewhere() -> None:
    links = named_in_pages(r"\]\((?!https?:)([^)#]+)")
    assert len(links) > 100
    assert [(page.name, link) for page, link in links if not (page.parent / link).exists()] == []


def test_files_that_pages_name_exist() -> None:
    named = named_in_pages(r"`((?:\w+/)+[\w.]+\.py)`")
    assert len(named) > 50
    folders = (ROOT, ROOT / "src/calgraph")
    missing = [(page.name, name) for page, name in named if not any((one / name).exists() for one in folders)]
    assert missing == []


def test_worked_example_of_the_conventions_gives_the_stated_output() -> None:
    example = "\n".join(code_of("docs/conventions.md", "python"))
    test = doctest.DocTestParser().get_doctest(example, {}, "conventions.md", "docs/conventions.md", 0)
    report: list[str] = []
    doctest.DocTestRunner(verbose=False).run(test, out=report.append)
    assert not report, "".join(report)


def test_rig_yaml_of_the_readme_is_read(tmp_path: Path) -> None:
    (tmp_path / "rig.yaml").write_text(code_of("README.md", "yaml")[0], encoding="utf-8")
    assert list(load_rig(tmp_path / "rig.yaml").sensors) == ["lidar", "laser", "camera"]


def test_badges_of_the_readme_state_what_the_package_does() -> None:
    shown = {badge.stem: badge.read_text(encoding="utf-8") for badge in ROOT.glob("docs/images/badge_*.svg")}
    pythons = re.findall(r"Python :: (3\.\d+)", "\n".join(project()["classifiers"]))
    assert f">{pythons[0]} to {pythons[-1]}<" in shown["badge_python"]
    assert f">{project()['license']}<" in shown["badge_licence"]


def test_requirements_are_pinned_to_versions_they_allow() -> None:
    pinned_in = {file: pins(file) for file in PINNED}
    stated = [
        (file, needed, pinned_in[file].get(canonicalize_name(needed.name), [])) for file, needed in requirements()
    ]
    assert [f"{file}: {needed}" for file, needed, versions in stated if not versions] == [], (
        "run make requirements"
    )
    assert [
        f"{file}: {needed}, not {version}"
        for file, needed, versions in stated
        for version in versions
        if not needed.specifier.contains(version)
    ] == []


@pytest.mark.parametrize("file", PINNED)
def test_every_pinned_version_has_hashes(file: str) -> None:
    entries = re.split(r"^(?=\S+==)", (ROOT / file).read_text(), flags=re.MULTILINE)[1:]
    assert len(entries) > 10
    assert all("--hash=sha256:" in entry for entry in entries)


PLATFORMS = {"linux": "Linux", "darwin": "Darwin", "win32": "Windows"}
PYTHONS = ("3.11.0", "3.11.15", "3.12.12", "3.13.9", "3.14.0")


@pytest.mark.parametrize("file", PINNED)
def test_a_file_of_pins_leaves_no_requirement_open(file: str) -> None:
    environments = [
        {
            "python_version": python.rpartition(".")[0],
            "python_full_version": python,
            "sys_platform": system,
            "platform_system": name,
            "os_name": "nt" if system == "win32" else "posix",
        }
        for python in PYTHONS
        for system, name in PLATFORMS.items()
    ]
    still_open = {
        f"{one['sys_platform']} {one['python_full_version']}: {left}"
        for one in environments
        for left in open_requirements(pinned(file), one)
    }
    assert still_open == set()


@pytest.mark.parametrize(
    ("spoil", "message"),
    [
        (lambda line: None if line.startswith("tornado==") else line, "distributed requires tornado"),
        (lambda line: line.replace("coverage[toml]", "coverage"), "pytest-cov requires coverage[toml]"),
        (lambda line: line.replace("botocore==1.", "botocore==0."), "boto3 requires botocore"),
    ],
    ids=["missing", "extra", "version"],
)
def test_a_requirement_that_pins_leave_open_is_named(spoil: Callable[[str], str | None], message: str) -> None:
    lines = [spoil(str(pin)) for pin in pinned("requirements/dev.txt")]
    required = open_requirements([Requirement(line) for line in lines if line], {"python_full_version": "3.12.0"})
    assert any(line.startswith(message) for line in required)


def test_stored_requirements_are_those_of_the_installed_packages() -> None:
    stored = json.loads((ROOT / "requirements/requires.json").read_text(encoding="utf-8"))
    compared = 0
    for package in distributions():
        lines = stored.get(f"{canonicalize_name(package.name)}=={package.version}")
        if lines is not None:
            compared += 1
            of_package = package.requires or []
            assert {line for line in of_package if ";" not in line} <= set(lines) <= set(of_package)
    assert compared > 100


@pytest.mark.parametrize("file", PINNED)
def test_pinned_files_name_no_registry(file: str) -> None:
    assert not re.search(r"https?:|--index|--find-links|--trusted-host", (ROOT / file).read_text())


def test_ci_tests_every_supported_python() -> None:
    classified = re.findall(r"Python :: (3\.\d+)", "\n".join(project()["classifiers"]))
    tested = yaml_of(WORKFLOW)["jobs"]["test"]["strategy"]["matrix"]["python"]
    assert tested == classified
    allowed = SpecifierSet(project()["requires-python"])
    assert classified[0] == next(f"3.{minor}" for minor in range(30) if allowed.contains(f"3.{minor}")) == "3.11"


def test_workflow_runs_the_targets_of_the_ci_script_and_the_documentation() -> None:
    of_script = make_targets((ROOT / ".ci/run").read_text(encoding="utf-8"))
    of_workflow = make_targets((ROOT / WORKFLOW).read_text(encoding="utf-8"))
    assert of_script == {"setup", "check", "test"}
    assert of_workflow == of_script | {"docs", "demo"}


def test_continuous_integration_fails_below_95_percent_coverage() -> None:
    settings = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["tool"]["coverage"]
    assert settings["run"]["branch"] is True
    assert settings["report"]["fail_under"] == 95
    assert 'make test ARGS="--cov --cov-report="' in (ROOT / WORKFLOW).read_text(encoding="utf-8")


def test_nothing_is_resolved_while_it_is_installed() -> None:
    scripts = [(ROOT / file).read_text(encoding="utf-8") for file in ("Makefile", "requirements/install")]
    installing = re.findall(r"\bpip install .*", "\n".join(scripts))
    of_packages = [line for line in installing if "$INSTALLER" not in line]
    assert len(of_packages) == 2
    assert all("--no-deps" in line for line in of_packages)


def test_called_targets_exist() -> None:
    defined = set(re.findall(r"^([a-z]+):", (ROOT / "Makefile").read_text(encoding="utf-8"), re.MULTILINE))
    called = make_targets("\n".join((ROOT / file).read_text(encoding="utf-8") for file in (".ci/run", WORKFLOW)))
    assert called - defined == set()


def test_pre_commit_runs_the_tools_of_make_check() -> None:
    recipe = re.search(r"^check:.*\n((?:\t.*\n)+)", (ROOT / "Makefile").read_text(encoding="utf-8"), re.MULTILINE)
    assert recipe
    of_make = [line.split()[0].removeprefix("$(BIN)/") for line in recipe.group(1).splitlines()]
    (local,) = yaml_of(".pre-commit-config.yaml")["repos"]
    of_hooks = [hook["entry"].split()[0].removeprefix(".venv/bin/") for hook in local["hooks"]]
    assert of_hooks == of_make == ["ruff", "ruff", "mypy", "lint-imports", "python"]


@pytest.mark.parametrize("form", FORMS, ids=lambda form: form.stem)
def test_issue_form_is_what_the_host_accepts(form: Path) -> None:
    content = yaml_of(form.relative_to(ROOT).as_posix())
    assert set(content) == {"name", "description", "labels", "body"}
    fields = [field for field in content["body"] if field["type"] != "markdown"]
    assert {field["type"] for field in fields} <= {"input", "textarea", "dropdown", "checkboxes"}
    assert all(field["attributes"]["label"] for field in fields)
    assert len({field["id"] for field in fields}) == len(fields)


def test_citation_states_the_version_and_the_licence_of_the_package() -> None:
    citation = yaml_of("CITATION.cff")
    stated = {key: str(citation[key]) for key in ("title", "version", "license")}
    assert stated == {"title": project()["name"], "version": project()["version"], "license": project()["license"]}
    assert citation["cff-version"] == "1.2.0"


@pytest.mark.parametrize("story", ["A rig", "A network"])
def test_the_reading_path_of_a_story_is_short(story: str) -> None:
    page = (ROOT / "docs/architecture.md").read_text()
    section = page.split(f"### {story}\n")[1].split("\n## ")[0].split("\n### ")[0]
    files = re.findall(r"^\| `(\S+\.py)`", section, re.MULTILINE)
    lines = sum(len((ROOT / "src/calgraph" / file).read_text().splitlines()) for file in files)
    assert 5 <= len(files) <= 10
    assert lines <= 2000


def test_the_picture_of_the_house_shows_the_import_contract() -> None:
    rooms = re.findall(r'font-weight="bold">(\w+)<', (ROOT / "docs/images/house.svg").read_text(encoding="utf-8"))
    tools = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["tool"]
    layers = next(c for c in tools["importlinter"]["contracts"] if c["type"] == "layers")["layers"]
    assert rooms == [room.strip() for line in layers for room in line.split("|")]
