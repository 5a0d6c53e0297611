"""Commands use one thread of NumPy and OpenCV: results do not depend on the number of cores."""

import os
import subprocess
import sys

import pytest

_CODE = """
import os, sys
sys.argv = ["calgraph", "--version"]
from calgraph.cli import main
try:
    main()
except SystemExit:
    print(os.environ["OMP_NUM_THREADS"], os.environ["OPENCV_FOR_THREADS_NUM"], "numpy" in sys.modules)
"""


@pytest.mark.parametrize(("stated", "used"), [(None, "1"), ("3", "3")])
def test_libraries_use_one_thread_unless_the_environment_states_more(stated: str | None, used: str) -> None:
    environment = {key: value for key, value in os.environ.items() if key != "OMP_NUM_THREADS"}
    if stated:
        environment["OMP_NUM_THREADS"] = stated
    run = subprocess.run(
        [sys.executable, "-c", _CODE], env=environment, capture_output=True, text=True, check=True
    )
    assert run.stdout.split()[-3:] == [used, "1", "False"]
