"""Every command that a page shows runs as it stands, in the order in which a reader would type it."""

import os
import re
import shutil
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path

import pytest

from calgraph.config import load_rig
from calgraph.result import load_calibration

pytestmark = pytest.mark.slow

ROOT = Path(__file__).resolve().parents[1]
BUILT = {"_build", "gallery", "generated"}
FIRST = "docs/quickstart.md"
"""It makes the recordings and results that other pages' commands take."""
LIVE = "docs/live.md"
FLEET = "docs/fleet.md"
PLACES = 14
"""To which the simulated operator of the quick start carries the board."""
EMPTY = 5.0
"""s; time at the start of its recording without board and operator."""
PAGES = sorted(
    path.relative_to(ROOT).as_posix()
    for path in [*ROOT.glob("*.md"), *ROOT.glob("docs/**/*.md")]
    if not BUILT & set(path.relative_to(ROOT).parts)
)
NOT_RUN = {
    "git clone": "needs a network",
    "cd calgraph": "is into the checkout",
    "pip": "needs a network, or removes what runs the tests",
    "make": "is what runs the tests, and what they test by themselves",
    "ros2": "needs ROS",
    "rosbag": "needs ROS",
    "xacro": "needs ROS",
}
"""Commands that are shown but not run, by what they begin with, and why."""


WITH_PYTHON = ("docs/library.md", "docs/use.md", "docs/formats.md")
"""Pages whose programs take the recording and the results of the quick start."""


def python_of(page: str) -> str:
    """All programs of a page."""
    text = (ROOT / page).read_text(encoding="utf-8")
    return "\n".join(re.findall(r"^```python\n(.*?)^```", text, re.MULTILINE | re.DOTALL))


