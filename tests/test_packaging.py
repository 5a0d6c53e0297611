"""Recipes for other ways of installing agree with pyproject.toml, and name files that exist."""

import ast
import re
import shlex
import subprocess
import tomllib
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import pytest
from packaging.requirements import Requirement
from ruamel.yaml import YAML

ROOT = Path(__file__).resolve().parents[1]
PYPROJECT: dict[str, Any] = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))
PROJECT = PYPROJECT["project"]
ROS = ROOT / "ros2/calgraph_tree"
NAMES_OF_CONDA = {"opencv-python-headless": "py-opencv"}


def test_the_conda_recipe_has_the_versions_and_dependencies_of_the_project() -> None:
    recipe = YAML(typ="safe").load((ROOT / "packaging/conda/recipe.yaml").read_text(encoding="utf-8"))
    assert recipe["context"]["version"] == PROJECT["version"]
    needed = [Requirement(one) for one in PROJECT["dependencies"]]
    # The recipe has no such conditions.
    assert not any(one.marker or one.extras for one in needed)
    bounds = {one.name: ",".join(sorted(map(str, one.specifier), reverse=True)) for one in needed}
    expected = {f"{NAMES_OF_CONDA.get(name, name)} {bound}" for name, bound in bounds.items()}
    assert set(recipe["requirements"]["run"]) == {f"python {PROJECT['requires-python']}", *expected}


def test_wheels_have_all_files_of_the_package() -> None:
    package = ROOT / "src/calgraph"
    patterns = PYPROJECT["tool"]["setuptools"]["package-data"]["calgraph"]
    packed = {path for pattern in patterns for path in package.glob(pattern)}
    files = {path for path in package.rglob("*") if path.is_file() and path.suffix not in (".py", ".pyc")}
    assert files - packed == set()


def test_the_image_copies_what_exists_and_is_not_ignored() -> None:
    lines = (ROOT / "Dockerfile").read_text(encoding="utf-8").splitlines()
    copied = [name for line in lines if line.startswith("COPY") for name in line.split()[1:-1]]
    sent = [line[1:] for line in (ROOT / ".dockerignore").read_text().splitlines() if line.startswith("!")]
    assert sorted(copied) == sorted(sent)
    assert all((ROOT / name).exists() for name in copied)


def test_the_ros_package_installs_its_launch_file() -> None:
    package = ElementTree.parse(ROS / "package.xml").getroot()
    build = (ROS / "CMakeLists.txt").read_text(encoding="utf-8")
    assert (package.get("format"), package.findtext("version")) == ("3", PROJECT["version"])
    assert f"project({package.findtext('name')})" in build
    (folder,) = re.findall(r"install\(DIRECTORY (\w+)", build)
    launch = ast.parse((ROS / folder / "tree.launch.py").read_text(encoding="utf-8"))
    assert "generate_launch_description" in {one.name for one in launch.body if isinstance(one, ast.FunctionDef)}
    imported = {one.module.split(".")[0] for one in launch.body if isinstance(one, ast.ImportFrom) and one.module}
    assert imported <= {one.text for one in package.findall("exec_depend")}


def read_commands(*names: str) -> list[str]:
    """The commands of these programs that pages show, in blocks and within lines."""
    pages = [*ROOT.glob("*.md"), *(ROOT / "docs").glob("*.md"), *(ROOT / "docs/decisions").glob("*.md")]
    text = "\n".join(page.read_text(encoding="utf-8") for page in pages)
    start = rf"(?:{'|'.join(names)}) "
    return [*re.findall(rf"`({start}[^`\n]+)`", text), *re.findall(rf"^({start}.+)$", text, re.MULTILINE)]


def test_commands_that_no_test_runs_are_shell() -> None:
    """Those of pip, make, docker, git, ROS and Python."""
    commands = read_commands("pip", "make", "docker", "git", "colcon", "ros2", "rosbag", "python")
    assert len(commands) > 40
    for one in commands:
        parsed = subprocess.run(["bash", "-n", "-c", one], capture_output=True, text=True, check=False)
        assert parsed.returncode == 0, f"{one}: {parsed.stderr}"


def list_unknown(commands: list[str]) -> list[str]:
    """What commands name that the project does not have: targets, extras, files, images and packages."""
    targets = re.findall(r"^([\w-]+):", (ROOT / "Makefile").read_text(encoding="utf-8"), re.MULTILINE)
    extras = PROJECT["optional-dependencies"]
    unknown: list[str] = []
    for one in commands:
        program, *words = shlex.split(one, comments=True)
        if program == "make":
            unknown += {word for word in words if "=" not in word} - set(targets)
        files = [word for word in words if re.fullmatch(r"[\w./-]+\.(py|txt)", word)]
        unknown += [name for name in files if program in ("pip", "python") and not (ROOT / name).is_file()]
        unknown += [extra for extra in re.findall(r"(?<=[\[,])[\w-]+(?=[\],])", one) if extra not in extras]
        if program == "docker" and words[0] == "build":
            unknown += [] if (ROOT / words[-1] / "Dockerfile").is_file() else [one]
        if "calgraph_" in one:
            launched = words[words.index(ROS.name) + 1 :]
            unknown += [name for name in launched if not (ROS / "launch" / name).is_file()]
    return unknown


def test_commands_that_no_test_runs_name_what_exists() -> None:
    assert list_unknown(read_commands("pip", "make", "docker", "colcon", "ros2", "python")) == []


@pytest.mark.parametrize(
    ("command", "unknown"),
    [
        ("make chekc", "chekc"),
        ("pip install 'calgraph[view,lvie]'", "lvie"),
        ("pip install -r requirements/gone.txt", "requirements/gone.txt"),
        ("ros2 launch calgraph_tree gone.launch.py", "gone.launch.py"),
    ],
)
def test_a_command_that_names_nothing_is_found(command: str, unknown: str) -> None:
    assert list_unknown([command]) == [unknown]
