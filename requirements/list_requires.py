"""Writes requires.json: what each pinned package requires, by its metadata, on any supported Python and system.

The files of this folder are installed without resolving anything, so that each must list all that its packages
require: tests/test_project.py compares them with requires.json. This program, run by `make requirements`, asks the
registry.
"""

import json
import subprocess
import sys
import tempfile
from pathlib import Path

from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

FOLDER = Path(__file__).resolve().parent
# The first and the last Python of a marker's interval: pins differ between 3.11.0 and 3.11.5.
PYTHONS = ("3.11.0", "3.11.15", "3.12.0", "3.13.0", "3.14.0")
SYSTEMS = ("linux", "darwin", "win32")


def main() -> None:
    """Writes the file."""
    lines = "\n".join(path.read_text(encoding="utf-8") for path in FOLDER.glob("*.txt")).splitlines()
    pins = [Requirement(line.rstrip("\\")) for line in lines if line[:1].isalnum()]
    requires: dict[str, list[str]] = {}
    for python in PYTHONS:
        extras: dict[str, set[str]] = {}
        for pin in pins:
            if key(pin) not in requires and holds(pin, {""}, (python,)):
                extras.setdefault(key(pin), {""}).update(pin.extras)
        for package, lines_of_package in fetch_metadata(sorted(extras), python).items():
            kept = [line for line in lines_of_package if holds(Requirement(line), extras[package], PYTHONS)]
            requires[package] = sorted(kept)
    text = json.dumps(requires, indent=1, sort_keys=True)
    (FOLDER / "requires.json").write_text(text + "\n", encoding="utf-8")


def key(pin: Requirement) -> str:
    """A pin without extras and marker."""
    return f"{canonicalize_name(pin.name)}{pin.specifier}"


def holds(requirement: Requirement, extras: set[str], pythons: tuple[str, ...]) -> bool:
    """Whether a requirement is one of some Python and system, with one of these extras."""
    return requirement.marker is None or any(
        requirement.marker.evaluate(
            {
                "python_version": python.rpartition(".")[0],
                "python_full_version": python,
                "sys_platform": system,
                "platform_system": {"linux": "Linux", "darwin": "Darwin", "win32": "Windows"}[system],
                "os_name": "nt" if system == "win32" else "posix",
                "extra": extra,
            }
        )
        for python in pythons
        for system in SYSTEMS
        for extra in extras
    )


def fetch_metadata(pins: list[str], python: str) -> dict[str, list[str]]:
    """The requirements of each pin, all extras included. Nothing is installed."""
    if not pins:
        return {}
    with tempfile.TemporaryDirectory() as folder:
        report = Path(folder) / "report.json"
        options = ["--dry-run", "--quiet", "--no-deps", "--ignore-installed", "--target", folder]
        options += ["--python-version", python, "--report", str(report)]
        subprocess.run([sys.executable, "-m", "pip", "install", *options, *pins], check=True)
        packages = [one["metadata"] for one in json.loads(report.read_text(encoding="utf-8"))["install"]]
    return {
        f"{canonicalize_name(one['name'])}=={one['version']}": one.get("requires_dist", []) for one in packages
    }


if __name__ == "__main__":
    main()
