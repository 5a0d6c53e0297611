"""Recipes for other ways of installing agree with pyproject.toml, and name files that exist."""

import ast
import re
import tomllib
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

from ruamel.yaml import YAML

ROOT = Path(__file__).resolve().parents[1]
PYPROJECT: dict[str, Any] = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))
PROJECT = PYPROJECT["project"]
ROS = ROOT / "ros2/calgraph_tree"
NAMES_OF_CONDA = {"opencv-python-headless": "py-opencv"}


def test_the_conda_recipe_has_the_versions_and_dependencies_of_the_project() -> None:
    recipe = YAML(typ="safe").load((ROOT / "packaging/conda/recipe.yaml").read_text(encoding="utf-8"))
    assert recipe["context"]["version"] == PROJECT["version"]
    needed = [re.fullmatch(r"([\w-]+)(.*)", one) for one in PROJECT["dependencies"]]
    expected = {f"{NAMES_OF_CONDA.get(one[1], one[1])} {one[2]}" for one in needed if one}
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