def run_python(page: str, folder: Path) -> None:
    done = subprocess.run(
        [sys.executable, "-c", python_of(page)], cwd=folder, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, f"{page}:\n{done.stderr}"


def blocks(page: str) -> list[str]:
    """The shell blocks of a page, without commands that cannot be run."""
    text = (ROOT / page).read_text(encoding="utf-8")
    found = re.findall(r"^```(?:sh|bash|shell|console)\n(.*?)^```", text, re.MULTILINE | re.DOTALL)
    return [kept for block in found if (kept := runnable(block)).strip()]


def runnable(block: str) -> str:
    # Of tests that run at the same time, one alone could have the default port.
    block = block.replace("calgraph live ", "calgraph live --port 0 ")
    joined = re.sub(r"\\\n\s*", " ", block).replace("\n$ ", "\n").removeprefix("$ ")
    return "\n".join(line for line in joined.splitlines() if not any(line.startswith(word) for word in NOT_RUN))


def run(page: str, folder: Path) -> str:
    """Runs a page's commands in a folder, and stops at the first that fails; what they printed."""
    return "".join(run_block(block, folder, page) for block in blocks(page))


def run_block(block: str, folder: Path, page: str) -> str:
    path = os.pathsep.join([str(Path(sys.executable).parent), os.environ["PATH"]])
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
    return done.stdout + done.stderr


@dataclass(frozen=True)
class Reader:
    """Who has typed the commands of a page."""

    folder: Path
    printed: str


@pytest.fixture(scope="module")
def reader(tmp_path_factory: pytest.TempPathFactory) -> Reader:
    """Of the quick start."""
    folder = tmp_path_factory.mktemp("reader")
    return Reader(folder, run(FIRST, folder))


@pytest.fixture(scope="module")
def live_reader(reader: Reader) -> Reader:
    """Of the quick start, and then of the page on live capture."""
    return Reader(reader.folder, run(LIVE, reader.folder))


@pytest.mark.timeout(600)
def test_quick_start_ends_with_a_result_to_use(reader: Reader) -> None:
    made = ("rig.yaml", "result/report.html", "again/calibration.yaml", "sensors.launch.py", "robot.urdf")
    assert [name for name in made if not (reader.folder / name).exists()] == []


@pytest.mark.parametrize(
    "claimed",
    [
        "No anomalies were found",
        "the covariance of camera is consistent with the bootstrap",
        "ros2 launch sensors.launch.py",
        "ros2 topic pub",
    ],
)
def test_quick_start_prints_what_it_claims(claimed: str, reader: Reader) -> None:
    assert claimed in reader.printed


def test_every_place_of_the_quick_start_is_a_capture(reader: Reader) -> None:
    evidence = load_calibration(reader.folder / "result/calibration.yaml").evidence
    assert len({row.capture for row in evidence.captures}) == PLACES


def test_the_problem_of_the_quick_start_is_half_a_megabyte(reader: Reader) -> None:
    assert (reader.folder / "problem.npz").stat().st_size / 1e6 == pytest.approx(0.5, abs=0.1)


def test_a_background_of_the_draft_ends_before_the_board_is_in_view(reader: Reader) -> None:
    start, end = load_rig(reader.folder / "rig.yaml").capture.background or (0.0, 0.0)
    assert 0 <= start <= end <= EMPTY


@pytest.mark.parametrize("page", [FIRST, *WITH_PYTHON])
def test_python_of_pages_runs(page: str, reader: Reader) -> None:
    run_python(page, reader.folder)


def test_no_other_page_has_a_program() -> None:
    # Those of conventions.md are doctests.
    others = {page for page in PAGES if python_of(page)} - {FIRST, FLEET, *WITH_PYTHON, "docs/conventions.md"}
    assert others == set()


def test_commands_are_in_blocks_that_run() -> None:
    shown = {}
    for page in PAGES:
        text = (ROOT / page).read_text(encoding="utf-8")
        fenced = re.findall(r"^```(\w*)\n(.*?)^```", text, re.MULTILINE | re.DOTALL)
        shown[page] = [
            block for kind, block in fenced if kind != "sh" and re.search("^calgraph ", block, re.MULTILINE)
        ]
    # That of a robot's bridge is replayed by another test.
    assert {page for page, found in shown.items() if found} == {LIVE}


def test_the_fleet_of_its_page_is_calibrated(reader: Reader) -> None:
    """As one robot of it, whose recording is that of the quick start."""
    text = (ROOT / FLEET).read_text(encoding="utf-8")
    (described,) = re.findall(r"^```yaml\n(.*?)^```", text, re.MULTILINE | re.DOTALL)
    robots = described.index("  amr-02")
    (reader.folder / "fleet.yaml").write_text(described[:robots], encoding="utf-8")
    for place, made in (
        ("rigs/amr-01.yaml", "robot/rig.yaml"),
        ("data/amr-01/march.mcap", "robot/recording/*.mcap"),
    ):
        (reader.folder / place).parent.mkdir(parents=True, exist_ok=True)
        (source,) = reader.folder.glob(made)
        shutil.copy(source, reader.folder / place)
    run(FLEET, reader.folder)
    run_python(FLEET, reader.folder)
    assert (reader.folder / "fleet/index.html").is_file()


@pytest.mark.timeout(600)
def test_a_rehearsal_takes_the_capture_of_every_place(live_reader: Reader) -> None:
    # On a slow machine, a replay may skip some.
    assert PLACES / 2 < live_reader.printed.count("\nCapture ") <= PLACES


@pytest.mark.timeout(600)
def test_the_recording_of_a_rehearsal_gives_the_same_result(live_reader: Reader) -> None:
    session, repeated = (
        (live_reader.folder / name / "residuals.csv").read_bytes() for name in ("rehearsal/result", "repeated")
    )
    assert session == repeated


@pytest.mark.timeout(600)
def test_a_session_runs_as_the_live_page_states(reader: Reader) -> None:
    """A replay as fast as nothing is skipped is in place of the robot."""
    (command,) = re.findall(r"^calgraph live .*ws://.*$", (ROOT / LIVE).read_text("utf-8"), re.MULTILINE)
    replay = runnable(command).replace("ws://robot:8765", "robot/recording --speed 0")
    assert "?token=" in run_block(replay, reader.folder, LIVE)
    assert (reader.folder / "session/result/report.html").is_file()


@pytest.mark.timeout(600)
@pytest.mark.parametrize("page", [page for page in PAGES if page not in (FIRST, LIVE, FLEET) and blocks(page)])
def test_commands_run(page: str, reader: Reader) -> None:
    run(page, reader.folder)
