"""calgraph calibrate --dump and calgraph solve: the same result without the recording."""

import subprocess
import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from typer.testing import Result

from calgraph.config import load_rig
from calgraph.errors import Rejected
from calgraph.result import load_calibration
from calgraph.rig.bundle.problem_file import load_problem, save_problem
from written_results import read_without_provenance

pytestmark = pytest.mark.slow

Run = Callable[..., Result]

RESULTS = ("calibration.yaml", "budget.csv", "captures.csv", "rig.resolved.yaml")
PICTURES = ("report.html", "residuals.csv", "scene.npz")
"""What shows images, scans and clouds, which a dumped problem does not keep."""


@pytest.fixture(scope="module")
def dumped(simulated: Path, tmp_path_factory: pytest.TempPathFactory, run: Run) -> Path:
    """The folder that ``calibrate --dump`` wrote, the dump among the results; not to be changed."""
    out = tmp_path_factory.mktemp("dumped") / "result"
    result = run(
        "calibrate", simulated / "rig.yaml", simulated / "recording", "-o", out, "--dump", out / "problem.npz"
    )
    assert result.exit_code == 0, result.output
    return out


@pytest.fixture(scope="module")
def solved(dumped: Path, tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, str]:
    """The folder that ``solve --json`` wrote in another process, and what it printed."""
    out = tmp_path_factory.mktemp("solved") / "again"
    code = "from calgraph.cli import main; main()"
    arguments = ["solve", str(dumped / "problem.npz"), "-o", str(out), "--json"]
    done = subprocess.run([sys.executable, "-c", code, *arguments], check=True, capture_output=True, text=True)
    return out, done.stdout


@pytest.fixture(scope="module")
def solved_as_in_the_paper(dumped: Path, tmp_path_factory: pytest.TempPathFactory, run: Run) -> Path:
    """The folder that ``solve --estimator hypergraph`` wrote."""
    out = tmp_path_factory.mktemp("paper") / "poses"
    assert run("solve", dumped / "problem.npz", "-o", out, "--estimator", "hypergraph").exit_code == 0
    return out


def test_another_process_writes_the_same_bytes(dumped: Path, solved: tuple[Path, str]) -> None:
    assert [
        n for n in RESULTS if read_without_provenance(solved[0] / n) != read_without_provenance(dumped / n)
    ] == []


def test_another_process_finds_the_same_in_all_digits(
    calibrated: tuple[Path, Result], solved: tuple[Path, str]
) -> None:
    """JSON has poses and covariances to the last bit."""
    assert solved[1] == calibrated[1].stdout


def test_dumping_changes_nothing(dumped: Path, calibrated: tuple[Path, Result]) -> None:
    names = (*RESULTS, *PICTURES)
    pairs = [(calibrated[0] / name, dumped / name) for name in names]
    assert [a for a, b in pairs if read_without_provenance(a) != read_without_provenance(b)] == []


def test_the_filter_may_be_another_one(dumped: Path, tmp_path: Path, run: Run) -> None:
    problem = load_problem(dumped / "problem.npz")
    fewer = {
        names: replace(pair, inliers=pair.inliers & (pair.matches[:, 0] > 0))
        for names, pair in problem.pairs.items()
        if not isinstance(pair, Rejected)
    }
    save_problem(replace(problem, pairs=fewer), tmp_path / "fewer.npz")
    run("solve", tmp_path / "fewer.npz", "-o", tmp_path / "a")
    run("solve", tmp_path / "fewer.npz", "-o", tmp_path / "b", "--filter", "none")
    few, all_of_them = (
        load_calibration(tmp_path / n / "calibration.yaml").transform("lidar", "camera") for n in "ab"
    )
    assert not np.array_equal(few, all_of_them)


def test_the_other_estimator_repeats_to_the_last_bit(
    simulated: Path, solved_as_in_the_paper: Path, tmp_path: Path, run: Run
) -> None:
    rig, recording, name = simulated / "rig.yaml", simulated / "recording", "calibration.yaml"
    run("calibrate", rig, recording, "-o", tmp_path / "a", "--estimator", "hypergraph")
    a, b = (read_without_provenance(folder / name) for folder in (tmp_path / "a", solved_as_in_the_paper))
    assert a == b


def test_the_result_states_its_estimator(dumped: Path, solved_as_in_the_paper: Path) -> None:
    folders = {"bundle": dumped, "hypergraph": solved_as_in_the_paper}
    for estimator, folder in folders.items():
        assert load_calibration(folder / "calibration.yaml").evidence.estimator == estimator


def test_the_result_has_the_covariance_of_two_sensors(dumped: Path) -> None:
    found = load_calibration(dumped / "calibration.yaml")
    deviations = np.sqrt(np.diag(found.covariance("camera", "laser_front")))
    assert ((deviations > 1e-5) & (deviations < 0.03)).all()
    np.testing.assert_allclose(found.covariance("lidar", "camera"), found["camera"].covariance, rtol=1e-7)


