"""The size of the house: lines, files, settings, packages, parameters of a command, and times of imports.

python benchmarks/house_size.py                            # of this checkout
python benchmarks/house_size.py OTHER_CHECKOUT .           # of another one beside it

Lines are those of all Python files, docstrings, comments and blank lines included. Settings are fields of classes
named ``…Settings``, but for those that hold other such classes. Times are the least of five runs.
"""

import argparse
import ast
import subprocess
import sys
import time
from collections.abc import Iterator
from os import environ
from pathlib import Path

RUNS = 5
COMMANDS = {
    "calgraph calibrate --help": "from calgraph.cli.launcher import main; main()",
    "import calgraph": "import calgraph",
    "import of the pipeline of rigs": (
        "try: import calgraph.rig.pipeline\nexcept ImportError: import calgraph.calibrate.rig"
    ),
    "import of the pipeline of networks": (
        "try: import calgraph.network.pipeline\nexcept ImportError: import calgraph.calibrate.network"
    ),
}
"""Programs by what they measure; earlier versions had the pipelines elsewhere."""


def main() -> None:
    """Prints a row for each figure, and a column for each checkout."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("checkouts", nargs="*", type=Path, default=[Path(__file__).resolve().parents[1]])
    arguments = parser.parse_args()
    columns = [dict(measure(checkout.resolve())) for checkout in arguments.checkouts]
    for name in dict.fromkeys(name for column in columns for name in column):
        print(f"{name:45}" + "".join(f"{column.get(name, '-'):>12}" for column in columns))


def measure(checkout: Path) -> Iterator[tuple[str, str]]:
    """Name and value of each figure of a checkout."""
    source = checkout / "src" / "calgraph"
    trees = {path: ast.parse(path.read_text(encoding="utf-8")) for path in sorted(source.rglob("*.py"))}
    yield "lines of src", str(sum(count_lines(path) for path in trees))
    yield "files of src", str(len(trees))
    yield "lines of benchmarks", str(sum(count_lines(path) for path in (checkout / "benchmarks").glob("*.py")))
    classes = [
        node
        for tree in trees.values()
        for node in ast.walk(tree)
        if isinstance(node, ast.ClassDef) and node.name.endswith("Settings") and node.bases
    ]
    names = {node.name for node in classes}
    fields = [
        one for node in classes for one in node.body
        if isinstance(one, ast.AnnAssign) and ast.unparse(one.annotation) not in names
    ]  # fmt: skip
    yield "settings", str(len(fields))
    yield "classes of settings", str(len(classes))
    yield "packages at the top", str(len([path for path in source.iterdir() if (path / "__init__.py").exists()]))
    yield "parameters of calibrate", str(count_parameters(trees[source / "cli" / "calibrate.py"]))
    for name, program in COMMANDS.items():
        arguments = ["calibrate", "--help"] if "help" in name else []
        yield f"{name}, s", f"{least_time(checkout, program, arguments):.2f}"


def count_lines(path: Path) -> int:
    """Of a file."""
    return len(path.read_text(encoding="utf-8").splitlines())


def count_parameters(tree: ast.Module) -> int:
    """Of the command that calibrates."""
    (command,) = (one for one in tree.body if isinstance(one, ast.FunctionDef) and one.name == "calibrate")
    return len(command.args.args) + len(command.args.kwonlyargs)


def with_source(checkout: Path) -> dict[str, str]:
    """The environment of a program that imports a checkout's package."""
    folders = [checkout / "src", checkout / "benchmarks", checkout / "tests"]
    return {**environ, "PYTHONPATH": ":".join(map(str, folders)), "OMP_NUM_THREADS": "1"}


def least_time(checkout: Path, program: str, arguments: list[str]) -> float:
    """Of several runs of a program, s."""
    times = []
    for _ in range(RUNS):
        begin = time.perf_counter()
        subprocess.run(
            [sys.executable, "-c", program, *arguments], env=with_source(checkout), capture_output=True, check=True
        )
        times.append(time.perf_counter() - begin)
    return min(times)


if __name__ == "__main__":
    main()
