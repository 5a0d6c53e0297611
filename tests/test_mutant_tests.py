"""The tests of a mutant are those that mirror its module or import it, the most specific ones first."""

from pathlib import Path

import pytest

from mutant_tests import Selection

FILES = {
    "src/calgraph/rig/__init__.py": "from calgraph.rig.solve import solve",
    "src/calgraph/rig/solve.py": "",
    "tests/rig/test_solve.py": "",
    "tests/rig/test_bundle.py": "from calgraph.rig import solve",
    "tests/rig/test_other.py": "import numpy",
    "tests/rig/pairs/test_pair.py": "",
    "tests/graph/test_tree.py": "def test(): from calgraph.rig.solve import solve",
    "tests/graph/test_scene.py": "from scenes import build",
    "tests/graph/test_path.py": "import calgraph.graph",
    "tests/cli/test_calibrate.py": "",
    "tests/scenes.py": "import calgraph.rig.solve",
}


@pytest.fixture
def checkout(tmp_path: Path) -> Path:
    for name, code in FILES.items():
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).write_text(code)
    return tmp_path


def test_tests_are_chosen_by_place_and_imports(checkout: Path) -> None:
    near, others = Selection(checkout).choose(Path("src/calgraph/rig/solve.py"))
    assert [file.as_posix() for file in near] == ["tests/rig/test_solve.py", "tests/rig/test_bundle.py"]
    assert [file.as_posix() for file in others] == [
        "tests/graph/test_scene.py",
        "tests/graph/test_tree.py",
        "tests/rig/pairs/test_pair.py",
        "tests/rig/test_other.py",
        "tests/cli/test_calibrate.py",
    ]