def test_the_filter_of_the_calibration_is_stored(simulated: Path, tmp_path: Path, run: Run) -> None:
    dump = tmp_path / "problem.npz"
    run(
        "calibrate", simulated / "rig.yaml", simulated / "recording", "-o", tmp_path / "out",
        "--filter", "none", "--dump", dump,
    )  # fmt: skip
    assert load_problem(dump).solver.keep == "none"


def test_a_place_without_folder_is_refused_before_the_recording_is_read(
    simulated: Path, tmp_path: Path, run: Run
) -> None:
    dump = tmp_path / "none" / "problem.npz"
    result = run("calibrate", simulated / "rig.yaml", tmp_path / "missing", "-o", tmp_path / "out", "--dump", dump)
    assert (result.exit_code, result.stderr) == (2, f"calgraph: {dump}: its folder does not exist\n")


def test_a_network_has_no_problem_to_dump(tmp_path: Path, simulated: Path, run: Run) -> None:
    rig = tmp_path / "rig.yaml"
    rig.write_text(
        "root: a\ntarget: {kind: people}\nsensors:\n  a: {kind: lidar2d, topic: /laser_front/scan}\n"
        "  b: {kind: lidar2d, topic: /lidar/points}\n"
    )
    result = run("calibrate", rig, simulated / "recording", "-o", tmp_path / "out", "--dump", tmp_path / "p.npz")
    assert result.exit_code == 2
    assert result.stderr.startswith("calgraph: --dump: only for rigs with a board")


def test_what_is_no_dump_is_bad_input(dumped: Path, tmp_path: Path, run: Run) -> None:
    result = run("solve", dumped / "calibration.yaml", "-o", tmp_path / "out")
    assert result.exit_code == 2
    assert result.stderr.startswith(f"calgraph: {dumped / 'calibration.yaml'}: ")
    assert not (tmp_path / "out").exists()


def test_sensors_that_calibrate_could_not_connect_are_named_again(
    simulated: Path, tmp_path: Path, run: Run
) -> None:
    rig = tmp_path / "rig.yaml"
    rig.write_text((simulated / "rig.yaml").read_text().replace("tag36h11", "tag25h9"))
    dump = tmp_path / "problem.npz"
    first = run("calibrate", rig, simulated / "recording", "-o", tmp_path / "a", "--dump", dump)
    second = run("solve", dump, "-o", tmp_path / "b")
    assert (second.exit_code, second.stderr) == (1, first.stderr)
    assert (tmp_path / "a/captures.csv").read_bytes() == (tmp_path / "b/captures.csv").read_bytes()


def test_systematic_errors_are_estimated_besides_poses(solved: tuple[Path, str]) -> None:
    estimated = load_calibration(solved[0] / "calibration.yaml").systematic
    assert {"range bias", "range scale", "focal length", "cy", "print scale"} <= {
        one.quantity for one in estimated
    }
    assert "range bias" in (solved[0] / "report.html").read_text(encoding="utf-8")


def test_the_papers_estimator_estimates_poses_only(solved_as_in_the_paper: Path) -> None:
    assert load_calibration(solved_as_in_the_paper / "calibration.yaml").systematic == ()


def test_the_published_method_is_solved_again_and_then_by_the_joint_one(
    simulated: Path, tmp_path: Path, run: Run
) -> None:
    """The paper's tags are used in the detections, which solve does not change."""
    rig, recording, dump = simulated / "rig.yaml", simulated / "recording", tmp_path / "problem.npz"
    arguments = ("--estimator", "published", "--set", "published.keep=none", "--dump", dump)
    assert run("calibrate", rig, recording, "-o", tmp_path / "a", *arguments).exit_code == 0
    solver = load_problem(dump).solver
    assert (solver.estimator, solver.keep) == ("hypergraph", "none")
    assert run("solve", dump, "-o", tmp_path / "b").exit_code == 0
    assert run("solve", dump, "-o", tmp_path / "c", "--estimator", "joint").exit_code == 0
    first, again, joint = (load_calibration(tmp_path / name / "calibration.yaml") for name in "abc")
    assert [one.evidence.estimator for one in (first, again, joint)] == ["hypergraph", "hypergraph", "bundle"]
    np.testing.assert_array_equal(first["camera"].T_root_sensor, again["camera"].T_root_sensor)
    settings = [load_rig(tmp_path / name / "rig.resolved.yaml").settings.published for name in "abc"]
    assert [one.keep for one in settings] == ["none", "none", None]


def test_settings_of_networks_are_refused(dumped: Path, tmp_path: Path, run: Run) -> None:
    result = run("solve", dumped / "problem.npz", "-o", tmp_path / "out", "--set", "published.icp=false")
    assert (result.exit_code, result.stderr) == (2, "calgraph: published.icp: only for networks\n")
