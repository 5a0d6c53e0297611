"""The benchmark of reliability: a sample of its cases, what it counts as wrong, and the tables of its page."""

import shutil
import signal
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from reliability import (
    COLUMNS,
    ROWS,
    Answer,
    Ending,
    Outcome,
    attempt,
    find_left,
    format_table,
    judge_ending,
    judge_recording,
    judge_result,
    run,
)
from reliability_messages import FORMS, MESSAGE_DAMAGE, Source, simulate_source, write_rig

pytestmark = pytest.mark.slow

PAGE = Path(__file__).resolve().parents[1] / "docs" / "reliability.md"
PEACEFUL = Ending(0, "", "", 1.0, 2**28, hung=False, orphans=0)
FAST = "calibrate", "rig.yaml", "recording", "-o", "out", "--folds", "0", "--jobs", "1"


@pytest.fixture(scope="module")
def source(tmp_path_factory: pytest.TempPathFactory) -> Source:
    return simulate_source(tmp_path_factory.mktemp("reliability") / "source", seed=0)


@pytest.fixture(scope="module")
def result(source: Source, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A right result; not to be changed."""
    folder = tmp_path_factory.mktemp("result")
    (folder / "recording").symlink_to(source.folder / "recording")
    write_rig(folder / "rig.yaml", source.rig)
    assert run(FAST, folder).code == 0
    return folder / "out"


@pytest.mark.parametrize(
    ("kind", "form", "answer"),
    [
        ("half of the clouds empty", "MCAP", Answer.RIGHT),
        ("topic without messages", "SQLite", Answer.REFUSED),
        ("clouds that contradict themselves", "ROS 1 bag", Answer.REFUSED),
        ("topics of another type", "plain folder, NPZ", Answer.REFUSED),
    ],
)
def test_damaged_messages(source: Source, tmp_path: Path, kind: str, form: str, answer: Answer) -> None:
    items = MESSAGE_DAMAGE[kind](source.items, np.random.default_rng(1))
    recording = FORMS[form](tmp_path / "recording", items)
    judged = judge_recording(source, form, recording, tmp_path, 0)
    assert judged.answer is answer, judged.detail


def cut_off(file: Path, rng: np.random.Generator) -> None:
    data = file.read_bytes()
    file.write_bytes(data[: int(rng.uniform(0.2, 0.95) * len(data))])


def change_bytes(file: Path, rng: np.random.Generator) -> None:
    """Of the first kilobytes, where headers are."""
    data = bytearray(file.read_bytes())
    for place in rng.integers(min(len(data), 4096), size=30):
        data[place] = rng.integers(256)
    file.write_bytes(data)


@pytest.mark.parametrize("form", ["MCAP", "SQLite", "ROS 1 bag"])
@pytest.mark.parametrize("damage", [cut_off, change_bytes])
def test_damaged_recordings_are_calibrated_or_refused(
    source: Source, tmp_path: Path, form: str, damage: Callable[[Path, np.random.Generator], None]
) -> None:
    recording = FORMS[form](tmp_path / "recording", source.items)
    files = [recording] if recording.is_file() else [file for file in recording.rglob("*") if file.is_file()]
    damage(max(files, key=lambda file: file.stat().st_size), np.random.default_rng(1))
    judged = judge_recording(source, form, recording, tmp_path, 0)
    assert not judged.answer.is_wrong, judged


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("damage", [cut_off, change_bytes])
def test_a_damaged_rig_is_used_or_refused(
    source: Source, tmp_path: Path, seed: int, damage: Callable[[Path, np.random.Generator], None]
) -> None:
    (tmp_path / "recording").symlink_to(source.folder / "recording")
    write_rig(tmp_path / "rig.yaml", source.rig)
    damage(tmp_path / "rig.yaml", np.random.default_rng(seed))
    judged = judge_ending(run(FAST, tmp_path), ["rig.yaml"])
    assert judged is None or not judged.answer.is_wrong, judged


@pytest.mark.parametrize(
    ("ending", "answer"),
    [
        (replace(PEACEFUL, code=2, stderr="calgraph: rig.yaml: is empty\n"), Answer.REFUSED),
        (replace(PEACEFUL, code=2, stderr="calgraph: something is wrong\n"), Answer.SILENT),
        (replace(PEACEFUL, code=1), Answer.SILENT),
        (replace(PEACEFUL, code=1, stderr="Traceback (most recent call last):\nKeyError: 3"), Answer.TRACEBACK),
        (replace(PEACEFUL, code=-signal.SIGSEGV), Answer.CRASH),
        (replace(PEACEFUL, code=3), Answer.CRASH),
        (replace(PEACEFUL, hung=True, code=-9), Answer.HANG),
        (replace(PEACEFUL, peak=2**31), Answer.MEMORY),
        (replace(PEACEFUL, orphans=1), Answer.LEFT),
        (replace(PEACEFUL, stderr="RuntimeWarning: invalid value"), Answer.FOREIGN),
    ],
)
def test_ends_are_judged(ending: Ending, answer: Answer) -> None:
    judged = judge_ending(ending, ["rig.yaml"])
    assert judged is not None
    assert judged.answer is answer


def test_results_are_judged_by_the_ground_truth(source: Source, result: Path, tmp_path: Path) -> None:
    assert judge_result(result, source.truth).answer is Answer.RIGHT
    off = {name: T.copy() for name, T in source.truth.T_root_sensor.items()}
    off["camera"][0, 3] += 1.0
    wrong = replace(source.truth, T_root_sensor=off)
    assert judge_result(result, wrong).answer is Answer.CONFIDENT
    half = shutil.copytree(result, tmp_path / "half")
    (half / "scene.npz").unlink()
    assert judge_result(half, source.truth).answer is Answer.HALF
    (tmp_path / ".out.1234.tmp").touch()
    assert len(find_left(tmp_path)) == 1


def test_processes_that_are_left_are_counted_and_ended(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("reliability._LONGEST_END", 0.2)
    ending = run(["-c", "sleep 600 & echo $!"], tmp_path, program=["sh"])
    assert ending.orphans == 1
    status = Path(f"/proc/{ending.stdout.strip()}/stat")
    assert not status.exists() or status.read_text().split()[2] in "ZX"


def tables() -> list[list[list[str]]]:
    """The cells of the tables of numbers on the page."""
    found: list[list[list[str]]] = []
    lines = PAGE.read_text(encoding="utf-8").splitlines()
    for before, line in zip(["", *lines], lines, strict=False):
        if not line.startswith("|"):
            continue
        cells = [cell.strip() for cell in line.strip("|").split("|")]
        if not before.startswith("|"):
            found.append([])
        found[-1].append(cells)
    return [table for table in found if "tried" in table[0]]


def test_the_page_has_tables_as_the_script_prints_them() -> None:
    layouts = {(head, *COLUMNS): set(rows) for head, rows in ROWS.items()}
    found = {tuple(head): (head, rows) for head, _, *rows in tables()}
    assert found.keys() & layouts.keys()
    for head, (_, rows) in found.items():
        assert {row[0] for row in rows[:-1]} <= layouts.get(head, {row[0] for row in rows})
        counts = np.array([[int(cell) for cell in row[1:]] for row in rows])
        assert rows[-1][0] == "**all**"
        np.testing.assert_array_equal(counts[:-1].sum(axis=0), counts[-1])
        np.testing.assert_array_equal(counts[:, 0], counts[:, 1:].sum(axis=1))


def test_tables_have_a_row_for_each_kind_and_their_sum() -> None:
    outcomes = [
        Outcome(kind, "MCAP", seed, answer.name, "")
        for kind in ("stamps jump", "stamps 0")
        for seed, answer in enumerate([Answer.RIGHT, Answer.LEFT])
    ]
    assert format_table(outcomes, "damage of the recording").splitlines() == [
        "| damage of the recording | tried | right | weak | refused | wrong |",
        "| --- | ---: | ---: | ---: | ---: | ---: |",
        "| stamps 0 | 2 | 1 | 0 | 0 | 1 |",
        "| stamps jump | 2 | 1 | 0 | 0 | 1 |",
        "| **all** | 4 | 2 | 0 | 0 | 2 |",
    ]


def test_a_case_has_the_same_damage_whenever_it_is_tried(source: Source) -> None:
    outcomes = [attempt("topic missing", "SQLite", 1, source.folder, None) for _ in range(2)]
    assert outcomes[0] == outcomes[1]
    assert outcomes[0].answer == "RIGHT"
